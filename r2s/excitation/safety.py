"""Is a motion safe to send to an arm: limits, torque, the table, the arm itself, and whether it is a motion at all.

Joint limits are checked on every sample; torque and geometry, which cost more, at `GEOMETRY_HZ`. The links are the
MJCF's geoms. Each error names joint or link, value, time and what is allowed.
"""

from collections.abc import Callable
from typing import Protocol

import mujoco
import numpy as np

from r2s.errors import UserError
from r2s.physics.contacts import TABLE_M, name_of, watched
from r2s.physics.robot import SIM_DT, Robot

TOOL_M = 0.1  # least height of the end effector, by default: the MJCF holds no tool
CLEARANCE_M = 0.03  # between a link and the table or another link: what a tracking error of 30 mrad covers
FAR_M = 0.1  # farther apart, the bounding spheres do
GEOMETRY_HZ = 100
TORQUE_SHARE = 0.8  # of tau_max, for |gravity| + |dynamics| + friction
FRICTION_SHARE = 0.15  # of tau_max, what friction may take: 0.14 of a Panda's joint 5 ...
FRICTION_ROOT = 0.5  # ... and no more than this times sqrt(tau_max): strong joints have less of it


class Motion(Protocol):
    """What is checked: t (T,) s; q, dq, ddq (T, n) rad, rad/s, rad/s^2."""

    @property
    def t(self) -> np.ndarray: ...  # noqa: D102
    @property
    def q(self) -> np.ndarray: ...  # noqa: D102
    @property
    def dq(self) -> np.ndarray: ...  # noqa: D102
    @property
    def ddq(self) -> np.ndarray: ...  # noqa: D102


def check_motion(robot: Robot, motion: Motion, *, table: float = TABLE_M, z_min: float = TOOL_M) -> None:
    """Raise UserError at the first thing that forbids this motion; in the order of the functions below.

    Args:
        robot: its limits and links.
        motion: on a clock of 1 ms.
        table: m, height of the table in the base frame; -inf where there is none.
        z_min: m, least height of the end effector, which carries what the MJCF does not show.

    """
    check_shape(robot, motion)
    check_limits(robot, motion)
    check_derivatives(robot, motion)
    check_torque(robot, motion)
    check_space(robot, motion, table=table, z_min=z_min)


def check_shape(robot: Robot, motion: Motion) -> None:
    """Raise UserError unless all is finite, as wide as the robot, on the arm's clock."""
    t = motion.t
    for name in ("q", "dq", "ddq"):
        x = getattr(motion, name)
        if x.shape != (len(t), robot.n):
            raise UserError(f"excitation: {name} is {x.shape}, for {robot.name} it must be {(len(t), robot.n)}")
        bad = np.argwhere(~np.isfinite(x))
        if len(bad):
            row, i = bad[0]
            raise UserError(
                f"excitation: {name} of joint {i + 1} is {x[row, i]} at {t[row]:.3f} s; it must be finite"
            )
    if len(t) < 3:
        raise UserError(f"excitation: {len(t)} samples are no motion")
    wrong = ~(np.abs(np.diff(t) - SIM_DT) <= 1e-6 * SIM_DT + 1e-11 * abs(t[-1]))
    if wrong.any():
        row = int(wrong.argmax())
        raise UserError(
            f"excitation: t steps by {t[row + 1] - t[row]:g} s at {t[row]:.3f} s; "
            f"an arm is driven in steps of {SIM_DT:g} s"
        )


