"""Impedance control (`joint_impedance`, `cartesian_impedance`, `hybrid`): actions set a spring's target or stiffness.

r2s/physics/impedance_laws.py contains the control laws; this module computes the laws' parameters from arm, task and
model. Default values scale with the arm: a spring's largest force is CLIP times the force that the torque limit
allows in all directions in the home posture. A spring's default stiffness is its largest force divided by CLIP_M or
by `displacement`, or less if the control loop's latency requires a softer spring.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from r2s.control.computed_torque import BANDWIDTH_LATENCY, LATENCY
from r2s.control.controller import ControlledTask, Controller
from r2s.control.impedance_cpp import CARTESIAN, JOINT
from r2s.errors import UserError, check_number, instead_of
from r2s.physics import impedance as law
from r2s.physics.description import chain
from r2s.physics.dynamics import Dynamics
from r2s.physics.impedance_laws import cartesian_impedance_law, joint_impedance_law
from r2s.physics.inverse_dynamics import InverseDynamics
from r2s.physics.kinematics import POSE
from r2s.physics.newton_euler import COM, LINK, MASS, links_of
from r2s.physics.robot import SIM_DT, Robot, per_joint

ACTIONS = ("target", "stiffness", "both")
# largest spring force as a fraction of the force that the torque limit allows in all directions in the home posture;
# the rest of the torque limit is for damping and feedforward
CLIP = 0.7
CLIP_M = 0.05  # m, error at which the default spring saturates


@dataclass(frozen=True)
class Impedance(Controller):
    """Impedance control of joints or end effector; `Controller` documents the inherited attributes.

    Attributes:
        model: the identified arm. target_size: number of values in a target. hybrid: whether hybrid control is used.
        contact: (4,), surface normal and contact force, N, for hybrid control; None: the task's contact.
    """

    model: InverseDynamics = field(default=None, repr=False)  # type: ignore[assignment]
    target_size: int = 0
    contact: np.ndarray | None = None
    hybrid: bool = False

    @property
    def setpoint_size(self) -> int:
        """Number of values in a setpoint: `target_size`, and 6 more if `hybrid`, and 3 more if `slides`."""
        # target; if `hybrid`: normal (3), force, measured force, flag for a measured force; if `slides`: pull (3)
        return self.target_size + 6 * self.hybrid + 3 * self.slides

    @property
    def slides(self) -> bool:
        """Whether the task moves its target along a surface; setpoints then end with the force `task.pull` (3,) N."""
        return bool(self.hybrid and self.parameters[law.APPROACH] == law.SLIDES)

    def holding_torque(self, q: np.ndarray) -> np.ndarray:
        """Return the torque (n,) Nm that holds the model at rest at q (n,) rad."""
        still = np.zeros((1, len(q)))
        return self.model(q[None], still, still, still)[0]

    def setpoint(self, task: Any, t: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return the setpoints (m, s): target and, for hybrid control, contact (measured force: 0) and pull."""
        if not self.target_size:
            return np.empty((len(t), 0))
        if self.law is joint_impedance_law:
            return np.concatenate(task.trajectory(t, goals, 0.0)[:2], axis=1)
        target = task.target(t, goals)
        if not self.hybrid:
            return target
        contact = task.contact(t, goals) if self.contact is None else np.tile(self.contact, (len(t), 1))
        pull = [task.pull(t, goals)] if self.slides else []
        return np.concatenate([target, contact, np.zeros((len(t), 2)), *pull], axis=1)

    def with_force(self, command: np.ndarray, force: np.ndarray) -> np.ndarray:
        """Return commands (m, c) of hybrid control with the measured `force` (m,) N, positive against the normal."""
        out, at = command.copy(), self.command_size - 3 * self.slides - 2
        out[:, at], out[:, at + 1] = force, 1.0
        return out


