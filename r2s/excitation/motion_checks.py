"""Check a motion before an arm runs it: consistency, limits, torque, and clearance to table and links.

The checks test joint limits at every sample, but torque and distances only at GEOMETRY_HZ. The geoms of the MJCF
define the links' shapes.
"""

from collections.abc import Callable, Sequence
from typing import Protocol

import mujoco
import numpy as np

from r2s.errors import UserError
from r2s.physics.collision import TABLE_M, collision_pairs, link_name
from r2s.physics.fence import FENCE_M
from r2s.physics.obstacle import Box
from r2s.physics.rigid_body import nominal_torque
from r2s.physics.robot import SIM_DT, Robot

TOOL_M = 0.1  # m, default minimum height of the end effector, because the MJCF contains no tool
CLEARANCE_M = 0.03  # m, least distance between a link and the table or another link
DEVIATION = 0.05  # rad; if all joints deviate by this angle, the links must still keep the distance FENCE_M
FAR_M = 0.1  # m, at larger distances the distance of bounding spheres is accurate enough
GEOMETRY_HZ = 100
TORQUE_SHARE = 0.8  # share of tau_max for |gravity| + |dynamics| + friction
FRICTION_SHARE = 0.15  # largest friction as a share of tau_max; 0.14 on joint 5 of a Panda
FRICTION_ROOT = 0.5  # sqrt(Nm); the friction of strong joints is at most FRICTION_ROOT * sqrt(tau_max)


class Motion(Protocol):
    """A motion to check: t (T,) s; q, dq, ddq (T, n) rad, rad/s, rad/s^2."""

    @property
    def t(self) -> np.ndarray: ...  # noqa: D102
    @property
    def q(self) -> np.ndarray: ...  # noqa: D102
    @property
    def dq(self) -> np.ndarray: ...  # noqa: D102
    @property
    def ddq(self) -> np.ndarray: ...  # noqa: D102


def check_motion(
    robot: Robot, motion: Motion, *, table: float = TABLE_M, z_min: float = TOOL_M, space: "Space | None" = None
) -> None:
    """Raise UserError at a motion's first violation; the message names joint or link, value and time.

    Args:
        robot: limits and links.
        motion: the motion, sampled at 1 kHz.
        table: m, height of the table in the base frame; -inf means no table.
        z_min: m, minimum height of the end effector, for a tool that the MJCF does not contain.
        space: a `Space`, for example with obstacles, that replaces table and z_min; if None, table and z_min apply.
    """
    check_shape(robot, motion)
    check_limits(robot, motion)
    check_derivatives(robot, motion)
    check_torque(robot, motion)
    check_space(robot, motion, table=table, z_min=z_min, space=space)


def check_shape(robot: Robot, motion: Motion) -> None:
    """Raise UserError unless the motion is finite, has a column per joint of the robot, and a time step of 1 ms."""
    t = motion.t
    for name in ("q", "dq", "ddq"):
        x = getattr(motion, name)
        if x.shape != (len(t), robot.n):
            raise UserError(f"excitation: expected {name} of shape {(len(t), robot.n)}, got {x.shape}")
        bad = np.argwhere(~np.isfinite(x))
        if len(bad):
            row, i = bad[0]
            raise UserError(f"excitation: {name} of joint {i + 1} is {x[row, i]} at {t[row]:.3f} s, not finite")
    if len(t) < 3:
        raise UserError(f"excitation: expected at least 3 samples, got {len(t)}")
    wrong = ~(np.abs(np.diff(t) - SIM_DT) <= 1e-6 * SIM_DT + 1e-11 * abs(t[-1]))
    if wrong.any():
        row = int(wrong.argmax())
        step = t[row + 1] - t[row]
        raise UserError(f"excitation: expected a time step of {SIM_DT:g} s, got {step:g} s at {t[row]:.3f} s")


def check_limits(robot: Robot, motion: Motion) -> None:
    """Raise UserError if position, velocity or acceleration of a joint exceeds its limits."""
    e, r = motion, robot
    for name, x, low, high, unit in (
        ("position", e.q, r.q_min, r.q_max, "rad"),
        ("velocity", e.dq, -r.dq_max, r.dq_max, "rad/s"),
        ("acceleration", e.ddq, -r.ddq_max, r.ddq_max, "rad/s^2"),
    ):
        bad = np.argwhere(~((x >= low) & (x <= high)))
        if len(bad):
            row, i = bad[0]
            raise UserError(
                f"excitation: {name} of joint {i + 1} is {x[row, i]:.4g} {unit} at {e.t[row]:.3f} s, "
                f"allowed {low[i]:g} to {high[i]:g}"
            )


