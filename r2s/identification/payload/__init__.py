"""The payload of an identified arm: mass, centre and tensor from a loaded recording."""
