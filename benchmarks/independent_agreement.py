"""Check whether arms of another simulator move like those of independent_arms.py under the same commands.

`python benchmarks/independent_agreement.py FOLDER ...` takes arms with a truth.json, cuts their training motion into
windows of 0.1 s in which all joints slide, starts each from the measured state and replays its commands. The
remaining error must be what noise of the start states grows to: same as on arms of independent_arms.py itself.
"""

import json
import sys
from pathlib import Path

import numpy as np
from independent_arms import friction, make_arm
from independent_dynamics import HISTORY, LUGRE, State, cycle
from numba import njit
from scipy.signal import savgol_filter

STEPS, LOCAL, SLIDES = 100, 31, 0.05  # ms, ms, rad/s
BEFORE = 40  # ms of earlier commands: 20 times the longest lag


@njit(cache=True)
def replay(arm, state, tau, out):
    """Fill out (T, N) rad with the angles before each command tau (T, N) Nm."""
    for k in range(len(tau)):
        out[k] = state.q
        cycle(arm, state, tau[k])


def sliding(arm, truth: dict, q: np.ndarray, dq: np.ndarray, tau: np.ndarray) -> State:
    """Return an arm sliding at q, dq (7,) after commands tau (BEFORE, 7), bristles in steady state."""
    bristle, drive = np.zeros(7), tau[0].copy()
    if arm.kind == LUGRE:
        viscous = np.where(dq > 0, truth["friction"]["fv_pos"], truth["friction"]["fv_neg"]) * dq
        bristle = (friction(truth, dq) - viscous) / arm.law[:, 7]
    standing = State(
        q.copy(), np.zeros(7), bristle, np.ones(7, int), np.ones(7), np.ones(7), drive, np.empty((HISTORY, 7))
    )
    standing.line[:] = tau[0]
    frozen = arm._replace(kind=0, low=np.full(7, -1e9), high=np.full(7, 1e9))  # only delay and lag advance
    for u in tau:
        cycle(frozen, standing, u)
    moving = standing._replace(dq=dq.copy(), stuck=np.zeros(7, int), way=np.sign(dq))
    return moving


def agreement(folder: Path) -> tuple[int, np.ndarray]:
    """Return the number of windows and the RMS error (7,) rad of angles after 0.1 s."""
    truth = json.loads((folder / "truth.json").read_text())
    arm = make_arm(truth)
    with np.load(folder / "train.npz") as z:
        q, tau = z["q"], z["tau_J_d"].astype(float)
    smooth, dq = (savgol_filter(q, LOCAL, 3, deriv, 1e-3, axis=0) for deriv in (0, 1))
    slides, errors, out = (np.abs(dq) > SLIDES).all(1), [], np.empty((STEPS, 7))
    for k in range(BEFORE, len(q) - STEPS, STEPS // 2):
        if slides[k - LOCAL // 2 : k + STEPS].all():
            replay(arm, sliding(arm, truth, smooth[k], dq[k], tau[k - BEFORE : k]), tau[k : k + STEPS], out)
            errors.append(out[-1] - q[k + STEPS - 1])
    return len(errors), np.sqrt((np.array(errors) ** 2).mean(0))


def main() -> None:
    """Print the errors of each arm."""
    for folder in sys.argv[1:]:
        count, error = agreement(Path(folder))
        print(f"{Path(folder).name}: {count} windows, mrad {np.round(1e3 * error, 3).tolist()}", flush=True)


if __name__ == "__main__":
    main()
