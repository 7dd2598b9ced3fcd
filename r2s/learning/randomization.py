"""Domain randomization: dynamics drawn around a centre, every link tensor physically valid."""

from dataclasses import replace

import numpy as np

from r2s.identification.parameters import ParameterSpace
from r2s.physics.dynamics import Dynamics

TRIES = 64


def draw(
    rng: np.random.Generator, center: Dynamics, m: int, *, phi_relative: float, inertia_relative: float
) -> Dynamics:
    """Return m drawn dynamics: the paper's randomization at phi 0.10 and inertia 0.05.

    phi (all 21) ~ center * U(1 - phi_relative, 1 + phi_relative)
    I_xx I_yy I_zz I_xy I_xz I_yz (all 42) ~ center * U(1 - inertia_relative, 1 + inertia_relative)
    Each element is a draw of its own; an unphysical tensor is drawn again.

    Args:
        rng: source of the draws.
        center: dynamics without a batch shape, n joints.
        m: how many.
        phi_relative, inertia_relative: half widths; 0 keeps the centre.
    """
    n = len(center.offset)
    phi = center.phi * rng.uniform(1 - phi_relative, 1 + phi_relative, (m, *center.phi.shape))
    inertia = np.broadcast_to(center.inertia, (m, n, 3, 3)).copy()
    todo = np.ones((m, n), dtype=bool) if inertia_relative else np.zeros((m, n), dtype=bool)
    for _ in range(TRIES):
        if not todo.any():
            break
        arm, link = np.nonzero(todo)
        factor = rng.uniform(1 - inertia_relative, 1 + inertia_relative, (len(arm), 3, 3))
        upper = np.triu(factor)
        tensor = center.inertia[link] * (upper + np.triu(factor, 1).transpose(0, 2, 1))
        inertia[arm, link] = tensor
        todo[arm, link] = ~physical(tensor)
    inertia[todo] = np.broadcast_to(center.inertia, (m, n, 3, 3))[todo]  # after 64 tries: the centre, which is valid
    return replace(center, phi=phi, inertia=inertia)


def draw_identified(rng: np.random.Generator, space: ParameterSpace, samples: np.ndarray, m: int) -> Dynamics:
    """Return m dynamics drawn from what identification says of the arm: rows of `samples` (S, P), so correlated.

    Every row is physical: scales of tensors are positive, and the full parametrisation has no other values.
    """
    return space.dynamics(samples[rng.integers(len(samples), size=m)])


def physical(tensor: np.ndarray) -> np.ndarray:
    """Return (...) bool: positive definite, and no principal moment above the sum of the others."""
    moments = np.linalg.eigvalsh(tensor)
    return (moments[..., 0] > 0) & (moments[..., 0] + moments[..., 1] >= moments[..., 2])
