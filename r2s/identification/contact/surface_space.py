"""Map the parameters of an unknown surface, and of gears in series with it, to a vector on the unit cube."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from r2s.errors import UserError, check_number
from r2s.physics.robot import per_joint
from r2s.physics.surface import UNIT_DEPTH, Surface

LOAD = 10.0  # N, load at which slope and height are defined, so that slope and height depend little on the exponent
# rad, largest tilt from the first guess of the plane; the tilt error of this guess is at most the friction angle
TILT = 0.6
HEIGHT = 0.02  # m, largest distance from the first guess of the plane
# bounds from foam to steel; the entries for slope of the force at LOAD (N/m) and bristle (m) are logarithms
BOUNDS = {
    "tilt_a": (-TILT, TILT),
    "tilt_b": (-TILT, TILT),
    "height": (-HEIGHT, HEIGHT),  # position of the tip under the force LOAD
    "slope": (np.log(1e2), np.log(1e6)),
    "exponent": (1.0, 2.0),  # linear 1, Hertz 1.5, cone 2
    "damping": (0.0, 50.0),
    "friction": (0.0, 2.0),
    "bristle": (np.log(1e-6), np.log(1e-2)),
}
NAMES = tuple(BOUNDS)
LOWER, UPPER = np.array(list(BOUNDS.values())).T
WIDTH = UPPER - LOWER
SURFACE = len(NAMES)  # number of values of a surface; u has 1 + n further values if the gears are elastic
FLAT = np.sqrt(12.0)  # 1 / standard deviation of a uniform distribution over the unit interval
# Deflection of gears at the largest torques, rad. DEFLECTION: standard deviation of a normal prior about 0. SOFTEST:
# upper bound. Strain wave gears deflect by 0.003 to 0.01 rad (a Panda's large joints: 87 Nm / 15,000 Nm/rad = 0.006).
DEFLECTION, SOFTEST = 0.01, 0.05
SCATTER, FARTHEST = 0.2, 0.6  # prior sigma and limit of (a gear's deflection / (mean deflection * `shape`) - 1)
WIDEST = 0.25  # largest relative standard deviation of an identified gear's deflection
LEAST_ACCURATE = 0.4  # largest allowed `accuracy`; intervals of two sigma then stay within FARTHEST and SOFTEST


@dataclass(frozen=True)
class Gears:
    """Prior of the gears' deflection under the joints' largest torques.

    Attributes:
        shape: (n,) prior mean of each gear's deflection, relative to the mean over all gears.
        center, width: rad, prior mean and standard deviation of the mean deflection over all gears.
        scatter: (n,) or one number, standard deviation of the ratio: gear deflection / (mean deflection * `shape`).
        stated: whether the stiffness of the gears is known, from the user or from an identification of the gears.
    """

    shape: np.ndarray
    center: float
    width: float
    scatter: np.ndarray | float
    stated: bool


def unknown_gears(n: int) -> Gears:
    """Return the prior of n gears' deflections for unknown stiffness; the most likely mean deflection is 0."""
    return Gears(np.ones(n), 0.0, DEFLECTION, SCATTER, False)


def stated_gears(tau_max: np.ndarray, *, stiffness: Any = None, accuracy: float = 0.1) -> Gears | None:
    """Return the prior of the deflections of gears with known stiffness, or None if `stiffness` is None.

    Half of the stiffness variance is due to an error that all gears share, for example an error in the data sheet.

    Args:
        tau_max: (n,) Nm, largest torques of the joints.
        stiffness: Nm/rad, one value per joint, or one value for the strongest joint; with one value, all gears
            deflect equally at the joints' largest torques. accuracy: relative standard deviation of the stiffness.

    Raises:
        UserError: a stiffness is not positive, `accuracy` is not in (0, LEAST_ACCURATE], or the gears are too soft.
    """
    check_number("accuracy", accuracy, f"(0, {LEAST_ACCURATE:g}]")
    if stiffness is None:
        return None
    own = per_joint("stiffness", stiffness, len(tau_max), f"the {len(tau_max)} joints")
    if np.ndim(stiffness) == 0:
        own = own * tau_max / tau_max.max()
    if not (np.isfinite(own) & (own > 0)).all():
        raise UserError(f"stiffness: expected positive numbers, Nm/rad, got {stiffness}")
    deflection, half = tau_max / own, accuracy / np.sqrt(2.0)
    mean = _mean_deflection(deflection, half)
    return Gears(deflection / mean, mean, half * mean, half, True)


def _mean_deflection(deflection: np.ndarray, width: float) -> float:
    """Return the mean of the deflections (n,) rad; raise UserError if mean + 2 standard deviations exceeds SOFTEST.

    width: relative standard deviation of the mean.
    """
    mean, most = float(deflection.mean()), SOFTEST / (1.0 + 2.0 * width)
    if mean > most:
        raise UserError(
            f"stiffness: robot.tau_max would twist these gears by {mean:.3g} rad, allowed are {most:.2g} rad; "
            "the unit is Nm/rad"
        )
    return mean


