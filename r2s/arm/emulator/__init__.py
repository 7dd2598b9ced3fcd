"""An emulated Franka control box, to which libfranka's clients connect as to a real box."""
