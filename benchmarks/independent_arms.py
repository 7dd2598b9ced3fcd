"""Record motion and ramps of simulated arms that share no code with r2s, and save their true parameters.

`python benchmarks/independent_arms.py FOLDER [SEED ...]` (by default seeds 0 to 23) writes FOLDER/<seed>/ with

    train.npz, validation.npz  20 s at 1 kHz: t; q, dq, tau_J_d (20000, 7), the command without gravity
    ramps.npz                  14 ramps, every second row of 1 kHz; joint 1 to 7, sign; t restarts for each
    truth.json                 all drawn values and the conventions in words

The seed determines all values; its remainder by 5 selects the family, in the order of FAMILIES.
"""

import json
import sys
import time
from pathlib import Path

import mujoco
import numpy as np
from common import ROBOT
from independent_dynamics import COULOMB, CYCLE, LUGRE, SMOOTH, Arm, at_rest, cycle, rigid_body
from numba import njit
from scipy.ndimage import uniform_filter1d
from scipy.special import expit

from r2s.files import atomic_write
from r2s.physics.payload import ee_pose, with_payload

FAMILIES = ("sigmoid", "coulomb", "stribeck", "lugre", "paper")  # paper: eq. (5), edges of eq. (6)
LEVEL = np.array([1.0, 0.8, 0.65, 1.15, 0.65, 0.35, 0.5])  # Nm, median of the drawn sliding friction
INERTIA = np.array([1.0, 1.0, 1.0, 0.8, 0.03, 0.02, 0.01])  # kg m^2, about what each joint accelerates
OFFSET = np.array([0.3, 0.35, 0.2, 0.3, 0.06, 0.04, 0.02])  # Nm
SECONDS = 20
SENSORS = {"q": (2e-5, 2e-5), "dq": (3e-3, 3e-4)}  # standard deviation and resolution, rad and rad/s
CENTRE = np.array([0.0, -0.2, 0.0, -1.75, 0.0, 1.95, 0.0])  # rad
AROUND = np.array([0.45, 0.15, 0.35, 0.2, 0.45, 0.15, 0.6])  # rad, range of the centre of a motion
FASTEST = np.array([1.2, 1.2, 1.2, 1.2, 1.4, 1.4, 1.4])  # rad/s
SOFTEST = 10.0  # rad/s^2, the largest acceleration of a Fourier motion
SLOW = 0.45  # rad/s, the fastest slow sweep
BANDWIDTH, FILTER_HZ = 24.0, 40.0  # of the controller, 1/s, and of its velocity
COMPENSATED, SOFT = 0.9, 0.04  # share of friction in the feedforward, and width of its tanh, rad/s
SETTLING, HELD, BRAKING, MOVED = 2.0, 0.5, 0.3, 0.01  # s, s, s, rad: phases of a ramp, and motion that ends it
RATE = np.array([0.15, 0.15, 0.15, 0.15, 0.1, 0.1, 0.1])  # Nm/s
LONGEST = 40.0  # s, longest ramp of a joint that does not move
CONVENTIONS = {
    "dynamics": "M(q) ddq + c(q,dq) + g(q) = tau_drive + g_nom(q) + offset - tau_f; tau_drive = lag(delay(tau_cmd))",
    "rows": "row k: q, dq sampled at t_k; tau_cmd computed from row k, reaches the lag at t_k + delay",
    "command": "tau_cmd excludes gravity; the robot adds g_nom(q) of the nominal masses without delay or lag",
    "offset": "constant torque on the joint, adding to the drive",
    "tau_f": "friction torque, positive against positive velocity",
    "stick": "a joint at rest holds while breakaway_net_neg <= net <= breakaway_net_pos, net = every torque on it "
    "but friction; a sliding joint comes to rest when its velocity crosses 0 or |dq| <= v_stick with net inside that "
    "band (not within 5 ms of its release). lugre: no such rule, the bristles hold up to fs",
    "inertia": "tensors about the centre of mass in the link frame; true = scale * nominal; masses and CoM unscaled",
}