def identified_gears(
    tau_max: np.ndarray, *, stiffness: np.ndarray, spread: np.ndarray, determined: np.ndarray
) -> Gears:
    """Return the prior of the deflections of gears whose stiffness was identified.

    A gear of undetermined stiffness gets the mean deflection of the other gears. Half of the smallest variance among
    the gears is due to an error that all gears share.

    Args:
        tau_max: (n,) Nm, largest torques of the joints. stiffness: (n,) Nm/rad. spread: (n,) relative standard
            deviation of the stiffness; values above WIDEST are set to WIDEST, because FARTHEST limits the deflection.
            determined: (n,) bool, whether slides determined the stiffness.

    Raises:
        UserError: the stiffness of more than half of the gears is undetermined, or the gears are too soft.
    """
    if 2 * determined.sum() < len(determined):
        raise UserError(
            f"stiffness: slides determined {determined.sum()} of {len(determined)} gears, expected at least half"
        )
    deflection = np.where(determined, tau_max / stiffness, (tau_max / stiffness)[determined].mean())
    spread = np.where(determined, np.minimum(spread, WIDEST), WIDEST)
    common = float(spread.min() / np.sqrt(2.0))
    mean = _mean_deflection(deflection, common)
    return Gears(deflection / mean, mean, common * mean, np.sqrt(spread**2 - common**2), True)


@dataclass(frozen=True)
class SurfaceSpace:
    """The space of surfaces near a plane through `origin` (3,) m with unit normal `normal` (3,).

    A vector u contains two tilts of the plane about axes through `origin`, the tip's height along the normal under
    the force LOAD, and five values of the force law. For elastic gears, u also contains the gears' mean deflection at
    the largest torques, and for each gear the ratio deflection / (mean deflection * `Gears.shape`).

    Attributes:
        tau_max: (n,) Nm, largest torques of the joints. gears: prior of the gears' deflection.
    """

    origin: np.ndarray
    normal: np.ndarray
    tau_max: np.ndarray
    gears: Gears

    @property
    def axes(self) -> np.ndarray:
        """Two unit vectors (2, 3) in the plane; u[0] and u[1] tilt the normal towards the first and second vector."""
        first = np.cross(self.normal, np.eye(3)[np.abs(self.normal).argmin()])
        first /= np.linalg.norm(first)
        return np.stack([first, np.cross(self.normal, first)])

    def plane(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return a point (..., 3) m and the normal (..., 3) of the plane that the vector u (..., U) describes."""
        p = LOWER + u[..., :SURFACE] * WIDTH
        normal = self.normal + p[..., :2] @ self.axes
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        height = p[..., 2] + LOAD * p[..., 4] / np.exp(p[..., 3])
        return self.origin + height[..., None] * normal, normal

    def law(self, u: np.ndarray) -> np.ndarray:
        """Return the force law's five values (..., 5) for vectors u (..., U), in the order of `contact_law`."""
        p = LOWER + u[..., :SURFACE] * WIDTH
        K = LOAD / (LOAD * p[..., 4] / np.exp(p[..., 3])) ** p[..., 4]
        return np.stack([K, p[..., 4], p[..., 5], p[..., 6], np.exp(p[..., 7])], -1)

    def compliance(self, u: np.ndarray) -> np.ndarray:
        """Return the gears' compliance (..., n) rad/Nm in vectors u (..., U), or 0 if u contains no gear values."""
        if u.shape[-1] == SURFACE:
            return np.zeros((*u.shape[:-1], len(self.tau_max)))
        relative = 1.0 + FARTHEST * (2.0 * u[..., SURFACE + 1 :] - 1.0)
        return SOFTEST * u[..., SURFACE, None] * self.gears.shape * relative / self.tau_max

    def with_gears(self, u: np.ndarray) -> np.ndarray:
        """Append the gears' prior means to a surface's vector u (8,); return the new vector (8 + 1 + n,)."""
        return np.concatenate([u, [self.gears.center / SOFTEST], np.full(len(self.tau_max), 0.5)])

    def prior(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and 1 / standard deviation, each (count,), of the Gaussian prior of a vector u (count,)."""
        joints = np.broadcast_to(2.0 * FARTHEST / self.gears.scatter, len(self.tau_max))
        weight = np.concatenate([np.full(SURFACE, FLAT), [SOFTEST / self.gears.width], joints])
        return self.with_gears(np.full(SURFACE, 0.5))[:count], weight[:count]

    def surface(self, u: np.ndarray) -> Surface:
        """Return the surface that the vector u (U,) describes."""
        point, normal = self.plane(u)
        K, *rest = self.law(u).tolist()
        return Surface(point, normal, K * UNIT_DEPTH ** (rest[0] - 1.0), *rest)

    def tilt_of(self, normal: np.ndarray) -> np.ndarray:
        """Return the change (2,) of u[:2] that tilts the normal `self.normal` to the direction `normal` (3,)."""
        return self.axes @ (normal / (normal @ self.normal)) / WIDTH[:2]

    def unit(self, height: float, slope: float, exponent: float, friction: float) -> np.ndarray:
        """Return the vector u (8,) of an untilted plane; `height` (m) and `slope` (N/m) refer to the load LOAD."""
        p = np.array([0.0, 0.0, height, np.log(slope), exponent, 0.0, friction, np.log(2e-4)])
        return np.clip((p - LOWER) / WIDTH, 0.0, 1.0)
