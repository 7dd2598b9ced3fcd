"""An emulated Franka control box; libfranka's clients connect to this box as to a real one."""
