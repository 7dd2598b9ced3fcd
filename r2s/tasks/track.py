"""`task=track`: follow a timed path with the end effector; paths, observations and reward terms."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import mujoco
import numpy as np
from scipy.signal import savgol_filter

from r2s.compiled import njit
from r2s.control.computed_torque import computed_torque
from r2s.control.controller import Controller
from r2s.errors import UserError, check_number, instead_of
from r2s.excitation.motion_checks import Space
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import SIM_DT, Robot
from r2s.tasks.measures import Measure, MeasureTable
from r2s.tasks.reach import OBSERVED, ReachTask, observation_terms, observe
from r2s.tasks.rewards import PAPER
from r2s.tasks.task import BaseTask, Episodes, ObservationTerm, State
from r2s.tasks.trajectory import KINDS, Curve, Paths, V, X, at_time, curve

FAR_M, NEAR_M, FINE_M = 0.03, 0.01, 0.003  # m, tanh scales of the reward
SPEED, ACCELERATION = 1.0, 10.0  # rad/s, rad/s^2, tanh scales of deviations from the plan
NEAR_RAD = 0.02  # rad, scale of observed joint errors
CHECKED = 12  # approximate number of postures per path that r2s checks for contacts
TRIES = 60  # largest mean number of attempts per path
JERK_S = 0.1  # s, window of the fitted cubic whose third derivative is the jerk

TRACK = MeasureTable(
    measures=(
        Measure("path_rmse_mm", "RMSE", "RMSE of the path", "mm", 1, 2, lower_is_better=True, root_mean_square=True),
        Measure("path_max_mm", "largest", "largest error of a path", "mm", 1, 1, lower_is_better=True),
        Measure("within_2mm", "2 mm", "time within 2 mm", "%", 100, 0),
        Measure("within_5mm", "5 mm", "time within 5 mm", "%", 100, 0),
        Measure("within_10mm", "10 mm", "time within 10 mm", "%", 100, 0),
        Measure("torque_rms_Nm", "torque", "RMS torque", "Nm", 1, 2, lower_is_better=True),
        Measure("jerk", "jerk", "RMS jerk of the end effector", "m/s^3", 1, 0, lower_is_better=True),
        Measure("return_track", "return", "return"),
        Measure("stopped", "stopped", "paths that were stopped", "%", 100, 0, lower_is_better=True),
    ),
    selection=("within_5mm", "path_rmse_mm"),
    rows=("path_rmse_mm", "path_max_mm", "within_2mm", "within_5mm", "within_10mm", "torque_rms_Nm", "jerk"),
    comparison=("path_rmse_mm", "path_max_mm", "within_2mm", "within_5mm", "return_track"),
    curves=("path_rmse_mm", "path_max_mm", "within_5mm", "return_track"),
    scores=("path_rmse_mm", "path_max_mm", "within_5mm", "return_track"),
    transfer=("path_rmse_mm", "within_5mm"),
    corner="time within",
    description="It follows timed paths with the end effector; the error is the distance to the current path point.",
    error=Measure("distance", "error", "error of the path", "mm", 1e3, lower_is_better=True),
    error_levels=(10.0, 5.0, 2.0),
)


@dataclass(frozen=True)
class TrackTask(BaseTask):
    """Follow a path on time; a `Task` (r2s/tasks/task.py) from conf/task/track.yaml.

    A goal is a plan (steps + 1 + preview, 6 + 3 n) from `Paths.plan`, with one row per control step.

    Attributes:
        ctrl_hz: Hz, policy rate, 50 to 200. episode_s: s, duration of a path.
        ramp_s: s, duration of the acceleration at the start and of the deceleration at the end of a path.
        torque_fraction, boost: the largest target torque is boost x torque_fraction x tau_max, at most tau_max.
        cutoff_hz: cut-off frequency of the low-pass on the torque.
        preview: number of future path positions in an observation.
        speed: (low, high) m/s, range of random peak speeds; the arm's limits can require a slower path.
        size: (low, high) m, range of random path radii. kinds: curves, a subset of KINDS, equally probable.
        reach, height, azimuth: region that contains the paths, see `ReachTask`.
        pool: number of different paths in a training.
        model: dynamics of the arm for the default controller, set by `with_model`.
    """

    ctrl_hz: int = 100
    episode_s: float = 4.0
    ramp_s: float = 0.6
    torque_fraction: float | tuple[float, ...] = 0.12
    boost: float = 2.5
    cutoff_hz: float = 100.0
    preview: int = 3
    speed: tuple[float, float] = (0.1, 1.0)
    size: tuple[float, float] = (0.08, 0.25)
    kinds: tuple[str, ...] = KINDS
    reach: tuple[float, float] | None = (0.3, 0.75)
    height: float = 0.2
    azimuth: float = 1.57
    pool: int = 256
    model: Dynamics | None = field(default=None, repr=False)
    measure_table: ClassVar[MeasureTable] = TRACK
    target_size: ClassVar[int] = 6

    def __post_init__(self):
        cycles = round(1 / SIM_DT)
        if not isinstance(self.ctrl_hz, int) or not 50 <= self.ctrl_hz <= 200 or cycles % self.ctrl_hz:
            raise UserError(f"task.ctrl_hz: {self.ctrl_hz!r} is not allowed; 50, 100, 125 and 200 are")
        check_number("task.ramp_s", self.ramp_s, "(0, inf)")
        check_number("task.episode_s", self.episode_s, f"[{2 * self.ramp_s:g}, 60]")  # 60 s: plans need memory
        check_number("task.boost", self.boost, "(0, inf)")
        check_number("task.cutoff_hz", self.cutoff_hz, "(0, inf)")
        check_number("task.pool", self.pool, "[1, inf)", whole=True)
        check_number("task.preview", self.preview, "[1, inf)", whole=True)
        if self.preview > self.steps:
            raise UserError(
                f"task.preview: {self.preview} samples are longer than the path, which has {self.steps} at "
                f"{self.ctrl_hz} Hz; at most that many are allowed"
            )
        for name, pair in (("speed", self.speed), ("size", self.size)):
            numbers = isinstance(pair, tuple) and len(pair) == 2 and all(isinstance(x, int | float) for x in pair)
            if not numbers or not 0 < pair[0] <= pair[1]:
                raise UserError(f"task.{name}: {pair} is not allowed; two numbers above 0 are, the lesser first")
        for kind in self.kinds or ("",):
            if kind not in KINDS:
                raise UserError(f"task.kinds: '{kind}'; {instead_of(kind, KINDS)}")
        replace(self._region)  # raises UserError if the region or the torque is invalid

    @property
    def _region(self) -> ReachTask:
        place = {"reach": self.reach, "height": self.height, "azimuth": self.azimuth}
        return ReachTask(self.ctrl_hz, self.episode_s, self.torque_fraction, **place)  # type: ignore[arg-type]

    @property
    def observation_summary(self) -> str:
        """Text that lists the terms and units of an observation."""
        own = (
            f"{OBSERVED} {self.preview} x ahead - ee velocity tanh(error/{FINE_M:g}) limited plan q - q plan dq - dq"
        )
        return f"{own}; rad, rad/s, m, m/s"

    @property
    def paper_weights(self) -> np.ndarray:
        """Weights (5,) of the reward terms: 1 for distance and smoothness, 0 for other terms."""
        return PAPER

    def region(self, robot: Robot) -> tuple[float, float]:
        """Return (low, high) m, range of the distance between paths and shoulder."""
        return self._region.region(robot)

    def torque_limit(self, robot: Robot) -> np.ndarray:
        """Return (n,) Nm, the largest target torque."""
        if self.controller is not None and self.controller.torque_limit is not None:
            return self.controller.torque_limit
        fraction = ReachTask(torque_fraction=self.torque_fraction).torque_limit(robot)
        return np.minimum(self.boost * fraction, robot.tau_max)

    def with_model(self, robot: Robot, dynamics: Dynamics) -> "TrackTask":
        """Return the task with one arm's model, for the default controller."""
        return replace(self, model=dynamics)

    def control(self, robot: Robot) -> Controller:
        """Return the controller: by default `control=computed_torque`, or without a model `control=torque`."""
        if self.controller is None and self.model is not None:
            return computed_torque(robot, self, self.model)
        return super().control(robot)

    def starts(self, robot: Robot, rng: np.random.Generator, count: int) -> np.ndarray:
        """Return home postures (count, n) rad; `begin` returns the first postures of the paths instead."""
        return np.tile(robot.q_home, (count, 1))

    def begin(self, starts: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return (m, n) rad, the first postures of the paths."""
        return goals[:, 0, 6 : 6 + starts.shape[1]]

    def goal_positions(self, goals: np.ndarray) -> np.ndarray:
        """Return (m, steps, 3) m, the reference position after each step."""
        return goals[:, 1 : self.steps + 1, X]

    def goals(self, robot: Robot, rng: np.random.Generator, count: int) -> np.ndarray:
        """Return plans (count, steps + 1 + preview, 6 + 3 n) of random paths that the arm can follow.

        Raises:
            UserError: hardly any random path is reachable, within the arm's limits and free of collisions.
        """
        paths = self._paths(robot)
        space, inside = Space(robot, table=-np.inf, z_min=self.height, deviation=0.0), _Inside(robot, self._region)
        found: list[np.ndarray] = []
        middles = self._region.goals(robot, rng, 4 * count)
        for tried in range(TRIES * count + TRIES):
            if tried and tried % len(middles) == 0:
                middles = self._region.goals(robot, rng, len(middles))
            size, speed = rng.uniform(*self.size), rng.uniform(*self.speed)
            shape = curve(self.kinds[rng.integers(len(self.kinds))], rng, size)
            plan = paths.plan(middles[tried % len(middles)], shape, speed, self._times)
            if plan is None or not inside(plan[:, X]):
                continue
            q = plan[:: max(1, len(plan) // CHECKED), 6 : 6 + robot.n]
            way = robot.q_home + np.linspace(0, 1, 5)[:, None] * (q[0] - robot.q_home)
            if (space.gaps(np.concatenate([way, q])) < 0).any():
                continue
            found.append(plan)
            if len(found) == count:
                return np.array(found)
            if tried > 4 * TRIES and not found:
                break
        low, high = inside.region
        raise UserError(
            f"task.size: paths of {self.size[0]:g} to {self.size[1]:g} m are out of the reach of {robot.name}, "
            f"task.reach {low:g} to {high:g} m, task.height {self.height:g} m; smaller ones or a wider region are "
            "allowed"
        )

    def plan(self, robot: Robot, start: Sequence[float], shape: Curve, pace: float) -> np.ndarray:
        """Return the plan (steps + 1 + preview, 6 + 3 n) of a custom curve.

        This method checks neither contacts nor whether the curve resembles the training paths.

        Args:
            robot: the arm. start: (3,) m, first end-effector position. shape: function from the path parameter u (T,)
                m to the offset (T, 3) m from `start`. pace: m/s, peak du/dt; r2s reduces an infeasible pace.

        Raises:
            UserError: the arm cannot follow the curve.
        """
        plan = self._paths(robot).plan(np.array(start, dtype=float), shape, pace, self._times)
        if plan is None:
            raise UserError(f"plan: {robot.name} cannot follow this curve from {list(start)} m; choose a nearer one")
        return plan

    @property
    def _times(self) -> np.ndarray:
        """(T,) s, the time of each row of a plan."""
        return np.arange(self.steps + 1 + self.preview) / self.ctrl_hz

    def _paths(self, robot: Robot) -> Paths:
        return Paths(robot, self.torque_limit(robot), self.episode_s, self.ramp_s)

    def observation_scale(self, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
        """Return fixed mean and standard deviation (d,) that normalize observations."""
        n = robot.n
        centre, scale = self._region.observation_scale(robot)
        ahead = np.repeat(self.speed[1] * np.arange(1, self.preview + 1) / self.ctrl_hz, 3)
        widths = (3, 0.3), (3, 1.0), (1, 0.3), (n, NEAR_RAD), (n, 0.2)
        more = np.concatenate([ahead, *(np.full(wide, x) for wide, x in widths)])
        scale = scale.copy()
        scale[2 * n + 6 : 2 * n + 9] = FAR_M  # the error
        scale[3 * n + 12 : 4 * n + 12] = FAR_M  # J^T error
        return np.concatenate([centre, np.zeros(len(more))]), np.concatenate([scale, more])

    def observe(self, state: State, goals: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Return the observations (m, d) float32, where `goals` are plans; see `observation_terms`."""
        n = state.q.shape[1]
        rows, k = np.arange(len(goals)), self._at(state.t)
        now = goals[rows, k]
        place = np.ascontiguousarray(now[:, X])
        first = observe(state.q, state.dq, state.ee, place, state.jacobian, state.effort, torque)
        ahead = goals[rows[:, None], k[:, None] + np.arange(1, self.preview + 1), X] - state.ee[:, None]
        own = [ahead.reshape(len(goals), -1), now[:, V], np.tanh((now[:, X] - state.ee) / FINE_M)]
        own += [state.limited[:, None], now[:, 6 : 6 + n] - state.q, now[:, 6 + n : 6 + 2 * n] - state.dq]
        return np.concatenate([first, *own], axis=1, dtype=np.float32)

    def observation_terms(self, robot: Robot) -> list[ObservationTerm]:
        """Return the terms of an observation in the order in which `observe` returns them."""
        torque = self.torque_limit(robot)
        own = [
            ObservationTerm(f"the next {self.preview} places - ee", "m", "ahead"),
            ObservationTerm("velocity of the path", "m/s", "velocity"),
            ObservationTerm(f"tanh(error / {FINE_M:g} m)", "1", "error", divided_by=FINE_M, tanh=True),
            ObservationTerm("limited", "1", "limited"),
            ObservationTerm("plan q - q", "rad", "q_off"),
            ObservationTerm("plan dq - dq", "rad/s", "dq_off"),
        ]
        return [*observation_terms(torque), *own]

    def trajectory(
        self, t: np.ndarray, goals: np.ndarray, ahead_s: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return q, dq, ddq (m, n) of the plans in `goals`, `ahead_s` seconds after the times t (m,) s."""
        return at_time(goals, self._at(t), ahead_s, self.ctrl_hz)

    def target(self, t: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return the impedance target (m, 6) at t (m,) s: planned position (m, 3) m, then velocity (m, 3) m/s."""
        now = goals[np.arange(len(goals)), self._at(t)]
        return np.concatenate([now[:, X], now[:, V]], axis=1)

    def distance_scale(self, state: State, goals: np.ndarray) -> np.ndarray:
        """Return (m,) ones, because the reward of `task=track` needs no initial distance as a scale."""
        return np.ones(len(goals))

    def judge(
        self, state: State, ddq: np.ndarray, goals: np.ndarray, scale: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the path error (m,) m, and the reward terms (m, 5) of `_judge`."""
        n, rows = state.q.shape[1], np.arange(len(goals))
        k = self._at(state.t)
        now, before = goals[rows, k], goals[rows, np.maximum(k - 1, 0)]
        speed = now[:, 6 + n : 6 + 2 * n]
        excess = ddq - (speed - before[:, 6 + n : 6 + 2 * n]) * self.ctrl_hz
        return _judge(now[:, X] - state.ee, state.dq - speed, excess, state.limited)

    def measures(self, episodes: Episodes) -> dict[str, float]:
        """Return the measures of `task=track`, one row of evaluations.csv.

        path_rmse_mm: RMS distance between end effector and reference over the steps of the paths without a stop.
        path_max_mm: largest distance on a path, mean over the paths without a stop. within_x: share of steps with a
        distance below x, where all steps of a stopped path are failures. return_track: sum of the reward over a path,
        mean over paths. torque_rms_Nm: RMS torque over joints and time. jerk: m/s^3, RMS jerk of the end effector,
        from cubic fits over JERK_S. stopped: share of stopped paths. q_left_rad, limited, collision: see
        `r2s.tasks.rollout.measures`.
        """
        ended = ~np.isfinite(episodes.distance).all(1)
        error = 1e3 * episodes.distance[~ended]
        none = not len(error)
        close = np.where(ended[:, None], np.inf, episodes.distance)
        window = max(5, round(JERK_S * self.ctrl_hz) // 2 * 2 + 1)
        jerk = np.full(1, np.nan)
        if episodes.ee.shape[1] >= window:
            jerk = savgol_filter(episodes.ee, window, 3, deriv=3, delta=1 / self.ctrl_hz, axis=1)
            jerk = np.linalg.norm(jerk[:, window // 2 : -(window // 2)], axis=-1)
        return {
            "path_rmse_mm": float("nan") if none else float(np.sqrt((error**2).mean())),
            "path_max_mm": float("nan") if none else float(error.max(1).mean()),
            "within_2mm": float((close < 0.002).mean()),
            "within_5mm": float((close < 0.005).mean()),
            "within_10mm": float((close < 0.010).mean()),
            "return_track": float(episodes.reward.sum(1).mean()),
            "torque_rms_Nm": float(np.sqrt((episodes.tau**2).mean())),
            "jerk": float(np.sqrt((jerk**2).mean())),
            "stopped": float(ended.mean()),
            "collision": float((episodes.collision != "").mean()),
            "q_left_rad": float(np.quantile(episodes.q_left, 0.05)),
            "limited": float(episodes.limited.mean()),
        }

    def score(self, row: Mapping[str, float]) -> float:
        """Return -(path_rmse_mm + 100 stopped); `stopped` is the share of the paths that a stop ended."""
        return -(row["path_rmse_mm"] if np.isfinite(row["path_rmse_mm"]) else 1e3) - 100 * row["stopped"]

    def _at(self, t: np.ndarray) -> np.ndarray:
        """Return (m,), the index of the plan row at each time t (m,) s."""
        return np.minimum(np.rint(t * self.ctrl_hz).astype(np.int64), self.steps)


class _Inside:
    """Test whether points (T, 3) m all lie in the task's region."""

    def __init__(self, robot: Robot, task: ReachTask):
        model = robot.model(gravity=False)
        data = mujoco.MjData(model)
        data.qpos = robot.q_home
        mujoco.mj_kinematics(model, data)
        self._shoulder = data.xanchor[min(1, robot.n - 1)].copy()
        self._task, self.region = task, task.region(robot)

    def __call__(self, points: np.ndarray) -> bool:
        away = np.linalg.norm(points - self._shoulder, axis=1)
        ahead = np.abs(np.arctan2(points[:, 1], points[:, 0])) <= self._task.azimuth
        low, high = self.region
        return bool(((away >= low) & (away <= high) & (points[:, 2] >= self._task.height) & ahead).all())


@njit(cache=True)
def _judge(error, dq, ddq, limited):
    """Return the distance (m,) m and the reward terms (m, 5).

    Terms, with the path error d: distance = -2 tanh(d / 3 cm);
    smoothness = -0.03 sum tanh(|dq| / 1 rad/s) - 0.03 sum tanh(|ddq| / 10 rad/s^2);
    precision = 1 - tanh(d / 1 cm) / 2 - tanh(d / 3 mm) / 2;
    stillness = 0, because the path defines where the arm rests;
    filter_penalty = -limited.

    Args:
        error: (m, 3) m, path error. dq, ddq: (m, n) rad/s, rad/s^2, deviations from the plan. limited: as in `State`.
    """
    m = len(error)
    distance, out = np.empty(m), np.empty((m, 5))
    for i in range(m):
        d = np.sqrt(error[i, 0] ** 2 + error[i, 1] ** 2 + error[i, 2] ** 2)
        rough = 0.0
        for j in range(dq.shape[1]):
            rough += np.tanh(abs(dq[i, j]) / SPEED) + np.tanh(abs(ddq[i, j]) / ACCELERATION)
        distance[i] = d
        out[i, 0] = -2.0 * np.tanh(d / FAR_M)
        out[i, 1] = -0.03 * rough
        out[i, 2] = 1.0 - 0.5 * (np.tanh(d / NEAR_M) + np.tanh(d / FINE_M))
        out[i, 3] = 0.0
        out[i, 4] = -limited[i]
    return distance, out
