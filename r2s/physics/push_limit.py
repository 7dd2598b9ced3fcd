"""Limit the force with which a tool's tip presses on a surface, and the tip's closing speed at contact.

A push is a force along the surface's inward normal. With the arm's mass matrix M, and along the inward normal, the
tip's Jacobian J, speed v and effective mass m = 1 / (J M^-1 J^T) (Khatib, IEEE Journal of Robotics and Automation
3(1), 1987) satisfy

    m dv/dt = P + P_f - F,   P = m (J M^-1 (tau - bias) + dJ/dt dq)

P is the push of the command, F >= 0 is the contact force, and P_f is the push of joint friction, with |P_f| <=
`hidden` = m |J M^-1| friction. Every millisecond, the push limit enforces two rules:

- Force: P + hidden <= force_max.
- Speed: dv/dt <= RATE (v_max - v). With an estimate R of F - P_f, the speed rule is P <= R + m RATE (v_max - v). The
  allowed speed v_max is `speed_near` / OVERSHOOT at the surface and grows with the tip's height.

The estimate R is P - m dv/dt after a low-pass: the momentum residual along the normal (De Luca et al., IROS 2006). In
free motion, R is 0, so the speed rule bounds the tip speed by v_max. At rest in contact, dv/dt is 0, so R equals the
push P. The speed rule is then P <= P + m RATE v_max, which allows P to rise. The push limit caps R at 0 if the tip
moves inward faster than v_max. It also caps R at 0 if the tip moves outward faster than `speed_near` / OVERSHOOT, or,
in a stop, faster than OVERSHOOT * LEAVE.

On a frictionless surface of stiffness k, the contact force F is at most force_max + speed_near sqrt(k m). By the
speed rule, the tip is not faster than speed_near when F reaches force_max. By the force rule, P + P_f <= force_max,
so the net force P + P_f - F brakes the tip while F exceeds force_max. Surface friction mu F pushes a sliding tip
inward with up to mu c F. The factor c is m |T J M^-1 J^T n|, with the full Jacobian J and the projection T onto the
plane with the normal n. On a surface with friction, the bound therefore contains (1 - mu c) F and (1 - mu c) k
instead of F and k.

The force rule and the speed rule restrict the torque to two half-spaces with the same normal J M^-1. Of all torques
in both half-spaces, Gauss' principle selects the torque nearest to the effort, which is the effort minus J^T f.
Regula falsi finds the force f for which the torque also satisfies the acceleration bounds (safety_filter.py).
"""

from dataclasses import dataclass

import numpy as np

from r2s.compiled import njit
from r2s.errors import UserError, check_number, instead_of
from r2s.physics.linear_algebra import factor, solve, unpack
from r2s.physics.payload import ee_pose
from r2s.physics.rigid_body import InverseInertia
from r2s.physics.robot import SIM_DT, Robot
from r2s.physics.safety_filter import APPROACH, RATE, JointDynamics, bounded, joint_bounds
from r2s.physics.safety_filter import WORK as FILTER_WORK
from r2s.physics.tip import Tip, nominal_plane

# Columns of a limit: settings; state of the push limit: R in N, last speed in m/s, whether this speed is valid; state
# of a stop (contact_stop.py): phase, contact force N at the start, height m at which the tip left the surface,
# outward pull N
FORCE_MAX, SPEED_NEAR, SLOPE, MARGIN, POINT, NORMAL, TIP, RADIUS, RESISTED, SPEED, BEGUN = (
    *(0, 1, 2, 3, 4, 7, 10, 13, 14, 15, 16),
)
STOP, PHASE, FELT, HEIGHT, PULL = range(BEGUN + 1, BEGUN + 6)
COLUMNS = PULL + 1
HOLD, RELEASE, RETREAT = 1, 2, 3  # values of STOP
STOPS = {"hold": HOLD, "release": RELEASE, "retreat": RETREAT}
LEAVE = 0.05  # m/s, outward tip speed in a stop: 20 N on 2e3 N/m are released in half of LEAVES_S
WORK = 3  # rows of `work` in addition to n
ROUNDS = 16  # largest number of trial values of f
CLOSE = 1e-2  # m/s^2, tolerance: the inward acceleration may be below its bound by up to CLOSE
OVERSHOOT = 1.5  # largest ratio of closing speed to v_max: latency limits how fast the tip brakes
STIFF = 1e5  # N/m, stiffest surface of conf/dr/contact.yaml
NEAR_M = 0.3  # m, distance from the surface beyond which the push limit has no effect


