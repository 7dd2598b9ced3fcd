"""Write recordings (data and layout) for the Rerun viewer, and start the viewer."""
