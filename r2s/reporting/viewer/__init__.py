"""Write recordings for the Rerun viewer (data and layout), and run the viewer."""
