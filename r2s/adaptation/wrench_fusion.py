"""External force from momentum and from a known surface together.

Encoders tell how deep the tip is in an identified surface, and its law (r2s/physics/surface.py) gives the normal
force F_s. The momentum's force F has other errors, so that one update of a Kalman filter combines both:
F' = F + P n (F_s - n . F) / (n . P n + s^2). The difference passes a low-pass first, because angles have noise.

A surface that was never identified, has moved or is another one gives a wrong F_s. So the difference is tested: its
low-passed mean, in standard deviations, may not exceed REFUSED (innovation test: Bar-Shalom, Li and Kirubarajan,
Estimation with Applications to Tracking, 2001, 5.4). A refused surface changes nothing for the rest of the motion: a
small force would agree with any.
"""

from typing import NamedTuple

import numpy as np

from r2s.adaptation.wrench import WrenchObserver, Z
from r2s.compiled import njit
from r2s.errors import UserError, check_number
from r2s.physics.robot import SIM_DT
from r2s.physics.surface import Surface, normal_force

DIFFERENCE_RATE = 50.0  # 1/s, low-pass of the difference of both forces
TEST_RATE = 10.0  # 1/s, low-pass of the tested difference
REFUSED = 2.2  # standard deviations
RATE_RATE = 100.0  # 1/s, low-pass of the penetration's rate
DIFFERENCE, TESTED, TRUSTED, DEPTH, RATE, SINCE = range(6)  # `memory`


class SurfaceLaw(NamedTuple):
    """A surface as numbers for compiled code."""

    point: np.ndarray  # (3,) m
    normal: np.ndarray  # (3,)
    K: float  # N/m^e
    exponent: float
    damping: float  # s/m
    radius: float  # m, of the tip
    share: float  # standard deviation of F_s, of F_s
    floor: float  # N, the same at any force


class FusedWrench:
    """Force of a `WrenchObserver` together with that of a surface, cycle by cycle.

    Attributes:
        force: (3,) N on the arm at the tip, base axes. covariance: (3, 3) N^2, of it.

    Args:
        observer: its robot has a tool. surface: identified. share, floor: standard deviation of the surface's force,
            relative and in N, such as its error on presses that it was not identified from.

    Raises:
        UserError: no tool, or share and floor below 0.
    """

    def __init__(self, observer: WrenchObserver, surface: Surface, share: float = 0.03, floor: float = 0.3):
        if observer.tool is None:
            raise UserError("robot.tool: a force from a surface needs the tip that touches it, got none")
        check_number("share", share, "[0, inf)")
        check_number("floor", floor, "(0, inf)")
        self.observer = observer
        point, normal = np.array(surface.point, dtype=float), np.array(surface.normal, dtype=float)
        law = (surface.coefficient, surface.exponent, surface.damping, observer.tool.radius, share, floor)
        self._law = SurfaceLaw(point, normal, *map(float, law))
        self.force, self.covariance = np.zeros(3), np.zeros((3, 3))
        self.begin()

    def begin(self) -> None:
        """Begin a motion from rest; the surface is trusted until it errs."""
        self.observer.begin()
        self._memory = np.zeros(6)
        self._memory[TRUSTED] = 1.0

    def __call__(self, q: np.ndarray, dq: np.ndarray, tau: np.ndarray) -> bool:
        """Process a cycle; see `WrenchObserver`."""
        touches = self.observer(q, dq, tau)
        observer = self.observer
        fuse(self._law, observer.force, observer.covariance, observer.tip, self._memory, self.force, self.covariance)
        return touches

    @property
    def force_half(self) -> np.ndarray:
        """(3,) N, half widths of the 95 % intervals of `force`."""
        return Z * np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    @property
    def trusted(self) -> bool:
        """Whether the surface agrees with the momentum."""
        return bool(self._memory[TRUSTED] > 0.0)


@njit(cache=True, error_model="numpy")
def fuse(law, force, covariance, tip, memory, fused, fused_covariance):
    """Write the fused force (3,) N and its covariance (3, 3) N^2; memory: (6,), of `FusedWrench`."""
    fused[:] = force
    fused_covariance[:] = covariance[:3, :3]
    depth, momentum_force = law.radius, 0.0
    for c in range(3):
        depth -= (tip[c] - law.point[c]) * law.normal[c]
        momentum_force += law.normal[c] * force[c]
    if memory[SINCE] > 0.0:
        memory[RATE] += SIM_DT * RATE_RATE * ((depth - memory[DEPTH]) / SIM_DT - memory[RATE])
    memory[DEPTH] = depth
    surface_force = normal_force(law.K, law.exponent, law.damping, depth, memory[RATE])
    if surface_force <= 0.0:  # the tip is away: something else may touch the arm
        memory[DIFFERENCE], memory[SINCE] = 0.0, 1.0
        return
    gain = np.zeros(3)
    variance = (law.share * surface_force) ** 2 + law.floor**2
    for i in range(3):
        for k in range(3):
            gain[i] += covariance[i, k] * law.normal[k]
        variance += law.normal[i] * gain[i]
    difference = surface_force - momentum_force
    memory[DIFFERENCE] += SIM_DT * DIFFERENCE_RATE * (difference - memory[DIFFERENCE])
    memory[TESTED] += SIM_DT * TEST_RATE * (difference / np.sqrt(variance) - memory[TESTED])
    if abs(memory[TESTED]) > REFUSED:
        memory[TRUSTED] = 0.0
    memory[SINCE] = 1.0
    if memory[TRUSTED] == 0.0:
        return
    for i in range(3):
        fused[i] += gain[i] * memory[DIFFERENCE] / variance
        for k in range(3):
            fused_covariance[i, k] -= gain[i] * gain[k] / variance
