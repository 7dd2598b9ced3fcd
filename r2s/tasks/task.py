"""The protocol `Task`: the interface through which environment, rollout and policies use a task.

A task defines start postures, goals, observations, reward terms, and the measures of episodes. To add a task, write
one Python file next to reach.py and one YAML file (docs/how_to/extending.md).
"""

import copy
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol, Self

import numpy as np

from r2s.control.controller import Controller
from r2s.control.torque import torque
from r2s.physics.dynamics import Dynamics
from r2s.physics.push_limit import PushLimit, push_limit
from r2s.physics.robot import SIM_DT, Robot
from r2s.tasks.measures import MeasureTable
from r2s.tasks.rewards import TERMS

# the score penalizes only filter rates above this value, because lower rates do not make policies better
MAX_FILTER_RATE = 0.04
TORQUE_STD = 0.3  # standard deviation of observed controller torques / torque limit


@dataclass(frozen=True, slots=True)
class State:
    """The state of m arms with n joints; the next control step may overwrite the arrays.

    Attributes:
        t: (m,) s, time since the episode began. q, dq: (m, n) rad, rad/s, joint angles and speeds.
        ee: (m, 3) m, end-effector position. jacobian: (m, 3, n) m/rad, the end effector's translational Jacobian.
        tau: (m, n) Nm, the last command (tau_J_d). effort: (m, n) Nm, the target torque after the low-pass.
        stopped: (m,), whether the arm has stopped before the end of its episode.
        limited: (m,), share of the last control period in which the safety filter changed the command.
        noise: (m, n) rad/s, sensor noise that `measured` adds to the true speed dq; None if dq already includes
            sensor noise, or the sensors have no noise.
        force: (m, 3) N, force that the tool exerts, in base axes: the true force in simulation and on twins, the
            reported force on other arms; None if unknown. Rewards and measures use `force`, but observations do not.
        box: (m, 6), perceived pose of the box in the base frame: the box's center, m, and the direction of the box's
            first axis; None if the task has no box.
    """

    t: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    ee: np.ndarray
    jacobian: np.ndarray
    tau: np.ndarray
    effort: np.ndarray
    stopped: np.ndarray
    limited: np.ndarray
    noise: np.ndarray | None = None
    force: np.ndarray | None = None
    box: np.ndarray | None = None

    def measured(self) -> "State":
        """Return the state as the sensors measure it, for policies and controllers."""
        return self if self.noise is None else replace(self, dq=self.dq + self.noise, noise=None)

    @staticmethod
    def at_home(robot: Robot) -> "State":
        """Return a state at rest in the home posture, with zero ee and Jacobian, for calls that compile functions."""
        rest, ee, jacobian = np.zeros((1, robot.n)), np.zeros((1, 3)), np.zeros((1, 3, robot.n))
        none = np.zeros(1, dtype=bool), np.zeros(1)
        return State(np.zeros(1), robot.q_home[None], rest, ee, jacobian, rest, rest, *none)


@dataclass(frozen=True)
class Episodes:
    """E finished episodes of T control steps; arrays with a dimension T contain the values after each step.

    Attributes:
        t: (T,) s, time. q, dq: (E, T, n) rad, rad/s, angles and speeds. ee: (E, T, 3) m, end effector. goal: goal
            positions, (E, 3) m, or (E, T, 3) m if goals move. tau: (E, T, n) Nm, command at the end of each step.
        distance: (E, T), distance in m, or force error in N for `task=press`. reward: (E, T), weighted by
            `Task.paper_weights`; for `task=reach`, the paper's reward.
        reward_smooth: (E, T), the reward computed from speeds without measurement noise.
        q_left: (E,) rad, smallest distance of any joint from its position limits.
        limited: (E,), share of the cycles in which the safety filter changed the command.
        collision: (E,) str, time and bodies of the contact that ended the episode; "" without contact.
        force: (E, T, 2) N, force on the surface and requested force; None if the task touches no surface.
        box: (E, T, 11), state of the box, see `Task.boxes`; None if the task moves no box.
    """

    t: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    ee: np.ndarray
    goal: np.ndarray
    tau: np.ndarray
    distance: np.ndarray
    reward: np.ndarray
    reward_smooth: np.ndarray
    q_left: np.ndarray
    limited: np.ndarray
    collision: np.ndarray
    force: np.ndarray | None = None
    box: np.ndarray | None = None


