"""What an identification found, against the truth.json of an arm that was simulated by somebody else.

`judge` compares a run folder of stage=identify with an arm's folder (benchmarks/independent_arms.py has its format);
`plain_regression` is what thirty lines of least squares find of the same recording.

Friction and offset of a sliding joint cannot be told apart where friction has two free levels; their difference can.
It is judged twice: by itself, as the parameters have it, for the arms have nothing else of the kind; and with all
that an identified arm may have beside it (load, drag, gravity that is not compensated), at the mean over the postures
of the training motion, which is what it feels in a simulator.
"""

import json
from pathlib import Path

import numpy as np
from common import ROBOT
from independent_arms import friction
from scipy.signal import butter, filtfilt, savgol_filter
from stick_slip import true_dynamics

from r2s.identification.parameter_file import load_parameters, load_posterior
from r2s.identification.prediction import _open_loop_ee
from r2s.physics.dynamics import Dynamics
from r2s.physics.friction import BRISTLE, COULOMB, SIGMOID, STRIBECK
from r2s.physics.rigid_body import LinkInertia, regressor
from r2s.recordings.readers import read

FAMILY = {"sigmoid": SIGMOID, "coulomb_viscous": COULOMB, "stribeck": STRIBECK, "lugre": BRISTLE}
SLOWEST = 0.05  # rad/s: slower, friction is not judged
FASTEST = 0.95  # quantile of the speeds visited in a direction
SPEEDS, CHECKED = 40, 5  # of a direction: where friction is compared, and where its interval is
POSTURES = 200
WAYS = (1, -1)
REACHED = 5e-3  # rad in its own direction: the ramp got there


def load_truth(folder: Path) -> dict:
    """Return truth.json with arrays for lists."""
    truth = json.loads((folder / "truth.json").read_text())
    return {k: np.array(v) if isinstance(v, list) else v for k, v in truth.items()}


def visited(q: np.ndarray) -> np.ndarray:
    """Return (2, 7) rad/s, the fastest speed that counts in both directions of a motion q (T, 7) rad at 1 kHz."""
    dq = savgol_filter(q, 31, 3, deriv=1, delta=1e-3, axis=0)
    return np.array([[np.quantile(x[x > SLOWEST], FASTEST) for x in way * dq.T] for way in WAYS])


def speeds(top: np.ndarray, count: int) -> np.ndarray:
    """Return (2, count, 7) rad/s with their signs: evenly from SLOWEST to `top` (2, 7), both directions."""
    share = np.linspace(0.0, 1.0, count)[:, None]
    return np.stack([way * (SLOWEST + share * (t - SLOWEST)) for way, t in zip(WAYS, top, strict=True)])


class Pull:
    """What an identified arm has beside links and friction law, at postures q (T, 7) rad: the mean over them."""

    def __init__(self, q: np.ndarray):
        still = np.zeros_like(q)
        self._gravity = regressor(ROBOT, q, still, still, ROBOT.gravity)
        self._nominal = LinkInertia(ROBOT.mass, ROBOT.com, ROBOT.inertia).standard()
        self._load = np.abs(np.einsum("tjkc,kc->tj", self._gravity, self._nominal)).mean(0)
        self._mean = self._gravity.mean(0)
        self._sin, self._cos = np.sin(q).mean(0), np.cos(q).mean(0)

    def constant(self, d: Dynamics) -> np.ndarray:
        """Return (..., 7) Nm that adds to the command."""
        error = LinkInertia(d.mass, d.com, d.inertia).standard() - self._nominal
        drag = d.drag[..., 0] * self._sin + d.drag[..., 1] * self._cos
        return d.offset + drag - np.einsum("jkc,...kc->...j", self._mean, error)

    def load(self, d: Dynamics) -> np.ndarray:
        """Return (..., 7) Nm that adds to friction, whichever way the joint slides."""
        return d.load * self._load


def drags(d: Dynamics, dq: np.ndarray, at: Pull | None = None) -> np.ndarray:
    """Return friction minus offset at dq (..., 7) rad/s, with `at` all that pulls; S dynamics give (S, ..., 7)."""
    if d.phi.ndim > 2:
        return np.stack([drags(d.one(k), dq, at) for k in range(len(d.phi))])
    if at is None:
        return d.friction(dq) - d.offset
    return d.friction(dq) + np.sign(dq) * at.load(d) - at.constant(d)


def edges(d: Dynamics, at: Pull | None = None) -> np.ndarray:
    """Return (7, 2) Nm: the commands at which a resting joint lets go, negative and positive; `at` as in `drags`."""
    held = d.family.held(d.phi) if d.family.held is not None else d.breakaway
    return held - (d.offset if at is None else at.constant(d))[:, None]


def reached(ramps: dict[str, np.ndarray]) -> np.ndarray:
    """Return (7, 2) bool: whether a ramp moved the joint in the negative and in the positive direction."""
    out = np.zeros((7, 2), dtype=bool)
    for joint in range(7):
        for side, sign in enumerate((-1, 1)):
            q = ramps["q"][(ramps["joint"] == joint + 1) & (ramps["sign"] == sign), joint]
            out[joint, side] = len(q) > 0 and (sign * (q - q[0])).max() > REACHED
    return out


