"""An emulated control box of a Franka arm, for the real clients: robot model, control cycle, server, process."""
