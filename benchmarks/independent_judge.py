"""Score an identification against the truth.json of an arm from another simulator.

`judge` compares a run folder of stage=identify with an arm's folder (format: benchmarks/independent_arms.py);
`plain_regression` is a baseline of thirty lines of least squares on the same recording.

Friction with a free level per direction does not separate from the offset; their difference is identifiable. It is
scored twice: for the parameters alone, because the arms have no other torques, and including all torques of the
identified arm (load, drag, uncompensated gravity) at the mean over the postures of the training motion, which is what
acts in a simulator.
"""

import json
from pathlib import Path

import numpy as np
from common import ROBOT, replace
from independent_arms import friction
from scipy.signal import butter, filtfilt, savgol_filter

from r2s.identification.parameter_file import load_parameters, load_posterior
from r2s.identification.prediction import open_loop_error
from r2s.physics.dynamics import Dynamics
from r2s.physics.friction import BRISTLE, COULOMB, SIGMOID, STRIBECK
from r2s.physics.rigid_body import LinkInertia, regressor
from r2s.recordings.readers import read

FAMILY = {"sigmoid": SIGMOID, "coulomb_viscous": COULOMB, "stribeck": STRIBECK, "lugre": BRISTLE}
SLOWEST = 0.05  # rad/s, lowest speed at which friction is scored
FASTEST = 0.95  # quantile of the visited speeds per direction
SPEEDS, CHECKED = 40, 5  # points per direction: for the friction error, and for its interval
POSTURES = 200
DIRECTIONS = (1, -1)
REACHED = 5e-3  # rad of motion that counts as breakaway
START_SPEED = 2e-3  # rad/s, largest measured start velocity of a joint that is at rest


def load_truth(folder: Path) -> dict:
    """Return truth.json with lists as arrays."""
    truth = json.loads((folder / "truth.json").read_text())
    return {k: np.array(v) if isinstance(v, list) else v for k, v in truth.items()}


def true_dynamics(truth: dict) -> Dynamics:
    """Return the dynamics of a truth.json; the families do not express the damping of LuGre bristles."""
    f = {name: np.array(values) for name, values in truth["friction"].items()}
    if "phi1" in f:
        family, phi = SIGMOID, np.stack([f["phi1"], f["phi2"], f["phi3"]], -1)
    else:
        family, (level, apart), (viscous, own) = COULOMB, _sides(f, "fc"), _sides(f, "fv")
        columns = [level, apart, viscous]
        if "vs" in f:
            rises = [f[f"fs_{side}"] / f[f"fc_{side}"] - 1 for side in ("pos", "neg")]
            rise, other = _sides({"rise_pos": rises[0], "rise_neg": rises[1]}, "rise")
            family, columns = STRIBECK, [*columns, rise, f["vs"], other]
        if "sigma0" in f:  # presliding: deflection of the bristles at the Coulomb level
            family = BRISTLE
            columns.insert(5, level / f["sigma0"])
        phi = np.stack([*columns, own], -1)
    return replace(
        Dynamics.of(ROBOT, phi, family, dq_min=START_SPEED),
        offset=np.array(truth["offset"]),
        breakaway=np.stack([truth["breakaway_net_neg"], truth["breakaway_net_pos"]], -1),
        mass=np.array(truth["mass"]),
        com=np.array(truth["com"]),
        inertia=np.array(truth["inertia"]),
        delay=truth["delay_s"],
        lag=truth["lag_s"],
        stiction_model="net",  # also if the true breakaway applies to the command: joints rest by their net torque
    )


