"""r2s: from recordings of a torque-controlled arm to a policy that works on that arm.

Each folder is a room. Data flow through recordings, excitation, identification, tasks, learning, engines, arm and
reporting. The rooms physics and control lie below these, and stages on top. A module imports only from its own room
and from rooms before it (tests/test_rooms.py). docs/explanation/architecture.md describes the rooms.
"""
