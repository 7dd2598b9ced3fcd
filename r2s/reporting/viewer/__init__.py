"""The rerun recording: its data, its layout, and the viewer's process."""
