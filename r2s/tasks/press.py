"""`task=press`: touch a surface of roughly known position, hold a requested force, and follow a step of the force."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from r2s.errors import check_number
from r2s.physics.dynamics import Dynamics
from r2s.physics.impedance import FIRST_DQ
from r2s.physics.robot import Robot
from r2s.physics.tip import Tip
from r2s.tasks.measures import MeasureTable
from r2s.tasks.press_measures import PRESS, WINDOW_S, press_measures
from r2s.tasks.surface_task import FAR_N, FINE_N, HARD_N, NORMAL, SurfaceTask, near, rough
from r2s.tasks.task import Episodes, State

LEAST_STEP = 0.2  # smallest force step / width of the range `force`
REVERSAL_S = 0.2  # s, time in which the friction feedforward reverses after a decrease of the force


@dataclass(frozen=True)
class PressTask(SurfaceTask):
    """Press on a surface; a `Task` (r2s/tasks/task.py) from conf/task/press.yaml.

    A goal is a row as in `SurfaceTask`; its two forces are the requested forces before and after the force step.

    Attributes:
        step_s: s, time of the force step. Other attributes: see `SurfaceTask`.
        creep: m/s, tip speed along the normal when the fastest joint moves at FIRST_DQ (r2s/physics/impedance.py).
    """

    step_s: float = 3.5
    creep: float = 0.0
    measure_table: ClassVar[MeasureTable] = PRESS
    reward_terms = "force", "precision", "excess", "smoothness", "filter_penalty"
    observation_summary = (
        "q dq tip tanh(height/5 mm) tip_velocity tanh(rate/0.01) force/20 tanh(force_error/10) ahead/5mm effort "
        "limited; rad, rad/s, m, m/s, N"
    )

    def __post_init__(self):
        super().__post_init__()
        check_number("task.step_s", self.step_s, f"[{WINDOW_S:g}, inf)")
        check_number("task.episode_s", self.episode_s, f"[{self.step_s + WINDOW_S:g}, 60]")

    def with_model(self, robot: Robot, dynamics: Dynamics) -> Self:
        """Return the task with the model `dynamics` of one arm, and with `creep`; see `SurfaceTask.with_model`."""
        task = super().with_model(robot, dynamics)
        jacobian, mobility = Tip(robot)(robot.q_home)[1], np.linalg.inv(task.model.mass(robot.q_home[None])[0])  # type: ignore[union-attr]
        moves = np.linalg.solve(jacobian @ mobility @ jacobian.T, jacobian @ mobility).T @ self.plane(robot)[1]
        return replace(task, creep=FIRST_DQ / float(np.abs(moves).max()))

    def path(self, rng: np.random.Generator, axes: np.ndarray) -> np.ndarray:
        """Return one point (1, 3) m, uniformly distributed in a disc of radius `spread` on the nominal plane."""
        about, away = rng.uniform(0, 2 * np.pi), self.spread * np.sqrt(rng.uniform())
        return away * np.array([[np.cos(about), np.sin(about)]]) @ axes

    def forces_of(self, rng: np.random.Generator) -> tuple[float, float]:
        """Return two forces ~ U(force), N, that differ by at least LEAST_STEP times the width of `force`."""
        low, high = self.force
        first = rng.uniform(low, high)
        second = first
        while abs(second - first) < LEAST_STEP * (high - low):
            second = rng.uniform(low, high)
        return first, second

    def goal_positions(self, goals: np.ndarray) -> np.ndarray:
        """Return (m, 3) m, the points of the nominal plane that the tip should touch."""
        return self.at(np.zeros(len(goals)), goals)

    def contact(self, t: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return (m, 4), normal and force, N, for hybrid control at t (m,) s; the force changes at `force_rate`."""
        first, second = goals[:, 6], goals[:, 7]
        moved = (self.force_rate * (t - self.step_s)).clip(0.0)
        force = first + np.sign(second - first) * np.minimum(moved, np.abs(second - first))
        return np.concatenate([goals[:, NORMAL], force[:, None]], axis=1)

    def target(self, t: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return the target (m, 6) of impedance control: position (m, 3) m, then velocity (m, 3) m/s.

        The target position moves against the normal, through the nominal plane. At the end of this motion, the spring
        of the impedance would exert the larger of the two forces even on the lowest allowed surface. The target
        velocity only sets the direction of the friction feedforward. The target velocity points along the normal
        after a decrease of the force, otherwise against the normal.
        """
        share = np.where(goals[:, 7] < goals[:, 6], ((t - self.step_s) / REVERSAL_S).clip(0.0, 1.0), 0.0)
        place = self.at(t, goals) - self.depth(t, goals)[:, None] * goals[:, NORMAL]
        return np.concatenate([place, (self.creep * (2.0 * share - 1.0))[:, None] * goals[:, NORMAL]], axis=1)

    def forces(self, state: State, goals: np.ndarray) -> np.ndarray:
        """Return (m, 2) N, the force against the nominal normal, and the requested force, which jumps at `step_s`."""
        before = state.t < self.step_s + 0.5 / self.ctrl_hz
        return self.pressed(state, goals, np.where(before, goals[:, 6], goals[:, 7]))

    def judge(
        self, state: State, ddq: np.ndarray, goals: np.ndarray, scale: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the force error (m,) N, and the reward terms (m, 5).

        Terms: force = -tanh(error / 5 N); precision = `near`(error, 5 N, 0.5 N); excess = -tanh(excess force / 10 N);
        smoothness = -0.03 sum tanh(|ddq| / 10 rad/s^2); filter_penalty = -`State.limited`.
        """
        beyond = -np.diff(self.forces(state, goals))[:, 0]
        error, excess = np.abs(beyond), np.tanh(beyond.clip(0.0) / HARD_N)
        terms = [-np.tanh(error / FAR_N), near(error, FAR_N, FINE_N), -excess, -rough(ddq), -state.limited]
        return error, np.stack(terms, axis=1)

    def measures(self, episodes: Episodes) -> dict[str, float]:
        """Return one row of evaluations.csv; see `press_measures`."""
        return press_measures(episodes, round(self.step_s * self.ctrl_hz), self.ctrl_hz)

    def score(self, row: Mapping[str, float]) -> float:
        """Return 10 success - force RMSE in N - 100 stopped; `success` and `stopped` are shares of the episodes."""
        rmse = row["force_rmse_N"] if np.isfinite(row["force_rmse_N"]) else 1e3
        return 10 * row["success"] - rmse - 100 * row["stopped"]
