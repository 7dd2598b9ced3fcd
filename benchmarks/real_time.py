"""Timing of recordings and of episodes in real time against the emulated arms, on a quiet and on a loaded computer.

    python benchmarks/real_time.py          three motions of each kind, then benchmarks/results/real_time.md

The emulated control box runs at 1 kHz in a process of its own on the same computer, which a real one does not: both
share its cores. Load: a busy loop per core, at normal priority.
"""

import contextlib
import os
from functools import partial

import numpy as np
import pandas as pd
from common import NEW, ROBOT, default_task, markdown, write_page
from safety_campaign import busy

from r2s.adaptation.adapters import AdapterContext, rls
from r2s.arm.clients.emulated import emulated_arm
from r2s.arm.interface import ArmStopped
from r2s.arm.realtime import Timing
from r2s.arm.realtime_process import RealtimeRunner
from r2s.arm.recorder import record
from r2s.arm.warm_up import warm_up
from r2s.excitation.motion import Excitation
from r2s.physics.robot import SIM_DT

MOTIONS, SECONDS = 3, 5.0
TASK = default_task("reach")


def swing() -> Excitation:
    """Return a motion of all joints about home, at up to 0.3 rad/s."""
    t = SIM_DT * np.arange(round(SECONDS / SIM_DT))
    w, ones = np.pi, np.ones(ROBOT.n)
    shapes = 1 - np.cos(w * t), w * np.sin(w * t), w * w * np.cos(w * t)
    q, dq, ddq = (0.1 * x[:, None] * ones for x in shapes)
    return Excitation(t, ROBOT.q_home + q, dq, ddq)


def recordings(client: str) -> Timing:
    """Return the timing of recordings in this process."""
    timing = Timing()
    warm_up(ROBOT)
    with emulated_arm(ROBOT, client=client, realtime=True, operator=None) as arm:
        for _ in range(MOTIONS):
            with contextlib.suppress(ArmStopped):  # less than 99 % in time, which the table shows
                record(arm, swing(), timing=timing)
    return timing


def episodes(client: str) -> Timing:
    """Return the timing of episodes with adapt=rls, with the arm in a process of its own."""
    opened = partial(emulated_arm, ROBOT, client=client, realtime=True, operator=None)
    control, goal = TASK.control(ROBOT), np.array([[0.4, 0.2, 0.4]])
    with RealtimeRunner(opened, ROBOT, TASK, np.ones(ROBOT.n), adapter=rls(AdapterContext(ROBOT, NEW))) as arms:
        for episode in range(MOTIONS):
            state = arms.place(ROBOT.q_home[None], episode)
            for k in range(TASK.steps):
                if state.stopped.all():
                    break
                action = np.full((1, control.action_dim), 0.3 * (-1) ** episode * np.cos(0.12 * k))
                state = arms.step(control.command(action, TASK, state.t, goal))
            arms.end()
        return arms.timing


def main() -> None:
    """Measure, and write the page."""
    tables = []
    for load in (False, True):
        with busy(os.cpu_count() or 1) if load else contextlib.nullcontext():
            for client in ("panda", "fr3"):
                for motion, measure in (("recording", recordings), ("episode, rls", episodes)):
                    table = pd.DataFrame(measure(client).table()).set_index("what")
                    name = f"{motion}, {client}{', loaded' * load}"
                    tables.append(table.rename(index=lambda what, name=name: f"{name}: {what}"))
                    print(tables[-1].to_string(), flush=True)
    text = pd.concat(tables).map(lambda x: "" if pd.isna(x) else f"{x:.4g}")
    write_page(
        "real_time", "Real time", "python benchmarks/real_time.py", [__doc__.split("\n\n", 2)[2], markdown(text)]
    )


if __name__ == "__main__":
    main()