def check_limits(robot: Robot, motion: Motion) -> None:
    """Raise UserError at the first joint whose position, velocity or acceleration leaves its limits."""
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
    """Raise UserError where dq is not the slope of q, or ddq that of dq, or the motion does not end at rest.

    A tracker feeds all three forward: a position that jumps between two samples is a kick that no limit shows.
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
                "a motion begins and ends at rest"
            )


def check_torque(robot: Robot, motion: Motion) -> None:
    """Raise UserError where the nominal model needs more than 80 % of a torque limit, friction included."""
    rows = _every(motion)
    share = torque_share(robot, motion.q[rows], motion.dq[rows], motion.ddq[rows])
    bad = np.argwhere(~(share <= TORQUE_SHARE))
    if len(bad):
        row, i = bad[0]
        limit = robot.tau_max[i]
        raise UserError(
            f"excitation: torque of joint {i + 1} is {share[row, i] * limit:.4g} Nm at {motion.t[rows[row]]:.3f} s "
            f"(gravity and dynamics as magnitudes, and {friction_margin(robot)[i]:.3g} Nm for friction), "
            f"allowed {TORQUE_SHARE * limit:.4g} Nm, {100 * TORQUE_SHARE:g} % of tau_max"
        )


def check_space(robot: Robot, motion: Motion, *, table: float = TABLE_M, z_min: float = TOOL_M) -> None:
    """Raise UserError where a link comes too near to the table or to another link.

    The way to the start depends on where the arm is: r2s/excitation/paths.py, when it goes there.
    """
    space = Space(robot, table=table, z_min=z_min)
    rows = _every(motion)
    space.check(motion.q[rows], lambda k: f"at {motion.t[rows[k]]:.3f} s")


def torque_share(robot: Robot, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
    """Return (T, n): |gravity| + |dynamics| of the nominal model plus `friction_margin`, over tau_max.

    Magnitudes are added, whatever their signs: the arm is not the nominal one, and some arms compensate gravity
    before the limit counts, others after.
    """
    weight = gravity_torque(robot, q)
    inertial = _inverse(robot, q, dq, ddq) - weight
    return (np.abs(weight) + np.abs(inertial) + friction_margin(robot)) / robot.tau_max


def gravity_torque(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Return (T, n) Nm that holds the nominal arm at rest at q (T, n)."""
    return _inverse(robot, q, np.zeros_like(q), np.zeros_like(q))


