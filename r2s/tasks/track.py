"""Follow a timed path with the hand: which paths, what a policy observes and changes, and what a step is worth."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import mujoco
import numpy as np
from scipy.signal import savgol_filter

from r2s.compiled import njit
from r2s.errors import UserError, check_number, choices, nearest
from r2s.excitation.safety import Space
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import SIM_DT, Robot
from r2s.tasks.model_torque import ModelTorque
from r2s.tasks.reach import OBSERVED, ReachTask, layout, observe
from r2s.tasks.rewards import PAPER
from r2s.tasks.task import Entry, Episodes, State, Usual
from r2s.tasks.timed_path import KINDS, Curve, Paths, V, X, curve, later

BASES = ("model", "none")
FAR_M, NEAR_M, FINE_M = 0.03, 0.01, 0.003  # lengths of the reward
CALM, PUSH = 1.0, 10.0  # rad/s, rad/s^2, of its smoothness: scales of what is not the plan's
NEAR_RAD = 0.02  # scale of what a joint is off its plan
SEEN = 12  # postures of a path that are looked at for contacts
TRIES = 60  # draws for each path, on average
JERK_S = 0.1  # whose places tell a jerk: a cubic through them
LATE = 0.007  # s, of torque and measurement on an arm that nobody has identified: delay, lag and a filter
CALMED = 0.6  # of a loop that is late by T: its rate x T, which leaves 56 deg of phase; pi / 2 swings for ever


@dataclass(frozen=True)
class TrackTask(Usual):
    """Follow a path on time; a `Task` (r2s/tasks/task.py) from conf/task/track.yaml.

    A goal is a plan (steps + 1 + preview, 6 + 3 n) of r2s/tasks/timed_path.py, a row for each control step.

    Attributes:
        ctrl_hz: policy rate, 50 to 200. episode_s: length of a path, s. ramp_s: of its beginning and of its end.
        torque_fraction, boost: a target asks for at most boost x torque_fraction of tau_max.
        cutoff_hz: low-pass on the torque.
        base: what an action is added to. "model": computed torque with the model that the task is told (`believing`);
            "none": nothing.
        residual: share of that torque which an action of 1 adds to base=model; of base=none it is 1.
        bandwidth: rad/s, of the feedback in the base; None: what `stiffness` says.
        preview: samples of the path ahead in an observation.
        speed: (low, high) m/s, at the path's fastest, drawn; slower where the arm's limits want it.
        size: (low, high) m, of paths, about their middle. kinds: of KINDS, as often each.
        reach, height, azimuth: where paths lie, as of `ReachTask`.
        pool: how many paths a training draws from.
        model: what the base is computed with; none: of the robot's own links, without friction.
    """

    ctrl_hz: int = 100
    episode_s: float = 4.0
    ramp_s: float = 0.6
    torque_fraction: float | tuple[float, ...] = 0.12
    boost: float = 2.5
    cutoff_hz: float = 100.0
    base: str = "model"
    residual: float = 0.1
    bandwidth: float | None = None
    preview: int = 3
    speed: tuple[float, float] = (0.1, 1.0)
    size: tuple[float, float] = (0.08, 0.25)
    kinds: tuple[str, ...] = KINDS
    reach: tuple[float, float] | None = (0.3, 0.75)
    height: float = 0.2
    azimuth: float = 1.57
    pool: int = 256
    model: ModelTorque | None = field(default=None, repr=False)

    def __post_init__(self):
        cycles = round(1 / SIM_DT)
        if not isinstance(self.ctrl_hz, int) or not 50 <= self.ctrl_hz <= 200 or cycles % self.ctrl_hz:
            raise UserError(f"task.ctrl_hz: {self.ctrl_hz!r} is not allowed; 50, 100, 125 and 200 are")
        check_number("task.ramp_s", self.ramp_s, "(0, inf)")
        check_number("task.episode_s", self.episode_s, f"[{2 * self.ramp_s:g}, 60]")  # plans are kept whole
        check_number("task.boost", self.boost, "(0, inf)")
        check_number("task.cutoff_hz", self.cutoff_hz, "(0, inf)")
        check_number("task.residual", self.residual, "(0, 1]")
        check_number("task.pool", self.pool, "[1, inf)", whole=True)
        check_number("task.preview", self.preview, "[1, inf)", whole=True)
        if self.bandwidth is not None:
            check_number("task.bandwidth", self.bandwidth, "(0, inf)")
        if self.preview > self.steps:
            raise UserError(
                f"task.preview: {self.preview} samples are longer than the path, which has {self.steps} at "
                f"{self.ctrl_hz} Hz; at most that many are allowed"
            )
        if self.base not in BASES:
            raise UserError(f"task.base: '{self.base}'; allowed: {choices(BASES)}{nearest(self.base, BASES)}")
        for name, pair in (("speed", self.speed), ("size", self.size)):
            numbers = isinstance(pair, tuple) and len(pair) == 2 and all(isinstance(x, int | float) for x in pair)
            if not numbers or not 0 < pair[0] <= pair[1]:
                raise UserError(f"task.{name}: {pair} is not allowed; two numbers above 0 are, the lesser first")
        for kind in self.kinds or ("",):
            if kind not in KINDS:
                raise UserError(f"task.kinds: '{kind}'; allowed: {choices(KINDS)}{nearest(str(kind), KINDS)}")
        replace(self._region)  # says what is wrong with it

    @property
    def _region(self) -> ReachTask:
        return ReachTask(self.ctrl_hz, self.episode_s, reach=self.reach, height=self.height, azimuth=self.azimuth)

    @property
    def share(self) -> float:  # type: ignore[override]
        """Of `torque`, what an action of 1 changes a target by."""
        return self.residual if self.base == "model" else 1.0

    @property
    def observed(self) -> str:
        """What is in an observation."""
        own = (
            f"{OBSERVED} {self.preview} x ahead - ee velocity tanh(error/{FINE_M:g}) limited plan q - q plan dq - dq"
        )
        return f"{own}{' base' if self.base == 'model' else ''}; rad, rad/s, m, m/s"

    @property
    def paper_weights(self) -> np.ndarray:
        """(5,), of what is reported: error and smoothness."""
        return PAPER

    def region(self, robot: Robot) -> tuple[float, float]:
        """Return (low, high) m, how far from the shoulder paths lie."""
        return self._region.region(robot)

    def torque(self, robot: Robot) -> np.ndarray:
        """(n,) Nm, the most that a target asks for."""
        fraction = ReachTask(torque_fraction=self.torque_fraction).torque(robot)
        return np.minimum(self.boost * fraction, robot.tau_max)

    def believing(self, robot: Robot, dynamics: Dynamics) -> "TrackTask":
        """Return the task whose base is computed with these dynamics, of one arm."""
        return replace(self, model=ModelTorque(robot, dynamics)) if self.base == "model" else self

    def starts(self, robot: Robot, rng: np.random.Generator, count: int) -> np.ndarray:
        """Return (count, n) rad, home: `begin` knows better."""
        return np.tile(robot.q_home, (count, 1))

    def begin(self, starts: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return (m, n) rad, where the paths start."""
        return goals[:, 0, 6 : 6 + starts.shape[1]]

    def places(self, goals: np.ndarray) -> np.ndarray:
        """Return (m, steps, 3) m, where the hand is to be after each step."""
        return goals[:, 1 : self.steps + 1, X]

    def goals(self, robot: Robot, rng: np.random.Generator, count: int) -> np.ndarray:
        """Return plans (count, steps + 1 + preview, 6 + 3 n) of random paths, each of which the arm can follow.

        Raises:
            UserError: hardly any path is within the arm's reach, its limits, and clear of itself.
        """
        paths = self._paths(robot)
        space, inside = Space(robot, table=-np.inf, z_min=self.height), _Inside(robot, self._region)
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
            q = plan[:: max(1, len(plan) // SEEN), 6 : 6 + robot.n]
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
        """Return the plan (steps + 1 + preview, 6 + 3 n) of a curve of one's own.

        Contacts, and whether it is of the training's family, are not looked at.

        Args:
            robot: the arm. start: (3,) m, where the hand begins. shape: how far from there it is, (T, 3) m, at u (T,)
                m along the curve. pace: m/s of u; slower, where the arm's limits want it.

        Raises:
            UserError: the arm cannot follow it.
        """
        plan = self._paths(robot).plan(np.array(start, dtype=float), shape, pace, self._times)
        if plan is None:
            raise UserError(
                f"plan: {robot.name} cannot follow this curve from {list(start)} m; a nearer one is allowed"
            )
        return plan

    @property
    def _times(self) -> np.ndarray:
        """(T,) s, of the rows of a plan."""
        return np.arange(self.steps + 1 + self.preview) / self.ctrl_hz

    def _paths(self, robot: Robot) -> Paths:
        return Paths(robot, self.torque(robot), self.episode_s, self.ramp_s)

    def observation_scale(self, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and standard deviation to normalise `observe` by: the task's own scales."""
        n = robot.n
        centre, scale = self._region.observation_scale(robot)
        based = n if self.base == "model" else 0
        ahead = np.repeat(self.speed[1] * np.arange(1, self.preview + 1) / self.ctrl_hz, 3)
        widths = (3, 0.3), (3, 1.0), (1, 0.3), (n, NEAR_RAD), (n, 0.2), (based, 0.3)
        more = np.concatenate([ahead, *(np.full(wide, x) for wide, x in widths)])
        scale = scale.copy()
        scale[2 * n + 6 : 2 * n + 9] = FAR_M  # the error
        scale[3 * n + 12 : 4 * n + 12] = FAR_M  # J'error
        return np.concatenate([centre, np.zeros(len(more))]), np.concatenate([scale, more])

    def observe(self, state: State, goals: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Return the observations float32 of plans `goals`; `observed` says what is in them."""
        n = state.q.shape[1]
        rows, k = np.arange(len(goals)), self._at(state.t)
        now = goals[rows, k]
        place = np.ascontiguousarray(now[:, X])
        first = observe(state.q, state.dq, state.ee, place, state.jacobian, state.effort, torque)
        ahead = goals[rows[:, None], k[:, None] + np.arange(1, self.preview + 1), X] - state.ee[:, None]
        own = [ahead.reshape(len(goals), -1), now[:, V], np.tanh((now[:, X] - state.ee) / FINE_M)]
        own += [state.limited[:, None], now[:, 6 : 6 + n] - state.q, now[:, 6 + n : 6 + 2 * n] - state.dq]
        if self.base == "model":
            own.append(self.computed(state, goals) / torque)
        return np.concatenate([first, *own], axis=1, dtype=np.float32)

    def layout(self, robot: Robot) -> list[Entry]:
        """Return what `observe` puts where, in its order."""
        torque = self.torque(robot)
        own = [
            Entry(f"the next {self.preview} places - ee", "m", "ahead"),
            Entry("velocity of the path", "m/s", "velocity"),
            Entry(f"tanh(error / {FINE_M:g} m)", "1", "error", divided_by=FINE_M, tanh=True),
            Entry("limited", "1", "limited"),
            Entry("plan q - q", "rad", "q_off"),
            Entry("plan dq - dq", "rad/s", "dq_off"),
        ]
        based = [Entry("base / torque", "1", "base", divided_by=tuple(torque.tolist()))]
        return [*layout(torque), *own, *(based if self.base == "model" else [])]

    def target(self, action: np.ndarray, state: State, goals: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Return (m, n) Nm: action x share x torque, beside the base."""
        own = self.share * action * torque
        return own + self.computed(state, goals) if self.base == "model" else own

    def late(self, dynamics: Dynamics) -> float:
        """Return s, by which a command acts late: half a control period, the low-pass, what the model believes."""
        return 0.5 / self.ctrl_hz + 1 / (2 * np.pi * self.cutoff_hz) + float(dynamics.delay) + float(dynamics.lag)

    def stiffness(self) -> float:
        """Return rad/s, the bandwidth of the base's feedback, critically damped: CALMED / (2 x how late the loop is).

        The loop is late by a whole control period, the low-pass, and LATE. Damping 2 w is its rate.
        """
        if self.bandwidth is not None:
            return self.bandwidth
        return 0.5 * CALMED / (1.0 / self.ctrl_hz + 1 / (2 * np.pi * self.cutoff_hz) + LATE)

    def computed(self, state: State, goals: np.ndarray) -> np.ndarray:
        """Return (m, n) Nm, computed torque with the model: what the plan needs when the torque acts, and feedback.

        The feedback compares the plan of now with the state of now, and is weighed with the model's inertia.
        """
        n, rows = state.q.shape[1], np.arange(len(goals))
        model = self.model
        assert model is not None, "a task with a base is told a model first"
        late, w = self.late(model.dynamics), self.stiffness()
        k = self._at(state.t)
        now = goals[rows, k]
        back = w**2 * (now[:, 6 : 6 + n] - state.q) + 2 * w * (now[:, 6 + n : 6 + 2 * n] - state.dq)
        q, dq, ddq = later(goals, k, late, self.ctrl_hz, n)
        return model(q, dq, ddq + back, dq)

    def reference(self, state: State, goals: np.ndarray) -> np.ndarray:
        """Return (m,) ones: distances are m."""
        return np.ones(len(goals))

    def judge(
        self, state: State, ddq: np.ndarray, goals: np.ndarray, reference: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return how far the hand is off its path (m,) m, and the reward terms (m, 5); see `_judge`."""
        n, rows = state.q.shape[1], np.arange(len(goals))
        k = self._at(state.t)
        now, before = goals[rows, k], goals[rows, np.maximum(k - 1, 0)]
        speed = now[:, 6 + n : 6 + 2 * n]
        push = ddq - (speed - before[:, 6 + n : 6 + 2 * n]) * self.ctrl_hz
        return _judge(now[:, X] - state.ee, state.dq - speed, push, state.limited)

    def measures(self, episodes: Episodes) -> dict[str, float]:
        """Return one row of evaluations.csv.

        path_rmse_mm: of the hand's distance from where it is to be, over all steps of all paths that were not
        stopped. path_max_mm: the largest of a path, mean over them. within_x: share of the steps, of which those of
        stopped paths count as outside. return_track: mean sum of the reward under `paper_weights`. torque_rms_Nm:
        over joints and time. jerk: m/s^3, RMS of the hand's, by a cubic through JERK_S. stopped: share of the paths.
        q_left_rad, limited: as of reaching.
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
            "q_left_rad": float(np.quantile(episodes.q_left, 0.05)),
            "limited": float(episodes.limited.mean()),
        }

    def score(self, row: Mapping[str, float]) -> float:
        """Return minus the RMSE, mm; a path that was stopped costs as much as 1 mm of it for each percent."""
        return -(row["path_rmse_mm"] if np.isfinite(row["path_rmse_mm"]) else 1e3) - 100 * row["stopped"]

    def _at(self, t: np.ndarray) -> np.ndarray:
        """Return (m,), the rows of plans at t (m,) s."""
        return np.minimum(np.rint(t * self.ctrl_hz).astype(np.int64), self.steps)


class _Inside:
    """Whether points (T, 3) m are all in the task's region."""

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
def _judge(error, dq, push, limited):
    """Return the distance (m,) m and the terms (m, 5).

    error       -2 tanh(distance / 3 cm)
    smoothness  -0.03 sum tanh(|dq| / 1 rad/s) - 0.03 sum tanh(|push| / 10 rad/s^2)
    precision   1 - tanh(distance / 1 cm) / 2 - tanh(distance / 3 mm) / 2
    stillness   0: the path says where to rest
    limited     -limited

    Args:
        error: (m, 3) m. dq, push: (m, n) rad/s, rad/s^2, what speed and acceleration have that the plan has not.
        limited: (m,), as of `State`.
    """
    m = len(error)
    distance, out = np.empty(m), np.empty((m, 5))
    for i in range(m):
        d = np.sqrt(error[i, 0] ** 2 + error[i, 1] ** 2 + error[i, 2] ** 2)
        rough = 0.0
        for j in range(dq.shape[1]):
            rough += np.tanh(abs(dq[i, j]) / CALM) + np.tanh(abs(push[i, j]) / PUSH)
        distance[i] = d
        out[i, 0] = -2.0 * np.tanh(d / FAR_M)
        out[i, 1] = -0.03 * rough
        out[i, 2] = 1.0 - 0.5 * (np.tanh(d / NEAR_M) + np.tanh(d / FINE_M))
        out[i, 3] = 0.0
        out[i, 4] = -limited[i]
    return distance, out