def judge(run: Path, arm: Path, threads: int = 0) -> dict:
    """Return what a run folder of stage=identify is worth on the arm of this folder."""
    truth, meta = load_truth(arm), json.loads((run / "meta.json").read_text())
    space, x = load_parameters(run, ROBOT)
    found, draws = space.dynamics(x), space.dynamics(load_posterior(run, space))
    with np.load(arm / "train.npz") as z:
        q = z["q"]
    with np.load(arm / "ramps.npz") as z:
        ramps = {k: z[k] for k in z.files}
    top = visited(q)
    v, some = speeds(top, SPEEDS), speeds(top, CHECKED)
    level = np.abs(friction(truth, v)).mean((0, 1))
    told = np.stack([truth["breakaway_command_neg"], truth["breakaway_command_pos"]], -1)
    pose = np.median(ramps["q"], axis=0)[None]

    def off(drag: np.ndarray) -> list[float]:
        return (100 * np.abs(drag - (friction(truth, v) - truth["offset"])).max((0, 1)) / level).tolist()

    def against(at: Pull | None, at_ramps: Pull | None) -> dict:
        low, high = np.quantile(drags(draws, some, at), (0.025, 0.975), axis=0)
        wanted = friction(truth, some) - truth["offset"]
        constant = found.offset if at is None else at.constant(found)
        edge = np.where(reached(ramps), np.abs(edges(found, at_ramps) - told), np.nan)
        return {
            "friction": off(drags(found, v, at)),
            "within": ((low <= wanted) & (wanted <= high)).mean((0, 1)).tolist(),
            "offset": (1e3 * np.abs(constant - truth["offset"])).tolist(),
            "edges": (1e3 * edge).tolist(),
        }

    late, true_late = np.asarray(draws.delay) + np.asarray(draws.lag), truth["delay_s"] + truth["lag_s"]
    between = np.quantile(np.atleast_1d(late), (0.025, 0.975))
    validation = read(arm / "validation.npz", torque="commanded")
    true = true_dynamics(truth)
    ahead = [_open_loop_ee(ROBOT, d, validation, threads)["0.5"] for d in (found, true)]
    return against(None, None) | {
        "true family": truth["family"],
        "paper": truth["paper"],
        "family": found.family.name,
        "right": found.family == FAMILY[truth["family"]],
        "felt": against(Pull(q[:: len(q) // POSTURES]), Pull(pose)),
        "plain": off(plain_regression(arm / "train.npz")(v)),
        "late": 1e3 * float(found.delay + found.lag),
        "true late": 1e3 * true_late,
        "late within": bool(between[0] <= true_late <= between[1]),
        "late interval": (1e3 * between).tolist(),
        "ee": ahead[0],
        "true ee": ahead[1],
        "seconds": meta["wall_clock_s"],
        "commit": (meta.get("git") or {}).get("commit"),
    }


class Plain:
    """What least squares found: friction minus offset is straight in either direction."""

    def __init__(self, levels: np.ndarray, delay: float):
        self.levels, self.delay = levels, delay  # (7, 4): at 0, up and down, and slopes; s

    def __call__(self, dq: np.ndarray) -> np.ndarray:
        """Return friction minus offset (..., 7) Nm at dq (..., 7) rad/s."""
        up, down, rise, fall = self.levels.T
        return np.where(dq > 0, up + rise * dq, -down + fall * dq)


def plain_regression(path: Path) -> Plain:
    """Return least squares of a recording: tensor scales, Coulomb and viscous friction of each direction, a delay.

    Both sides of the equation are low-passed at 8 Hz, delays of 0 to 8 ms are tried, and rows within 80 ms of a speed
    below 0.1 rad/s are left out.
    """
    with np.load(path) as z:
        raw, tau = z["q"], z["tau_J_d"].astype(float)
    low, quick = butter(2, 8 / 500), butter(2, 40 / 500)

    def slow(x: np.ndarray) -> np.ndarray:
        return filtfilt(*low, x, axis=0)

    q = slow(raw)
    dq = np.gradient(q, 1e-3, axis=0)
    y = regressor(ROBOT, q, dq, np.gradient(dq, 1e-3, axis=0))
    points = LinkInertia(ROBOT.mass, ROBOT.com, 0 * ROBOT.inertia).standard()  # known: masses and centres
    tensors = LinkInertia(ROBOT.mass, ROBOT.com, ROBOT.inertia).standard() - points
    scaled, rest = np.einsum("tjlp,lp->tjl", y, tensors), np.einsum("tjlp,lp->tj", y, points)
    v = filtfilt(*quick, np.gradient(raw, 1e-3, axis=0), axis=0)
    laws = np.stack([slow(np.maximum(np.sign(v), 0)), slow(np.minimum(np.sign(v), 0))], -1)
    laws = np.concatenate([laws, np.stack([slow(np.maximum(v, 0)), slow(np.minimum(v, 0))], -1)], -1)
    near = np.stack([np.convolve(np.abs(x) <= 0.1, np.ones(161), "same") > 0.5 for x in v.T], 1)
    near[:300] = near[-300:] = True
    n, rows = ROBOT.n, np.arange(len(raw))
    blocks, sides, delays = [], [], np.arange(0, 8, 0.25)
    for j in range(n):
        block = np.zeros((len(raw), n + 4 * n))
        block[:, :n], block[:, n + 4 * j : n + 4 * (j + 1)] = scaled[:, j], laws[:, j]
        late = np.stack([np.interp(rows - ms, rows, tau[:, j]) for ms in delays], 1)
        blocks.append(block[~near[:, j]])
        sides.append((slow(late) - rest[:, j : j + 1])[~near[:, j]])
    a, b = np.concatenate(blocks), np.concatenate(sides)
    found = np.linalg.lstsq(a, b, rcond=None)[0]
    best = int(((a @ found - b) ** 2).mean(0).argmin())
    return Plain(found[n:, best].reshape(n, 4), 1e-3 * delays[best])
