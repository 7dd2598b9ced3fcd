"""Compute the external torque and force at which a Franka arm stops itself (libfranka's setCollisionBehavior)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from r2s.arm.clients.connection_check import check_joints
from r2s.errors import UserError, check_number
from r2s.physics.push_limit import STIFF, PushLimit
from r2s.physics.robot import Robot
from r2s.physics.tip import Tip
from r2s.tasks.surface_task import RESIDUAL, SurfaceTask
from r2s.tasks.task import Task

OFF = 100.0  # N, Nm: libfranka's impedance examples set all thresholds to this value, so that no reflex acts
# Share of CAUTIOUS added to the thresholds for friction and model errors, which the arm reports as external torque.
# On a Panda, this false torque is up to 3.7 Nm in joints 1 to 4 (CAUTIOUS: 18 to 20 Nm), and up to 2.2 Nm in the
# wrist (12 to 16 Nm).
ERROR = 0.2
FRICTION = 0.5  # friction coefficient of a surface, the largest in conf/dr/contact.yaml


@dataclass(frozen=True)
class CollisionThresholds:
    """Thresholds of external torque and force above which the arm stops itself.

    r2s also sets libfranka's contact thresholds to these values. The defaults are the lowest in libfranka's examples.

    Attributes:
        torque: (7,) Nm, threshold of each joint. force: (6,) N, Nm, thresholds of the wrench at the end effector.

    Raises:
        UserError: the number of values is wrong, or a value is not between 0 and OFF.
    """

    torque: Sequence[float] = (20.0, 20.0, 18.0, 18.0, 16.0, 14.0, 12.0)
    force: Sequence[float] = (20.0, 20.0, 20.0, 25.0, 25.0, 25.0)

    def __post_init__(self):
        for name, values, count in (("torque", self.torque, 7), ("force", self.force, 6)):
            if len(values) != count:
                raise UserError(f"collision_{name}: expected {count} numbers, got {len(values)}")
            for value in values:
                check_number(f"collision_{name}", value, f"(0, {OFF:g})")


CAUTIOUS = CollisionThresholds()


def thresholds_for(robot: Robot, task: Task | None) -> CollisionThresholds:
    """Return thresholds above the largest contact force of a `SurfaceTask`, or of any task with a push limit.

    Without a task, and for other tasks, such as task=push without safety.force_max, the result is CAUTIOUS.
    Without safety.force_max, the largest push of a `SurfaceTask` is the sum of the requested force, the force that an
    action may add, and twice the force that joint friction may hide. The function assumes that the tip meets the
    surface at the task's approach speed.

    Raises:
        UserError: as `thresholds_of`.
    """
    limit = None if task is None else task.push_limit
    if limit is not None or not isinstance(task, SurfaceTask):
        return thresholds_of(robot, limit)
    speed = task.approach_speed
    limit = PushLimit((1.0 + RESIDUAL) * task.force[1], speed, *task.plane(robot))
    hidden = limit.at(robot, task.model.dynamics.level, robot.q_home)[1]  # type: ignore[union-attr]
    limit = replace(limit, force_max=limit.force_max + 2.0 * hidden)
    return thresholds_of(robot, limit, f"task.force: {task.force[1]:g} N, at a task.approach_speed of {speed:g} m/s,")


def thresholds_of(robot: Robot, limit: PushLimit | None, cause: str | None = None) -> CollisionThresholds:
    """Return collision thresholds above every contact force that the push limit allows; without a limit, CAUTIOUS.

    The push limit allows at most the normal force F on a rigid surface, so the tangential force is at most FRICTION *
    F. The thresholds are the resulting torques and forces plus ERROR * CAUTIOUS for model errors, but at least
    CAUTIOUS.

    cause: setting that the error message names; if None, safety.force_max.

    Raises:
        UserError: the push limit needs thresholds so high that they would switch the reflexes off, or the robot does
            not have 7 joints.
    """
    cautious = np.array(CAUTIOUS.torque), np.array(CAUTIOUS.force)
    if limit is None:
        return CAUTIOUS
    check_joints(robot)
    tip, tool = Tip(robot), robot.tool
    q = tip.posture(limit.point + tool.radius * limit.normal)  # type: ignore[union-attr]
    q = robot.q_home if q is None else q
    jacobian, most = tip(q)[1], limit.bound(robot, q, STIFF)
    lever = np.abs(limit.normal @ jacobian) + FRICTION * np.linalg.norm(jacobian, axis=0)  # m
    arm = float(np.linalg.norm(tool.tip)) + tool.radius  # type: ignore[union-attr]
    reached = most * lever, most * np.repeat([1.0, arm], 3)
    torque, force = (np.maximum(low, ERROR * low + x).round(1) for low, x in zip(cautious, reached, strict=True))
    if max(torque.max(), force.max()) >= OFF:
        typed = f"{limit.force_max:g} N, with safety.speed_near of {limit.speed_near:.3g} m/s,"
        raise UserError(
            f"{cause or f'safety.force_max: {typed}'} allows {most:.3g} N on a rigid surface; for that the arm's "
            f"reflexes would be off ({OFF:g} N or Nm); lower one, or set arm.collision_torque and arm.collision_force"
        )
    return CollisionThresholds(tuple(torque.tolist()), tuple(force.tolist()))
