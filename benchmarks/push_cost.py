"""Cost of the limit of pushes in a cycle of the driver, beside the cycle without it, interleaved in one process.

python benchmarks/push_cost.py    prints us per cycle and arm, the median of the fastest tenth of the rounds
"""

import sys
import time
from dataclasses import replace

import numpy as np
from common import NEW, ROBOT

from r2s.arm.driver import DriverBatch
from r2s.physics.push_limit import PushLimit
from r2s.physics.surface import load_tool
from r2s.physics.tip import Tip
from r2s.tasks.press import PressTask

ARMS, CYCLES, ROUNDS = 64, 20, 200


def main() -> None:
    """Measure drivers far from the plane, near it, with a push that the limit cuts, and beyond bounds of joints."""
    robot = replace(ROBOT, tool=load_tool("r2s:models/press_tool.json"))
    point, up = PressTask().plane(robot)
    torque, rng = 0.3 * robot.tau_max, np.random.default_rng(0)
    starts = PressTask().goals(robot, rng, ARMS)[:, 9:]
    inwards = -np.array([up @ Tip(robot)(q)[1] for q in starts])
    near = PushLimit(30.0, 0.03, point, up, 5e-3, np.radians(5.0))
    still = 0.01 * rng.standard_normal((ARMS, robot.n))
    fast = 0.7 * robot.dq_max * rng.uniform(-1.0, 1.0, (ARMS, robot.n))  # some joints are beyond their bounds
    cases = {  # limit, N of the push, and speeds
        "without": (None, 5.0, still), "far": (replace(near, point=point - up), 5.0, still),
        "near": (near, 5.0, still), "without, full push": (None, 150.0, still), "full push": (near, 150.0, still),
        "without, at bounds": (None, 150.0, fast), "at bounds": (near, 150.0, fast),
    }  # fmt: skip
    drivers = {
        name: (DriverBatch(robot, torque, ARMS, friction=NEW.level, push_limit=limit), push * inwards, dq)
        for name, (limit, push, dq) in cases.items()
    }
    last, spent = np.zeros((ARMS, robot.n)), {name: [] for name in cases}
    for _ in range(ROUNDS):
        for name, (driver, command, dq) in drivers.items():
            began = time.perf_counter()
            for _ in range(CYCLES):
                driver(starts, dq, last, command)
            spent[name].append(1e6 * (time.perf_counter() - began) / CYCLES / ARMS)
    for name, values in spent.items():
        fast = np.sort(values)[: ROUNDS // 10]
        print(f"{name:20} {np.median(fast):6.2f} us")


if __name__ == "__main__":
    sys.exit(main())