def check_derivatives(robot: Robot, motion: Motion) -> None:
    """Raise UserError unless dq and ddq are the derivatives of q, and the motion starts and ends at rest.

    The tracking controller uses q, dq and ddq, so a jump of q alone would jerk the arm, even if no limit is exceeded.
    """
    e = motion
    for name, x, slope, most, unit in (
        ("dq", e.q, e.dq, robot.dq_max, "rad/s"),
        ("ddq", e.dq, e.ddq, robot.ddq_max, "rad/s^2"),
    ):
        off = np.abs((x[2:] - x[:-2]) / (2 * SIM_DT) - slope[1:-1])
        bad = np.argwhere(~(off <= 0.02 * most))
        if len(bad):
            row, i = bad[0]
            raise UserError(
                f"excitation: {name} of joint {i + 1} is {off[row, i]:.3g} {unit} off the slope of {name[1:]} at "
                f"{e.t[row + 1]:.3f} s, allowed {0.02 * most[i]:g}"
            )
        moving = np.argwhere(~(np.abs(slope[[0, -1]]) <= 1e-3 * most))
        if len(moving):
            end, i = moving[0]
            raise UserError(
                f"excitation: {name} of joint {i + 1} is {slope[-end, i]:.3g} {unit} at {e.t[-end]:.3f} s; "
                "expected 0 at both ends"
            )


def check_torque(robot: Robot, motion: Motion) -> None:
    """Raise UserError if the torque |gravity| + |dynamics| + `friction_margin` exceeds 80 % of tau_max."""
    rows = geometry_rows(motion)
    share = torque_share(robot, motion.q[rows], motion.dq[rows], motion.ddq[rows])
    bad = np.argwhere(~(share <= TORQUE_SHARE))
    if len(bad):
        row, i = bad[0]
        limit = robot.tau_max[i]
        raise UserError(
            f"excitation: torque of joint {i + 1} is {share[row, i] * limit:.4g} Nm at {motion.t[rows[row]]:.3f} s "
            f"(|gravity| + |dynamics| + {friction_margin(robot)[i]:.3g} Nm for friction), "
            f"allowed {TORQUE_SHARE * limit:.4g} Nm, {100 * TORQUE_SHARE:g} % of tau_max"
        )


def check_space(
    robot: Robot, motion: Motion, *, table: float = TABLE_M, z_min: float = TOOL_M, space: "Space | None" = None
) -> None:
    """Raise UserError if the motion brings a link too near to the table, an obstacle or another link."""
    space = space or Space(robot, table=table, z_min=z_min)
    rows = geometry_rows(motion)
    space.check(motion.q[rows], lambda k: f"at {motion.t[rows[k]]:.3f} s")