@dataclass(frozen=True)
class ObservationTerm:
    """Description of one observation term, from which a program without r2s can compute the term.

    Attributes:
        name: name of the term. unit: SI unit of the term, "1" if dimensionless.
        of: signal in the term: q, dq, ee, goal, error (goal - ee), effort, pull (J^T error), control (torque of a
            controller with `observes_torque`). For tasks with a planned path, goal is the current path position, and
            further signals are ahead (next positions - ee), velocity (of the path), limited, q_off, dq_off (plan -
            arm). For tasks on a surface, `MORE_OF` in r2s/export/contract.py lists further signals.
        divided_by: divisor of the signal: a number, or one per element; if None, 1. tanh: whether tanh is applied
            last.
    """

    name: str
    unit: str
    of: str
    divided_by: float | tuple[float, ...] | None = None
    tanh: bool = False


class Task(Protocol):
    """Interface of a task that an arm performs in episodes of `steps` control steps.

    Attributes:
        ctrl_hz: policy rate. cutoff_hz: cut-off of the low-pass on the torque. steps: control steps per episode.
        substeps: physics steps per control step.
        observation_summary: terms and units of an observation, for the metadata of policy.onnx.
        reward_terms: names of the reward terms. paper_weights: (k,), weights of the reward terms in
            `Episodes.reward`.
        pool: number of different goals in a training.
        speed_noise: rad/s. In training, each arm gets a random value ~ U(0, speed_noise); the standard deviation of
            the arm's speed noise is at least this value. None and 0 set no lower bound.
        measure_table: the measures that `measures` returns, with their presentation (r2s/tasks/measures.py).
        may_touch: pairs of bodies that may touch each other: two names, or a name and "table". Other contacts end an
            episode.
        touches: whether the tool touches a surface; simulated arms then need `Dynamics.surface`.
        moves_box: whether the surface is a box that the tool pushes; arms must then perceive the box (`State.box`).
        push_limit: limit of the force and the speed of contacts, or None without a limit.
    """

    @property
    def ctrl_hz(self) -> int: ...  # noqa: D102 (see the class)
    @property
    def cutoff_hz(self) -> float: ...  # noqa: D102
    @property
    def steps(self) -> int: ...  # noqa: D102
    @property
    def substeps(self) -> int: ...  # noqa: D102
    @property
    def observation_summary(self) -> str: ...  # noqa: D102
    @property
    def reward_terms(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def paper_weights(self) -> np.ndarray: ...  # noqa: D102
    @property
    def pool(self) -> int: ...  # noqa: D102
    @property
    def speed_noise(self) -> float | None: ...  # noqa: D102
    @property
    def measure_table(self) -> MeasureTable: ...  # noqa: D102
    @property
    def may_touch(self) -> tuple[tuple[str, str], ...]: ...  # noqa: D102
    @property
    def touches(self) -> bool: ...  # noqa: D102
    @property
    def moves_box(self) -> bool: ...  # noqa: D102
    @property
    def push_limit(self) -> PushLimit | None: ...  # noqa: D102

    def torque_limit(self, robot: Robot) -> np.ndarray:
        """Return (n,) Nm, the largest target torque."""
        ...

    def with_model(self, robot: Robot, dynamics: Dynamics) -> "Task":
        """Return the task with the attributes that depend on the model `dynamics` of one arm."""
        ...

    def controlled_by(self, controller: Controller) -> "Task":
        """Return a copy of the task that uses `controller`."""
        ...

    def pushing_within(
        self, robot: Robot, friction: np.ndarray, force_max: float | None, speed_near: float | None
    ) -> "Task":
        """Return the task with limits of contact force (N) and speed (m/s); friction: (n,) Nm, joint friction."""
        ...

    def control(self, robot: Robot) -> Controller:
        """Return the controller, which defines the action space; by default `control=torque`."""
        ...

    def starts(self, robot: Robot, rng: np.random.Generator, count: int) -> np.ndarray:
        """Return (count, n) rad, the postures in which episodes start at rest."""
        ...

    def goals(self, robot: Robot, rng: np.random.Generator, count: int) -> np.ndarray:
        """Return the random goals (count, ...) of `count` episodes: points or timed paths."""
        ...

    def begin(self, starts: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return (m, n) rad, the start postures in `goals`, or `starts` if goals of this task contain none."""
        ...

    def goal_positions(self, goals: np.ndarray) -> np.ndarray:
        """Return goal positions to plot: (m, 3) m, or (m, steps, 3) m after each step for moving goals."""
        ...

    def observation_scale(self, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and standard deviation (d,) that normalize observations."""
        ...

    def observe(self, state: State, goals: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Return the observations (m, d) float32; torque: `torque_limit`, the divisor of the efforts."""
        ...

    def distance_scale(self, state: State, goals: np.ndarray) -> np.ndarray:
        """Return (m,) m, divisors of the distances in the reward, computed from the first state of the episodes."""
        ...

    def judge(
        self, state: State, ddq: np.ndarray, goals: np.ndarray, scale: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the distance (m,) m from the goal, and the reward terms (m, k).

        Args:
            state: state after a control period. ddq: (m, n) rad/s^2, mean over the control period.
            goals: (m, ...), goals of the episodes. scale: (m,) m, result of `distance_scale`.
        """
        ...

    def forces(self, state: State, goals: np.ndarray) -> np.ndarray | None:
        """Return (m, 2) N, force against a surface and requested force, or None if the task requests no force."""
        ...

    def boxes(self, state: State, goals: np.ndarray) -> np.ndarray:
        """Return (m, 11): pose of the box, yaw error rad, height of the tip above the table m, edges of the box m."""
        ...

    def expected(self, robot: Robot, dynamics: Dynamics) -> Dynamics:
        """Return the dynamics with the task's nominal surface or box, for predictions of episodes."""
        ...

    def measures(self, episodes: Episodes) -> dict[str, float]:
        """Return the measures of the episodes, one row of evaluations.csv."""
        ...

    def score(self, row: Mapping[str, float]) -> float:
        """Return the score of a policy from a row of `measures`; the best policy has the highest score."""
        ...


def observe(task: Task, controller: Controller, state: State, goals: np.ndarray, torque: np.ndarray) -> np.ndarray:
    """Return the policy's observations (m, d) float32: terms of the task, then terms of the controller.

    Args:
        task, controller: the task and its controller. goals: (m, ...). state: true state; this function adds its
            `noise`.
        torque: (n,) Nm, `Task.torque_limit`.
    """
    state = state.measured()
    own = task.observe(state, goals, torque)
    if not controller.observes_torque:
        return own
    rest = controller.command(np.zeros((len(goals), controller.action_dim)), task, state.t, goals)
    return np.concatenate([own, controller.torque(state.q, state.dq, rest) / torque], axis=1, dtype=np.float32)


def observation_scale(task: Task, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviation (d,) that normalize the result of `observe`."""
    mean, std = task.observation_scale(robot)
    if not task.control(robot).observes_torque:
        return mean, std
    return np.concatenate([mean, np.zeros(robot.n)]), np.concatenate([std, np.full(robot.n, TORQUE_STD)])


class BaseTask:
    """Base class with the defaults of most tasks: torque control, goals that are positions, no model."""

    ctrl_hz: int
    episode_s: float
    pool = 2048
    reward_terms: tuple[str, ...] = TERMS
    speed_noise: float | None = None
    may_touch: tuple[tuple[str, str], ...] = ()
    touches = False
    moves_box = False
    controller: Controller | None = None
    push_limit: PushLimit | None = None

    @property
    def steps(self) -> int:
        """Number of control steps per episode."""
        return round(self.episode_s * self.ctrl_hz)

    @property
    def substeps(self) -> int:
        """Number of physics steps per control step."""
        return round(1.0 / (self.ctrl_hz * SIM_DT))

    def with_model(self, robot: Robot, dynamics: Dynamics) -> Self:
        """Return the task unchanged, because the task uses no model of the arm."""
        return self

    def controlled_by(self, controller: Controller) -> Self:
        """Return a copy of the task that uses `controller`."""
        return self._with("controller", controller)

    def pushing_within(
        self, robot: Robot, friction: np.ndarray, force_max: float | None, speed_near: float | None
    ) -> Self:
        """Return the task with a push limit (r2s/physics/push_limit.py) for a work table below the home posture."""
        return self._with("push_limit", push_limit(robot, friction, force_max, speed_near))

    def _with(self, name: str, value: Any) -> Self:
        task = copy.copy(self)
        object.__setattr__(task, name, value)  # tasks are frozen dataclasses
        return task

    def control(self, robot: Robot) -> Controller:
        """Return the controller that `controlled_by` set, or else `control=torque`."""
        return self.controller or torque(robot, self)  # type: ignore[arg-type]

    def begin(self, starts: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return `starts`, because start postures do not depend on the goals."""
        return starts

    def goal_positions(self, goals: np.ndarray) -> np.ndarray:
        """Return the goals."""
        return goals

    def forces(self, state: State, goals: np.ndarray) -> np.ndarray | None:
        """Return None, because the task requests no force."""
        return None

    def boxes(self, state: State, goals: np.ndarray) -> np.ndarray:
        """Raise TypeError, because the task moves no box."""
        raise TypeError(f"{type(self).__name__} moves no box")

    def expected(self, robot: Robot, dynamics: Dynamics) -> Dynamics:
        """Return the dynamics unchanged, because the task has no surface and no box."""
        return dynamics

    def score(self, row: Mapping[str, float]) -> float:
        """Return the score of one evaluation.

        The score is return + 100 (success within 1 cm + share of episodes that end at rest) - 1000 max(0, filter rate
        - MAX_FILTER_RATE).
        """
        price = 1e3 * max(row["limited"] - MAX_FILTER_RATE, 0.0)
        return 100 * (row["success_1cm"] + row["rest"]) + row["return_paper"] - price
