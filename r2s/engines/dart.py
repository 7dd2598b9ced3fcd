"""Simulate an arm in DART with the settings of Gazebo's physics plugin, for Sim2Sim transfer and the rigid twin.

DART has semi-implicit Euler steps, implicit joint damping, hard position limits and exact Coulomb friction. With the
plugin's settings, joint angles in DART agree with the plugin's to round-off, and with MuJoCo's to 1e-15 rad over 0.1
s.
"""

from collections.abc import Callable
from types import ModuleType
from typing import Any

import mujoco
import numpy as np

from r2s.errors import UserError, import_failure
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import SIM_DT, Robot
from r2s.physics.welds import Bodies, about, make_pose


class DartEngine:
    """An arm without contacts. A command acts for one step and is clipped to the torque limits.

    Args:
        robot: the arm; its MJCF defines kinematics, inertia and limits.
        gravity: whether gravity acts; False for an arm that compensates gravity itself, as in libfranka.
        masses, coms, inertias: mass (n,) kg, center of mass (n, 3) m, and tensor (n, 3, 3) kg m^2 about the center of
            mass, of the n moving links, in link axes; None: the MJCF's values.
        armature: (n,) kg m^2, armature of the joints; None: the values of `robot`.
        stop_margin: rad, distance of the hard stops beyond the position limits.

    Like MuJoCo, this engine has no velocity limits: they would hide that a policy violates the arm's limits.
    """

    def __init__(
        self,
        robot: Robot,
        *,
        gravity: bool,
        masses: np.ndarray | None = None,
        coms: np.ndarray | None = None,
        inertias: np.ndarray | None = None,
        armature: np.ndarray | None = None,
        stop_margin: float = 0.0,
    ):
        dart = _dartpy()
        model = robot.model(gravity=gravity)
        n = robot.n
        bodies = model.jnt_bodyid
        links = Bodies(model)
        given = {"masses": (masses, links.mass), "coms": (coms, links.com), "inertias": (inertias, links.inertia)}
        for name, (value, own) in given.items():
            if value is not None:
                if np.shape(value) != own[bodies].shape:
                    raise UserError(f"{name}: expected shape {own[bodies].shape}, got {np.shape(value)}")
                own[bodies] = value
        self.robot = robot
        # DART has no armature A. Damping D = A/h and the torque (A/h) v together are exactly equivalent to A:
        # DART's implicit step h at speed v solves (M + h D) a = tau + (A/h) v - D v, that is, (M + A) a = tau.
        self._armature = np.array(robot.armature if armature is None else armature, dtype=float)
        self._damping = self._armature / SIM_DT
        self._counter = self._damping if self._armature.any() else None
        self._low, self._high = -robot.tau_max, robot.tau_max
        self._skeleton = dart.dynamics.Skeleton(robot.name)
        self._joints = []
        parent: Any = None
        for i in range(n):
            joint, parent = self._add_link(dart, model, links, i, parent)
            joint.setPositionLowerLimit(0, float(robot.q_min[i]) - stop_margin)
            joint.setPositionUpperLimit(0, float(robot.q_max[i]) + stop_margin)
            self._joints.append(joint)
        site = model.site(robot.ee_site).id
        anchor, pose = links.moving_parent(model.site_bodyid[site])
        if anchor != bodies[-1]:
            raise UserError(f"robot.ee: expected a site on the arm's last link, got '{robot.ee_site}'")
        self._tip, self._links, self._last = parent, links, int(bodies[-1])
        self._ee = pose[:3, :3] @ model.site_pos[site] + pose[:3, 3]
        self._world = dart.simulation.World()
        self._world.setTimeStep(SIM_DT)
        self._world.setGravity(model.opt.gravity)
        self._world.addSkeleton(self._skeleton)
        _as_gazebo(dart, self._world)

    def _add_link(self, dart: ModuleType, model: mujoco.MjModel, links: Bodies, i: int, parent):
        body = int(model.jnt_bodyid[i])
        anchor, pose = links.moving_parent(model.body_parentid[body])
        if parent is None and anchor != 0:
            raise UserError(f"robot.mjcf: link '{model.body(body).name}' has no fixed base")
        to_joint = make_pose(model.jnt_pos[i], None)
        zero = make_pose(None, about(model.jnt_axis[i], -model.qpos0[i]))  # the MJCF states poses at qpos0
        properties = dart.dynamics.RevoluteJointProperties()
        properties.mName = model.joint(i).name or f"joint{i + 1}"
        properties.mAxis = model.jnt_axis[i]
        properties.mT_ParentBodyToJoint = _isometry(dart, pose @ links.local[body] @ to_joint @ zero)
        properties.mT_ChildBodyToJoint = _isometry(dart, to_joint)
        joint, link = self._skeleton.createRevoluteJointAndBodyNodePair(parent, properties)
        link.setName(model.body(body).name or f"link{i + 1}")
        mass, com, inertia = links.lumped(body)
        if mass <= 0:
            raise UserError(f"robot.mjcf: link '{model.body(body).name}' has no mass")
        link.setInertia(dart.dynamics.Inertia(mass, com, inertia))
        joint.setDampingCoefficient(0, float(self._damping[i]))
        joint.setSpringStiffness(0, float(model.jnt_stiffness[i]))
        joint.setRestPosition(0, float(model.qpos_spring[i]))
        joint.setLimitEnforcement(True)  # off by default in dartpy
        return joint, link

    def relink(self, mass: float, com: np.ndarray, inertia: np.ndarray) -> None:
        """During a motion, set the last link's mass kg, center (3,) m and tensor (3, 3) kg m^2 about the center."""
        at = self._last
        self._links.mass[at], self._links.com[at], self._links.inertia[at] = mass, com, inertia
        self._tip.setInertia(_dartpy().dynamics.Inertia(*self._links.lumped(at)))

    def reset(self, q: np.ndarray, dq: np.ndarray) -> None:
        """Set the joint positions q (n,) rad and velocities dq (n,) rad/s."""
        self._skeleton.resetCommands()
        self._skeleton.clearInternalForces()
        self._skeleton.setPositions(q)
        self._skeleton.setVelocities(dq)

    def step(
        self, tau: np.ndarray, passive: np.ndarray | None = None, damping: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Advance one time step; return the new (q, dq), (n,) rad, rad/s.

        Args:
            tau: (n,) Nm, the command; clipped to the torque limits.
            passive: (n,) Nm, additional joint torque that is not clipped, such as friction and offsets.
            damping: (n,) Nm s/rad, joint damping that DART adds in this step and integrates implicitly.
        """
        drive = np.minimum(np.maximum(tau, self._low), self._high)
        if passive is not None:
            drive += passive
        if self._counter is not None:
            drive += self._counter * self._skeleton.getVelocities()
        if damping is not None:
            for joint, d in zip(self._joints, (self._damping + damping).tolist(), strict=True):
                joint.setDampingCoefficient(0, d)
        self._skeleton.setCommands(drive)
        self._world.step()
        return self._skeleton.getPositions(), self._skeleton.getVelocities()

    def ee(self) -> np.ndarray:
        """Return the end effector's position (3,) m in the base frame."""
        pose = self._tip.getWorldTransform()
        return pose.rotation() @ self._ee + pose.translation()

    def mass_matrix(self, q: np.ndarray) -> np.ndarray:
        """Return the mass matrix (n, n) kg m^2 with armature at q (n,) rad; the arm's state does not change."""
        return self._at(q, self._skeleton.getMassMatrix) + np.diag(self._armature)

    def gravity_torque(self, q: np.ndarray) -> np.ndarray:
        """Return the torque (n,) Nm that holds the arm against gravity at q (n,) rad; the state does not change."""
        return self._at(q, self._skeleton.getGravityForces)

    def gravity_torque_there(self, q: np.ndarray) -> np.ndarray:
        """Return the torque (n,) Nm that holds the arm against gravity at q (n,) rad, and set the arm to q."""
        self._skeleton.setPositions(q)
        return self._skeleton.getGravityForces()

    def _at(self, q, query):
        here = self._skeleton.getPositions()
        if (here == q).all():
            return query()
        self._skeleton.setPositions(q)
        result = query()
        self._skeleton.setPositions(here)
        return result


def dart(robot: Robot) -> Callable[[Dynamics], DartEngine]:
    """Return the function that creates a DART engine without gravity from the dynamics of an arm."""
    _dartpy()
    return lambda d: DartEngine(
        robot, gravity=False, masses=d.mass, coms=d.com, inertias=d.inertia, armature=d.armature
    )


def _dartpy() -> ModuleType:
    try:
        import dartpy
    except ImportError as error:
        raise UserError(f"the DART engine needs dartpy, {import_failure(error, 'dartpy', 'dartpy')}") from None
    return dartpy


def _as_gazebo(dart: ModuleType, world) -> None:
    """Change the settings in which dartpy 6.20 differs from Gazebo's plugin."""
    # this setting affects the whole process; by default DART pushes joints back into their limits at up to 10 rad/s
    dart.constraint.JointConstraint.setMaxErrorReductionVelocity(0.0)
    options = dart.simulation.DeactivationOptions()
    options.mEnabled = False
    world.setDeactivationOptions(options)


def _isometry(dart: ModuleType, pose: np.ndarray):
    isometry = dart.math.Isometry3()
    isometry.set_rotation(pose[:3, :3])
    isometry.set_translation(pose[:3, 3])
    return isometry
