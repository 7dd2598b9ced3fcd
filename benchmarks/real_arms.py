"""A real Kinova Gen3: torque of its sensors and of its motors, on motion that was not fitted.

`python benchmarks/real_arms.py FOLDER` takes the folder of the recordings (docs/real_arms.md says where they are
from) and identifies with the settings of stage=identify. The same data go to a ridge regression. Writes
docs/real_arms.md.
"""

import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from common import MACHINE, ROOT, conf, how, searches

from r2s.identification.family_selection import left_out
from r2s.identification.identify import identify
from r2s.identification.parameters import parameter_space
from r2s.identification.smooth_motion import SmoothMotion
from r2s.identification.torque_residual import TorqueResidual
from r2s.physics.dynamics import Dynamics, nominal_dynamics
from r2s.physics.friction import WIDTH_DQ
from r2s.physics.rigid_body import regressor
from r2s.physics.robot import Robot, load_robot
from r2s.recordings.readers import read
from r2s.recordings.recording import Recording

CUTOFF_HZ, ROWS_HZ, FOLDS = 10.0, 100.0, 4
RIDGE = 10.0 ** np.arange(-12, 1.1, 0.5)  # strengths, relative to the mean square of a column
TRAINED = {"joints 1, 3, 5, 7": (1, 3, 5, 7), "joints 2, 4, 6": (2, 4, 6)}


def kinova(folder: Path) -> tuple[Robot, Dynamics]:
    """Return the arm of the recordings in a folder, and where its identification starts; end where there is none."""
    model = folder / "model.xml"
    if not model.is_file():
        sys.exit(f"there is no {model}: FOLDER is that of the Kinova's recordings (docs/real_arms.md)")
    own = {k: v for k, v in conf("robot/other").items() if k not in ("defaults", "mjcf")}
    robot = load_robot(str(model), **own)
    return robot, nominal_dynamics(robot, **conf("friction/uniform"))


def rmse(robot: Robot, recording: Recording, dynamics: Dynamics) -> np.ndarray:
    """Return (n,) Nm of a model's torque."""
    space = parameter_space(robot, dynamics, {"offset": [-1.0, 1.0]})
    error = TorqueResidual(robot, space, recording, cutoff_hz=CUTOFF_HZ, rate_hz=ROWS_HZ).off(dynamics)
    return np.sqrt((error**2).mean(0))


