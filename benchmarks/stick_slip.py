"""The true parameters of independently simulated arms, open loop for 0.5 s: what the rule of stiction costs.

usage: python benchmarks/stick_slip.py FOLDER. One sub-folder per arm, with its truth.json and recordings; prints the mean
end-effector error of the truth under each rule (`hold` of Dynamics), and how fast each simulates.
"""

import json
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import ROBOT

from r2s.identification.prediction import _open_loop_ee
from r2s.physics.dynamics import HOLDS, Dynamics
from r2s.physics.friction import COULOMB, SIGMOID, STRIBECK
from r2s.physics.simulator import Simulator
from r2s.recordings.readers import read

HORIZON = "0.5"  # s
NAMES = ("train", "validation")


def true_dynamics(truth: dict) -> Dynamics:
    """Return an arm's truth.json as far as the families express it.

    One value for both directions where they have one: the mean of both viscous terms and of both Stribeck rises.
    """
    f = {name: np.array(values) for name, values in truth["friction"].items()}
    if "phi1" in f:
        family, columns = SIGMOID, [f["phi1"], f["phi2"], f["phi3"]]
    else:
        level = 0.5 * (f["fc_pos"] + f["fc_neg"])
        viscous = 0.5 * (f["fv_pos"] + f["fv_neg"])
        family, columns = COULOMB, [level, 0.5 * (f["fc_pos"] - f["fc_neg"]) / level, viscous]
        if "vs" in f:
            rise = 0.5 * (f["fs_pos"] / f["fc_pos"] + f["fs_neg"] / f["fc_neg"]) - 1.0
            family, columns = STRIBECK, [*columns, rise, f["vs"]]
    command = truth["breakaway_on"] == "command"
    return replace(
        Dynamics.of(ROBOT, np.stack(columns, -1), family, dq_min=truth["v_stick"]),
        offset=np.array(truth["offset"]),
        breakaway=np.stack([truth["breakaway_net_neg"], truth["breakaway_net_pos"]], -1),
        mass=np.array(truth["mass"]),
        com=np.array(truth["com"]),
        inertia=np.array(truth["inertia"]),
        delay=truth["delay_s"],
        lag=truth["lag_s"],
        hold="command" if command else "net",
    )


def recording(path: Path):
    """Return a recording of these arms."""
    return read(path, torque="commanded", columns={"tau": "tau_J_d"})


def main() -> None:
    """Print one line per arm."""
    print(f"{'arm':10}" + "".join(f"{f'{name}, {hold}, mm':>26}" for name in NAMES for hold in HOLDS))
    for folder in sorted(Path(sys.argv[1]).iterdir()):
        if not (folder / "truth.json").is_file():
            continue
        truth = json.loads((folder / "truth.json").read_text())
        if truth["family"] == "lugre":
            continue  # no family here has its bristle damping
        true, line = true_dynamics(truth), f"{folder.name:10}"
        for name in NAMES:
            seen = recording(folder / f"{name}.npz")
            for hold in HOLDS:
                line += f"{_open_loop_ee(ROBOT, replace(true, hold=hold), seen, 1)[HORIZON]:26.2f}"
        print(line, flush=True)


if __name__ == "__main__":
    main()