@dataclass(frozen=True)
class PushLimit:
    """Settings of the push limit at a plane whose position is known approximately.

    Attributes:
        force_max: N, largest push. speed_near: m/s, largest closing speed at the surface.
        point, normal: (3,) m and (3,), nominal plane in the base frame. stop: a key of STOPS (contact_stop.py).
        place, tilt: m and rad, largest deviations of the true plane from the nominal plane.
    """

    force_max: float
    speed_near: float
    point: np.ndarray
    normal: np.ndarray
    place: float = 0.0
    tilt: float = 0.0
    stop: str = "release"

    def columns(self, robot: Robot) -> np.ndarray:
        """Return the initial argument `limit` (COLUMNS,) of `push_bound` for the robot's tool."""
        Tip(robot)  # raises UserError without a tool
        site, axes = ee_pose(robot)
        out = np.zeros(COLUMNS)
        out[FORCE_MAX], out[SPEED_NEAR] = self.force_max, self.speed_near / OVERSHOOT
        out[SLOPE], out[MARGIN], out[STOP] = np.tan(self.tilt), self.place, STOPS[self.stop]
        out[POINT : POINT + 3], out[NORMAL : NORMAL + 3] = self.point, self.normal
        out[TIP : TIP + 3], out[RADIUS] = site + axes @ robot.tool.tip, robot.tool.radius  # type: ignore[union-attr]
        return out

    def at(self, robot: Robot, friction: np.ndarray, q: np.ndarray) -> tuple[float, float]:
        """Return the effective mass, kg, at q (n,) rad, and the largest push, N, of joint friction (n,) Nm."""
        row = -self.normal @ Tip(robot)(q)[1]
        lever = InverseInertia(robot)(q[None])[0] @ row
        mass = 1.0 / float(row @ lever)
        return mass, mass * float(np.abs(lever) @ friction)

    def bound(self, robot: Robot, q: np.ndarray, stiffness: float, friction: float = 0.0) -> float:
        """Return the largest contact force, N, at q (n,) rad.

        stiffness: N/m, of the surface. friction: friction coefficient of the surface. The result is infinite if
        surface friction can push a sliding tip inward without limit.
        """
        jacobian = Tip(robot)(q)[1]
        moved = jacobian @ InverseInertia(robot)(q[None])[0] @ jacobian.T @ self.normal  # 1/kg, per unit normal force
        mass = 1.0 / float(moved @ self.normal)
        left = 1.0 - friction * mass * float(np.linalg.norm(moved - self.normal / mass))
        return (self.force_max + self.speed_near * np.sqrt(left * stiffness * mass)) / left if left > 0.0 else np.inf


def push_limit(
    robot: Robot,
    friction: np.ndarray,
    force_max: float | None,
    speed_near: float | None,
    plane: tuple[np.ndarray, np.ndarray] | None = None,
    asked: float = 0.0,
    stop: str | None = None,
) -> PushLimit | None:
    """Return the push limit for the settings `safety.force_max` and `safety.speed_near`; None if both are null.

    Args:
        robot: an arm with a tool. friction: (n,) Nm, friction level of each joint.
        force_max, speed_near: N and m/s, see `PushLimit`; None for `speed_near`: the speed that limits the contact
            force to 2 force_max, at home on a surface of 1e5 N/m.
        plane: point (3,) m and normal (3,); if None, a work table below the tip at home. asked: N, a task's largest
            force.
        stop: a key of STOPS (contact_stop.py), "release" by default.

    Raises:
        UserError: a value is out of range, the robot has no tool, or force_max is less than the task's force plus
            twice `hidden`, the largest push of joint friction.
    """
    if stop is not None and stop not in STOPS:
        raise UserError(f"task.stop: {stop!r}; {instead_of(stop, STOPS)}")
    if force_max is None and speed_near is None:
        return None
    if force_max is None:
        raise UserError("safety.speed_near: it needs safety.force_max, got null; set a force in N")
    check_number("safety.force_max", force_max, "(0, inf)")
    point, normal = plane or nominal_plane(robot)
    mass, hidden = PushLimit(force_max, 1.0, point, normal).at(robot, friction, robot.q_home)
    if speed_near is None:
        speed_near = force_max / np.sqrt(STIFF * mass)
    check_number("safety.speed_near", speed_near, "(0, inf)")
    if (least := asked + 2.0 * hidden) > force_max:
        raise UserError(
            f"safety.force_max: {force_max:g} N is not allowed; {least:.3g} N or more is: the task asks for "
            f"{asked:g} N, and joint friction may hide {hidden:.2g} N in each direction"
        )
    return PushLimit(float(force_max), float(speed_near), point, normal, stop=stop or "release")