def draw(seed: int) -> dict:
    """Return the content of truth.json for a seed, except the friction curve."""
    rng, name = np.random.default_rng([seed, 0]), FAMILIES[seed % len(FAMILIES)]
    n = len(LEVEL)

    def sides(values: np.ndarray, by: float) -> list[np.ndarray]:
        apart = rng.uniform(-by, by, n)
        return [values * (1 + apart), values * (1 - apart)]

    # level = LEVEL * exp(U(-0.6, 0.6))
    level = LEVEL * np.exp(rng.uniform(-0.6, 0.6, n))
    if name in ("sigmoid", "paper"):
        # phi1 = 2 level; phi2 = exp(U(log 2, log 25)); phi3 = U(-0.03, 0.03)
        slope = np.exp(rng.uniform(np.log(2.0), np.log(25.0), n))
        friction = {"phi1": 2 * level, "phi2": slope, "phi3": rng.uniform(-0.03, 0.03, n)}
        high, low = sides(level * rng.uniform(0.4, 0.9, n), 0.15)
    else:
        # fc of a direction = level (1 +- U(-0.1, 0.1)); fv = fc U(0.1, 0.45), its directions 10 % apart
        friction = dict(zip(("fc_pos", "fc_neg"), sides(level, 0.1), strict=True))
        friction |= dict(zip(("fv_pos", "fv_neg"), sides(level * rng.uniform(0.1, 0.45, n), 0.1), strict=True))
        # breakaway = fc U(1.05, 1.35), or with a Stribeck rise fc U(1.15, 1.6)
        over = (1.05, 1.35) if name == "coulomb" else (1.15, 1.6)
        high, low = (friction[fc] * rng.uniform(*over, n) for fc in ("fc_pos", "fc_neg"))
        if name != "coulomb":
            friction |= {"fs_pos": high, "fs_neg": low, "vs": np.exp(rng.uniform(np.log(0.02), np.log(0.1), n))}
    if name == "lugre":
        # sigma0 = level / U(2.5e-4, 7e-4) rad; sigma1 = 2 zeta sqrt(sigma0 M), zeta = U(0.17, 0.5)
        stiff = level / rng.uniform(2.5e-4, 7e-4, n)
        friction |= {"sigma0": stiff, "sigma1": rng.uniform(0.35, 1.0, n) * np.sqrt(stiff * INERTIA)}
    # offset = N(0, OFFSET), within 2.2 deviations; the arm must rest without a command
    most = np.minimum(2.2 * OFFSET, 0.9 * np.minimum(high, low))
    offset = np.clip(rng.normal(0.0, OFFSET), -most, most)
    if name == "paper":  # breakaway torques apply to the command, independent of the offset
        high, low = np.maximum(high + offset, 0.0), np.maximum(low - offset, 0.0)
    scale = rng.uniform(0.7, 1.4, n)
    truth = {"seed": seed, "family": {"coulomb": "coulomb_viscous", "paper": "sigmoid"}.get(name, name)}
    truth |= {"paper": name == "paper", "conventions": CONVENTIONS, "friction": friction}
    truth |= {"breakaway_net_pos": high, "breakaway_net_neg": -low}
    truth |= {"breakaway_command_pos": high - offset, "breakaway_command_neg": -low - offset, "v_stick": 1e-3}
    truth |= {"offset": offset, "delay_s": rng.uniform(1e-3, 4.5e-3), "lag_s": rng.uniform(0.0, 2e-3)}
    truth["lag_s"] *= name != "paper"
    truth |= {"inertia_scale": scale, "inertia": scale[:, None, None] * ROBOT.inertia}
    truth |= {"mass": ROBOT.mass, "com": ROBOT.com}
    truth["noise"] = {name: {k: [v[i]] * n for k, v in SENSORS.items()} for i, name in enumerate(("sd", "lsb"))}
    truth["breakaway_on"] = "command" if truth["paper"] else "net"
    return truth


