"""Define recordings of an arm; read them from files and logs, repair and check them, and write them to files."""
