"""What a task has to say, and what it is told: the protocol that environment, rollout and policies depend on.

A new task is one file beside reach.py and one yaml: where episodes start, what is asked, what a policy sees of it,
and what that is worth.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import SIM_DT, Robot

OFTEN = 0.04  # of the cycles: policies that the driver's law limits in more are no better for what they gain by it


@dataclass(frozen=True, slots=True)
class State:
    """m arms of n joints at one moment. Its arrays may be views that the next step overwrites.

    Attributes:
        t: (m,) s since their episodes began. q, dq: (m, n) rad, rad/s.
        ee: (m, 3) m, the end effector. jacobian: (m, 3, n) m/rad, its translational Jacobian.
        tau: (m, n) Nm, the last command (tau_J_d). effort: (m, n) Nm, the target as it has come through the low-pass.
        stopped: (m,), whether the arm has ended its motion.
        limited: (m,), in which share of the last control period the driver's law changed what was asked for.
        told: (m, c), what a policy is told of its arm (r2s/adaptation/telling.py); None: nothing.
        noise: (m, n) rad/s, what sensors would add to dq where that is the truth; None: dq is what they say, or they
            are exact.
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
    told: np.ndarray | None = None
    noise: np.ndarray | None = None

    def seen(self) -> "State":
        """Return the state as sensors say it, which is all that a policy or a controller has."""
        return self if self.noise is None else replace(self, dq=self.dq + self.noise, noise=None)

    @staticmethod
    def still(robot: Robot) -> "State":
        """Return one arm at rest at home, without kinematics: what functions are compiled on."""
        rest, ee, jacobian = np.zeros((1, robot.n)), np.zeros((1, 3)), np.zeros((1, 3, robot.n))
        none = np.zeros(1, dtype=bool), np.zeros(1)
        return State(np.zeros(1), robot.q_home[None], rest, ee, jacobian, rest, rest, *none)