def _inverse(robot: Robot, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
    """Return (T, n) Nm, the nominal model's torque, gravity included."""
    model = robot.model(gravity=True)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)  # a limit's soft spring is no dynamics
    data, out = mujoco.MjData(model), np.empty_like(q)
    for k in range(len(q)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[k], dq[k], ddq[k]
        mujoco.mj_inverse(model, data)
        out[k] = data.qfrc_inverse
    return out


def friction_margin(robot: Robot) -> np.ndarray:
    """Return (n,) Nm, kept for friction that nobody knows yet."""
    return np.minimum(FRICTION_SHARE * robot.tau_max, FRICTION_ROOT * np.sqrt(robot.tau_max))


class Space:
    """Distances of an arm's links from the table and from each other.

    What is left out of them says r2s/physics/contacts.py.

    Attributes:
        clearance: (K,) m, kept by each distance: the end effector's height above z_min (it has this much to spare in
            a search, not here), the links' above the table, the pairs'.
        reach: m that no point of the arm is farther than from any of its joints.

    """

    def __init__(self, robot: Robot, *, table: float = TABLE_M, z_min: float = TOOL_M):
        self.model = robot.model(gravity=False)
        self.data = mujoco.MjData(self.model)
        self.site = self.model.site(robot.ee_site).id
        moving = self.model.jnt_bodyid
        parts = np.isin(self.model.geom_bodyid, np.arange(moving[0], self.model.nbody))
        farthest = (np.linalg.norm(self.model.geom_pos, axis=1) + self.model.geom_rbound)[parts].max(initial=0.0)
        links = np.linalg.norm(self.model.body_pos[moving[0] + 1 :], axis=1).sum()
        self.reach = float(links + farthest)
        found = watched(robot, self.model, table=bool(np.isfinite(table)))
        self.table, self.floor = table, z_min
        self.above, self.pairs = found.above, found.pairs
        self._pose(robot.q_home)
        at_home = self._heights(self.data.geom_xpos[None], self.data.geom_xmat[None])[0] - table
        if (at_home <= 0).any():
            worst = int(at_home.argmin())
            name = name_of(self.model, self.above[worst])
            raise UserError(
                f"excitation: {name} reaches {-at_home[worst]:.3f} m below the table at {table:g} m already at "
                "robot.q_home; give another height of the table, -inf for none"
            )
        need = np.minimum(CLEARANCE_M, 0.5 * at_home)  # an arm that folds low comes back to where it was
        self.clearance = np.array([CLEARANCE_M, *need, *(CLEARANCE_M for _ in self.pairs)])

    def gaps(self, q: np.ndarray) -> np.ndarray:
        """Return (T, K) m at postures q (T, n): how much more than allowed each distance is; negative: too near."""
        tip, apart = np.empty((len(q), 1)), np.empty((len(q), len(self.pairs)))
        places, frames = (np.empty((len(q), self.model.ngeom, k)) for k in (3, 9))
        for k, posture in enumerate(q):
            self._pose(posture)
            tip[k] = self.data.site_xpos[self.site, 2]
            places[k], frames[k] = self.data.geom_xpos, self.data.geom_xmat
            apart[k] = self._apart()
        distances = np.hstack([tip - self.floor, self._heights(places, frames) - self.table, apart])
        distances[:, 1:] -= self.clearance[1:]
        return distances

    def check(self, q: np.ndarray, when: Callable[[int], str]) -> None:
        """Raise UserError at the first posture of q (T, n) that comes too near; `when` says where row k is."""
        gaps = self.gaps(q)
        bad = np.argwhere(~(gaps >= 0))
        if len(bad):
            row, which = bad[0]
            raise UserError(f"excitation: {self.explain(int(which), gaps[row, which], when(row))}")

    def explain(self, which: int, gap: float, when: str) -> str:
        """Return in words how near it comes where column `which` of `gaps` is `gap` m, `when`."""
        if which == 0:
            seen = gap + self.floor
            return f"the end effector is {seen:.3f} m above the base plane {when}, allowed {self.floor:g} m or more"
        allowed = self.clearance[which]
        if which <= len(self.above):
            name, other = name_of(self.model, self.above[which - 1]), "above the table"
        else:
            a, b = self.pairs[which - 1 - len(self.above)]
            name, other = name_of(self.model, a), f"from {name_of(self.model, b)}"
        return f"{name} is {gap + allowed:.3f} m {other} {when}, allowed {allowed:.3g} m or more"

    def _pose(self, q: np.ndarray) -> None:
        self.data.qpos[:] = q
        mujoco.mj_kinematics(self.model, self.data)

    def _distance(self, a: int, b: int) -> float:
        return mujoco.mj_geomDistance(self.model, self.data, a, b, 1.0, None)

    def _apart(self) -> np.ndarray:
        """Return (pairs,) m between the geoms of each pair; of those far apart, between their bounding spheres."""
        a, b = np.array(self.pairs, dtype=int).reshape(-1, 2).T
        radius, place = self.model.geom_rbound, self.data.geom_xpos
        out = np.linalg.norm(place[a] - place[b], axis=1) - radius[a] - radius[b]
        for k in np.flatnonzero(out < FAR_M):
            out[k] = self._distance(*self.pairs[k])
        return out

    def _heights(self, places: np.ndarray, frames: np.ndarray) -> np.ndarray:
        """Return (T, G) heights of the lowest points of `above`, from geom_xpos and geom_xmat (T, ngeom, .)."""
        lowest = [places[:, g, 2] - self._reach(g, frames[:, g, 6:]) for g in self.above]
        return np.array(lowest).T.reshape(len(places), len(self.above))

    def _reach(self, g: int, up: np.ndarray) -> np.ndarray:
        """Return (T,) m from a geom's centre to its lowest point; `up` (T, 3) is the vertical in its axes.

        Exact, but for a signed distance field, which is taken as its bounding sphere.
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


def _every(motion: Motion) -> np.ndarray:
    """Return the rows at GEOMETRY_HZ, the last one included."""
    rows = np.arange(0, len(motion.t), max(1, round(1 / (GEOMETRY_HZ * SIM_DT))))
    return np.union1d(rows, [len(motion.t) - 1])
