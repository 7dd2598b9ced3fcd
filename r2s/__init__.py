"""r2s: from recordings of a torque-controlled arm to a policy that works on that arm.

Each folder or file of r2s is called a room. A table in docs/explanation/architecture.md describes the rooms.
A module imports only from its own room and from rooms in higher rows of this table; tests/test_rooms.py checks the
imports.
"""
