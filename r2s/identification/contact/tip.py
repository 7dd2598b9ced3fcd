"""Compute a tool tip's motion in a recording, and the joint torque of the tip's contact with a surface."""

from dataclasses import dataclass, field

import numpy as np

from r2s.compiled import njit
from r2s.physics.contact import RIGID
from r2s.physics.kinematics import POSE, link_frames
from r2s.physics.newton_euler import links_of
from r2s.physics.payload import ee_pose
from r2s.physics.robot import Robot
from r2s.physics.surface import Surface, normal_force

NEWTON = 10  # iterations for two springs in series; relative error below 1e-6 for exponents of 1 to 2
SHALLOW = 1e-6  # least surface depth / total deflection; at depth 0, the force curve would have no slope


@dataclass(frozen=True)
class TipMotion:
    """Motion of a tool's spherical tip at F instants, on an arm with n joints.

    Attributes:
        step: s, time between two instants. starts: (F,) bool, whether a new continuous motion starts at an instant.
        centre: (F, 3) m, center of the tip. radius: m, radius of the tip.
        axes, origins: (F, n, 3), joint axes, and points on these axes, in the base frame. dq: (F, n) rad/s, velocity.
        play: m, largest tip path due to encoder noise; a path shorter than `play` only bends bristles elastically.
        compliance: (n,) rad/Nm, compliance of gears whose deflection the encoders do not measure; an empty array
            means rigid gears.
    """

    step: float
    starts: np.ndarray
    centre: np.ndarray
    radius: float
    axes: np.ndarray
    origins: np.ndarray
    dq: np.ndarray
    play: float = 0.0
    compliance: np.ndarray = field(default_factory=lambda: np.zeros(0))

    @staticmethod
    def of(robot: Robot, q: np.ndarray, dq: np.ndarray, step: float, starts: np.ndarray, play: float) -> "TipMotion":
        """Return the motion of the tip of `robot.tool` for joint motion q, dq (F, n) rad, rad/s."""
        assert robot.tool is not None
        links = links_of(robot, robot.mass, robot.com, robot.inertia)
        place, axes_of_site = ee_pose(robot)
        frames, axes = np.empty((*q.shape, POSE)), np.empty((*q.shape, 3))
        _frames(links, np.ascontiguousarray(q), frames, axes)
        rotation = frames[:, -1, 3:].reshape(-1, 3, 3)
        centre = frames[:, -1, :3] + rotation @ (place + axes_of_site @ robot.tool.tip)
        origins = np.ascontiguousarray(frames[..., :3])
        return TipMotion(step, starts, centre, robot.tool.radius, axes, origins, np.ascontiguousarray(dq), play)

    def jacobian(self, at: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """Return Jacobians (A, 3, n) m/rad of the tip's deepest point, at the instants with the indices `at` (A,)."""
        point = self.centre[at] - self.radius * normal
        return np.cross(self.axes[at], point[:, None] - self.origins[at]).swapaxes(1, 2)

    def contact(self, surface: Surface) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return joint torque (F, n) Nm, normal force (F,) N, penetration depth (F,) m and its rate (F,) m/s."""
        return self.contact_of(surface.point, surface.normal, contact_law(surface))

    def contact_of(
        self, point: np.ndarray, normal: np.ndarray, law: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the result of `contact` for a plane with `point` and `normal`; `law`: result of `contact_law`."""
        tau, out = np.empty_like(self.dq), np.empty((3, len(self.dq)))
        motion = self.centre, self.axes, self.origins, self.dq, self.starts
        _contact(motion, (self.radius, self.step, self.play, self.compliance), point, normal, law, tau, out)
        return tau, out[0], out[1], out[2]


def contact_law(surface: Surface) -> np.ndarray:
    """Return the values (5,) of a surface's force law: K, exponent, damping, friction and bristle."""
    s = surface
    return np.array([s.coefficient, s.exponent, s.damping, s.friction, max(s.bristle, RIGID)])


@njit(cache=True, error_model="numpy")
def _frames(links, q, frames, axes):
    for t in range(len(q)):
        link_frames(links, q[t], frames[t], axes[t])


@njit(cache=True, error_model="numpy")
def _contact(motion, settings, point, normal, law, tau, out):
    """Write joint torque into tau (F, n); write normal force, penetration depth and depth rate into out (3, F).

    The contact force on the tip is F g with g = n - mu z: normal force F, unit normal n, friction coefficient mu and
    bristle deflection z (Dahl 1968 in two dimensions). z follows dz = (dx - |dx| z) / bristle; x is the tip's deepest
    point, projected onto the surface. Encoder noise lengthens the path |dx| of a resting tip, which would relax the
    bristles. A path shorter than `play` therefore only bends bristles elastically.

    Gears and surface are springs in series. With the deepest point's Jacobian J and the gears' compliances C, the
    contact force turns the joints by C J^T g F. This deflection reduces the measured depth by n^T J C J^T g F.
    `bristle` includes the gears' deflection along the surface.
    """
    centre, axes, origins, dq, starts = motion
    radius, step, play, compliance = settings
    K, exponent, damping, friction, bristle = law
    z, lead, n = np.zeros(3), np.zeros(3), dq.shape[1]
    arm, v, f = np.empty((n, 3)), np.empty(3), np.empty(3)
    for t in range(len(dq)):
        depth, rate = radius, 0.0
        for k in range(3):
            depth -= normal[k] * (centre[t, k] - point[k])
            v[k] = 0.0
        for j in range(n):
            x = centre[t, 0] - radius * normal[0] - origins[t, j, 0]
            y = centre[t, 1] - radius * normal[1] - origins[t, j, 1]
            w = centre[t, 2] - radius * normal[2] - origins[t, j, 2]
            a, b, c = axes[t, j]
            arm[j, 0], arm[j, 1], arm[j, 2] = b * w - c * y, c * x - a * w, a * y - b * x
            for k in range(3):
                v[k] += arm[j, k] * dq[t, j]
        for k in range(3):
            rate -= normal[k] * v[k]
        soft = 0.0
        for j in range(len(compliance)):
            along_n, along_g = 0.0, 0.0
            for k in range(3):
                along_n += arm[j, k] * normal[k]
                along_g += arm[j, k] * (normal[k] - friction * z[k])
            soft += compliance[j] * along_n * along_g
        force, depth, own_rate = _in_series(soft, K, exponent, damping, depth, rate)
        if depth <= 0.0 or starts[t]:
            z[:], lead[:] = 0.0, 0.0
        else:
            far, along = 0.0, 0.0
            for k in range(3):
                lead[k] += step * (v[k] + rate * normal[k])
                far += lead[k] ** 2
            far = np.sqrt(far)
            path = max(far - play, 0.0)
            keep = np.exp(-path / bristle)
            for k in range(3):
                z[k] = keep * z[k] + (1.0 - keep) * (lead[k] / far if path > 0.0 else 0.0)
                lead[k] *= (far - path) / far if path > 0.0 else 1.0
                along += normal[k] * z[k]
            for k in range(3):
                z[k] -= along * normal[k]
        bent = 0.0
        ahead = np.sqrt(lead[0] ** 2 + lead[1] ** 2 + lead[2] ** 2)
        for k in range(3):
            f[k] = z[k] + (lead[k] - ahead * z[k]) / max(bristle, ahead)
            bent += f[k] ** 2
        share = friction / max(np.sqrt(bent), 1.0)
        for k in range(3):
            f[k] = force * (normal[k] - share * f[k])
        out[0, t], out[1, t], out[2, t] = force, depth, own_rate
        for j in range(n):
            tau[t, j] = arm[j, 0] * f[0] + arm[j, 1] * f[1] + arm[j, 2] * f[2]


@njit(cache=True, error_model="numpy")
def _in_series(soft, K, exponent, damping, depth, rate):
    """Compute force, depth and depth rate of a surface in series with a spring (`soft`, m/N) by Newton's method.

    depth, rate: m, m/s, total deflection of spring and surface, and the rate of this total. The returned rate of the
    surface's depth neglects damping.
    """
    if soft <= 0.0 or depth <= 0.0:
        return normal_force(K, exponent, damping, depth, rate), depth, rate
    total, force, own_rate = depth, 0.0, 0.0
    for _ in range(NEWTON):
        depth = max(total - soft * force, SHALLOW * total)
        slope = exponent * normal_force(K, exponent, 0.0, depth, 0.0) / depth
        own_rate = rate / (1.0 + soft * slope)
        own = normal_force(K, exponent, damping, depth, own_rate)
        force += (own - force) / (1.0 + soft * slope * max(1.0 + damping * own_rate, 0.0))
    return force, max(total - soft * force, SHALLOW * total), own_rate
