"""r2s: from recordings of a torque-controlled arm to a policy that works on that arm.

Read bottom-up: recording, robot, friction, parameters, simulator (data and physics);
randomization, residual, identify, rewards, env (what is done with them); networks, tqc,
train, evaluate (learning); engines, arm (the outside); runs, report, viewer (telling).
A module imports only from floors below its own (tests/test_floors.py checks it).
"""
