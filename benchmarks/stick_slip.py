"""Predict arms of another simulator from their true parameters, open loop, with each stiction model.

usage: python benchmarks/stick_slip.py FOLDER, with a sub-folder for each arm: truth.json, train.npz, validation.npz.
Prints the mean end-effector error after 0.5 s per arm, and the cost of stiction_model="net" in speed.
"""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from bench import duel
from common import NEW, ROBOT

from r2s.identification.prediction import open_loop_error
from r2s.physics.dynamics import STICTION_MODELS, Dynamics
from r2s.physics.friction import BRISTLE, COULOMB, SIGMOID, STRIBECK
from r2s.physics.simulator import Simulator
from r2s.recordings.readers import read

HORIZON = "0.5"  # s
NAMES = ("train", "validation")
START = 2e-3  # rad/s, largest measured start velocity of a joint that is at rest


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
        Dynamics.of(ROBOT, phi, family, dq_min=START),
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


def speed(dynamics: Dynamics, tau: np.ndarray) -> tuple[float, float]:
    """Return steps/s of stiction_model="net" and of "command" under torques (m, S, n) Nm from home."""
    arms, q0 = len(tau), np.tile(ROBOT.q_home, (len(tau), 1))
    sims = [Simulator(ROBOT, replace(dynamics, stiction_model=model), arms, 1) for model in ("net", "command")]

    def run(sim: Simulator) -> None:
        sim.reset(q0, np.zeros_like(q0))
        sim.rollout(tau)

    return duel(lambda: run(sims[0]), lambda: run(sims[1]), arms * tau.shape[1])


def main() -> None:
    """Print one line per arm, then the speeds."""
    columns = [f"{name}, {model}, mm" for name in NAMES for model in STICTION_MODELS]
    print(f"{'arm':12}" + "".join(f"{column:>26}" for column in columns))
    for folder in sorted(Path(sys.argv[1]).iterdir()):
        truth = json.loads((folder / "truth.json").read_text()) if (folder / "truth.json").is_file() else {}
        if truth.get("family", "lugre") == "lugre":
            continue  # no family expresses bristle damping
        true = true_dynamics(truth)
        line = f"{folder.name:12}"
        for name in NAMES:
            recording = read(folder / f"{name}.npz", torque="commanded")
            for model in STICTION_MODELS:
                dynamics = replace(true, stiction_model=model, dq_min=NEW.dq_min if model == "command" else START)
                line += f"{open_loop_error(ROBOT, dynamics, recording, 1)[HORIZON]:26.2f}"
        print(line, flush=True)
    rng = np.random.default_rng(0)
    held = np.repeat(rng.uniform(-1, 1, (128, 1, 7)) * [1, 1, 1, 1, 0.5, 0.3, 0.3], 200, axis=1)
    for name, tau in {"at rest": 0 * held, "some held": held, "in motion": 8 * held}.items():
        net, command = speed(replace(NEW, dq_min=1e-3), tau)
        print(f"{name:12}net {net:,.0f} steps/s, command {command:,.0f}: ratio {net / command:.2f}", flush=True)


if __name__ == "__main__":
    main()
