"""What holds a joint at rest: whose torque its edges are of, and the edges, from a recording.

A scan, because the error has no gradient by them.
"""

from dataclasses import replace
from functools import partial

import numpy as np

from r2s.identification.parameters import parameter_space
from r2s.identification.problem import Report
from r2s.identification.replay_residual import ReplayResidual
from r2s.identification.windows import cut_windows, replay
from r2s.physics.dynamics import HOLDS, Dynamics
from r2s.physics.robot import Robot
from r2s.recordings.recording import Recording

CREEP = 2e-3  # rad/s, below which stiction may hold: above what a step of 1 ms leaves of a stop, below any motion
HORIZON = 0.5  # s, of the replays that a rule is chosen by: long enough for stops


def stiction(
    robot: Robot,
    dynamics: Dynamics,
    recording: Recording,
    largest: float | None,
    report: Report,
    *,
    window_s: float,
    stride: int,
    nthread: int,
) -> dict[str, np.ndarray | float]:
    """Return the rule that holds joints at rest, {"hold": its place in HOLDS, "dq_min": rad/s, "edges": (n, 2) Nm}.

    Of the paper's rule and of stiction that one is kept which replays the recording's stops better. `largest` and
    the others: see `scan_breakaway`.
    """
    scan = partial(scan_breakaway, window_s=window_s, stride=stride, nthread=nthread, report=report)
    trials = []
    for hold in HOLDS:
        dq_min = dynamics.dq_min if hold == "command" else min(dynamics.dq_min, CREEP)
        trial = replace(dynamics, hold=hold, dq_min=dq_min)
        if largest is not None:  # not measured: each rule gets its own
            trial = replace(trial, breakaway=scan(robot, trial, recording, largest))
        trials.append(trial)
    windows = cut_windows(recording, HORIZON, limit=60)
    error = np.stack([np.abs(replay(robot, t, windows, nthread) - windows.q).mean((0, 1)) for t in trials])
    best = int((error / error.mean(0)).sum(1).argmin())
    chosen = trials[best]
    return {"hold": float(best), "dq_min": chosen.dq_min, "edges": chosen.breakaway}


def scan_breakaway(
    robot: Robot,
    dynamics: Dynamics,
    recording: Recording,
    largest: float,
    *,
    window_s: float,
    stride: int,
    nthread: int,
    report: Report,
) -> np.ndarray:
    """Return the edges (n, 2) Nm of the dead zone that replay the recording best, everything else as in `dynamics`.

    The error jumps where a joint is held or let go one step sooner, so there is no gradient: each edge is scanned
    over [0, largest], all edges at once and each judged by its own joint, then again about the best, ever finer.
    The coarse scan is done twice, because an edge looks different while the others are wrong.
    """
    space = parameter_space(
        robot, dynamics, {"breakaway_negative": [-largest, 0.0], "breakaway_positive": [0.0, largest]}
    )
    data = ReplayResidual(
        robot, space, recording, window_s=window_s, stride=stride, slowest=0.0, limit=50, nthread=nthread
    )
    x, step, coarse, passes = space.start, largest / 12, 2, 6
    sign = np.repeat([-1.0, 1.0], robot.n)
    joint = np.tile(np.arange(robot.n), 2)
    for k in range(passes):
        offsets = np.linspace(0, largest, 13) if k < coarse else step * np.arange(-2, 3)
        base = np.zeros_like(x) if k < coarse else x
        trials = np.clip(base[:, None] + sign[:, None] * offsets, space.lower[:, None], space.upper[:, None])
        candidates = np.repeat(x[None], trials.size, axis=0).reshape(*trials.shape, -1)
        candidates[np.arange(len(x)), :, np.arange(len(x))] = trials
        cost = data.joint_error(candidates.reshape(-1, len(x))).reshape(*trials.shape, robot.n)
        own = np.take_along_axis(cost, joint[:, None, None], axis=2)[..., 0]
        x = trials[np.arange(len(x)), own.argmin(1)]
        step /= 1 if k < coarse else 2.5
        row = {"pass": k + 1, "evaluations": data.candidates, "done": k + 1, "total": passes}
        report(row | {"search": "breakaway"})
    return x.reshape(2, robot.n).T