def joint_impedance(
    robot: Robot,
    task: ControlledTask,
    dynamics: Dynamics,
    *,
    action: str = "target",
    torque_fraction: Sequence[float] | float = 0.5,
    displacement: float = 0.5,
    stiffness: Sequence[float] | float | None = None,
    softest: float = 0.1,
    damping: float = 1.0,
    tank: Sequence[float] = (1.0, 2.0),
) -> Impedance:
    """Return the controller whose joint springs pull to the task's trajectory, or to q_home if the task has none.

    Args:
        robot, task: the arm and its task. dynamics: the arm's model, for damping and feedforward.
        action: what a policy's action sets: "target", "stiffness" or "both".
        torque_fraction: torque limit / tau_max. displacement: rad, shift of the target by an action of 1.
        stiffness: Nm/rad, largest stiffness of each joint; None: CLIP * torque limit / displacement, or less if the
            spring's natural frequency would exceed `fastest_spring`. damping: damping ratio of all modes.
        softest: ratio of the smallest to the largest stiffness that an action sets.
        tank: J, initial level and capacity of the energy tank.

    Raises:
        UserError: a setting is out of its range.
    """
    limit, moves = _torque(robot, torque_fraction), hasattr(task, "trajectory")
    p, rows = _parameters(robot, task, dynamics, damping, tank)
    _check(action, softest, displacement)
    if action == "stiffness" and not moves:
        raise UserError(f"action: the target of {type(task).__name__} is home at all times; allowed: target, both")
    if stiffness is None:
        K = np.minimum(CLIP * limit / displacement, fastest_spring(task) ** 2 / np.diag(_at_home(p, robot)[1]))
    else:
        K = per_joint("stiffness", stiffness, robot.n, f"the {robot.n} joints of {robot.name}")
        if not (np.isfinite(K).all() and (K > 0).all()):
            raise UserError(f"stiffness: expected numbers above 0 Nm/rad, got {K.min():g}")
    rows[:, law.K_JOINT : law.K_JOINT + 3] = np.stack([K, softest * K, K], -1)
    rows[:, law.JOINT_LIMIT] = (CLIP * limit) ** 2 / (2 * K)
    scale, offset = _action(action, np.full(robot.n, displacement), softest * K, K, p)
    p[law.TARGET_AT] = len(scale) if moves else -1
    unit = {"target": "rad", "stiffness": "Nm/rad", "both": "rad, Nm/rad"}[action]
    return Impedance(
        "joint_impedance",
        joint_impedance_law,
        scale,
        offset,
        action,
        unit,
        parameters=p,
        memory_size=law.STIFFNESS + (law.ROWS + 1) * robot.n + robot.n**2,
        cpp=JOINT,
        torque_limit=limit,
        model=InverseDynamics(robot, dynamics),
        target_size=2 * robot.n if moves else 0,
    )


