"""The true parameters of arms that another simulator moved, open loop: what the rule of stiction costs, by arm.

usage: python benchmarks/stick_slip.py FOLDER, with a sub-folder for each arm: truth.json, train.npz, validation.npz.
Prints the mean end-effector error after 0.5 s under both rules (`hold` of Dynamics), and what "net" costs in speed.
"""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from bench import duel
from common import NEW, ROBOT
from scipy.optimize import least_squares
from scipy.signal import savgol_filter

from r2s.identification.prediction import _open_loop_ee
from r2s.physics.dynamics import HOLDS, Dynamics
from r2s.physics.friction import BRISTLE, COULOMB, SIGMOID, STRIBECK
from r2s.physics.robot import SIM_DT
from r2s.physics.simulator import Simulator
from r2s.recordings.readers import read
from r2s.recordings.recording import Recording

HORIZON = "0.5"  # s
NAMES = ("train", "validation")
SLOWEST = 5e-3  # rad/s; slower, the direction of a measured velocity is not known
START = 2e-3  # rad/s: what a window's measured start velocity may be of a joint at rest


def true_dynamics(truth: dict, recording: Recording | None) -> Dynamics:
    """Return an arm's truth.json as far as the families express it.

    Theirs have one viscous term for both directions, where the arms have two: the law is the one that is closest to
    the arm's over the velocities of `recording`, by least squares; eq. (5) needs none.
    """
    f = {name: np.array(values) for name, values in truth["friction"].items()}
    if "phi1" in f:
        family, phi = SIGMOID, np.stack([f["phi1"], f["phi2"], f["phi3"]], -1)
    else:
        family = STRIBECK if "vs" in f else COULOMB
        joints = [{name: values[j] for name, values in f.items()} for j in range(ROBOT.n)]
        phi = np.stack([_closest(family, one, dq) for one, dq in zip(joints, _speeds(recording), strict=True)])
    if "sigma0" in f:  # bristles: as far as they bend under the Coulomb level
        family, bend = BRISTLE, 0.5 * (f["fc_pos"] + f["fc_neg"]) / f["sigma0"]
        phi = np.concatenate([phi[:, :5], bend[:, None], phi[:, 5:]], 1)
    return replace(
        Dynamics.of(ROBOT, phi, family, dq_min=START),
        offset=np.array(truth["offset"]),
        breakaway=np.stack([truth["breakaway_net_neg"], truth["breakaway_net_pos"]], -1),
        mass=np.array(truth["mass"]),
        com=np.array(truth["com"]),
        inertia=np.array(truth["inertia"]),
        delay=truth["delay_s"],
        lag=truth["lag_s"],
        hold="net",  # also where the truth's edges are of the command: its joints rest by what acts on them
    )


def _speeds(recording: Recording) -> np.ndarray:
    """Return (n, T) rad/s."""
    return savgol_filter(recording.q, 31, 3, deriv=1, delta=SIM_DT, axis=0).T


def _closest(family, f: dict, dq: np.ndarray) -> np.ndarray:
    """Return the parameters (K,) of one joint's law that is closest to f at the velocities dq (T,)."""
    v = dq[np.abs(dq) > SLOWEST][::7]
    up, level = v > 0, np.where(v > 0, f["fc_pos"], f["fc_neg"])
    if "vs" in f:
        level = level + (np.where(up, f["fs_pos"], f["fs_neg"]) - level) * np.exp(-((v / f["vs"]) ** 2))
    true = level * np.sign(v) + np.where(up, f["fv_pos"], f["fv_neg"]) * v
    mean = 0.5 * (f["fc_pos"] + f["fc_neg"])
    start = [mean, 0.0, f["fv_pos"], 0.2, f.get("vs", 0.0), 0.0][: len(family.names)]
    return least_squares(lambda p: family.law(v, list(p), np.sign(v)) - true, start, x_scale=0.1).x


def speed(dynamics: Dynamics, tau: np.ndarray) -> tuple[float, float]:
    """Return steps/s of hold="net" and of "command" under torques (m, S, n) Nm from home."""
    arms, q0 = len(tau), np.tile(ROBOT.q_home, (len(tau), 1))
    sims = [Simulator(ROBOT, replace(dynamics, hold=hold), arms, 1) for hold in ("net", "command")]

    def run(sim: Simulator) -> None:
        sim.reset(q0, np.zeros_like(q0))
        sim.rollout(tau)

    return duel(lambda: run(sims[0]), lambda: run(sims[1]), arms * tau.shape[1])


def main() -> None:
    """Print one line per arm, then the speeds."""
    columns = [f"{name}, {hold}, mm" for name in NAMES for hold in HOLDS]
    print(f"{'arm':12}" + "".join(f"{column:>26}" for column in columns))
    for folder in sorted(Path(sys.argv[1]).iterdir()):
        truth = json.loads((folder / "truth.json").read_text()) if (folder / "truth.json").is_file() else {}
        if truth.get("family", "lugre") == "lugre":
            continue  # no family here has the bristle damping of a LuGre arm
        seen = {n: read(folder / f"{n}.npz", torque="commanded") for n in NAMES}
        true = true_dynamics(truth, seen["train"])
        line = f"{folder.name:12}"
        for recording in seen.values():
            for hold in HOLDS:
                one = replace(true, hold=hold, dq_min=NEW.dq_min if hold == "command" else START)
                line += f"{_open_loop_ee(ROBOT, one, recording, 1)[HORIZON]:26.2f}"
        print(line, flush=True)
    rng = np.random.default_rng(0)
    held = np.repeat(rng.uniform(-1, 1, (128, 1, 7)) * [1, 1, 1, 1, 0.5, 0.3, 0.3], 200, axis=1)
    for name, tau in {"at rest": 0 * held, "some held": held, "in motion": 8 * held}.items():
        net, command = speed(replace(NEW, dq_min=1e-3), tau)
        print(f"{name:12}net {net:,.0f} steps/s, command {command:,.0f}: ratio {net / command:.2f}", flush=True)


if __name__ == "__main__":
    main()
