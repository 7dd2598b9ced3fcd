"""Task push: push a box of unknown mass and friction to a pose on the table.

The table's pose and the box's size are known. Observations contain the box's pose with the noise `pose_noise`, as
from a camera. The box's mass and friction are not observed; they are part of the dynamics (`dr=box`, `arm.surface`).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

import numpy as np

from r2s.control.impedance import Impedance, cartesian_impedance
from r2s.errors import UserError, check_number
from r2s.physics.box import (
    EXPECTED,
    PUSHED_AT,
    SIZE,
    SPREAD,
    TABLE,
    YAW,
    TableFrame,
    check_size,
    standing_box,
    table_frame,
)
from r2s.physics.dynamics import Dynamics
from r2s.physics.impedance import arm_tips
from r2s.physics.push_limit import push_limit
from r2s.physics.robot import Robot
from r2s.physics.tip import Tip, nominal_plane
from r2s.tasks.measures import MeasureTable
from r2s.tasks.push_measures import GOOD_M, GOOD_RAD, PUSH, push_measures
from r2s.tasks.surface_task import near, rough
from r2s.tasks.task import Episodes, State
from r2s.tasks.tip_task import TipTask

POSE, START = slice(0, 6), 6  # columns of a goal: pose of the box, then the start posture
BEHIND = 0.04  # m, gap between tip and box at the start
FAR_M, FAR_RAD, GAP_M, FINE_M, LEVEL_M = 0.1, 0.5, 0.05, 0.02, 0.02  # m, rad: tanh scales
CLEAR_M = 0.01  # m, clearance below which the term `table` is negative; without this term the tip rubs on the table
WEIGHTS = {
    "distance": 1.0,
    "yaw": 0.5,
    "precision": 1.0,
    "gap": 0.3,
    "height": 0.3,
    "table": 1.0,
    "smoothness": 1.0,
    "filter_penalty": 1.0,
}
# columns of an observation after q, dq, effort and `limited`: in the table's frame, tip position m, tip velocity m/s,
# box pose and pose error (each x m, y m, yaw rad)
TIP, TIP_RATE, BOX, ERROR = slice(0, 3), slice(3, 6), slice(6, 9), slice(12, 15)


@dataclass(frozen=True)
class PushTask(TipTask):
    """Push a box to a pose; a `Task` (r2s/tasks/task.py) from conf/task/push.yaml.

    A goal is a row (6 + n,): the box's goal pose, encoded as in `State.box`, then the arm's start posture, rad.
    In the start posture, the tip is behind the box, at PUSHED_AT times the height of the box.

    Attributes:
        ctrl_hz: policy rate. episode_s: length of an episode, s.
        size: (3,) m, edges of the box. away: (low, high) m, distance of a goal from the box's nominal position.
        bearing: degrees, largest angle between a goal's direction and straight ahead. goal_yaw: degrees, largest yaw
            of a goal.
        spread, first_yaw: m and degrees, largest shift and rotation of the box's start pose from the nominal pose,
            for `dr=box`.
        pose_noise: m and degrees, standard deviations of position and yaw noise in the pose that simulated arms
            perceive.
        point, normal: nominal position of the box on the table, m, and the table's normal; if None, see
            `table_frame`.
        displacement: m, distance by which an action of 1 shifts the tip's target in the default controller.
        tool, pool: see `SurfaceTask`. torque_fraction, cutoff_hz, speed_noise: see `TipTask`.
        tip_radius, frame: radius of the tip, m, and frame of the table. own, parameters: default controller and its
            parameters. `with_model` sets tip_radius, frame, own and parameters.
    """

    ctrl_hz: int = 25
    episode_s: float = 10.0
    size: tuple[float, float, float] = SIZE
    away: tuple[float, float] = (0.06, 0.14)
    bearing: float = 30.0
    goal_yaw: float = 20.0
    spread: float = SPREAD
    first_yaw: float = YAW
    pose_noise: tuple[float, float] = (1e-3, 0.5)
    point: tuple[float, float, float] | None = None
    normal: tuple[float, float, float] | None = None
    displacement: float = 0.25
    tool: str | None = None
    torque_fraction: float | tuple[float, ...] = 0.5
    cutoff_hz: float = 100.0
    speed_noise: float | None = None
    pool: int = 1024
    tip_radius: float = 0.0
    frame: TableFrame | None = field(default=None, repr=False)
    parameters: np.ndarray | None = field(default=None, repr=False)
    own: Impedance | None = field(default=None, repr=False)
    touches = True
    moves_box = True
    target_size: ClassVar[int] = 3
    measure_table: ClassVar[MeasureTable] = PUSH
    reward_terms = tuple(WEIGHTS)
    observation_summary = (
        "q dq effort limited tip tip_velocity box(x y yaw) goal(x y yaw) error error_in_box tip_in_box tanh(errors); "
        "rad, rad/s, m, m/s, in the frame of the table"
    )

    def __post_init__(self):
        self.as_reach()  # raises UserError for a wrong rate
        check_size("task.size", self.size, TABLE[1])
        for name in ("away", "pose_noise"):
            pair = getattr(self, name)
            if not isinstance(pair, tuple) or len(pair) != 2:
                raise UserError(f"task.{name}: expected two numbers, got {pair!r}")
            for value in pair:
                check_number(f"task.{name}", value, "[0, 1]" if name == "away" else "[0, inf)")
        if not self.away[0] <= self.away[1]:
            raise UserError(f"task.away: expected [least, most] m, got {list(self.away)}")
        for name in ("bearing", "goal_yaw", "first_yaw"):
            check_number(f"task.{name}", getattr(self, name), "[0, 180]")
        check_number("task.spread", self.spread, "[0, inf)")
        check_number("task.displacement", self.displacement, "(0, inf)")
        check_number("task.pool", self.pool, "[1, inf)", whole=True)

    @property
    def height(self) -> float:
        """Height above the table, m, at which the tip's center pushes."""
        return PUSHED_AT * self.size[2]

    def with_model(self, robot: Robot, dynamics: Dynamics) -> Self:
        """Return the task with the default controller and the frame of the table for one arm.

        Raises:
            UserError: the robot has no tool, the tool is too short for the box, or the tip would touch the table.
        """
        Tip(robot)
        length, radius = float(np.linalg.norm(robot.tool.tip)), robot.tool.radius  # type: ignore[union-attr]
        if not radius < self.height or self.size[2] > self.height + length:
            raise UserError(
                f"task.size: a tip of {radius:g} m, {length:g} m from the flange, pushes boxes of "
                f"{radius / PUSHED_AT:.3g} to {length / (1 - PUSHED_AT):.3g} m height, got {self.size[2]:g} m"
            )
        frame = table_frame(robot, self.point, self.normal)
        task = replace(self, speed_noise=self.noise_for(dynamics), tip_radius=radius, frame=frame)
        share = self.torque_fraction
        own = cartesian_impedance(robot, task, dynamics, torque_fraction=share, displacement=self.displacement)
        return replace(task, own=own, parameters=own.parameters)

    def pushing_within(
        self, robot: Robot, friction: np.ndarray, force_max: float | None, speed_near: float | None
    ) -> Self:
        """Return the task with limits of contact force (N) and speed (m/s) at the table plane (`point`, `normal`)."""
        plane = nominal_plane(robot, self.point, self.normal)
        return self._with("push_limit", push_limit(robot, friction, force_max, speed_near, plane))

    @property
    def paper_weights(self) -> np.ndarray:
        """Weights (k,) of the reward terms, in the order of `reward_terms`."""
        return np.array(list(WEIGHTS.values()))

    @property
    def table(self) -> TableFrame:
        """The frame of the table on which the box stands."""
        return self.of_model("frame")

    @property
    def centre(self) -> np.ndarray:
        """(3,) m, tip target at zero action: straight ahead of the box's nominal position, by the mean of `away`."""
        return self.table.outside(np.array([0.5 * sum(self.away), 0.0, self.height]))

    def target(self, t: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return the target (m, 3) m of an impedance controller: always the point `centre`."""
        return np.tile(self.centre, (len(goals), 1))

    def expected(self, robot: Robot, dynamics: Dynamics) -> Dynamics:
        """Return the dynamics with a box of medium mass and friction at its nominal position."""
        return replace(dynamics, surface=standing_box(self.table, np.zeros(3), self.size, **EXPECTED))

    def begin(self, starts: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return (m, n) rad, start postures with the tip behind the box."""
        return goals[:, START : START + starts.shape[1]]

    def goals(self, robot: Robot, rng: np.random.Generator, count: int) -> np.ndarray:
        """Return random goals (count, 6 + n); the class docstring describes a goal.

        A goal has distance ~ U(away), bearing ~ U(-bearing, bearing), yaw ~ U(-goal_yaw, goal_yaw). The tip starts
        behind the box, at the distance BEHIND from the rearmost possible corner. The tip's random sideways shift is
        at most half the box's width.

        Raises:
            UserError: the tip cannot reach its start position, or the far side of the box at its goal.
        """
        tip, wide = Tip(robot), 0.5 * float(np.hypot(*self.size[:2]))
        back = self.spread + wide + robot.tool.radius + BEHIND  # type: ignore[union-attr]
        rows = []
        for _ in range(count):
            distance, side = rng.uniform(*self.away), 0.5 * self.size[1] * rng.uniform(-1, 1)
            bearing, yaw = np.radians([self.bearing, self.goal_yaw]) * rng.uniform(-1, 1, 2)
            goal = np.array([distance * np.cos(bearing), distance * np.sin(bearing), yaw])
            behind = self.table.outside(np.array([-back, side, self.height]))
            beyond = self.table.outside(np.array([goal[0] + wide, goal[1], self.height]))
            start = tip.posture(behind)
            if start is None or tip.posture(beyond) is None:
                at = behind if start is None else beyond
                raise UserError(
                    f"task.point: the tip of {robot.name} does not reach {np.round(at, 3).tolist()} m; choose a "
                    "nearer one"
                )
            rows.append(np.concatenate([self.table.pose(goal, 0.5 * self.size[2]), start]))
        return np.array(rows)

    def goal_positions(self, goals: np.ndarray) -> np.ndarray:
        """Return (m, 3) m, the center of the box at each goal."""
        return goals[:, :3]

    def planar(self, state: State, goals: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return box pose, goal pose and error (goal - box), each (m, 3): x m, y m, yaw rad in the table's frame."""
        seen = self.table.pose(np.zeros((len(goals), 3)), 0.5 * self.size[2]) if state.box is None else state.box
        box, goal = self.table.planar(seen), self.table.planar(goals[:, POSE])
        error = goal - box
        error[:, 2] = np.arctan2(np.sin(error[:, 2]), np.cos(error[:, 2]))
        return box, goal, error

    def tip(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return position (m, 3) m and Jacobian (m, 3, n) m/rad of the tip at q (m, n) rad, in the table's frame."""
        place, jacobian = arm_tips(np.ascontiguousarray(q), self.of_model("parameters"))
        return self.table.inside(place), np.einsum("ij,mjn->min", self.table.axes, jacobian)

    def observation_scale(self, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
        """Return fixed mean and standard deviation (3 n + 25,) that normalize observations."""
        n, (low, high) = robot.n, robot.q_range
        mean = np.zeros(3 * n + 25)
        mean[:n] = 0.5 * (low + high)
        planar = [0.1, 0.1, 0.3]
        scale = [
            0.15 * (high - low),
            np.full(n, 0.3),
            np.full(n, 0.3),
            np.full(1, 0.3),
            [0.1, 0.1, 0.03],
            np.full(3, 0.1),
        ]
        return mean, np.concatenate([*scale, *[planar] * 3, np.full(4, 0.1), np.ones(5)])

    def observe(self, state: State, goals: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Return the observations (m, 3 n + 25) float32; see `observation_summary`."""
        place, jacobian = self.tip(state.q)
        box, goal, error = self.planar(state, goals)
        velocity = np.einsum("mkn,mn->mk", jacobian, state.dq)
        in_box, tip_in_box = _turned(error[:, :2], box[:, 2]), _turned(place[:, :2] - box[:, :2], box[:, 2])
        half = 0.5 * np.array(self.size[:2])
        fine = np.tanh(np.concatenate([in_box / GOOD_M, error[:, 2:] / GOOD_RAD], axis=1))
        faces = np.tanh((np.abs(tip_in_box) - half) / FINE_M)
        own = [state.effort / torque, state.limited[:, None]]
        rows = [state.q, state.dq, *own, place, velocity, box, goal, error, in_box, tip_in_box, fine, faces]
        return np.concatenate(rows, axis=1, dtype=np.float32)

    def forces(self, state: State, goals: np.ndarray) -> np.ndarray:
        """Return (m, 2) N: the magnitude of the force on the box, and the requested force, which is 0."""
        none = np.zeros(len(goals))
        return np.stack([none if state.force is None else np.linalg.norm(state.force, axis=1), none], 1)

    def boxes(self, state: State, goals: np.ndarray) -> np.ndarray:
        """Return (m, 11): pose of the box, yaw error rad, height of the tip's lowest point m, edges of the box m."""
        box, _, error = self.planar(state, goals)
        pose, height = self.table.pose(box, 0.5 * self.size[2]), self.tip(state.q)[0][:, 2]
        edges = np.tile(self.size, (len(goals), 1))
        return np.concatenate([pose, error[:, 2:], (height - self.tip_radius)[:, None], edges], axis=1)

    def judge(
        self, state: State, ddq: np.ndarray, goals: np.ndarray, scale: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the distance d (m,) m of the box from its goal, and the reward terms (m, 8).

        Terms, with the yaw error e: distance = -tanh(d / 10 cm); yaw = -tanh(|e| / 0.5 rad); precision = `near`(d, 10
        cm, 3 cm) `near`(|e|, 0.5 rad, 10 degrees); gap = -tanh(distance of the tip from the box / 5 cm); height =
        -tanh(height error of the tip / 2 cm); table = -tanh(max(0, c - h) / 1 cm), with the height h of the tip's
        lowest point above the table, and c = 1 cm (less for low boxes); smoothness = -0.03 sum tanh(|ddq| / 10
        rad/s^2); filter_penalty = -`State.limited`.
        """
        place, _ = self.tip(state.q)
        box, _, error = self.planar(state, goals)
        d, yaw = np.linalg.norm(error[:, :2], axis=1), np.abs(error[:, 2])
        beyond = np.abs(_turned(place[:, :2] - box[:, :2], box[:, 2])) - 0.5 * np.array(self.size[:2])
        gap = (np.linalg.norm(beyond.clip(0.0), axis=1) - self.tip_radius).clip(0.0)
        precise = near(d, FAR_M, GOOD_M) * near(yaw, FAR_RAD, GOOD_RAD)
        level = np.tanh(np.abs(place[:, 2] - self.height) / LEVEL_M)
        clear = min(CLEAR_M, self.height - self.tip_radius)  # the tip pushes a low box with less clearance
        low = np.tanh((clear + self.tip_radius - place[:, 2]).clip(0.0) / CLEAR_M)
        terms = [-np.tanh(d / FAR_M), -np.tanh(yaw / FAR_RAD), precise, -np.tanh(gap / GAP_M), -level, -low]
        return d, np.stack([*terms, -rough(ddq), -state.limited], axis=1)

    def measures(self, episodes: Episodes) -> dict[str, float]:
        """Return one row of evaluations.csv; see `push_measures`."""
        return push_measures(episodes, self.ctrl_hz)

    def score(self, row: Mapping[str, float]) -> float:
        """Return 100 (success - stopped) + return / 10; `success` and `stopped` are shares of the episodes."""
        return 100 * (row["success"] - row["stopped"]) + 0.1 * row["return_push"]


def _turned(vectors: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """Express vectors (m, 2) in axes that are rotated by yaw (m,) rad."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.stack([c * vectors[:, 0] + s * vectors[:, 1], c * vectors[:, 1] - s * vectors[:, 0]], axis=1)