def cartesian_impedance(
    robot: Robot,
    task: Any,
    dynamics: Dynamics,
    *,
    action: str = "target",
    torque_fraction: Sequence[float] | float = 0.5,
    displacement: float = 0.1,
    rotation: float = 0.3,
    stiffness: float | None = None,
    rotational_stiffness: float = 0.0,
    softest: float = 0.1,
    damping: float = 1.0,
    force_clip: float | None = None,
    moment_clip: float | None = None,
    null_stiffness: float = 0.2,
    tank: Sequence[float] = (1.0, 2.0),
    hybrid: bool = False,
    normal: Sequence[float] | None = None,
    force: float | None = None,
    integral_rate: float = 2.0,
    integral_max: float = 0.3,
) -> Impedance:
    """Return the controller with springs between the end effector, or the tool's tip, and the task's target.

    Args:
        robot, task, dynamics, action, torque_fraction, softest, damping, tank: see `joint_impedance`.
        displacement, rotation: m and rad, shift and rotation of the target by an action of 1.
        stiffness: N/m, largest stiffness; None: force_clip / CLIP_M, or less if `fastest_spring` requires less.
        rotational_stiffness: Nm/rad, largest stiffness; 0: only the null-space springs act on the orientation.
        force_clip: N, largest spring force at the largest stiffness. The torque limit allows a force F in all
            directions in the home posture; force_clip may be at most F, and is CLIP times F if None.
        moment_clip: Nm, largest spring moment, at most the moment that the torque limit allows in all directions;
            None: CLIP times this moment.
        null_stiffness: 1/rad; this factor times a joint's torque limit is the stiffness, Nm/rad, of the joint's
            null-space spring to q_home.
        hybrid: whether to control the force along a surface normal; impedance control then acts only along the
            surface. An action that displaces the target against the normal adds the force stiffness * displacement.
            If `task.approaches`, the target moves into the surface, and the force is at most stiffness times the
            depth of the target below the tip, so that the tip is no faster than the target.
        normal, force: normal (3,) out of the surface, in the base frame; contact force against the normal, N; both
            None: the task's values.
        integral_rate: 1/s, integral gain on a measured force error. integral_max: integral limit / force_clip.

    Raises:
        UserError: the task has no target or contact, or a setting is out of its range.
    """
    name = "hybrid" if hybrid else "cartesian_impedance"
    if not hasattr(task, "target"):
        raise UserError(f"control: {name} needs a task with a target; {type(task).__name__} has none, reach has one")
    limit, rotates = _torque(robot, torque_fraction), rotational_stiffness > 0
    p, rows = _parameters(robot, task, dynamics, damping, tank)
    _check(action, softest, displacement)
    for key, value in (("rotational_stiffness", rotational_stiffness), ("integral_rate", integral_rate)):
        check_number(key, value, "[0, inf)")
    check_number("null_stiffness", null_stiffness, "(0, inf)")
    check_number("integral_max", integral_max, "[0, 1]")
    check_number("rotation", rotation, "(0, inf)")
    jacobian, mobility = _at_home(p, robot)
    force_clip = _clip("force_clip", "N", force_clip, limit, jacobian[:3])
    moment_clip = _clip("moment_clip", "Nm", moment_clip, limit, jacobian[3:])
    if stiffness is None:
        slow = np.linalg.eigvalsh(jacobian[:3] @ mobility @ jacobian[:3].T)[-1]
        stiffness = min(force_clip / CLIP_M, fastest_spring(task) ** 2 / slow)
    check_number("stiffness", stiffness, "(0, inf)")
    K = np.array([stiffness] * 3 + [rotational_stiffness])
    p[law.K_DEFAULT : law.K_HIGH + 4] = np.concatenate([K, softest * K, K])
    p[law.FORCE_LIMIT] = force_clip**2 / (2 * stiffness)
    p[law.MOMENT_LIMIT] = moment_clip**2 / (2 * rotational_stiffness) if rotates else 0.0
    p[law.HYBRID], p[law.RATE] = hybrid, integral_rate
    p[law.APPROACH] = getattr(task, "approaches", 0) if hybrid and normal is None else 0
    p[law.FORCE_MAX], p[law.INTEGRAL_MAX] = force_clip, integral_max * force_clip
    p[law.TASK_AXES], p[law.TARGET_SIZE] = 6 if rotates else 3, task.target_size
    rows[:, law.K_JOINT] = null_stiffness * limit
    moves, set_K = np.array([displacement] * 3 + [rotation] * 3), K[: 4 if rotates else 3]
    scale, offset = _action(action, moves[: 6 if rotates else 3], softest * set_K, set_K, p)
    p[law.TARGET_AT] = len(scale)
    unit = {"target": "m", "stiffness": "N/m", "both": "m, N/m"}[action] + (
        "; rotation: rad, Nm/rad" if rotates else ""
    )
    return Impedance(
        name,
        cartesian_impedance_law,
        scale,
        offset,
        action,
        unit,
        parameters=p,
        memory_size=law.STIFFNESS + law.SPRINGS + law.ROWS * robot.n + 2 * robot.n**2,
        cpp=CARTESIAN,
        torque_limit=limit,
        model=InverseDynamics(robot, dynamics),
        target_size=task.target_size,
        contact=_contact(task, normal, force, force_clip) if hybrid else None,
        hybrid=hybrid,
    )


def _check(action: str, softest: float, displacement: float) -> None:
    """Raise UserError if `action`, `softest` or `displacement` has a value that is not allowed."""
    if action not in ACTIONS:
        raise UserError(f"action: '{action}'; {instead_of(action, ACTIONS)}")
    check_number("softest", softest, "(0, 1]")
    check_number("displacement", displacement, "(0, inf)")


def _torque(robot: Robot, fraction: Sequence[float] | float) -> np.ndarray:
    """Return the torque limit `fraction` * tau_max (n,) Nm; raise UserError unless 0 < `fraction` <= 1."""
    share = per_joint("torque_fraction", fraction, robot.n, f"the {robot.n} joints of {robot.name}")
    if not ((share > 0) & (share <= 1)).all():
        raise UserError(f"torque_fraction: expected numbers in (0, 1], got {share.tolist()}")
    return share * robot.tau_max


def _contact(task: Any, normal: Sequence[float] | None, force: float | None, most: float) -> np.ndarray | None:
    """Return the unit normal and force (4,) from the settings, or None if the controller uses the task's contact."""
    if normal is None and force is None and hasattr(task, "contact"):
        return None
    if normal is None or force is None:
        raise UserError(
            f"normal: {type(task).__name__} has no contact; hybrid needs control.normal and control.force"
        )
    check_number("force", force, f"[0, {most:.6g}]")
    n = np.array(normal, dtype=float)
    if n.shape != (3,) or not np.isfinite(n).all() or not np.linalg.norm(n) > 0:
        raise UserError(f"normal: expected three numbers, not all 0, got {list(normal)}")
    return np.array([*(n / np.linalg.norm(n)), force])


