"""An emulated control box of a Franka arm, for the real clients: wire format, control cycle, server, process."""
