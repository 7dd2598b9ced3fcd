"""Draw random parameters of rigid and elastic twins: links, torque offset, cable drag and sensor noise."""

import numpy as np

from r2s.compiled import njit
from r2s.physics.payload import Links
from r2s.physics.robot import Robot

ENCODER = 2e-5  # rad, resolution


def draw_links(robot: Robot, rng: np.random.Generator) -> Links:
    """Draw random masses, centers of mass and inertia tensors of the links."""
    model = robot.model(gravity=True)
    n, bodies = robot.n, model.jnt_bodyid
    small = np.minimum(1.0, robot.tau_max / 12)[:, None]  # scale for joints weaker than a Panda's wrist
    masses = model.body_mass[bodies] * rng.uniform(0.98, 1.02, n)  # U(0.98, 1.02) of the nominal mass
    coms = model.body_ipos[bodies] + small * rng.uniform(-2e-3, 2e-3, (n, 3))  # U(-2, 2) mm
    scale = rng.uniform(0.73, 1.37, n)  # range of the paper's ratios NEW / OLD; a scaled tensor remains physical
    return masses, coms, robot.inertia * scale[:, None, None]


def magnitudes(robot: Robot) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return kinetic friction (n,), range of |offset| (n, 2), largest cable torque (n,) and torque noise (n,), Nm.

    The magnitudes for a Panda follow the paper's Tables I and IV; for other arms they depend on the torque limits.
    """
    big = robot.tau_max >= 40
    if robot.n == 7 and np.allclose(robot.tau_max, [87] * 4 + [12] * 3):
        level = 0.5 * np.array([3.40, 1.98, 2.51, 2.44, 2.60, 1.19, 1.55])  # phi1 / 2, Table IV NEW
    else:
        level = np.minimum(0.05 * robot.tau_max, 0.45 * robot.tau_max**0.25)
    small = np.minimum(1.0, robot.tau_max / 12)
    offset = np.where(big[:, None], [0.05, 0.7], small[:, None] * [0.01, 0.08])
    return level, offset, np.where(big, 0.3, 0.08 * small), np.where(big, 0.3, 0.1 * small)


def draw_surroundings(robot: Robot, rng: np.random.Generator, hold: np.ndarray, unbalanced: np.ndarray) -> np.ndarray:
    """Draw an array (8, n): torque offset, Nm; 4 arguments of `drag`; standard deviations of noise on q, dq, tau_J.

    Args:
        robot: the arm. rng: random number generator. hold: (n,) Nm, lower bound of each joint's stiction.
        unbalanced: (n,) Nm, gravity compensation minus gravity torque in the home posture.
    """
    _, offset_range, drag_max, noise_max = magnitudes(robot)
    n = robot.n
    offset = rng.uniform(offset_range[:, 0], offset_range[:, 1]) * rng.choice([-1, 1], n)
    return np.array(
        [
            # the paper's Table I lists gravity error plus offset; this sum must not move an arm in the home posture
            np.clip(offset, -hold - unbalanced, hold - unbalanced),
            drag_max * rng.uniform(0.15, 0.7, n),  # Nm
            drag_max * rng.uniform(0.0, 0.3, n),  # Nm, of a cable along two joints
            rng.uniform(0.7, 2.0, n),  # rad per rad
            rng.uniform(-np.pi, np.pi, n),  # rad
            rng.uniform(0.5e-5, 1.5e-5, n),  # rad, of q
            rng.uniform(2e-3, 4e-3, n),  # rad/s, of dq before its filter
            noise_max * rng.uniform(0.5, 1.0, n),  # Nm, of tau_J
        ]
    )


@njit(cache=True)
def drag(own, along, waves, phase, q, q_next):
    """Return a cable's torque (Nm) on a joint at the angle q (rad); the next joint is at q_next (rad)."""
    return own * np.sin(waves * q + phase) + along * np.sin(q_next - phase)
