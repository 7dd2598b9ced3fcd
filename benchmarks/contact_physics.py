"""Contact physics: replays of contact arms of another simulator from their true parameters, and the cost in speed.

usage: python benchmarks/contact_physics.py FOLDER, with a sub-folder for each arm: truth.json, contact.npz,
truth_contact.npz. Prints the RMS error of the normal force in open-loop windows, and ratios of speed.
"""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from bench import duel
from common import NEW, ROBOT
from independent_judge import true_dynamics
from scipy.signal import savgol_filter

from r2s.physics.actuation import Motors
from r2s.physics.contact_layout import COLUMNS, DEFLECTION, FORCE
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot
from r2s.physics.simulator import Simulator
from r2s.physics.surface import Surface, Tool

SMOOTH, BEFORE = 31, 40  # ms of the smoothing of a start state; ms of commands before the first window
UP = np.array([0.0, 0.0, 1.0])


def contact_arm(folder: Path) -> tuple[Robot, Dynamics]:
    """Return robot with tool, and true dynamics with surface, of a truth.json."""
    truth = json.loads((folder / "truth.json").read_text())
    c = truth["contact"]
    bristle = c["mu"] / c["bristle_s0_per_m"]
    law = c["k_N_per_m"], c["exponent"], c["c_s_per_m"], c["mu"], bristle
    surface = Surface(np.array(c["point"]), np.array(c["normal"]), *law)
    robot = replace(ROBOT, tool=Tool(np.array(c["tip_in_flange_m"]), c["radius_m"]))
    return robot, replace(true_dynamics(truth), surface=surface, dq_min=truth["v_stick"])


def replay_errors(folder: Path, length: int, measured: bool = False) -> np.ndarray:
    """Return the error (K,) N of the normal force at all times of contact in open-loop windows of `length` ms.

    A window starts at the smoothed angles and speeds, joints at rest at rest, from the true depth and bristles.
    measured: from the measured depth, without bristle deflection.
    """
    robot, d = contact_arm(folder)
    seen, true = np.load(folder / "contact.npz"), np.load(folder / "truth_contact.npz")
    joint = Motors(1, robot.n, d.delay, d.lag)(seen["tau_J_d"][None].astype(float))[0]
    starts = np.arange(BEFORE, len(joint) - length, length)
    q, dq = (savgol_filter(seen["q"], SMOOTH, 3, k, 1e-3, axis=0)[starts] for k in (0, 1))
    dq[true["stuck"][starts].astype(bool)] = 0.0
    normal, force = d.surface.normal, true["normal_force"]
    sim = Simulator(robot, d, len(starts), 1)
    if not measured:
        for _ in range(2):  # Newton's method along the normal
            sim.reset(q, dq)
            sim.rollout(np.zeros((len(starts), 1, robot.n)))
            wrong = true["penetration"][starts] - sim.depth
            sim.reset(q, dq)
            along = np.einsum("kij,i->kj", sim.jacobian, normal)
            q = q - along * (wrong / (along**2).sum(1))[:, None]
    sim.reset(q, dq)
    if not measured:
        across = true["wrench"][starts, :3] - force[starts, None] * normal
        load = np.maximum(d.surface.friction * force[starts], 1e-3)[:, None]
        deflection = -d.surface.bristle * across / load * (force[starts, None] > 0)
        sim._contact[:, DEFLECTION : DEFLECTION + 3] = deflection
    out = sim.rollout(np.stack([joint[k : k + length] for k in starts]), record=("userdata",))
    found = out["userdata"][..., -COLUMNS:][..., FORCE : FORCE + 3] @ normal
    expected = np.stack([force[k : k + length] for k in starts])
    return (found - expected)[expected > 0]


def speeds(stiction: str, arms: int = 128, steps: int = 200) -> dict[str, tuple[float, float]]:
    """Return steps/s with and without a surface, interleaved: out of reach, pressed, and slid on."""
    d = replace(NEW, stiction_model=stiction, dq_min=1e-3, offset=0 * NEW.offset)
    robot, q0 = replace(ROBOT, tool=Tool(np.array([0.0, 0.0, 0.05]), 0.01)), np.tile(ROBOT.q_home, (arms, 1))
    probe = Simulator(ROBOT, d, 1, 1)
    probe.reset(q0[:1], 0 * q0[:1])
    tip, jacobian = probe.ee[0] - 0.06 * UP, probe.jacobian[0].copy()
    rng, out = np.random.default_rng(0), {}
    press = np.tile(jacobian.T @ (-20 * UP), (arms, steps, 1)) * rng.uniform(0.8, 1.2, (arms, 1, 1))
    free = 8 * np.repeat(rng.uniform(-1, 1, (arms, 1, 7)) * [1, 1, 1, 1, 0.5, 0.3, 0.3], steps, axis=1)
    slide = press + np.array([12.0, 0, 0, 0, 0, 0, 0])
    for name, tau, depth in (("out of reach", free, -0.5), ("pressed", press, 1e-3), ("slid on", slide, 1e-3)):
        surface = Surface(tip + depth * UP, UP, 2e4, 1.5, 1.0, 0.3, 2e-4)
        sims = Simulator(robot, replace(d, surface=surface), arms, 1), Simulator(ROBOT, d, arms, 1)

        def run(sim: Simulator, torque: np.ndarray) -> None:
            sim.reset(q0, 0 * q0)
            sim.rollout(torque)

        with_surface, without = sims
        ours, peer = lambda s=with_surface, t=tau: run(s, t), lambda s=without: run(s, free)
        out[name] = duel(ours, peer, arms * steps)
    return out


def main() -> None:
    """Print one line per arm and window, then the speeds."""
    for folder in sorted(Path(sys.argv[1]).iterdir()):
        if not (folder / "truth_contact.npz").is_file():
            continue
        for measured in (False, True):
            start = "measured" if measured else "true"
            rms = [np.sqrt(np.mean(replay_errors(folder, k, measured) ** 2)) for k in (200, 500, 1000)]
            values = ", ".join(f"{1e-3 * k:g} s {x:.3f} N" for k, x in zip((200, 500, 1000), rms, strict=True))
            print(f"{folder.name:10} from the {start} depth: {values}", flush=True)
    for stiction in ("net", "command"):
        for name, (ours, peer) in speeds(stiction).items():
            print(
                f"{stiction:8} {name:13} {ours:,.0f} steps/s, free {peer:,.0f}: ratio {ours / peer:.2f}", flush=True
            )


if __name__ == "__main__":
    main()
