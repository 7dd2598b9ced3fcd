"""r2s: from recordings of a torque-controlled arm to a policy that works on that arm.

Each folder is a room; data flows through them in this order: recordings, excitation, identification, tasks, learning,
engines, arm, reporting, with physics under all of them and stages on top. A module imports only from its own room and
from rooms before it (tests/test_rooms.py). docs/architecture.md says what each room holds.
"""