def columns(robot: Robot, recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Return A (T n, P) and tau (T n,): all standard parameters, Coulomb, viscous, offset and rotor of each joint."""
    m = SmoothMotion.of(recording, CUTOFF_HZ, ROWS_HZ)
    samples, n = m.q.shape
    parts = [regressor(robot, m.q, m.dq, m.ddq, robot.gravity).reshape(samples, n, -1)]
    for x in (m.filtered(np.tanh(m.fast / WIDTH_DQ)), m.dq, np.ones_like(m.q), m.ddq):
        parts.append(x[:, :, None] * np.eye(n))
    return np.concatenate(parts, -1).reshape(samples * n, -1), m.tau.ravel()


def ridge(robot: Robot, train: Recording, test: Recording) -> tuple[np.ndarray, float]:
    """Return (n,) Nm on `test` of a ridge regression, and its strength: the best on blocks left out of `train`."""
    a, tau = columns(robot, train)
    scale = np.sqrt((a**2).mean(0))
    scale[scale < 1e-9] = 1.0

    def fit(a: np.ndarray, tau: np.ndarray, strength: float) -> np.ndarray:
        x = a / scale
        return np.linalg.solve(x.T @ x + strength * len(tau) * np.eye(len(scale)), x.T @ tau) / scale

    error = np.zeros(len(RIDGE))
    for rest, out in left_out(train, FOLDS):
        (a1, tau1), (a2, tau2) = columns(robot, rest), columns(robot, out)
        error += [((a2 @ fit(a1, tau1, s) - tau2) ** 2).sum() for s in RIDGE]
    strength = float(RIDGE[error.argmin()])
    a2, tau2 = columns(robot, test)
    off = (a2 @ fit(a, tau, strength) - tau2).reshape(-1, robot.n)
    return np.sqrt((off**2).mean(0)), strength


def joined(parts: Sequence[Recording], name: str) -> Recording:
    """Return one recording of several, each a trajectory of its own."""
    arrays = {f: np.concatenate([getattr(p, f) for p in parts]) for f in ("t", "q", "dq", "tau")}
    trajectory = np.repeat(np.arange(len(parts)), [len(p.t) for p in parts])
    return Recording(**arrays, torque=parts[0].torque, trajectory=trajectory, name=name)


def main() -> None:
    """Fit, judge and write the table."""
    if len(sys.argv) != 2:
        sys.exit("usage: python benchmarks/real_arms.py FOLDER")
    folder = Path(sys.argv[1])
    robot, nominal = kinova(folder)
    lines: list[str] = []

    def recorded(name: str, torque: str) -> Recording:
        return read(folder / f"{name}.npz", torque=torque, n_joints=robot.n, name=name)

    def judged(kind: str, fitted: str, on: str, train: Recording, test: Recording) -> None:
        began = time.perf_counter()
        found = identify(robot, nominal, train, searches("staged"), how(kind, family="auto"))
        seconds = time.perf_counter() - began
        terms = {"link": "link_alpha", "payload": "payload_mass"}
        kept = ", ".join(term for term, block in terms.items() if block in found.space.blocks)
        by_ridge, strength = ridge(robot, train, test)
        before, after = (rmse(robot, test, d) for d in (nominal, found.dynamics))
        cells = [kind, fitted, on, f"{before.mean():.2f}", f"{by_ridge.mean():.2f}", f"**{after.mean():.2f}**"]
        cells += [found.dynamics.family.name, kept or "neither", " ".join(f"{x:.2f}" for x in after)]
        cells += [f"{strength:.0e}", f"{seconds:.0f}"]
        lines.append("| " + " | ".join(cells) + " |")
        print(lines[-1], flush=True)

    for kind in ("measured", "motor"):
        judged(kind, "optitraj1", "optitraj2", recorded("optitraj1", kind), recorded("optitraj2", kind))
    trapezoids = {j: recorded(f"joint{j}_trapez", "motor") for j in range(1, robot.n + 1)}
    for words, some in TRAINED.items():
        train = joined([recorded("optitraj1", "motor"), *(trapezoids[j] for j in some)], words)
        test = joined([r for j, r in trapezoids.items() if j not in some], "the other joints")
        judged("motor", f"optitraj1, trapezoids of {words}", "the other trapezoids", train, test)
    page = ROOT / "docs" / "real_arms.md"
    _, section, after = page.read_text().partition("\n## ")  # of benchmarks/stand.py
    page.write_text(TEXT.format(machine=MACHINE, lines="\n".join(lines)) + section + after)
    print("written: docs/real_arms.md")


TEXT = """# A real Kinova Gen3: its torque sensors and its motors

`python benchmarks/real_arms.py FOLDER` on {machine}. The recordings are of a physical arm with an unstated
payload (github.com/wissem01chiha/dynamic-identification, CC0-1.0); the MJCF has the numbers of Kinova's public
description. `measured` is the joint torque sensor, `motor` the motor current times a constant. Both are
identified with the settings of stage=identify and `friction=uniform`. optitraj1 is 4.7 s, optitraj2 2.3 s of
another motion; in a trapezoid one joint moves and the others stand. Torque RMSE in Nm after a 10 Hz zero-phase
filter, mean over the joints. `ridge` is a regression with the same data: all standard parameters of the links,
Coulomb, viscous, offset and rotor inertia of each joint, its strength by cross-validation on blocks of the
training data.

| torque | fitted to | judged on | nominal | ridge | r2s | family | kept | r2s by joint | strength of ridge | s |
|---|---|---|---|---|---|---|---|---|---|---|
{lines}

`kept` says what of `link` and `payload` the motion left out of the training data asked for. Fitted to optitraj1,
both kinds of torque find a payload of 0.9 kg at the hand, and links as published. Beliefs about motor torque are
in shares of each joint's torque limit. They come from what gears are like and from blocks left out of optitraj1.
No setting was chosen by optitraj2 or by the trapezoids, but their errors were seen while the terms were built.

What remains on optitraj2 is mostly no rigid body. A rigid model with a payload, fitted to optitraj2 itself, keeps
0.81 Nm of the sensors' torque and 0.74 Nm of the motors'; after a 3 Hz filter it keeps 0.11 and 0.17 Nm. On
optitraj1 the torque of joint 2 is three to five times what its motion explains between 5.7 and 8 Hz, in phase,
and less than that between 9 and 11.5 Hz, in antiphase. So something swings at about 8 Hz: the base, below.
In the trapezoids most of the error is that of joints that stand: they hold
anything up to their breakaway, and the motion does not tell what.
"""

if __name__ == "__main__":
    main()