@njit(cache=True, error_model="numpy")
def tip_motion(limit, kinematics, dq, row):
    """Write Jacobian J (n,) m/rad to `row`; return height, m, inward and lateral speed, m/s, and dJ/dt dq, m/s^2.

    The height is the tip's height above the highest possible true plane. The lateral speed is along the plane.
    """
    position, R, anchor, axis = kinematics
    a, b, c = limit[TIP], limit[TIP + 1], limit[TIP + 2]
    nx, ny, nz = limit[NORMAL], limit[NORMAL + 1], limit[NORMAL + 2]
    x = position[0] + R[0] * a + R[1] * b + R[2] * c
    y = position[1] + R[3] * a + R[4] * b + R[5] * c
    z = position[2] + R[6] * a + R[7] * b + R[8] * c
    rx, ry, rz = x - limit[POINT], y - limit[POINT + 1], z - limit[POINT + 2]
    height = nx * rx + ny * ry + nz * rz
    aside = np.sqrt(max(rx * rx + ry * ry + rz * rz - height * height, 0.0))
    height -= limit[RADIUS] + limit[MARGIN] + limit[SLOPE] * aside
    wx, wy, wz, ex, ey, ez = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0  # angular velocity and acceleration of a link
    vx, vy, vz, conv = 0.0, 0.0, 0.0, 0.0
    for j in range(len(dq)):
        ux, uy, uz, s = axis[j, 0], axis[j, 1], axis[j, 2], dq[j]
        rx, ry, rz = x - anchor[j, 0], y - anchor[j, 1], z - anchor[j, 2]
        cx, cy, cz = uy * rz - uz * ry, uz * rx - ux * rz, ux * ry - uy * rx
        row[j] = -(nx * cx + ny * cy + nz * cz)
        vx, vy, vz = vx + s * cx, vy + s * cy, vz + s * cz
        # angular acceleration due to the turning axis of the joint; below, acceleration of the next anchor
        tx, ty, tz = s * (wy * uz - wz * uy), s * (wz * ux - wx * uz), s * (wx * uy - wy * ux)
        ex, ey, ez = ex + tx, ey + ty, ez + tz
        wx, wy, wz = wx + s * ux, wy + s * uy, wz + s * uz
        last = j == len(dq) - 1
        dx = (x if last else anchor[j + 1, 0]) - anchor[j, 0]
        dy = (y if last else anchor[j + 1, 1]) - anchor[j, 1]
        dz = (z if last else anchor[j + 1, 2]) - anchor[j, 2]
        gx, gy, gz = wy * dz - wz * dy, wz * dx - wx * dz, wx * dy - wy * dx
        conv -= nx * (ey * dz - ez * dy + wy * gz - wz * gy)
        conv -= ny * (ez * dx - ex * dz + wz * gx - wx * gz)
        conv -= nz * (ex * dy - ey * dx + wx * gy - wy * gx)
    inwards = -(nx * vx + ny * vy + nz * vz)
    along = np.sqrt(max(vx * vx + vy * vy + vz * vz - inwards * inwards, 0.0))
    return height, inwards, along, conv