@dataclass(frozen=True)
class Episodes:
    """E finished episodes of T control steps; row k is the state after step k.

    Attributes:
        t: (T,) s. q, dq: (E, T, n). ee: (E, T, 3) m. goal: (E, 3) m, or (E, T, 3) where it moves, as of
        `Task.places`. tau: (E, T, n) Nm, the command at the end of the step. distance: (E, T) m. reward: (E, T),
        under `Task.paper_weights`: of reaching, eq. (2).
        reward_smooth: (E, T), the same with the noise of the speeds taken out, where an arm measured them.
        q_left: (E,) rad, how close any joint came to a position limit.
        limited: (E,), in which share of the cycles the driver's law changed what was asked for.
        collision: (E,) words: when it touched what, which ended it; "" where it touched nothing.
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


@dataclass(frozen=True)
class Entry:
    """What a stretch of an observation is, for a program that has to make it without r2s.

    Attributes:
        name: of it. unit: SI, "1" where it has none.
        of: what it is made of: q, dq, ee, goal, error (goal - ee), effort, or pull (J^T error). Of a plan `goal` is
            where the hand is to be now, and there are ahead (the next places - ee), velocity (the path's), limited,
            q_off and dq_off (the plan's less the arm's), and base (the torque that an action is added to).
        divided_by: one number, or one for each element; None: nothing. tanh: whether tanh is taken then.
    """

    name: str
    unit: str
    of: str
    divided_by: float | tuple[float, ...] | None = None
    tanh: bool = False


class Task(Protocol):
    """What is asked of an arm in episodes of `steps` control steps.

    Attributes:
        ctrl_hz: policy rate. cutoff_hz: low-pass on the torque. steps: control steps of an episode.
        substeps: physics steps of a control step.
        observed: what is in an observation, in words and units, for whoever deploys the policy.
        paper_weights: (k,), of the reward terms in `Episodes.reward`.
        share: of `torque`, what an action of 1 changes a target by. pool: how many goals a training draws from.
        speed_noise: rad/s; speeds that a training shows are at least as noisy as U(0, speed_noise), a draw for each
            arm. None or 0: as the arm's own sensors are.
    """

    @property
    def ctrl_hz(self) -> int: ...  # noqa: D102 (said above)
    @property
    def cutoff_hz(self) -> float: ...  # noqa: D102
    @property
    def steps(self) -> int: ...  # noqa: D102
    @property
    def substeps(self) -> int: ...  # noqa: D102
    @property
    def observed(self) -> str: ...  # noqa: D102
    @property
    def paper_weights(self) -> np.ndarray: ...  # noqa: D102

    @property
    def share(self) -> float: ...  # noqa: D102
    @property
    def pool(self) -> int: ...  # noqa: D102
    @property
    def speed_noise(self) -> float | None: ...  # noqa: D102

    def torque(self, robot: Robot) -> np.ndarray:
        """Return (n,) Nm, the most that a target asks for."""
        ...

    def believing(self, robot: Robot, dynamics: Dynamics) -> "Task":
        """Return the task, told what the arm is believed to be: for targets that a model has a part in."""
        ...

    def starts(self, robot: Robot, rng: np.random.Generator, count: int) -> np.ndarray:
        """Return (count, n) rad, where episodes start at rest."""
        ...

    def goals(self, robot: Robot, rng: np.random.Generator, count: int) -> np.ndarray:
        """Return (count, ...), what is asked in that many episodes: a point, or a path with its times."""
        ...

    def begin(self, starts: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return (m, n) rad, where the episodes with these goals start, of what `starts` said."""
        ...

    def places(self, goals: np.ndarray) -> np.ndarray:
        """Return what is asked, to look at: points (m, 3) m, or (m, steps, 3) where the hand belongs after a step."""
        ...

    def observation_scale(self, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and standard deviation (d,) to normalise observations by."""
        ...

    def observe(self, state: State, goals: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Return the observations (m, d) float32; `torque` as of `Task.torque`."""
        ...

    def target(self, action: np.ndarray, state: State, goals: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Return (m, n) Nm, what actions (m, n) in [-1, 1] ask for at this state; `torque` as of `Task.torque`."""
        ...

    def reference(self, state: State, goals: np.ndarray) -> np.ndarray:
        """Return (m,) m, what the distances of the episodes that begin at `state` are measured by."""
        ...

    def judge(
        self, state: State, ddq: np.ndarray, goals: np.ndarray, reference: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the distance (m,) m from what is asked, and the reward terms (m, k).

        Args:
            state: after a step. ddq: (m, n) rad/s^2, mean over that control period.
            goals: (m, ...). reference: (m,), see there.
        """
        ...

    def measures(self, episodes: Episodes) -> dict[str, float]:
        """Return one row of evaluations.csv."""
        ...

    def score(self, row: Mapping[str, float]) -> float:
        """Return what makes one row of `measures` better than another."""
        ...


def observed(task: Task, state: State, goals: np.ndarray, torque: np.ndarray) -> np.ndarray:
    """Return what a policy is shown (m, d) float32: the task's observations, and then what is told of the arm."""
    own = task.observe(state.seen(), goals, torque)
    return own if state.told is None else np.concatenate([own, state.told], axis=1, dtype=np.float32)


class Usual:
    """What most tasks have in common: an action is a share of the torque, and a goal is what there is to look at."""

    ctrl_hz: int
    episode_s: float
    share = 1.0
    pool = 2048
    speed_noise: float | None = None

    @property
    def steps(self) -> int:
        """Control steps of an episode."""
        return round(self.episode_s * self.ctrl_hz)

    @property
    def substeps(self) -> int:
        """Physics steps of a control step."""
        return round(1.0 / (self.ctrl_hz * SIM_DT))

    def believing(self, robot: Robot, dynamics: Dynamics) -> "Usual":
        """Return the task: it has no use for a model."""
        return self

    def begin(self, starts: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return the starts: they do not depend on the goals."""
        return starts

    def places(self, goals: np.ndarray) -> np.ndarray:
        """Return the goals."""
        return goals

    def target(self, action: np.ndarray, state: State, goals: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Return (m, n) Nm, action x torque."""
        return action * torque

    def score(self, row: Mapping[str, float]) -> float:
        """Return what makes one evaluation better than another.

        1 % more within 1 cm, or at rest, is worth 1 of the return; 1 % more cycles that the driver's law limits cost
        10 of it, from OFTEN on.
        """
        return 100 * (row["success_1cm"] + row["rest"]) + row["return_paper"] - 1e3 * max(row["limited"] - OFTEN, 0.0)
