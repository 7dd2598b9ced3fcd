"""`control=computed_torque`: follow a task's trajectory by inverse dynamics; the policy's action adds torque.

    tau = action + ID(q_r, dq_r, ddq_r) + M(q_r) (w^2 (q_d - q) + 2 w (dq_d - dq))

ID is the inverse dynamics of the identified arm, with friction and without gravity. q_d is the present reference
position. q_r is the reference position at the time when the torque will act, so that latency does not delay the
feedforward (Spong, Hutchinson and Vidyasagar, Robot Modeling and Control, ch. 8).
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from r2s.control.controller import ControlledTask, Controller
from r2s.errors import UserError, check_number
from r2s.physics.control_laws import computed_torque_law
from r2s.physics.dynamics import Dynamics
from r2s.physics.inverse_dynamics import InverseDynamics
from r2s.physics.robot import SIM_DT, Robot

LATENCY = 0.007  # s, assumed latency of the feedback: delay, lag and velocity filter (docs/explanation/arms.md)
# rad, bandwidth 2 w times latency. For velocity feedback alone, 0.6 leaves a phase margin of 90 - 34 = 56 deg, and
# pi / 2 is the stability limit. With position feedback, the phase margin is 41 deg, and 1.29 is the stability limit.
BANDWIDTH_LATENCY = 0.6


@dataclass(frozen=True)
class ComputedTorque(Controller):
    """Computed-torque control along a task's trajectory; `Controller` documents the inherited attributes.

    Attributes:
        model: the identified arm. ahead_s: s, look-ahead of the feedforward: control period / 2 + low-pass time
            constant + identified delay + identified lag.
    """

    model: InverseDynamics = field(default=None, repr=False)  # type: ignore[assignment]
    ahead_s: float = 0.0

    @property
    def setpoint_size(self) -> int:
        """Number of values in a setpoint: n each for feedforward, q_d and dq_d, and n^2 for the mass matrix."""
        n = self.action_dim
        return n * (3 + n)

    @property
    def observes_torque(self) -> bool:
        """Whether the policy observes the computed torque, to which the control law adds the policy's action."""
        return True

    def holding_torque(self, q: np.ndarray) -> np.ndarray:
        """Return the torque (n,) Nm that holds the model at rest at q (n,) rad."""
        still = np.zeros((1, len(q)))
        return self.model(q[None], still, still, still)[0]

    def setpoint(self, task: Any, t: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return the setpoints (m, s): feedforward Nm, q_d rad, dq_d rad/s, and the flattened mass matrix kg m^2."""
        q_d, dq_d, _ = task.trajectory(t, goals, 0.0)
        q, dq, ddq = task.trajectory(t, goals, self.ahead_s)
        mass = self.model.mass(q).reshape(len(q), -1)
        return np.concatenate([self.model(q, dq, ddq, dq), q_d, dq_d, mass], axis=1)


def computed_torque(
    robot: Robot,
    task: ControlledTask,
    dynamics: Dynamics,
    *,
    residual: float = 0.1,
    bandwidth: float | None = None,
    feedback_hz: float | None = None,
) -> ComputedTorque:
    """Return the computed-torque controller of a task with a trajectory.

    Args:
        robot, task: the arm and its task. dynamics: the identified arm.
        residual: torque that an action of 1 adds, as a fraction of the task's torque limit.
        bandwidth: natural frequency w of the critically damped feedback, rad/s; the loop has the bandwidth 2 w. If
            None, w is BANDWIDTH_LATENCY / (2 latency), with latency = control period + low-pass time constant +
            LATENCY.
        feedback_hz: Hz, update rate of the feedback, at most 1000; None: the policy's rate.

    Raises:
        UserError: the task has no trajectory, or a setting is out of its range.
    """
    if not hasattr(task, "trajectory"):
        raise UserError(
            f"control: computed_torque needs a task with a reference trajectory; {type(task).__name__} has none, "
            "task=track has one"
        )
    check_number("residual", residual, "(0, 1]")
    low_pass = 1 / (2 * np.pi * task.cutoff_hz)
    if bandwidth is None:
        bandwidth = 0.5 * BANDWIDTH_LATENCY / (1.0 / task.ctrl_hz + low_pass + LATENCY)
    else:
        check_number("bandwidth", bandwidth, "(0, inf)")
    if feedback_hz is not None:
        check_number("feedback_hz", feedback_hz, f"[{task.ctrl_hz}, {1 / SIM_DT:g}]")
    hold = round(1.0 / ((feedback_hz or task.ctrl_hz) * SIM_DT))
    return ComputedTorque(
        "computed_torque",
        computed_torque_law,
        residual * task.torque_limit(robot),
        np.zeros(robot.n),
        parameters=np.array([bandwidth, hold], dtype=float),
        memory_size=1 + robot.n,
        model=InverseDynamics(robot, dynamics),
        ahead_s=0.5 / task.ctrl_hz + low_pass + float(dynamics.delay) + float(dynamics.lag),
    )
