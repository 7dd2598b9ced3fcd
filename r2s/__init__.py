"""r2s: from recordings of a torque-controlled arm to a policy that works on that arm.

Each folder of r2s is called a room. Data flow through the rooms recordings, excitation, identification, tasks,
learning, engines, arm and reporting, which import from the rooms physics and control. A module imports only from its
own room and from rooms above it in the table of docs/explanation/architecture.md (tests/test_rooms.py).
"""
