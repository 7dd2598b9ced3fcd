"""What a model predicts of motion that it was not fitted to: to choose one by, and to judge it.

Nothing leaks: what is left out are whole blocks of time, or of phase where a motion repeats itself.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from r2s.errors import UserError
from r2s.friction import FAMILIES
from r2s.parameters import ParameterSpace, of_family, parameter_space
from r2s.problem import Problem, Report, fit_torque, searched
from r2s.recording import Recording
from r2s.robot import Robot
from r2s.simulator import Dynamics, Simulator
from r2s.torque_residual import TorqueResidual
from r2s.windows import cut_windows, replay

HORIZONS = (0.1, 0.5, 2.0)  # s, open-loop prediction
FAMILY_HZ = 50.0  # rows per second that families are compared on


def left_out(recording: Recording, folds: int) -> list[tuple[Recording, Recording]]:
    """Return (rest, block) for blocks of time, or of phase where the motion repeats itself; 0.1 s apart."""
    clock = recording.t % recording.period if recording.period else recording.t
    edges = np.quantile(clock, np.linspace(0, 1, folds + 1))
    pairs = []
    for low, high in pairwise(edges):
        out = (clock >= low) & (clock <= high)
        near = (clock > low - 0.1) & (clock < high + 0.1)
        pairs.append((recording.select(~near), recording.select(out)))
    return pairs


def compare_families(
    robot: Robot,
    nominal: Dynamics,
    recording: Recording,
    bounds: Mapping[str, Sequence[float]],
    prior: Mapping[str, float],
    terms: Sequence[str],
    folds: int,
    how: Mapping[str, Any],
    report: Report,
) -> dict[str, Any]:
    """Return {"error": (F,) relative to the best, "best": index}: torque predicted on motion left out.

    A family with more parameters has to predict clearly better: by more than one standard error of the difference
    over blocks of half a second (Breiman et al. 1984, the one-standard-error rule).
    """
    how = dict(how) | {"rate_hz": FAMILY_HZ}
    spaces = [searched(robot, of_family(nominal, f.name), bounds, terms, recording) for f in FAMILIES]
    blocks: list[list[np.ndarray]] = [[] for _ in FAMILIES]
    for k, (rest, out) in enumerate(left_out(recording, folds)):
        fit, test = (TorqueResidual(robot, spaces[0], part, **how) for part in (rest, out))
        window = test.clusters[:: robot.n]
        for left, space in zip(blocks, spaces, strict=True):
            own = fit.on(space)
            u = fit_torque(Problem(own, own, prior))
            error = test.on(space).error(space.from_unit(u)[None])[0] ** 2
            left.append(np.stack([error[window == w].mean(0) for w in np.unique(window)]))
        cost = min(float(np.concatenate(left).mean()) for left in blocks)
        report({"search": "family", "evaluations": 0, "cost": cost, "done": k + 1, "total": folds})
    means = [np.concatenate(left) for left in blocks]  # (blocks, n) of each family
    squares = [(m / means[0].mean(0)).sum(1) for m in means]
    mean = np.array([s.mean() for s in squares])
    best = int(mean.argmin())
    for k in np.argsort([len(f.names) for f in FAMILIES], kind="stable"):
        more = squares[k] - squares[best]
        if mean[k] <= mean[best] + more.std() / np.sqrt(len(more)):
            best = int(k)
            break
    return {"error": np.sqrt(mean / mean.min()), "best": best}


def joints_kept(
    robot: Robot,
    space: ParameterSpace,
    recording: Recording,
    prior: Mapping[str, float],
    folds: int,
    how: Mapping[str, Any],
) -> np.ndarray:
    """Return (n,) bool: joints whose refit does not predict left-out motion at least 5 % better (RMSE).

    Published parameters are a strong start on real arms; a refit has to earn its place.
    """
    squared = np.zeros((2, robot.n))
    for rest, out in left_out(recording, folds):
        fit, test = (TorqueResidual(robot, space, part, **how) for part in (rest, out))
        x = space.from_unit(fit_torque(Problem(fit, fit, prior)))
        squared += (test.error(np.stack([x, space.start])) ** 2).sum(1)
    return squared[0] >= 0.9 * squared[1]


def prediction_errors(
    robot: Robot,
    nominal: Dynamics,
    identified: Dynamics,
    recording: Recording,
    *,
    window_s: float,
    cutoff_hz: float,
    nthread: int = 0,
) -> dict:
    """Return one side of summary.json: torque RMSE per joint and, for commanded torque, open-loop errors.

    position_rmse_mrad is over replays of `window_s`; ee_error_mm is the mean end-effector distance after 0.1, 0.5
    and 2 s open loop (horizons that no trajectory reaches are left out).
    """
    space = parameter_space(robot, nominal, {"offset": [-1.0, 1.0]})
    torque = TorqueResidual(robot, space, recording, cutoff_hz=cutoff_hz)
    out: dict = {"rows": len(recording.t), "seconds": recording.duration}
    for name, dynamics in (("", identified), ("nominal_", nominal)):
        error = torque.off(dynamics)
        out[f"{name}torque_rmse_Nm"] = np.sqrt((error**2).mean(0)).tolist()
    if recording.torque == "measured":
        return out
    windows = cut_windows(recording, window_s)
    for name, dynamics in (("", identified), ("nominal_", nominal)):
        error = replay(robot, dynamics, windows, nthread) - windows.q
        out[f"{name}position_rmse_mrad"] = (1e3 * np.sqrt((error**2).mean((0, 1)))).tolist()
        out[f"{name}ee_error_mm"] = _open_loop_ee(robot, dynamics, recording, nthread)
    return out


def _open_loop_ee(robot: Robot, dynamics: Dynamics, recording: Recording, nthread: int) -> dict[str, float]:
    """Return {"0.1": mm, ...}: mean distance between simulated and recorded end effector after each horizon."""
    errors = {}
    for horizon in HORIZONS:
        try:
            windows = cut_windows(recording, horizon, limit=100)
        except UserError:
            continue
        sim = Simulator(robot, dynamics, len(windows.q0), nthread)
        q = replay(robot, dynamics, windows, nthread)[:, -1]
        places = []
        for state in (q, windows.q[:, -1]):
            sim.reset(state, np.zeros_like(state))
            places.append(sim.ee.copy())
        errors[f"{horizon:g}"] = float(1e3 * np.linalg.norm(places[0] - places[1], axis=-1).mean())
    return errors