def _clip(name: str, unit: str, value: float | None, limit: np.ndarray, jacobian: np.ndarray) -> float:
    """Check and return `value`; if None, CLIP times the force or moment that `limit` allows in all directions."""
    most = float((limit / np.maximum(np.linalg.norm(jacobian, axis=0), 1e-9)).min())
    if value is None:
        return CLIP * most
    check_number(name, value, "(0, inf)")
    if value > most:
        raise UserError(f"{name}: expected at most {most:.3g} {unit}, which the torque limit allows, got {value:g}")
    return float(value)


def fastest_spring(task: ControlledTask) -> float:
    """Return the highest allowed spring frequency w, rad/s; a critically damped spring has the loop bandwidth 2 w."""
    return 0.5 * BANDWIDTH_LATENCY / (1 / (2 * np.pi * task.cutoff_hz) + LATENCY)


def _at_home(parameters: np.ndarray, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Return the Jacobian (6, n) of the tip and the inverse mass matrix (n, n) in the home posture."""
    n = robot.n
    frames, jacobian, mass = np.empty((n, POSE)), np.empty((6, n)), np.empty((n, n))
    law.arm_pose(robot.q_home, parameters, frames, jacobian, np.empty(3))
    law.mass_matrix(parameters, frames, jacobian, mass)
    return jacobian, np.linalg.inv(mass)


def _action(
    action: str, moves: np.ndarray, low: np.ndarray, high: np.ndarray, parameters: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return an action's scale and offset; write the indices of the action's values in a command to `parameters`."""
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    parameters[law.DISPLACED] = -1 if action == "stiffness" else 0
    parameters[law.STIFFNESS_AT] = {"target": -1, "stiffness": 0, "both": len(moves)}[action]
    scale = {"target": moves, "stiffness": half, "both": np.concatenate([moves, half])}[action]
    offset = {"target": 0 * moves, "stiffness": middle, "both": np.concatenate([0 * moves, middle])}[action]
    return scale, offset


def _parameters(
    robot: Robot, task: ControlledTask, dynamics: Dynamics, damping: float, tank: Sequence[float]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the law's parameters (p,), with springs and action still 0, and a view (n, ROW) of joint parameters."""
    check_number("damping", damping, "(0, 10]")
    if np.shape(tank) != (2,) or not 0 <= tank[0] <= tank[1] < np.inf:
        raise UserError(f"tank: expected first level and size in J, 0 <= level <= size, got {tank}")
    d, n = dynamics, robot.n
    own, nominal = links_of(robot, d.mass, d.com, d.inertia), links_of(robot, robot.mass, robot.com, robot.inertia)
    p = np.zeros(law.HEAD + n * law.ROW)
    rows = p[law.HEAD :].reshape(n, law.ROW)
    p[law.HOLD], p[law.RATIO], p[law.CYCLE_S] = round(1 / (task.ctrl_hz * SIM_DT)), 2 * damping, SIM_DT
    p[law.FILL], p[law.TANK] = tank
    hand = chain(robot, Dynamics.of(robot, np.zeros((n, 3))), friction=False)[1]
    tool = getattr(robot, "tool", None)
    p[law.TIP : law.TIP + 3] = hand[:3, 3] if tool is None else hand[:3, :3] @ tool.tip + hand[:3, 3]
    p[law.GRAVITY : law.GRAVITY + 3] = robot.gravity
    rows[:, :LINK], rows[:, law.ROTOR] = own, d.armature
    moment = [links[:, MASS, None] * links[:, COM : COM + 3] for links in (own, nominal)]
    rows[:, law.MASS_ERROR] = own[:, MASS] - nominal[:, MASS]
    rows[:, law.MOMENT_ERROR : law.MOMENT_ERROR + 3] = moment[0] - moment[1]
    rows[:, law.OFFSET], rows[:, law.DRAG : law.DRAG + 2], rows[:, law.HOME] = d.offset, d.drag, robot.q_home
    rows[:, law.EDGES : law.EDGES + 2] = d.breakaway
    if d.family.has_memory and "presliding" in d.family.names:
        rows[:, law.PRESLIDING] = d.phi[:, d.family.names.index("presliding")]
    rows[:, law.LOAD] = d.load
    for k in range(2 * law.NODES):
        v = np.full(n, law.FIRST_DQ * 4.0 ** (k % law.NODES) * (1 if k < law.NODES else -1))
        rows[:, law.FRICTION + k] = d.friction(v, np.sign(v))
    frames = np.empty((n, POSE))
    law.arm_pose(robot.q_home, p, frames, np.empty((6, n)), np.empty(3))
    p[law.HOME_AXES : law.HOME_AXES + 9] = frames[-1, 3:]
    return p, rows
