"""Choose the stiction model of joints at rest and, if no ramps were recorded, the breakaway torques.

r2s tries every stiction model and a grid of breakaway torques, because the replay error has no useful gradient.
"""

from dataclasses import replace
from functools import partial

import numpy as np

from r2s.identification.parameters import parameter_space
from r2s.identification.problem import Report
from r2s.identification.residuals.replay_residual import ReplayResidual
from r2s.identification.residuals.windows import cut_windows, replay, windows_or_none
from r2s.physics.dynamics import CREEP, STICTION_MODELS, Dynamics
from r2s.physics.robot import Robot
from r2s.recordings.recording import Recording

HORIZON, WINDOWS = 0.5, 60  # length (s, enough for stops) and number of the replays that choose a model
SCAN_WINDOWS, PASSES, COARSE = 50, 6, 2  # in `scan_breakaway`: windows, passes, and how many passes are coarse
SCAN_BATCH = 12  # candidates replayed at once, with 50 windows each; 36 would need three times the memory
LEAST = 5e-4  # the scan range assumes at least this friction, relative to tau_max
POINTS, FINE_POINTS, REFINE = 13, 2, 2.5  # points of a coarse pass; points per side and step divisor of a fine pass


def choose_stiction(
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
    """Return {"model": index in STICTION_MODELS, "dq_min": rad/s, "breakaway": (n, 2) Nm}, fitted to replayed stops.

    largest: largest breakaway torque of the scan, relative to the identified friction. If `largest` is None, r2s does
    not scan, because ramps determine the breakaway torques. If all trajectories are shorter than a window, the values
    of `dynamics` are returned.
    """
    windows = windows_or_none(recording, HORIZON, WINDOWS)
    scanned = largest is None or windows_or_none(recording, window_s, 1) is not None
    if windows is None or not scanned:
        present = float(STICTION_MODELS.index(dynamics.stiction_model))
        return {"model": present, "dq_min": dynamics.dq_min, "breakaway": dynamics.breakaway}
    scan = partial(scan_breakaway, window_s=window_s, stride=stride, nthread=nthread, report=report)
    trials = []
    for model in STICTION_MODELS:
        dq_min = dynamics.dq_min if model == "command" else min(dynamics.dq_min, CREEP)
        trial = replace(dynamics, stiction_model=model, dq_min=dq_min)
        if largest is not None:  # the best breakaway torques depend on the stiction model
            friction = np.maximum(dynamics.level, np.abs(dynamics.family.at_rest(dynamics.phi)).max(-1))
            limit = largest * np.maximum(friction, LEAST * robot.tau_max)
            trial = replace(trial, breakaway=scan(robot, trial, recording, limit))
        trials.append(trial)
    error = np.stack([np.abs(replay(robot, t, windows, nthread) - windows.q).mean((0, 1)) for t in trials])
    best = int((error / error.mean(0)).sum(1).argmin())
    chosen = trials[best]
    return {"model": float(best), "dq_min": chosen.dq_min, "breakaway": chosen.breakaway}


def scan_breakaway(
    robot: Robot,
    dynamics: Dynamics,
    recording: Recording,
    largest: np.ndarray,
    *,
    window_s: float,
    stride: int,
    nthread: int,
    report: Report,
) -> np.ndarray:
    """Return the breakaway torques (n, 2) Nm with which `dynamics` replays the recording best.

    A gradient search would fail, because the replay error jumps if a joint starts to slide one step sooner. In each
    pass, a candidate changes the breakaway torque of one joint, and r2s minimizes the replay error of this joint.
    Coarse passes scan from 0 to `largest` (n,) Nm; fine passes refine the best value. The second coarse pass is
    necessary, because joints affect each other.
    """
    space = parameter_space(
        robot, dynamics, {"breakaway_negative": [-largest, 0.0], "breakaway_positive": [0.0, largest]}
    )
    windows = cut_windows(recording, window_s, limit=SCAN_WINDOWS)
    data = ReplayResidual(space, recording, windows, stride=stride, batch=SCAN_BATCH, nthread=nthread)
    x, most = space.start, np.tile(largest, 2)[:, None]
    step = most / (POINTS - 1)
    sign = np.repeat([-1.0, 1.0], robot.n)
    joint = np.tile(np.arange(robot.n), 2)
    evaluations = 1 + 3 * robot.n  # replays for the residual's weights, see `ReplayResidual`
    for k in range(PASSES):
        coarse = k < COARSE
        offsets = most * np.linspace(0, 1, POINTS) if coarse else step * np.arange(-FINE_POINTS, FINE_POINTS + 1)
        base = np.zeros_like(x) if coarse else x
        trials = np.clip(base[:, None] + sign[:, None] * offsets, space.lower[:, None], space.upper[:, None])
        candidates = np.repeat(x[None], trials.size, axis=0).reshape(*trials.shape, -1)
        candidates[np.arange(len(x)), :, np.arange(len(x))] = trials
        cost = data.joint_error(candidates.reshape(-1, len(x))).reshape(*trials.shape, robot.n)
        own = np.take_along_axis(cost, joint[:, None, None], axis=2)[..., 0]
        x = trials[np.arange(len(x)), own.argmin(1)]
        step = step / (1 if coarse else REFINE)
        evaluations += trials.size
        row = {"pass": k + 1, "evaluations": evaluations, "done": k + 1, "total": PASSES}
        report(row | {"search": "breakaway"})
    return x.reshape(2, robot.n).T