def make_arm(truth: dict, step: float | None = None) -> Arm:
    """Return the arm of a truth.json; step: the longest step in s, by default 0.1 ms, 0.05 ms with bristles."""
    f = {k: np.array(v, dtype=float) for k, v in truth["friction"].items()}
    kind = {"sigmoid": SMOOTH, "lugre": LUGRE}.get(truth["family"], COULOMB)
    law = np.zeros((len(LEVEL), 9))
    if kind == SMOOTH:
        law[:, :3] = np.stack([f["phi1"], f["phi2"], f["phi3"]], -1)
    else:
        named = ("fc_pos", "fc_neg", "fv_pos", "fv_neg", "fs_pos", "fs_neg", "vs", "sigma0", "sigma1")
        without = {"fs_pos": f["fc_pos"], "fs_neg": f["fc_neg"], "vs": 1.0, "sigma0": 0.0, "sigma1": 0.0}
        for k, name in enumerate(named):
            law[:, k] = f[name] if name in f else without[name]
    links = (np.array(truth[k], dtype=float) for k in ("mass", "com", "inertia"))
    held = (np.array(truth[k], dtype=float) for k in ("offset", "breakaway_net_neg", "breakaway_net_pos"))
    rest = truth["v_stick"], truth["delay_s"], truth["lag_s"]
    return Arm(*links, kind, law, *held, *rest, step or (5e-5 if kind == LUGRE else 1e-4), np.zeros((len(law), 4)))


def carrying(arm: Arm, payload) -> Arm:
    """Return the arm with a payload (r2s.physics.payload) that its gravity compensation does not know."""
    place, axes = ee_pose(ROBOT)
    mass, com, tensor = with_payload(ROBOT, payload, (arm.mass, arm.com, arm.tensor))
    carried = np.zeros((len(mass), 4))
    carried[-1] = payload.mass, *(place + axes @ payload.centre)
    return arm._replace(mass=mass, com=com, tensor=tensor, carried=carried)


def motion(rng: np.random.Generator) -> np.ndarray:
    """Return (3, T, 7) rad, rad/s, rad/s^2: hold, Fourier, hold, slow sweeps, hold."""
    n, t = len(CENTRE), np.arange(SECONDS * 1000) * CYCLE
    middle = CENTRE + rng.uniform(-AROUND, AROUND)
    begins, ends = 0.75, 12.3
    s = (t - begins) / (ends - begins)
    rate = 2 * np.pi * 0.09 * np.arange(1, 9)
    phase = rng.uniform(0, 2 * np.pi, (n, 8))
    size = rng.normal(size=(n, 8)) / np.arange(1, 9) ** 0.5
    wave = np.einsum("jk,tjk->tj", size, np.sin(rate * (t[:, None, None] - begins) + phase))
    edge = 1.2 / (ends - begins)  # share of the motion for fading in, and for fading out
    swell = np.clip(np.minimum(s, 1 - s) / edge, 0.0, 1.0)
    place = wave * (swell**3 * (10 - 15 * swell + 6 * swell**2))[:, None]
    dq, ddq = _rates(place)
    largest = np.maximum(np.abs(dq).max(0) / (FASTEST * rng.uniform(0.85, 1.0, n)), np.abs(ddq).max(0) / SOFTEST)
    place /= np.maximum(largest, np.abs(place).max(0) / 0.9)
    # sweeps: legs of constant speed; the last leg returns
    legs, first, last = 6, 13.3, 18.7
    speed = rng.uniform(-SLOW, SLOW, (legs, n)) * rng.choice([0.2, 0.5, 1.0], (legs, n))
    speed[-1] = 0.0
    each = (last - first) / legs
    speed[-1] = -speed.sum(0)
    speed[-1] = np.clip(speed[-1], -SLOW, SLOW)
    leg = np.clip(((t - first) / each).astype(int), 0, legs - 1)
    slow = np.where(((t > first) & (t < last))[:, None], speed[leg], 0.0)
    width = 151
    kernel = np.hanning(width + 2)[1:-1]
    slow = np.apply_along_axis(np.convolve, 0, slow, kernel / kernel.sum(), "same")
    place = middle + place + np.cumsum(slow, axis=0) * CYCLE
    return np.stack([place, *_rates(place)])