def torque_share(robot: Robot, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
    """Return (|gravity| + |dynamics| + `friction_margin`) / tau_max (T, n) of the nominal model.

    The sum of magnitudes contains a reserve, because a real arm differs from the nominal model. The sum is an upper
    bound for arms whose torque limit includes gravity compensation and for arms whose limit does not.
    """
    gravity = gravity_torque(robot, q)
    dynamics = nominal_torque(robot, q, dq, ddq) - gravity
    return (np.abs(gravity) + np.abs(dynamics) + friction_margin(robot)) / robot.tau_max


def gravity_torque(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Return the torque (T, n) Nm that holds the nominal arm at rest at q (T, n) rad."""
    return nominal_torque(robot, q, np.zeros_like(q), np.zeros_like(q))


def friction_margin(robot: Robot) -> np.ndarray:
    """Return the torque (n,) Nm that is reserved for friction, because the checks use no identified friction."""
    return np.minimum(FRICTION_SHARE * robot.tau_max, FRICTION_ROOT * np.sqrt(robot.tau_max))


class Space:
    """Compute the distances of an arm's links from table, obstacles and each other; collision.py selects the geoms.

    An arm does not follow its plan exactly. If each joint j deviates by e_j rad, a distance decreases by at most
    sum_j lever_j |e_j| to first order, where lever_j bounds the link's displacement per rad of joint j. A planned
    posture needs enough distance for a deviation of all joints by DEVIATION. Plans ignore larger deviations, because
    an arm stops beyond its `DeviationLimits`, which depend on the distances along the motion.

    Attributes:
        clearance: (K,) m, smallest required distances: of the end effector above z_min (element 0), of geoms above
            the table, and between the two geoms of each pair. Element 0 is an exception: the end effector may come
            down to z_min; element 0 only scales the end effector's height above z_min in fourier.py.
        reach: m, upper bound of the distance between a point of the arm and a joint.

    Args:
        robot: links of the arm. table, z_min: m, see `check_motion`. deviation: rad, assumed deviation of all joints.
        obstacles: boxes that the links must avoid.
    """

    def __init__(
        self,
        robot: Robot,
        *,
        table: float = TABLE_M,
        z_min: float = TOOL_M,
        deviation: float = DEVIATION,
        obstacles: Sequence[Box] = (),
    ):
        self._deviation = deviation
        self.model = robot.model(gravity=False, obstacles=obstacles)
        self.data = mujoco.MjData(self.model)
        self.site = self.model.site(robot.ee_site).id
        moving = self.model.jnt_bodyid
        parts = np.isin(self.model.geom_bodyid, np.arange(moving[0], self.model.nbody))
        farthest = (np.linalg.norm(self.model.geom_pos, axis=1) + self.model.geom_rbound)[parts].max(initial=0.0)
        links = np.linalg.norm(self.model.body_pos[moving[0] + 1 :], axis=1).sum()
        self.reach = float(links + farthest)
        found = collision_pairs(robot, self.model, table=bool(np.isfinite(table)))
        self.table, self.floor = table, z_min
        self.above, self.pairs, self._link = found.above, found.pairs, found.link
        self._pose(robot.q_home)
        at_home = self._heights(self.data.geom_xpos[None], self.data.geom_xmat[None])[0] - table
        if (at_home <= 0).any():
            worst = int(at_home.argmin())
            name = link_name(self.model, self.above[worst])
            raise UserError(
                f"excitation: {name} reaches {-at_home[worst]:.3f} m below the table at {table:g} m already at "
                "robot.q_home; set another height of the table, -inf for none"
            )
        need = np.minimum(CLEARANCE_M, 0.5 * at_home)  # so that an arm can return to a low home posture
        self.clearance = np.array([CLEARANCE_M, *need, *(CLEARANCE_M for _ in self.pairs)])
        # upper limit of required distances, for a return home: half the distance at home or, if larger, `clearance`
        self._most = np.maximum(0.5 * self.measured(robot.q_home[None])[0][0], self.clearance)

    def gaps(self, q: np.ndarray) -> np.ndarray:
        """Return distances minus required distances, (T, K) m, at postures q (T, n) rad; below 0 is too near."""
        distances, levers = self.measured(q)
        return distances - self._needed(levers)

    def _needed(self, levers: np.ndarray) -> np.ndarray:
        """Return the required distances (T, K) m for levers (T, K, n) m/rad; 0 m for the end effector."""
        need = np.clip(FENCE_M + self._deviation * levers.sum(2), self.clearance, self._most)
        need[:, 0] = 0.0
        return need

    def measured(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return distances (T, K) m and levers (T, K, n) m/rad, see `Space`; the end effector's levers are 0."""
        tip, apart = np.empty((len(q), 1)), np.empty((len(q), len(self.pairs)))
        places, frames = (np.empty((len(q), self.model.ngeom, k)) for k in (3, 9))
        levers = np.zeros((len(q), 1 + len(self.above) + len(self.pairs), q.shape[1]))
        for k, posture in enumerate(q):
            self._pose(posture)
            tip[k] = self.data.site_xpos[self.site, 2]
            places[k], frames[k] = self.data.geom_xpos, self.data.geom_xmat
            apart[k] = self._apart()
            levers[k, 1:] = self._levers()
        return np.hstack([tip - self.floor, self._heights(places, frames) - self.table, apart]), levers

    def _levers(self) -> np.ndarray:
        """Return levers (K - 1, n) m/rad: bounds on how fast K - 1 distances change with each joint's angle."""
        d, radius, link = self.data, self.model.geom_rbound, self._link
        arm = d.geom_xpos[:, None] - d.xanchor
        moved = np.cross(d.xaxis, arm)  # (ngeom, n, 3), displacement of each geom's center
        joint = np.arange(len(d.xaxis))
        up = np.abs(moved[:, :, 2]) + radius[:, None] * np.hypot(*d.xaxis.T[:2])
        lifted = np.where(joint < link[:, None], up, 0.0)[self.above]
        far = np.linalg.norm(moved, axis=2) + radius[:, None]
        a, b = np.array(self.pairs, dtype=int).reshape(-1, 2).T
        between = (joint >= link[a, None]) & (joint < link[b, None])
        # either link may be regarded as moved by a joint between them: both bounds hold, use the smaller one
        return np.concatenate([lifted, np.where(between, np.minimum(far[a], far[b]), 0.0)])

    def check(self, q: np.ndarray, when: Callable[[int], str]) -> None:
        """Raise UserError if a posture in q (T, n) rad has a gap below 0; `when(k)` describes row k."""
        gaps = self.gaps(q)
        bad = np.argwhere(~(gaps >= 0))
        if len(bad):
            row, which = bad[0]
            raise UserError(f"excitation: {self.explain(int(which), q[row], when(row))}")

    def explain(self, which: int, q: np.ndarray, when: str) -> str:
        """Return the error message for column `which` of `gaps`, a distance that is too small at q (n,) rad."""
        distances, levers = self.measured(q[None])
        seen, allowed = distances[0, which], self._needed(levers)[0, which]
        if which == 0:
            seen += self.floor
            return f"the end effector is {seen:.3f} m above the base plane {when}, allowed {self.floor:g} m or more"
        if which <= len(self.above):
            name, other = link_name(self.model, self.above[which - 1]), "above the table"
        else:
            a, b = self.pairs[which - 1 - len(self.above)]
            name, other = link_name(self.model, a), f"from {link_name(self.model, b)}"
        return f"{name} is {seen:.3f} m {other} {when}, allowed {allowed:.3g} m or more"

    def _pose(self, q: np.ndarray) -> None:
        self.data.qpos[:] = q
        mujoco.mj_kinematics(self.model, self.data)

    def _distance(self, a: int, b: int) -> float:
        return mujoco.mj_geomDistance(self.model, self.data, a, b, 1.0, None)

    def _apart(self) -> np.ndarray:
        """Return the distance (m) between the geoms of each pair; above FAR_M, between their bounding spheres."""
        a, b = np.array(self.pairs, dtype=int).reshape(-1, 2).T
        radius, place = self.model.geom_rbound, self.data.geom_xpos
        out = np.linalg.norm(place[a] - place[b], axis=1) - radius[a] - radius[b]
        for k in np.flatnonzero(out < FAR_M):
            out[k] = self._distance(*self.pairs[k])
        return out

    def _heights(self, places: np.ndarray, frames: np.ndarray) -> np.ndarray:
        """Return the height (T, G) m of the lowest point of each geom in `above`, from geom_xpos and geom_xmat."""
        lowest = [places[:, g, 2] - self._reach(g, frames[:, g, 6:]) for g in self.above]
        return np.array(lowest).T.reshape(len(places), len(self.above))

    def _reach(self, g: int, up: np.ndarray) -> np.ndarray:
        """Return the height (T,) m of a geom's center above its lowest point; `up` (T, 3): vertical in geom axes.

        For shapes without a formula in this function, such as signed distance fields, use the bounding sphere.
        """
        m, kind, size = self.model, mujoco.mjtGeom, self.model.geom_size[g]
        across, along = np.hypot(up[:, 0], up[:, 1]), np.abs(up[:, 2])
        match m.geom_type[g]:
            case kind.mjGEOM_CAPSULE:
                return size[0] + size[1] * along
            case kind.mjGEOM_CYLINDER:
                return size[0] * across + size[1] * along
            case kind.mjGEOM_BOX:
                return np.abs(up) @ size
            case kind.mjGEOM_ELLIPSOID:
                return np.linalg.norm(up * size, axis=1)
            case kind.mjGEOM_MESH:
                mesh = m.geom_dataid[g]
                first = m.mesh_vertadr[mesh]
                return -(up @ m.mesh_vert[first : first + m.mesh_vertnum[mesh]].T).min(1)
            case _:
                return np.full(len(up), m.geom_rbound[g])


def geometry_rows(motion: Motion) -> np.ndarray:
    """Return the indices of a motion's rows at which geometry is checked: rows at GEOMETRY_HZ and the last row."""
    rows = np.arange(0, len(motion.t), max(1, round(1 / (GEOMETRY_HZ * SIM_DT))))
    return np.union1d(rows, [len(motion.t) - 1])
