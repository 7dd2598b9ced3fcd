"""Check whether a newly connected arm matches the robot model, before the arm moves."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from r2s.arm.clients import fr3_limits
from r2s.errors import UserError
from r2s.physics.payload import LoadTorque, Payload, ee_pose
from r2s.physics.rigid_body import nominal_torque
from r2s.physics.robot import Robot

# At equal joint angles, poses of arm and model differ only by rounding: single precision (1e-7 m) and robot files
PLACE_M, ANGLE_DEG = 1e-3, 0.2  # 1 mm: a tenth of a policy's position error; 0.2 deg move a point 0.3 m away by 1 mm
LOAD_KG = 0.01  # weight torque 0.08 Nm at full reach: less than the friction of any joint, so the arm does not sink
GRAVITY = 0.1  # m/s^2: equals a tilt of 0.6 deg, or an error of 1 % in gravity compensation
# Without the arm's gravity vector O_ddP_O, r2s compares gravity torques.
# The link models of r2s and the arm differ, so the comparison detects only tilts above 5 to 12 deg.
GRAVITY_SHARE, GRAVITY_NM = 0.1, 1.0  # allowed error: a share of the posture's largest gravity torque, plus 1 Nm
BEYOND = 0.1  # rad, accepted distance of a joint beyond its limit: a person may have guided it there


def check_joints(robot: Robot) -> None:
    """Raise UserError unless the robot has the 7 joints of a Franka arm."""
    if robot.n != 7:
        raise UserError(f"expected 7 joints for a Franka arm, got {robot.n} ({robot.name})")


@dataclass(frozen=True)
class ArmType:
    """A type of Franka arm and its limits (Franka's FCI documentation).

    Attributes:
        name: name of the arm type. version: version of the arm's FCI.
        q_min, q_max, dq_max, tau_max: (7,) rad, rad/s, Nm, joint limits. dtau_max: Nm/s, limit of the torque rate.
    """

    name: str
    version: int
    q_min: np.ndarray
    q_max: np.ndarray
    dq_max: np.ndarray
    tau_max: np.ndarray
    dtau_max: float = 1000.0

    def within(self, robot: Robot) -> Robot:
        """Return the robot with its position and velocity limits clipped to those of this arm type."""
        q_min, q_max = np.maximum(robot.q_min, self.q_min), np.minimum(robot.q_max, self.q_max)
        return replace(robot, q_min=q_min, q_max=q_max, dq_max=np.minimum(robot.dq_max, self.dq_max))


_TAU_MAX = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])
PANDA = ArmType(
    "Panda",
    5,
    np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973]),
    np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973]),
    np.array([2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61]),
    _TAU_MAX,
)
FR3 = ArmType("FR3", 10, fr3_limits.Q_MIN, fr3_limits.Q_MAX, fr3_limits.DQ_MAX, _TAU_MAX)


@dataclass(frozen=True)
class Finding:
    """Result of comparing a property of the arm or computer with the value that r2s expects.

    Attributes:
        name: name of the property. expected: expected value. found: actual value.
        refused: whether the result forbids motion.
    """

    name: str
    expected: str
    found: str
    refused: bool = False

    def __str__(self) -> str:
        return f"{self.name}: expected {self.expected}, got {self.found}"


@dataclass(frozen=True)
class Connection:
    """Properties that an arm must have before a client may move it.

    Attributes:
        arm: type of the arm. declared: payload plus end effector that the arm's gravity compensation should assume.
        moves: whether the client may move the arm; if False (`r2s check`), the client only reports mismatches.
    """

    arm: ArmType
    declared: Payload | None = None
    moves: bool = True

    def findings(self, robot: Robot, version: int, state: Any) -> list[Finding]:
        """Compare the robot model and the expected properties with the arm's FCI version and RobotState at rest."""
        return [
            Finding(
                "FCI version", f"{self.arm.version} ({self.arm.name})", f"{version}", version != self.arm.version
            ),
            Finding("mode", "idle", str(state.robot_mode)),
            _posture(self.arm, np.array(state.q)),
            *_limits(self.arm, robot),
            _end_effector(robot, state),
            self._load(state),
            self._gravity(robot, state),
            _external(state),
        ]

    def _load(self, s: Any) -> Finding:
        mass = 0.0 if self.declared is None else float(self.declared.mass)
        found = f"{s.m_ee + s.m_load:.3f} kg in the arm (m_ee {s.m_ee:.3f}, m_load {s.m_load:.3f})"
        wrong = abs(s.m_ee + s.m_load - mass) > LOAD_KG
        return Finding("load", f"{mass:.3f} kg (arm.declared_payload)", found, wrong)

    def _gravity(self, robot: Robot, s: Any) -> Finding:
        if hasattr(s, "O_ddP_O"):
            wrong = bool(np.abs(robot.gravity - s.O_ddP_O).max() > GRAVITY)
            return Finding("gravity", f"{_row(robot.gravity)} m/s^2", f"{_row(s.O_ddP_O)} m/s^2 (O_ddP_O)", wrong)
        # panda-python does not pass O_ddP_O on. At rest, tau_J minus tau_ext is the gravity torque of the arm's model
        own = gravity_torque(robot, np.array(s.q), _load_of(robot, s))
        arm = np.array(s.tau_J) - s.tau_ext_hat_filtered
        wrong = bool(np.abs(own - arm).max() > GRAVITY_NM + GRAVITY_SHARE * np.abs(own).max())
        return Finding(
            "gravity torque", f"{_row(own, 1)} Nm", f"{_row(arm, 1)} Nm (tau_J - tau_ext_hat_filtered)", wrong
        )


def gravity_torque(robot: Robot, q: np.ndarray, load: np.ndarray) -> np.ndarray:
    """Return the gravity torque (n,) Nm of nominal links and load at q (n,) rad; `mass_and_moment` defines `load`."""
    rest = np.zeros((1, robot.n))
    return nominal_torque(robot, q[None], rest, rest)[0] + LoadTorque(robot)(q, load)


def _load_of(robot: Robot, s: Any) -> np.ndarray:
    """Return mass (kg) and first moment (kg m) of end effector plus load in the RobotState `s`, as one array (4,)."""
    place, axes = ee_pose(robot)
    tool = np.array(s.F_T_EE).reshape(4, 4).T
    flange = axes @ tool[:3, :3].T
    return s.m_total * np.append(1.0, place + flange @ (np.array(s.F_x_Ctotal) - tool[:3, 3]))


def refuse(findings: Sequence[Finding], what: str) -> None:
    """Raise UserError if any finding forbids motion; the message lists all such findings in one line."""
    if wrong := [str(finding) for finding in findings if finding.refused]:
        raise UserError(f"{what}: {'; '.join(wrong)}")


def _posture(arm: ArmType, q: np.ndarray) -> Finding:
    outside = np.maximum(arm.q_min - q, q - arm.q_max)
    i = int(outside.argmax())
    name, allowed = f"posture, joint {i + 1}", f"{arm.q_min[i]:g} to {arm.q_max[i]:g} rad ({arm.name})"
    return Finding(name, allowed, f"{q[i]:.4f} rad", bool(outside[i] > BEYOND))


def _limits(arm: ArmType, robot: Robot) -> list[Finding]:
    """Check that the model's torque and torque rate limits do not exceed the arm's, and that home is in range."""
    step, torque = robot.dtau_max / arm.dtau_max, robot.tau_max / arm.tau_max
    i, j, home = int(torque.argmax()), int(step.argmax()), robot.q_home
    k = int(np.maximum(robot.q_min - home, home - robot.q_max).argmax())
    inside = bool((robot.q_min[k] <= home[k]) & (home[k] <= robot.q_max[k]))
    rows = (
        ("torque limit", i, f"{robot.tau_max[i]:g} Nm", f"{arm.tau_max[i]:g} Nm", torque[i] > 1),
        ("torque rate", j, f"{robot.dtau_max[j]:g} Nm/s", f"{arm.dtau_max:g} Nm/s", step[j] > 1),
        ("home posture", k, f"{home[k]:g} rad", f"{arm.q_min[k]:g} to {arm.q_max[k]:g} rad", not inside),
    )
    return [
        *(Finding(f"{name}, joint {n + 1}", ours, its, bool(wrong)) for name, n, ours, its, wrong in rows),
        Finding("lowest positions, used", _row(robot.q_min), f"{_row(arm.q_min)} rad"),
        Finding("highest positions, used", _row(robot.q_max), f"{_row(arm.q_max)} rad"),
        Finding("velocity limits, used", _row(robot.dq_max), f"{_row(arm.dq_max)} rad/s"),
    ]


def _end_effector(robot: Robot, s: Any) -> Finding:
    model = robot.model(gravity=False)
    data, site = mujoco.MjData(model), model.site(robot.ee_site).id
    data.qpos[:] = s.q
    mujoco.mj_kinematics(model, data)
    arm, tool = (np.array(x).reshape(4, 4).T for x in (s.O_T_EE, s.F_T_EE))  # by columns
    place, rotation = data.site_xpos[site], data.site_xmat[site].reshape(3, 3)
    apart = float(np.linalg.norm(place - arm[:3, 3]))
    relative = rotation.T @ arm[:3, :3]  # the next line computes sine and cosine of this rotation's angle
    sine, cosine = np.linalg.norm(relative - relative.T) / np.sqrt(8), (np.trace(relative) - 1) / 2
    turned = float(np.degrees(np.arctan2(sine, cosine)))
    found = f"{_row(arm[:3, 3], 4)} m (O_T_EE, with F_T_EE at {_row(tool[:3, 3], 4)} m)"
    found += f": {apart:.4f} m and {turned:.2f} deg apart, allowed {PLACE_M:g} m and {ANGLE_DEG:g} deg"
    return Finding("end effector", f"{_row(place, 4)} m", found, apart > PLACE_M or turned > ANGLE_DEG)


def _external(s: Any) -> Finding:
    """Report the external torque. A large one forbids no motion: an adapter may compensate an undeclared load."""
    return Finding("external torque at rest", "about 0 Nm", f"{_row(np.array(s.tau_ext_hat_filtered), 1)} Nm")


def _row(x: np.ndarray, digits: int = 2) -> str:
    return f"[{', '.join(f'{value:.{digits}f}' for value in x)}]"
