"""Export friction parameters to a YAML file for crisp_controllers (ROS 2), in the form of the paper's equation (5).

crisp_controllers (github.com/utiasDSL/crisp_controllers) adds fp1 / (1 + exp(-fp2 (dq + fp3))) - fp1 / (1 + exp(-fp2
fp3)) to each joint's torque. r2s fits fp1, fp2 and fp3 to an arm's friction; the sigmoid law without viscous friction
has the same form and needs no fit.
"""

from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from r2s.files import atomic_write
from r2s.physics.dynamics import Dynamics
from r2s.physics.friction import SIGMOID
from r2s.physics.robot import Robot

SPEEDS, SLOWEST = 100, 0.01  # number of fitted speeds per direction, from SLOWEST * dq_max to dq_max
STEEPEST = 100.0  # s/rad, largest fp2: with a steeper law, a controller that filters dq chatters


def sigmoid_law(dq: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """Return friction (...) Nm at dq (...) rad/s for the parameters phi (..., 3): fp1 Nm, fp2 s/rad, fp3 rad/s."""
    fp1, fp2, fp3 = (phi[..., k] for k in range(3))
    return fp1 / (1 + np.exp(-fp2 * (dq + fp3))) - fp1 / (1 + np.exp(-fp2 * fp3))


def fit_sigmoid(robot: Robot, dynamics: Dynamics) -> tuple[np.ndarray, np.ndarray]:
    """Fit `sigmoid_law` to an arm's friction up to dq_max; return the parameters (n, 3) and RMS errors (n,) Nm."""
    share = np.geomspace(SLOWEST, 1.0, SPEEDS)
    dq = np.concatenate([-share[::-1], share])[:, None] * robot.dq_max
    true = dynamics.friction(dq, np.sign(dq))
    if dynamics.family is SIGMOID and not dynamics.phi[:, 3:].any():  # the same law: viscous friction is 0
        return dynamics.phi[:, :3], np.zeros(robot.n)
    out = np.empty((robot.n, 3))
    for j in range(robot.n):
        level = max(float(np.abs(true[:, j]).max()), 1e-9)
        bounds = [0.0, 0.1, -robot.dq_max[j]], [10 * level, STEEPEST, robot.dq_max[j]]

        def error(x: np.ndarray, j: int = j) -> np.ndarray:
            return sigmoid_law(dq[:, j], x) - true[:, j]

        starts = ([2 * level, steep, 0.0] for steep in (3.0, 30.0))  # nearly viscous; nearly Coulomb friction
        fits = [least_squares(error, start, bounds=bounds, x_scale="jac") for start in starts]
        out[j] = min(fits, key=lambda fit: fit.cost).x
    return out, np.sqrt(np.mean((sigmoid_law(dq, out) - true) ** 2, axis=0))


def write_crisp(path: Path, robot: Robot, dynamics: Dynamics) -> None:
    """Write a YAML file with the friction parameters in `ros__parameters` and the fit error in a comment."""
    phi, rms = fit_sigmoid(robot, dynamics)
    level = np.maximum(dynamics.family.level(dynamics.phi, robot.dq_max), 1e-9)
    errors = ", ".join(f"{e:.3g} ({100 * e / x:.0f} %)" for e, x in zip(rms, level, strict=True))
    rows = "\n".join(f"      fp{k + 1}: [{', '.join(f'{v:.9g}' for v in phi[:, k])}]" for k in range(3))
    text = f"""# Friction of {robot.name} for crisp_controllers: fp1 Nm, fp2 s/rad, fp3 rad/s per joint.
# RMS error against the identified {dynamics.family.name} friction up to dq_max, Nm (of the friction there): {errors}.
# Offset, load and cable torques are not part of this law.
/**:
  ros__parameters:
    use_friction: true
    friction:
{rows}
"""
    with atomic_write(path) as part:
        part.write_text(text)
