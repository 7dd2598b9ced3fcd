"""r2s: from recordings of a torque-controlled arm to a policy that works on that arm.

Each folder or file of r2s is called a room. The rooms physics and control provide functions to the rooms that
process data: recordings, excitation, identification, tasks, learning, engines, arm and reporting. A module imports
only from its own room and from rooms in higher rows of the table in docs/explanation/architecture.md;
tests/test_rooms.py checks the imports.
"""
