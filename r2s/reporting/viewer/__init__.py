"""Write the rerun recording (data and layout), and run the rerun viewer."""
