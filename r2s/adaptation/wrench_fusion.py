"""Combine two estimates of the external force: from the momentum and from an identified surface.

The joint angles yield the tip's penetration depth, and the surface's contact law (r2s/physics/surface.py) yields the
normal force F_s. The variance s^2 of F_s comes from the surface's posterior, encoder noise, and errors of the contact
law. The momentum yields the force F with covariance P. A Kalman update along the normal n combines F and F_s:
F' = F + P n (F_s - n^T F) / (n^T P n + s^2). Before the update, a low-pass filters F_s - n^T F, because the measured
angles are noisy.

The force F_s is wrong if the tip touches a different surface or if the identified surface has moved. An innovation
test (Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking, 2001, 5.4) therefore rejects a surface
if the low-passed innovation exceeds REFUSED standard deviations. Above INFLATED standard deviations, the surface's
weight decreases. The estimate ignores a rejected surface until the motion ends, because any surface would pass the
test at a small force.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from r2s.adaptation import tuning
from r2s.adaptation.sensor_noise import SensorNoise, panda_noise
from r2s.adaptation.wrench import WrenchObserver
from r2s.compiled import njit
from r2s.errors import UserError
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import SIM_DT, Robot
from r2s.physics.surface import Surface, normal_force
from r2s.recordings.recording import Recording

DIFFERENCE, TESTED, TRUSTED, DEPTH, RATE, SINCE = range(6)  # indices of `memory`
LAW_K, LAW_EXPONENT, LAW_DAMPING, LAW_POINT, LAW_NORMAL, LAW = 0, 1, 2, 3, 6, 9  # columns of `SurfaceLaw.law`


class SurfaceLaw(NamedTuple):
    """A surface's parameters as arrays for compiled code."""

    law: np.ndarray  # (1 + S, LAW): the estimate, then S posterior samples
    radius: float  # m, radius of the tip
    angle: float  # rad, noise of measured angles


def surface_law(surface: Surface, draws: Sequence[Surface], radius: float, angle: float) -> SurfaceLaw:
    """Return the `SurfaceLaw` of a surface and of at most `tuning.SURFACE_DRAWS` posterior samples."""
    each = [surface, *draws[: tuning.SURFACE_DRAWS]]
    law = [np.concatenate([[s.coefficient, s.exponent, s.damping], s.point, s.normal]) for s in each]
    return SurfaceLaw(np.array(law, dtype=float), float(radius), float(angle))


