"""`task=reach`: move the end effector to a point and hold it there; goals, observations and reward terms."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar

import mujoco
import numpy as np

from r2s.compiled import njit
from r2s.errors import UserError, check_number
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import SIM_DT, Robot
from r2s.tasks import rewards
from r2s.tasks.measures import Measure, MeasureTable
from r2s.tasks.rollout import measures
from r2s.tasks.task import BaseTask, Episodes, ObservationTerm, State

FINE_M = 0.02  # m, tanh scale of the observed error; small, so that this input resolves the last centimeters
FINE_RAD = 0.015  # m^2/rad, tanh scale of the observed J^T error
FINE_DQ = 0.1  # rad/s, tanh scale of observed speeds; small, so that this input resolves slow motion
OBSERVED = (  # terms of `observe`, for metadata
    f"q dq ee goal error effort tanh(error/{FINE_M:g}) J'error tanh(J'error/{FINE_RAD:g}) tanh(dq/{FINE_DQ:g})"
)
SPEED_NOISE = 0.05  # rad/s, largest speed noise in training for an identified arm; equals REST (rollout.py)
CLOSE_M = 1e-3  # m, the reward divides by the initial distance, or by CLOSE_M if larger
MIDDLE = 0.05, 0.95  # default goal region: quantiles of the end effector's distance from the shoulder
POSTURES = 500  # number of random postures from which r2s computes the quantiles MIDDLE

REACH = MeasureTable(
    measures=(
        Measure("success_5cm", "5 cm", "success at 5 cm", "%", 100, 0),
        Measure("success_2cm", "2 cm", "success at 2 cm", "%", 100, 0),
        Measure("success_1cm", "1 cm", "success at 1 cm", "%", 100, 0),
        Measure("success_5mm", "5 mm", "success at 5 mm", "%", 100, 0),
        Measure("distance_median_m", "median\ndistance", "median distance", "mm", 1e3, 1, lower_is_better=True),
        Measure("return_paper", "return", "return (eq. 2)"),
        Measure("return_smooth", "return", "return (eq. 2) without measurement noise"),
        Measure("rest", "at rest", "episodes that end at rest", "%", 100, 0),
        Measure("time_to_reach_s", "time to reach", "time to reach 2 cm", "s", 1, 2, lower_is_better=True),
        Measure("overshoot_m", "overshoot", "overshoot beyond 2 cm", "mm", 1e3, 1, lower_is_better=True),
    ),
    selection=("success_1cm", "return_paper"),
    rows=("success_5cm", "success_2cm", "success_1cm", "success_5mm", "distance_median_m", "return_smooth", "rest"),
    comparison=("success_2cm", "success_1cm", "success_5mm", "distance_median_m", "return_paper"),
    curves=("success_5cm", "success_2cm", "success_1cm", "return_paper"),
    scores=("success_1cm", "success_5mm", "distance_median_m", "return_paper"),
    transfer=("success_1cm",),
    diagnostics=(
        *("ee_path_rmse_mm", "tau_rmse_Nm", "time_to_reach_s", "overshoot_m"),
        *("limited", "q_left_rad", "collision", "stops"),
    ),
    corner="success within",
    description="It moves the end effector to a point and holds it there.",
    reward="reward, eq. (2)",
)


@dataclass(frozen=True)
class ReachTask(BaseTask):
    """Reach a point; a `Task` (r2s/tasks/task.py) from conf/task/reach.yaml.

    Attributes:
        ctrl_hz: policy rate. episode_s: length of an episode, s.
        torque_fraction: share of tau_max that an action of 1 commands: a number for all joints, or one per joint.
        cutoff_hz: cut-off frequency of the low-pass on the torque.
        start_spread: rad, largest random deviation of a joint from q_home in a start posture.
        reach: (low, high) m, range of the distance between goal and shoulder (the second joint, or the only joint).
            If None, low and high are the quantiles MIDDLE of the end effector's distance from the shoulder in random
            postures.
        height: lowest goal, m. azimuth: rad, largest horizontal angle between a goal's direction and straight ahead.
        speed_noise: rad/s, see `Task`. If None, the value is SPEED_NOISE for models with measurement noise, such as
            identified arms, and 0 for other models. A policy trained with speed noise does not react to this noise.
            Such a policy therefore does not excite oscillations of elastic gears, which rigid models lack
            (benchmarks/results/transfer.md).
    """

    ctrl_hz: int = 50
    episode_s: float = 4.0
    torque_fraction: float | tuple[float, ...] = 0.3
    cutoff_hz: float = 100.0
    start_spread: float = 0.1
    reach: tuple[float, float] | None = (0.3, 0.75)
    height: float = 0.1
    azimuth: float = 1.57
    speed_noise: float | None = None
    measure_table: ClassVar[MeasureTable] = REACH
    target_size: ClassVar[int] = 3

    def __post_init__(self):
        cycles = round(1 / SIM_DT)
        if not isinstance(self.ctrl_hz, int) or self.ctrl_hz < 1 or cycles % self.ctrl_hz:
            raise UserError(f"task.ctrl_hz: {self.ctrl_hz!r} is not allowed; what divides {cycles} is, such as 50")
        check_number("task.episode_s", self.episode_s, f"[{1 / self.ctrl_hz}, 600]")
        check_number("task.cutoff_hz", self.cutoff_hz, "(0, inf)")
        check_number("task.start_spread", self.start_spread, "[0, inf)")
        if self.speed_noise is not None:
            check_number("task.speed_noise", self.speed_noise, "[0, 1]")
        for share in np.ravel(np.array(self.torque_fraction, dtype=object)):
            check_number("task.torque_fraction", share, "[1e-6, 1]")
        self._check_region()

    def _check_region(self) -> None:
        """Raise UserError if `reach`, `height` or `azimuth` is invalid."""
        check_number("task.height", self.height, "[-inf, inf]")
        check_number("task.azimuth", self.azimuth, "[0, inf]")
        if self.reach is None:
            return
        if not isinstance(self.reach, tuple | list) or len(self.reach) != 2:
            raise UserError(f"task.reach: expected [least, most] m or null, got {self.reach!r}")
        for value in self.reach:
            check_number("task.reach", value, "[0, inf)")
        if self.reach[0] > self.reach[1]:
            raise UserError(f"task.reach: expected [least, most] m, got {list(self.reach)}")

    def with_model(self, robot: Robot, dynamics: Dynamics) -> "ReachTask":
        """Return the task; if `speed_noise` is None, set the default for an arm with these dynamics."""
        if self.speed_noise is not None:
            return self
        return replace(self, speed_noise=SPEED_NOISE if np.any(dynamics.speed_noise) else 0.0)

    def torque_limit(self, robot: Robot) -> np.ndarray:
        """Return (n,) Nm, the controller's torque limit; without such a limit, the torque for an action of 1."""
        if self.controller is not None and self.controller.torque_limit is not None:
            return self.controller.torque_limit
        share = np.array(self.torque_fraction, dtype=float)
        if share.ndim and share.shape != (robot.n,):
            raise UserError(
                f"task.torque_fraction: expected {robot.n} values, for the {robot.n} joints of {robot.name}, "
                f"got {share.size}; its default is robot.torque_fraction, of tracking robot.tracking_fraction"
            )
        return share * robot.tau_max

    @property
    def observation_summary(self) -> str:
        """Text that lists the terms and units of an observation."""
        return f"{OBSERVED}; rad, rad/s, m"

    @property
    def paper_weights(self) -> np.ndarray:
        """Weights (5,) with which the reward terms add up to the paper's reward."""
        return rewards.PAPER

    def starts(self, robot: Robot, rng: np.random.Generator, count: int) -> np.ndarray:
        """Return (count, n) rad, random start postures: q_home + U(-start_spread, start_spread)."""
        return robot.q_home + rng.uniform(-self.start_spread, self.start_spread, (count, robot.n))

    def region(self, robot: Robot) -> tuple[float, float]:
        """Return (low, high) m, the range of the distance between goal and shoulder."""
        if self.reach is not None:
            return self.reach
        postures = zip(range(POSTURES), _postures(robot, np.random.default_rng(0)), strict=False)
        low, high = np.quantile([away for _, (_, away) in postures], MIDDLE)
        return float(low) - 1e-6, float(high) + 1e-6  # wider: a one-joint arm has only one distance

    def goals(self, robot: Robot, rng: np.random.Generator, count: int) -> np.ndarray:
        """Return (count, 3) m: end-effector positions of random joint angles, so that every goal is reachable.

        Raises:
            UserError: hardly any random posture has its end effector in the task's region.
        """
        reach = self.region(robot)
        found: list[np.ndarray] = []
        for tried, (p, away) in enumerate(_postures(robot, rng), 1):
            if reach[0] <= away <= reach[1] and p[2] >= self.height and abs(np.arctan2(p[1], p[0])) <= self.azimuth:
                found.append(p)
                if len(found) == count:
                    return np.array(found)
            if (tried == 2000 and len(found) < 2) or tried == 1000 * count + 1000:
                break
        raise UserError(
            f"task.reach {reach[0]:g} to {reach[1]:g} m, task.height {self.height:g} m: {robot.name} "
            "hardly ever gets there; widen them"
        )

    def target(self, t: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return the target (m, 3) m of impedance control: the goal itself."""
        return goals

    def observation_scale(self, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
        """Return fixed mean and standard deviation (6 n + 12,) that normalize observations.

        Scales from random motion would be too large: random torques spin the wrist at 10 rad/s, but near a goal even
        0.1 rad/s matters.
        """
        n, far = robot.n, self.region(robot)[1]
        centre = np.zeros(6 * n + 12)
        low, high = robot.q_range
        centre[:n] = 0.5 * (low + high)
        places = [np.full(3, 0.5 * far)] * 3
        scale = [0.3 * (high - low), np.full(n, 0.5), *places, np.full(n, 0.5)]
        scale += [np.ones(3), np.full(n, 0.2 * far), np.ones(2 * n)]
        return centre, np.concatenate(scale)

    def observe(self, state: State, goals: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Return the observations (m, 6 n + 12) float32 for goals (m, 3) m; see `Task.observe`."""
        return observe(state.q, state.dq, state.ee, goals, state.jacobian, state.effort, torque)

    def observation_terms(self, robot: Robot) -> list[ObservationTerm]:
        """Return the terms of an observation in the order in which `observe` returns them."""
        return observation_terms(self.torque_limit(robot))

    def distance_scale(self, state: State, goals: np.ndarray) -> np.ndarray:
        """Return (m,) m, max(initial distance from the goal, CLOSE_M)."""
        return np.maximum(np.linalg.norm(goals - state.ee, axis=-1), CLOSE_M)

    def judge(
        self, state: State, ddq: np.ndarray, goals: np.ndarray, scale: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the distance (m,) m and the reward terms (m, 5) of r2s/tasks/rewards.py; see `Task.judge`."""
        return _judge(state.ee, goals, scale, state.dq, ddq, state.limited)

    def measures(self, episodes: Episodes) -> dict[str, float]:
        """Return one row of evaluations.csv; see `r2s.tasks.rollout.measures`."""
        return measures(episodes)


def observation_terms(torque: np.ndarray) -> list[ObservationTerm]:
    """Return the observation terms in the order in which `observe` returns them; torque: (n,) Nm, torque limit."""
    return [
        ObservationTerm("q", "rad", "q"),
        ObservationTerm("dq", "rad/s", "dq"),
        ObservationTerm("ee", "m", "ee"),
        ObservationTerm("goal", "m", "goal"),
        ObservationTerm("error", "m", "error"),
        ObservationTerm("effort / torque", "1", "effort", divided_by=tuple(torque.tolist())),
        ObservationTerm(f"tanh(error / {FINE_M:g} m)", "1", "error", divided_by=FINE_M, tanh=True),
        ObservationTerm("J'error", "m^2/rad", "pull"),
        ObservationTerm(f"tanh(J'error / {FINE_RAD:g})", "1", "pull", divided_by=FINE_RAD, tanh=True),
        ObservationTerm(f"tanh(dq / {FINE_DQ:g} rad/s)", "1", "dq", divided_by=FINE_DQ, tanh=True),
    ]


def _postures(robot: Robot, rng: np.random.Generator) -> Iterator[tuple[np.ndarray, float]]:
    """Yield the end-effector position (3,) m of random postures, and its distance from the shoulder, m."""
    model = robot.model(gravity=False)
    data, site = mujoco.MjData(model), model.site(robot.ee_site).id
    data.qpos = robot.q_home
    mujoco.mj_kinematics(model, data)
    shoulder = data.xanchor[min(1, robot.n - 1)].copy()
    low, high = robot.q_range
    middle, half = 0.5 * (low + high), 0.45 * (high - low)
    while True:
        data.qpos = middle + half * rng.uniform(-1, 1, robot.n)
        mujoco.mj_kinematics(model, data)
        p = data.site_xpos[site].copy()
        yield p, float(np.linalg.norm(p - shoulder))


@njit(cache=True)
def observe(
    q: np.ndarray,
    dq: np.ndarray,
    ee: np.ndarray,
    goal: np.ndarray,
    jacobian: np.ndarray,
    effort: np.ndarray,
    torque: np.ndarray,
) -> np.ndarray:
    """Return the observation (m, 6 n + 12) float32 in SI units; arms and simulators share this function.

    Terms: q; dq; ee; goal; error; effort / torque; tanh(error / 2 cm); J^T error; tanh(J^T error / 1.5 cm); tanh(dq /
    0.1 rad/s). J^T error shows which joints move the end effector toward the goal; a network without this term would
    have to learn the Jacobian. Torque can change by at most 1 Nm per ms, so the next torques depend on the present
    effort; the policy therefore observes the effort.

    Args:
        q, dq: (m, n) rad, rad/s, joint angles and speeds.
        ee, goal: (m, 3) m, position of the end effector and goal position.
        jacobian: (m, 3, n) m/rad, translational Jacobian of the end effector.
        effort: (m, n) Nm, the target torque after the low-pass. torque: (n,) Nm, the torque limit.
    """
    m, n = q.shape
    out = np.empty((m, 6 * n + 12), np.float32)
    for i in range(m):
        for j in range(n):
            pull = 0.0
            for k in range(3):
                pull += jacobian[i, k, j] * (goal[i, k] - ee[i, k])
            out[i, 5 * n + 12 + j] = np.tanh(dq[i, j] / FINE_DQ)
            out[i, j], out[i, n + j], out[i, 2 * n + 9 + j] = q[i, j], dq[i, j], effort[i, j] / torque[j]
            out[i, 3 * n + 12 + j], out[i, 4 * n + 12 + j] = pull, np.tanh(pull / FINE_RAD)
        for k in range(3):
            error = goal[i, k] - ee[i, k]
            out[i, 2 * n + k], out[i, 2 * n + 3 + k], out[i, 2 * n + 6 + k] = ee[i, k], goal[i, k], error
            out[i, 3 * n + 9 + k] = np.tanh(error / FINE_M)
    return out


@njit(cache=True)
def _judge(ee, goal, reference, dq, ddq, limited):
    distance = np.empty(len(ee))
    for i in range(len(ee)):
        x, y, z = goal[i, 0] - ee[i, 0], goal[i, 1] - ee[i, 1], goal[i, 2] - ee[i, 2]
        distance[i] = np.sqrt(x * x + y * y + z * z)
    return distance, rewards.terms(distance, reference, dq, ddq, limited)
