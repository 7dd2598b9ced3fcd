"""r2s: from recordings of a torque-controlled arm to a policy that works on that arm.

Each folder or file of r2s is called a room. The rooms `recordings`, `excitation`, `identification`, `tasks`,
`learning`, `engines`, `arm` and `reporting` process data, with functions from the rooms `physics` and `control`.
A module imports only from its own room and from rooms in higher rows of the table in
docs/explanation/architecture.md; tests/test_rooms.py checks the imports.
"""