class FusedWrench(WrenchObserver):
    """A `WrenchObserver` whose force estimate also uses an identified surface; contact detection ignores the surface.

    Args:
        surface: identified surface. draws: samples of the surface's posterior
            (r2s/identification/contact/contact_file.py).

    Raises:
        UserError: the robot has no tool.
    """

    def __init__(
        self,
        robot: Robot,
        dynamics: Dynamics,
        surface: Surface,
        draws: Sequence[Surface] = (),
        thresholds: np.ndarray | None = None,
        sensors: SensorNoise | None = None,
    ):
        if robot.tool is None:
            raise UserError("robot.tool: a force from a surface needs the tip that touches it, got none")
        sensors = sensors or panda_noise()
        self._law = surface_law(surface, draws, robot.tool.radius, sensors.angle)
        super().__init__(robot, dynamics, thresholds, sensors)

    def calibrate(self, robot: Robot, free: Sequence[Recording]) -> None:
        """Set sensor noise and contact thresholds from recordings without contact; see `WrenchObserver`."""
        super().calibrate(robot, free)
        self._law = self._law._replace(angle=self.sensors.angle)

    def begin(self) -> None:
        """Start a motion from rest; trust the surface again, even after a rejection by the innovation test."""
        super().begin()
        self._fused, self._fused_covariance = np.zeros(3), np.zeros((3, 3))
        self._memory = np.zeros(6)
        self._memory[TRUSTED] = 1.0

    def __call__(self, q: np.ndarray, dq: np.ndarray, tau: np.ndarray) -> bool:
        """Process one cycle; see `WrenchObserver`."""
        touches, state = super().__call__(q, dq, tau), self._state
        fuse(
            self._law,
            state.x,
            state.P,
            state.place,
            state.jacobian,
            self._memory,
            self._fused,
            self._fused_covariance,
        )
        return touches

    @property
    def wrench(self) -> np.ndarray:
        """Force (3,) N on the arm's tip in base axes, fused from joint torques and the surface's contact law."""
        return self._fused

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of `wrench`."""
        return self._fused_covariance

    @property
    def trusted(self) -> bool:
        """Whether the innovation test has accepted the surface throughout this motion."""
        return bool(self._memory[TRUSTED] > 0.0)


@njit(cache=True, error_model="numpy")
def surface_force(law, k, tip, rate):
    """Return force (N) and depth (m) of a tip at `tip` (3,) m in surface k of `law.law`; rate: m/s, of the depth."""
    row = law.law[k]
    depth = law.radius
    for c in range(3):
        depth -= (tip[c] - row[LAW_POINT + c]) * row[LAW_NORMAL + c]
    return normal_force(row[LAW_K], row[LAW_EXPONENT], row[LAW_DAMPING], depth, rate), depth


@njit(cache=True, error_model="numpy")
def surface_variance(law, force, depth, tip, rate, jacobian):
    """Return the normal force's variance (N^2) due to posterior, encoder noise and errors of the contact law."""
    square, count = (tuning.SURFACE_SHARE * force) ** 2 + tuning.SURFACE_FLOOR**2, len(law.law) - 1
    for k in range(1, count + 1):
        square += (surface_force(law, k, tip, rate)[0] - force) ** 2 / count
    normal, slope = law.law[0, LAW_NORMAL : LAW_NORMAL + 3], force * law.law[0, LAW_EXPONENT] / depth
    smooth = 0.5 * SIM_DT * tuning.DIFFERENCE_RATE  # share of the variance of white noise that passes the low-pass
    for j in range(jacobian.shape[1]):
        lever = normal[0] * jacobian[0, j] + normal[1] * jacobian[1, j] + normal[2] * jacobian[2, j]
        square += smooth * (slope * lever * law.angle) ** 2
    return square


@njit(cache=True, error_model="numpy")
def fuse(law, force, covariance, tip, jacobian, memory, fused, fused_covariance):
    """Compute the fused force (3,) N and its covariance (3, 3) N^2; update `memory` (6,) of the observer."""
    fused[:] = force[:3]
    fused_covariance[:] = covariance[:3, :3]
    normal = law.law[0, LAW_NORMAL : LAW_NORMAL + 3]
    pressing, depth = surface_force(law, 0, tip, memory[RATE])
    if memory[SINCE] > 0.0:
        memory[RATE] += SIM_DT * tuning.DEPTH_RATE * ((depth - memory[DEPTH]) / SIM_DT - memory[RATE])
    memory[DEPTH], memory[SINCE] = depth, 1.0
    if pressing <= 0.0:  # the tip does not touch the surface; another part of the arm may touch something
        memory[DIFFERENCE] = 0.0
        return
    own = surface_variance(law, pressing, depth, tip, memory[RATE], jacobian)
    gain, variance, difference = np.zeros(3), own, pressing
    for i in range(3):
        for k in range(3):
            gain[i] += covariance[i, k] * normal[k]
        variance += normal[i] * gain[i]
        difference -= normal[i] * force[i]
    memory[DIFFERENCE] += SIM_DT * tuning.DIFFERENCE_RATE * (difference - memory[DIFFERENCE])
    memory[TESTED] += SIM_DT * tuning.TEST_RATE * (difference / np.sqrt(variance) - memory[TESTED])
    if abs(memory[TESTED]) > tuning.REFUSED:
        memory[TRUSTED] = 0.0
    if memory[TRUSTED] == 0.0:
        return
    variance *= 1.0 + tuning.INFLATION * max(abs(memory[TESTED]) - tuning.INFLATED, 0.0) ** 2
    for i in range(3):
        fused[i] += gain[i] * memory[DIFFERENCE] / variance
        for k in range(3):
            fused_covariance[i, k] -= gain[i] * gain[k] / variance
