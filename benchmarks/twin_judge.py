"""Judge the intervals of an identified twin's friction: what besides nominal links and gravity opposes its motion.

Friction, offset, cable and errors of the links' gravity do not separate, so their sum is judged, in Nm: in each joint
and direction the mean over the training motion, in BINS ranges of speed. `WatchedTwin` logs the sum while it moves.
"""

from itertools import pairwise

import numpy as np
from common import ROBOT
from independent_judge import DIRECTIONS, SLOWEST, visited
from payload_parts import net_friction
from scipy.signal import savgol_filter

from r2s.arm.interface import ArmState
from r2s.arm.twins import elastic_joints as elastic
from r2s.arm.twins import lugre_joints as lugre
from r2s.arm.twins.draws import drag
from r2s.arm.twins.elastic_twin import ElasticTwin
from r2s.arm.twins.twin_base import TwinBase
from r2s.identification.result import IdentificationResult
from r2s.physics.dynamics import Dynamics
from r2s.physics.rigid_body import LinkInertia, regressor
from r2s.physics.robot import SIM_DT

BINS, LEAST = 5, 20  # ranges of speed in each direction; fewest rows of a judged range
EVERY = 10  # cycles; judged rows of the motion


class WatchedTwin:
    """A twin that logs its friction minus offset and cable torque, Nm, in each cycle.

    Attributes:
        resistance: the log, one (n,) array per cycle. links: masses, centers of mass and tensors of the true links.
    """

    def __init__(self, arm: TwinBase):
        self.arm, self.robot = arm, arm.robot
        self._elastic = isinstance(arm, ElasticTwin)
        self.resistance: list[np.ndarray] = []
        self.links = arm._unloaded if self._elastic else arm._links  # type: ignore[attr-defined]

    def move_to(self, q: np.ndarray) -> ArmState:
        """Place the arm; see `Arm`."""
        return self.arm.move_to(q)

    def read(self) -> ArmState:
        """Return the state."""
        return self.arm.read()

    def command(self, tau: np.ndarray) -> None:
        """Send a command and log what resists it."""
        self.arm.command(tau)
        p, s = self.arm._hidden, self.arm._state  # type: ignore[attr-defined]
        of, q = (elastic, s[elastic.LINK_Q]) if self._elastic else (lugre, s[lugre.Q])
        friction = net_friction(p, s) if self._elastic else s[lugre.FRICTION]
        cable = p[of.DRAG_OWN], p[of.DRAG_NEXT], p[of.DRAG_WAVES], p[of.DRAG_PHASE]
        pull = [drag(*(row[i] for row in cable), q[i], q[(i + 1) % len(q)]) for i in range(len(q))]
        self.resistance.append(friction - p[of.OFFSET] - np.array(pull))

    def stop(self) -> None:
        """End the motion."""
        self.arm.stop()


def covered(twin: WatchedTwin, q: np.ndarray, found: IdentificationResult) -> float:
    """Return the share of judged means that lie in their 95 % interval; q: (T, 7) rad, the motion of `twin`'s log."""
    motion = Means(q)
    true = motion.of(np.array(twin.resistance)[motion.rows])
    true += motion.gravity_error(LinkInertia(*twin.links).standard())
    draws = found.space.dynamics(found.found.samples)
    means = np.array([motion.resistance(draws.one(k)) for k in range(len(found.found.samples))])
    low, high = np.quantile(means, (0.025, 0.975), axis=0)
    seen = np.isfinite(true)
    return float(((low <= true) & (true <= high))[seen].mean())


class Means:
    """Means (14 BINS,) over the rows of a motion q (T, 7) rad: by joint, then direction, then range of speed."""

    def __init__(self, q: np.ndarray):
        dq = savgol_filter(q, 31, 3, deriv=1, delta=SIM_DT, axis=0)
        self.rows = slice(None, len(q), EVERY)
        top, self.q, self.dq = visited(q), q[self.rows], dq[self.rows]
        still = np.zeros_like(self.q)
        self._gravity = regressor(ROBOT, self.q, still, still, ROBOT.gravity)
        self._nominal = LinkInertia(ROBOT.mass, ROBOT.com, ROBOT.inertia).standard()
        self._load = np.abs(np.einsum("tjkc,kc->tj", self._gravity, self._nominal))
        self._within = []  # by joint, direction and range of speed: the rows of its mean
        for j in range(ROBOT.n):
            for way, fastest in zip(DIRECTIONS, top[:, j], strict=True):
                edges = np.linspace(SLOWEST, fastest, BINS + 1)
                speed = way * self.dq[:, j]
                own = [np.flatnonzero((speed >= a) & (speed < b)) for a, b in pairwise(edges)]
                self._within += [(j, rows) for rows in own]
        self._mean_gravity = [self._gravity[rows, j].mean(0) for j, rows in self._within]

    def of(self, torque: np.ndarray) -> np.ndarray:
        """Return the means of a torque (T', 7) Nm; NaN in ranges of speed with fewer than LEAST rows."""
        return np.array([torque[rows, j].mean() if len(rows) >= LEAST else np.nan for j, rows in self._within])

    def gravity_error(self, standard: np.ndarray) -> np.ndarray:
        """Return the means of the gravity torque of links, given their standard parameters, minus the nominal one."""
        return np.array([np.sum(y * (standard - self._nominal)) for y in self._mean_gravity])

    def resistance(self, d: Dynamics) -> np.ndarray:
        """Return the means of what an identified arm adds to nominal links and gravity."""
        torque = d.friction(self.dq) + np.sign(self.dq) * d.load * self._load - d.offset
        torque -= d.drag[:, 0] * np.sin(self.q) + d.drag[:, 1] * np.cos(self.q)
        return self.of(torque) + self.gravity_error(LinkInertia(d.mass, d.com, d.inertia).standard())