@njit(cache=True, error_model="numpy")
def push_bound(limit, arm, kinematics, last, friction, work):
    """Return the largest allowed tip acceleration J M^-1 tau, m/s^2, into a surface; inf far from the surface.

    Args:
        limit: (COLUMNS,) from `PushLimit.columns`; `push_bound` updates the estimate R and the last speed.
        arm: `JointDynamics` with finite values. kinematics: position (3,) m and rotation (9,) of the last link, and
            anchors (n, 3) m and axes (n, 3) of the joints, all in the base frame.
        last: (n,) Nm, the torque that the arm applied last.
        friction: (n,) Nm, friction level of each joint.
        work: (n + WORK, n), scratch array; afterward, row n contains J and row n + 1 contains J M^-1.
    """
    n = len(last)
    root, row, lever, none = work[:n], work[n], work[n + 1], work[n + 2]
    height, speed, along, convective = tip_motion(limit, kinematics, arm.dq, row)
    if height > NEAR_M:
        limit[RESISTED], limit[BEGUN] = 0.0, 0.0
        return np.inf
    none[:] = 0.0
    lever[:] = row
    unpack(arm.mass, 1.0, none, root)
    factor(root, root)
    solve(root, lever)
    mobility, before, own, hidden = 0.0, convective, convective, 0.0  # hidden: m/s^2
    for j in range(n):
        mobility += row[j] * lever[j]
        before += lever[j] * (last[j] - arm.bias[j])
        own -= lever[j] * arm.bias[j]
        hidden += abs(lever[j]) * friction[j]
    mass, most = 1.0 / mobility, limit[FORCE_MAX]
    if limit[BEGUN] == 0.0:
        limit[SPEED], limit[BEGUN] = speed, 1.0
    resisted = limit[RESISTED] + RATE * (SIM_DT * (mass * before - limit[RESISTED]) - mass * (speed - limit[SPEED]))
    allowed = limit[SPEED_NEAR] - limit[SLOPE] * along + APPROACH * max(height, 0.0)
    slowest = limit[SPEED_NEAR] if limit[PHASE] == 0.0 else OVERSHOOT * LEAVE
    if speed > allowed or speed < -slowest:
        resisted = min(resisted, 0.0)
    limit[RESISTED], limit[SPEED] = min(max(resisted, -most), most), speed
    return min(RATE * (allowed - speed) + mobility * limit[RESISTED], mobility * most - hidden) - own


@njit(cache=True, error_model="numpy")
def limit_pushes(limit, arm, kinematics, last, share, friction, limits, out):
    """Limit the push and the joint accelerations that the torques `out` (n,) Nm cause.

    The acceleration bounds include the estimated contact force. Return whether `out` changed. `filter_torque`
    explains `share` and `limits`; `push_bound` explains the other arguments.
    """
    n = len(out)
    own, work, effort = np.empty((n + WORK, n)), np.empty((2 * n + FILTER_WORK, n)), out.copy()
    bound = push_bound(limit, arm, kinematics, last, friction, own)
    row, lever, load = own[n], own[n + 1], own[n + 2]
    for j in range(n):
        load[j] = arm.bias[j] + max(limit[RESISTED], 0.0) * row[j]
    touching = JointDynamics(arm.q, arm.dq, arm.mass, load)
    joint_bounds(touching, share, limits, work)
    changed = bounded(touching, friction, limits, work, own[:n], out)
    before = _excess(lever, bound, out)
    if before <= 0.0:
        return changed
    mobility = 0.0
    for j in range(n):
        mobility += row[j] * lever[j]
    # low, high: N, bracket of f; before, after: excess at low and high. If no joint is at its bound, the first trial
    # hits the middle of the tolerance CLOSE; a trial at the edge of CLOSE could fail by round-off
    low, high, after, force = 0.0, np.inf, 0.0, (before + 0.5 * CLOSE) / mobility
    for _ in range(ROUNDS):
        for j in range(n):
            out[j] = effort[j] - force * row[j]
        bounded(touching, friction, limits, work, own[:n], out)
        now = _excess(lever, bound, out)
        if -CLOSE <= now <= 0.0:
            break
        if now > 0.0:
            low, before, after = force, now, 0.5 * after
        else:
            high, after, before = force, now, (0.5 if high < np.inf else 1.0) * before
        if high == np.inf:
            force *= 2.0
        else:  # regula falsi with the Illinois rule (Dowell and Jarratt, BIT 11, 1971), towards the middle of CLOSE
            x, y = before + 0.5 * CLOSE, after + 0.5 * CLOSE
            force = (low * y - high * x) / (y - x) if y < 0.0 else 0.5 * (low + high)
    return True


@njit(cache=True, error_model="numpy")
def _excess(lever, bound, tau):
    """Return the excess, m/s^2, of the inward acceleration J M^-1 tau over `bound`; lever: (n,), J M^-1."""
    out = -bound
    for j in range(len(tau)):
        out += lever[j] * tau[j]
    return out