def _rates(place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    dq = np.gradient(place, CYCLE, axis=0)
    return dq, np.gradient(dq, CYCLE, axis=0)


@njit(cache=True)
def sensed(true, noise, resolution):
    """Return sensor readings (N,)."""
    return np.round((true + noise) / resolution) * resolution


@njit(cache=True)
def control(nominal, friction_ff, q, dq, q_ref, dq_ref, ddq_ref, M, bias):
    """Return the command (N,) Nm of computed torque with nominal links and feedforward friction, without offset."""
    rigid_body(q, dq_ref, nominal.mass, nominal.com, nominal.tensor, 0.0, M, bias)
    ddq = ddq_ref + 2.0 * BANDWIDTH * (dq_ref - dq) + BANDWIDTH**2 * (q_ref - q)
    return M @ ddq + bias + friction_ff * np.tanh(dq_ref / SOFT)


@njit(cache=True)
def follow(arm, nominal, friction_ff, state, reference, noise, resolution):
    """Return rows (T, 3, N) of readings q, dq and commands of an arm that follows (3, T, N)."""
    rows = np.empty((reference.shape[1], 3, 7))
    M, bias, slow = np.empty((7, 7)), np.empty(7), np.zeros(7)
    factor = 1.0 - np.exp(-2.0 * np.pi * FILTER_HZ * CYCLE)
    for k in range(len(rows)):
        q = sensed(state.q, noise[k, 0], resolution[0])
        dq = sensed(state.dq, noise[k, 1], resolution[1])
        slow += factor * (dq - slow)
        u = control(nominal, friction_ff, q, slow, reference[0, k], reference[1, k], reference[2, k], M, bias)
        rows[k, 0], rows[k, 1], rows[k, 2] = q, dq, u
        cycle(arm, state, u)
    return rows


@njit(cache=True)
def ramp(arm, state, start, joint, rate, noise, resolution, longest):
    """Return rows (T, 3, N): HELD s of the command `start`, then a rising command until the joint has moved."""
    rows = np.empty((longest, 3, 7))
    first, held = state.q[joint], int(HELD / CYCLE)
    for k in range(longest):
        u = start.copy()
        u[joint] += rate * max(k - held, 0) * CYCLE
        rows[k, 0] = sensed(state.q, noise[k, 0], resolution[0])
        rows[k, 1] = sensed(state.dq, noise[k, 1], resolution[1])
        rows[k, 2] = u
        cycle(arm, state, u)
        if abs(rows[k, 0, joint] - first) > MOVED:
            return rows[: k + 1]
    return rows


class Recorder:
    """A simulated arm with sensors and a controller, at rest at q (7,) rad.

    The controller has the nominal links and feedforward friction (7,) Nm.
    """

    def __init__(self, arm: Arm, friction_ff: np.ndarray, q: np.ndarray, rng: np.random.Generator):
        self.arm, self.friction_ff, self.rng, self.state = arm, friction_ff, rng, at_rest(arm, q)
        self.nominal = arm._replace(tensor=ROBOT.inertia)
        self.resolution = np.stack([np.full(7, SENSORS[k][1]) for k in ("q", "dq")])
        self._sd = np.array([SENSORS[k][0] for k in ("q", "dq")])

    def noise(self, rows: int) -> np.ndarray:
        """Return sensor noise (rows, 2, 7)."""
        return self.rng.normal(size=(rows, 2, 7)) * self._sd[:, None]

    def follow(self, reference: np.ndarray) -> np.ndarray:
        """Follow a reference (3, T, 7); return rows (T, 3, 7)."""
        noise = self.noise(reference.shape[1])
        return follow(self.arm, self.nominal, self.friction_ff, self.state, reference, noise, self.resolution)

    def hold(self, q: np.ndarray, seconds: float) -> np.ndarray:
        """Hold q (7,) rad; return rows."""
        reference = np.zeros((3, round(seconds / CYCLE), 7))
        reference[0] = q
        return self.follow(reference)

    def ramp(self, pose: np.ndarray, joint: int, sign: int) -> np.ndarray:
        """Return the rows of one ramp, including its hold."""
        start = self.hold(pose, SETTLING)[-200:, 2].mean(0)
        longest, rate = round(LONGEST / CYCLE), sign * RATE[joint]
        rows = ramp(self.arm, self.state, start, joint, rate, self.noise(longest), self.resolution, longest)
        return np.concatenate([rows, self.hold(rows[-1, 0], BRAKING)])


def record_motion(arm: Arm, friction_ff: np.ndarray, seed: int, which: int) -> dict[str, np.ndarray]:
    """Return the arrays of train.npz (which=1) or validation.npz (2)."""
    rng = np.random.default_rng([seed, which])
    reference = motion(rng)
    rows = Recorder(arm, friction_ff, reference[0, 0], rng).follow(reference)
    return {"t": np.arange(len(rows)) * CYCLE, **_columns(rows)}


def record_ramps(arm: Arm, friction_ff: np.ndarray, seed: int) -> dict[str, np.ndarray]:
    """Return the arrays of ramps.npz."""
    rng = np.random.default_rng([seed, 3])
    pose = CENTRE + rng.uniform(-AROUND, AROUND)
    recorder, parts = Recorder(arm, friction_ff, pose, rng), []
    for joint in range(len(pose)):
        for sign in (1, -1):
            rows = recorder.ramp(pose, joint, sign)[::2]
            t = SETTLING + np.arange(len(rows)) * 2 * CYCLE
            which = {"joint": np.full(len(rows), joint + 1, np.int8), "sign": np.full(len(rows), sign, np.int8)}
            parts.append({"t": t, **_columns(rows), **which})
    return {k: np.concatenate([p[k] for p in parts]) for k in parts[0]}


def _columns(rows: np.ndarray) -> dict[str, np.ndarray]:
    return {"q": rows[:, 0], "dq": rows[:, 1].astype(np.float32), "tau_J_d": rows[:, 2].astype(np.float32)}


def friction(truth: dict, dq: np.ndarray) -> np.ndarray:
    """Return friction (..., 7) Nm in steady motion at dq (..., 7) rad/s; 0 at rest."""
    f = {k: np.array(v, dtype=float) for k, v in truth["friction"].items()}
    if truth["family"] == "sigmoid":
        return f["phi1"] * (expit(f["phi2"] * (dq + f["phi3"])) - expit(f["phi2"] * f["phi3"]))

    def side(name: str, otherwise: str) -> np.ndarray:
        name = name if f"{name}_pos" in f else otherwise
        return np.where(dq > 0, f[f"{name}_pos"], f[f"{name}_neg"])

    slow = np.exp(-((dq / f["vs"]) ** 2)) if "vs" in f else 0.0
    return np.sign(dq) * (side("fc", "") + (side("fs", "fc") - side("fc", "")) * slow) + side("fv", "") * dq


def rigid_body_error(samples: int = 50) -> float:
    """Return the largest difference from MuJoCo's inverse dynamics with gravity, Nm."""
    model, rng = ROBOT.model(gravity=True), np.random.default_rng(0)
    data, M, bias, worst = mujoco.MjData(model), np.empty((7, 7)), np.empty(7), 0.0
    for _ in range(samples):
        data.qpos = rng.uniform(ROBOT.q_min, ROBOT.q_max)
        data.qvel, data.qacc = rng.normal(size=7), 5 * rng.normal(size=7)
        rigid_body(data.qpos.copy(), data.qvel.copy(), ROBOT.mass, ROBOT.com, ROBOT.inertia, 9.81, M, bias)
        ours = M @ data.qacc + bias
        mujoco.mj_inverse(model, data)
        worst = max(worst, np.abs(ours - data.qfrc_inverse).max())
    return float(worst)


def plain(value):
    """Return arrays as lists, for JSON."""
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value


def write_arm(folder: Path, seed: int) -> None:
    """Write the arm of a seed; truth.json is the last file and marks the folder as complete."""
    truth = draw(seed)
    arm, fast = make_arm(truth), np.ones(7)
    friction_ff = COMPENSATED * 0.5 * (friction(truth, fast) - friction(truth, -fast))
    folder.mkdir(parents=True, exist_ok=True)
    for which, name in enumerate(("train", "validation"), start=1):
        np.savez_compressed(folder / f"{name}.npz", **record_motion(arm, friction_ff, seed, which))
    np.savez_compressed(folder / "ramps.npz", **record_ramps(arm, friction_ff, seed))
    speeds = np.round(np.linspace(-2, 2, 401), 2)
    truth["friction_curve"] = {"dq": speeds, "tau_f": friction(truth, np.repeat(speeds[:, None], 7, axis=1)).T}
    with atomic_write(folder / "truth.json") as part:
        part.write_text(json.dumps(plain(truth)))


def describe(folder: Path) -> str:
    """Return a summary of a recorded arm; raise ValueError if it cannot be identified."""
    truth = json.loads((folder / "truth.json").read_text())
    parts = [f"{folder.name}: {truth['family']}{' (paper)' if truth['paper'] else ''}"]
    for name in ("train", "validation", "ramps"):
        with np.load(folder / f"{name}.npz") as z:
            a = {k: z[k] for k in z.files}
        if not all(np.isfinite(v).all() for v in a.values()):
            raise ValueError(f"{folder / name}: all values must be finite")
        if (share := np.abs(a["tau_J_d"]).max(0) / ROBOT.tau_max).max() > 1:
            raise ValueError(f"{folder / name}: expected commands up to tau_max, got {share.max():.2f} tau_max")
        if name == "ramps":
            ends = np.flatnonzero(np.diff(a["t"], append=-1) < 0)
            moved = sum(a["t"][e] < SETTLING + HELD + LONGEST for e in ends)
            parts.append(f"{moved} of {len(ends)} ramps moved, {len(a['t']) * 2 * CYCLE:.0f} s")
            continue
        speed = np.abs(uniform_filter1d(np.gradient(a["q"], CYCLE, axis=0), 21, axis=0))
        fastest, rest = speed.max(0), (speed < 4e-3).mean(0)
        parts.append(
            f"{name}: largest command {share.max():.2f} tau_max, fastest {fastest.min():.2f}-{fastest.max():.2f}"
        )
        parts[-1] += f" rad/s, at rest {rest.min():.2f}-{rest.max():.2f} of the time"
    return "; ".join(parts)


def main() -> None:
    """Write the missing arms and print a summary of each."""
    if len(sys.argv) < 2:
        sys.exit("usage: python benchmarks/independent_arms.py FOLDER [SEED ...]")
    print(f"rigid bodies against MuJoCo: {rigid_body_error():.1e} Nm")
    for seed in [int(s) for s in sys.argv[2:]] or range(24):
        folder, began = Path(sys.argv[1]) / str(seed), time.perf_counter()
        if not (folder / "truth.json").is_file():
            write_arm(folder, seed)
        print(f"{describe(folder)}; {time.perf_counter() - began:.0f} s", flush=True)


if __name__ == "__main__":
    main()