def _sides(f: dict[str, np.ndarray], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean over both directions, and the relative deviation from it."""
    mean = 0.5 * (f[f"{name}_pos"] + f[f"{name}_neg"])
    return mean, f[f"{name}_pos"] / mean - 1


def visited(q: np.ndarray) -> np.ndarray:
    """Return the highest scored speed per direction, (2, 7) rad/s, of a motion q (T, 7) rad at 1 kHz."""
    dq = savgol_filter(q, 31, 3, deriv=1, delta=1e-3, axis=0)
    return np.array([[np.quantile(x[x > SLOWEST], FASTEST) for x in way * dq.T] for way in DIRECTIONS])


def speeds(top: np.ndarray, count: int) -> np.ndarray:
    """Return signed speeds (2, count, 7) rad/s, evenly from SLOWEST to `top` (2, 7), both directions."""
    share = np.linspace(0.0, 1.0, count)[:, None]
    return np.stack([way * (SLOWEST + share * (t - SLOWEST)) for way, t in zip(DIRECTIONS, top, strict=True)])


class OtherTorques:
    """Torques of an identified arm besides links and friction law, mean over postures q (T, 7) rad."""

    def __init__(self, q: np.ndarray):
        still = np.zeros_like(q)
        self._gravity = regressor(ROBOT, q, still, still, ROBOT.gravity)
        self._nominal = LinkInertia(ROBOT.mass, ROBOT.com, ROBOT.inertia).standard()
        self._load = np.abs(np.einsum("tjkc,kc->tj", self._gravity, self._nominal)).mean(0)
        self._mean = self._gravity.mean(0)
        self._sin, self._cos = np.sin(q).mean(0), np.cos(q).mean(0)

    def constant(self, d: Dynamics) -> np.ndarray:
        """Return the constant torque (..., 7) Nm that adds to the command."""
        error = LinkInertia(d.mass, d.com, d.inertia).standard() - self._nominal
        drag = d.drag[..., 0] * self._sin + d.drag[..., 1] * self._cos
        return d.offset + drag - np.einsum("jkc,...kc->...j", self._mean, error)

    def load(self, d: Dynamics) -> np.ndarray:
        """Return load-dependent friction (..., 7) Nm, independent of the direction."""
        return d.load * self._load


def drags(d: Dynamics, dq: np.ndarray, at: OtherTorques | None = None) -> np.ndarray:
    """Return friction minus offset at dq (..., 7) rad/s, with the torques `at`; S dynamics give (S, ..., 7)."""
    if d.phi.ndim > 2:
        return np.stack([drags(d.one(k), dq, at) for k in range(len(d.phi))])
    if at is None:
        return d.friction(dq) - d.offset
    return d.friction(dq) + np.sign(dq) * at.load(d) - at.constant(d)


def edges(d: Dynamics, at: OtherTorques | None = None) -> np.ndarray:
    """Return breakaway commands (7, 2) Nm, negative and positive; `at` same as in `drags`."""
    held = d.family.held(d.phi) if d.family.held is not None else d.breakaway
    return held - (d.offset if at is None else at.constant(d))[:, None]


def reached(ramps: dict[str, np.ndarray]) -> np.ndarray:
    """Return (7, 2) bool: whether a ramp moved the joint in the negative and positive direction."""
    out = np.zeros((7, 2), dtype=bool)
    for joint in range(7):
        for side, sign in enumerate((-1, 1)):
            q = ramps["q"][(ramps["joint"] == joint + 1) & (ramps["sign"] == sign), joint]
            out[joint, side] = len(q) > 0 and (sign * (q - q[0])).max() > REACHED
    return out


def judge(run: Path, arm: Path, threads: int = 0) -> dict:
    """Return the scores of a run folder of stage=identify on the arm of a folder."""
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
    true_edges = np.stack([truth["breakaway_command_neg"], truth["breakaway_command_pos"]], -1)
    pose = np.median(ramps["q"], axis=0)[None]

    def relative_error(drag: np.ndarray) -> list[float]:
        return (100 * np.abs(drag - (friction(truth, v) - truth["offset"])).max((0, 1)) / level).tolist()

    def scores(at: OtherTorques | None, at_ramps: OtherTorques | None) -> dict:
        low, high = np.quantile(drags(draws, some, at), (0.025, 0.975), axis=0)
        true_drag = friction(truth, some) - truth["offset"]
        constant = found.offset if at is None else at.constant(found)
        edge = np.where(reached(ramps), np.abs(edges(found, at_ramps) - true_edges), np.nan)
        return {
            "friction": relative_error(drags(found, v, at)),
            "within": ((low <= true_drag) & (true_drag <= high)).mean((0, 1)).tolist(),
            "offset": (1e3 * np.abs(constant - truth["offset"])).tolist(),
            "edges": (1e3 * edge).tolist(),
        }

    latency, true_latency = np.asarray(draws.delay) + np.asarray(draws.lag), truth["delay_s"] + truth["lag_s"]
    interval = np.quantile(np.atleast_1d(latency), (0.025, 0.975))
    validation = read(arm / "validation.npz", torque="commanded")
    true = true_dynamics(truth)
    ahead = [open_loop_error(ROBOT, d, validation, threads)["0.5"] for d in (found, true)]
    return scores(None, None) | {
        "true family": truth["family"],
        "paper": truth["paper"],
        "family": found.family.name,
        "right": found.family == FAMILY[truth["family"]],
        "total": scores(OtherTorques(q[:: len(q) // POSTURES]), OtherTorques(pose)),
        "plain": relative_error(plain_regression(arm / "train.npz")(v)),
        "latency": 1e3 * float(found.delay + found.lag),
        "true latency": 1e3 * true_latency,
        "latency within": bool(interval[0] <= true_latency <= interval[1]),
        "latency interval": (1e3 * interval).tolist(),
        "ee": ahead[0],
        "true ee": ahead[1],
        "seconds": meta["wall_clock_s"],
        "commit": (meta.get("git") or {}).get("commit"),
    }


class Plain:
    """A least-squares model: friction minus offset is affine in speed per direction."""

    def __init__(self, levels: np.ndarray, delay: float):
        self.levels, self.delay = levels, delay  # (7, 4): levels at 0 and slopes, both directions; s

    def __call__(self, dq: np.ndarray) -> np.ndarray:
        """Return friction minus offset (..., 7) Nm at dq (..., 7) rad/s."""
        up, down, rise, fall = self.levels.T
        return np.where(dq > 0, up + rise * dq, -down + fall * dq)


def plain_regression(path: Path) -> Plain:
    """Fit tensor scales, Coulomb and viscous friction per direction and a delay to a recording by least squares.

    Both sides of the equation pass an 8 Hz low-pass. The delay is the best of 0 to 8 ms. Rows within 80 ms of a speed
    below 0.1 rad/s are excluded.
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
        delayed = np.stack([np.interp(rows - ms, rows, tau[:, j]) for ms in delays], 1)
        blocks.append(block[~near[:, j]])
        sides.append((slow(delayed) - rest[:, j : j + 1])[~near[:, j]])
    a, b = np.concatenate(blocks), np.concatenate(sides)
    found = np.linalg.lstsq(a, b, rcond=None)[0]
    best = int(((a @ found - b) ** 2).mean(0).argmin())
    return Plain(found[n:, best].reshape(n, 4), 1e-3 * delays[best])
