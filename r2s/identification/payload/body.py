"""Coordinates that describe only physically possible rigid bodies, and a prior for bodies that arms carry."""

from dataclasses import dataclass

import numpy as np

from r2s.physics.payload import WATER
from r2s.physics.rigid_body import LinkInertia

NAMES = ("mass", "x", "y", "z", "d1", "d2", "d3", "s12", "s13", "s23")
# Prior standard deviations. SIZE: of log(size of a body along an axis / size of a ball of water of the same mass); a
# steel block is half as large as this ball, an empty box of 2 kg three times as large. SHEAR: of s12, s13, s23.
SIZE, SHEAR = 0.7, 0.5
HEAVIEST, FARTHEST, WIDEST = 3.0, 6.0, 6.0  # bounds: mass / rated mass; distance, shape / prior sigma
STEP = 1e-6  # finite-difference step, relative to the width of the bounds


@dataclass(frozen=True)
class BodySpace:
    """Coordinates z (10,) of a body in the end effector's frame: mass, center of mass, shape of the second moment.

    The second moment about the center is mass gyration^2 V V^T. The shape consists of the elements of the matrix V =
    [[e^d1, s12, s13], [0, e^d2, s23], [0, 0, e^d3]] (log-Cholesky: Rucker and Wensing, IEEE RA-L 7(2), 2022). Every z
    with positive mass is physically possible.

    Attributes:
        heaviest: kg, rated mass of the arm's payload. far: m, prior standard deviation of the center's coordinates.
        gyration: m, r / sqrt(5), where r is the radius of a ball of water with about the body's mass.
    """

    heaviest: float
    far: float
    gyration: float

    @classmethod
    def about(cls, heaviest: float, far: float, mass: float) -> "BodySpace":
        """Return the space for bodies with a mass of about `mass` kg."""
        radius = (3 * mass / (4 * np.pi * WATER)) ** (1 / 3)
        return cls(heaviest, far, float(radius / np.sqrt(5)))

    @property
    def sigma(self) -> np.ndarray:
        """(10,) standard deviations of the prior of z about 0; inf means a flat prior."""
        return np.array([np.inf, *[self.far] * 3, *[SIZE] * 3, *[SHEAR] * 3])

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds (10,) of the coordinates z."""
        reach = np.array([0.0, *[FARTHEST * self.far] * 3, *[WIDEST * SIZE] * 3, *[WIDEST * SHEAR] * 3])
        return -reach, reach + HEAVIEST * self.heaviest * np.eye(10)[0]

    def body(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return mass (...) kg, center (..., 3) m and tensor about the center (..., 3, 3) kg m^2 for z (..., 10)."""
        v = np.zeros((*z.shape[:-1], 3, 3))
        for i in range(3):
            v[..., i, i] = np.exp(z[..., 4 + i])
        v[..., 0, 1], v[..., 0, 2], v[..., 1, 2] = z[..., 7], z[..., 8], z[..., 9]
        second = (z[..., 0] * self.gyration**2)[..., None, None] * (v @ np.swapaxes(v, -1, -2))
        return z[..., 0], z[..., 1:4], np.trace(second, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) - second

    def standard(self, z: np.ndarray) -> np.ndarray:
        """Return standard parameters (..., 10) of bodies with coordinates z (..., 10): mass, first moments, tensor.

        First moments and inertia tensor are about the origin of the end effector's frame.
        """
        mass, centre, tensor = self.body(z)
        return LinkInertia(mass, centre, tensor).standard()

    def slope(self, z: np.ndarray) -> np.ndarray:
        """Return the derivative (10, 10) of `standard` with respect to the coordinates z (10,)."""
        h = STEP * np.diag(np.subtract(*self.bounds[::-1]))
        return ((self.standard(z + h) - self.standard(z - h)) / (2 * h.diagonal()[:, None])).T

    def prior(self, z: np.ndarray) -> np.ndarray:
        """Return the prior's residual (9,) in standard deviations, without the mass, whose prior is flat."""
        return z[1:] / self.sigma[1:]
