"""Task press: touch a surface whose place is roughly known, hold a force against it, and follow a step of the force.

The arm knows a nominal plane. The true one, its stiffness and its friction are part of the dynamics (`dr=contact`,
`arm.surface`). Neither observation nor controller knows the true force: the estimate that a policy observes is made
of q, dq and the commanded torque.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from r2s.compiled import njit
from r2s.control.controller import Controller
from r2s.control.impedance import Impedance, cartesian_impedance
from r2s.errors import UserError, check_number
from r2s.physics.dynamics import Dynamics
from r2s.physics.impedance import FIRST_DQ, FORCE_MAX, K_DEFAULT, arm_pose
from r2s.physics.inverse_dynamics import InverseDynamics
from r2s.physics.kinematics import POSE
from r2s.physics.push_limit import push_limit
from r2s.physics.robot import Robot
from r2s.physics.surface import Surface
from r2s.physics.tip import Tip, nominal_plane
from r2s.tasks.measures import MeasureTable
from r2s.tasks.press_measures import PRESS, WINDOW_S, press_measures
from r2s.tasks.reach import SPEED_NOISE, ReachTask
from r2s.tasks.task import BaseTask, Episodes, ObservationTerm, State

POINT, NORMAL, FORCES, HEIGHT, START = slice(0, 3), slice(3, 6), slice(6, 8), 8, 9  # columns of a goal
LEAST_STEP = 0.2  # of the range of forces, the smallest step
LAG_M = 0.01  # m, by which the tip may follow its target: damping at approach_speed, and 2 N of wrong friction
REVERSAL_S = 0.2  # s, in which the direction of friction changes after a step
RESIDUAL_M = 5e-3  # m, displacement of an action of 1 under the task's own controller: a quarter of 20 N on the Panda
FINE_M, FINE_V, FAR_N, FINE_N, HARD_N = 5e-3, 0.01, 5.0, 0.5, 10.0  # m, m/s, N: tanh scales
REGULAR = 1e-3  # m^2/rad^2, of the least squares of the force: blind directions of the Jacobian count as force-free
EXPECTED = 1.4e4, 1.25, 1.5, 0.3  # stiffness N/m, exponent, damping s/m, friction: middle of conf/dr/contact.yaml


@dataclass(frozen=True)
class PressTask(BaseTask):
    """Press on a surface; a `Task` (r2s/tasks/task.py) from conf/task/press.yaml.

    A goal is a row (9 + n,): the touched point of the nominal plane m, its normal, both forces N, height of the tip
    above the point at the start m, and the start posture rad.

    Attributes:
        ctrl_hz: policy rate. episode_s, step_s: length of an episode, and when the force steps, s.
        force: (low, high) N, drawn forces. force_rate: N/s, at which the asked force moves after a step.
        approach_speed: m/s, of the target along the nominal normal, so the largest speed of a touch.
        clearance: m, height of the tip above the nominal plane at the start. spread: m, of the touched points about
            `point`. place: m and tilt: degrees, by which the true plane may differ from the nominal one.
        point, normal: of the nominal plane in the base frame, m; None: a table below the tip at home.
        tool: tool file of the robot if robot.tool is null; the stages read it.
        torque_fraction, cutoff_hz, speed_noise: see `ReachTask`; the torque limit is the controller's, if it has one.
        pool: number of goals that a training draws from.
        stop: what a stop does with a force, of `r2s.physics.push_limit.STOPS`; None: release.
        model, own, parameters: the identified arm, the task's own controller and its parameters; see `with_model`.
        creep: m/s, along the normal, at which the fastest joint has the first speed of the controller's friction.
    """

    ctrl_hz: int = 100
    episode_s: float = 7.0
    step_s: float = 3.5
    force: tuple[float, float] = (5.0, 20.0)
    force_rate: float = 40.0
    approach_speed: float = 0.02
    clearance: float = 0.015
    spread: float = 0.05
    place: float = 5e-3
    tilt: float = 5.0
    point: tuple[float, float, float] | None = None
    normal: tuple[float, float, float] | None = None
    tool: str | None = None
    torque_fraction: float | tuple[float, ...] = 0.3
    cutoff_hz: float = 100.0
    speed_noise: float | None = None
    pool: int = 512
    stop: str | None = None
    model: InverseDynamics | None = field(default=None, repr=False)
    parameters: np.ndarray | None = field(default=None, repr=False)
    own: Impedance | None = field(default=None, repr=False)
    creep: float = 0.0
    touches = True
    approaches: ClassVar[bool] = True  # read by `control=hybrid`
    measure_table: ClassVar[MeasureTable] = PRESS
    target_size: ClassVar[int] = 6
    reward_terms = "force", "precision", "excess", "smoothness", "filter_penalty"

    def __post_init__(self):
        self._as_reach()  # raises for a wrong rate
        for name, low in (("force_rate", 1e-3), ("approach_speed", 1e-4), ("clearance", 1e-4), ("step_s", WINDOW_S)):
            check_number(f"task.{name}", getattr(self, name), f"[{low:g}, inf)")
        check_number("task.episode_s", self.episode_s, f"[{self.step_s + WINDOW_S:g}, 60]")
        check_number("task.pool", self.pool, "[1, inf)", whole=True)
        check_number("task.place", self.place, "[0, inf)")
        check_number("task.tilt", self.tilt, "[0, 45]")
        check_number("task.spread", self.spread, "[0, inf)")
        numbers = isinstance(self.force, tuple) and len(self.force) == 2
        if (
            not numbers
            or not all(isinstance(x, int | float) for x in self.force)
            or not 0 < self.force[0] < self.force[1]
        ):
            raise UserError(f"task.force: {self.force} is not allowed; two numbers above 0 N are, the lesser first")
        if self.clearance <= self._beyond:
            raise UserError(
                f"task.clearance: {self.clearance:g} m may lie inside the surface; more than {self._beyond:.3g} m is "
                "allowed, for place, spread and tilt"
            )

    @property
    def _beyond(self) -> float:
        """Largest distance, m, of the true surface from the nominal plane at a touched point."""
        return self.place + self.spread * float(np.tan(np.radians(self.tilt)))

    def _as_reach(self) -> ReachTask:
        return ReachTask(
            self.ctrl_hz, self.episode_s, self.torque_fraction, self.cutoff_hz, speed_noise=self.speed_noise
        )

    def with_model(self, robot: Robot, dynamics: Dynamics) -> "PressTask":
        """Return the task with the model of one arm, for its controller and for the estimate of the force.

        Raises:
            UserError: the robot has no tool, or cannot exert the forces.
        """
        Tip(robot)
        noise = self.speed_noise
        if noise is None:
            noise = SPEED_NOISE if np.any(dynamics.speed_noise) else 0.0
        task = replace(self, model=InverseDynamics(robot, dynamics), speed_noise=noise)
        own = cartesian_impedance(robot, task, dynamics, hybrid=True, displacement=RESIDUAL_M)
        task._check_force(own)
        jacobian, mobility = Tip(robot)(robot.q_home)[1], np.linalg.inv(task.model.mass(robot.q_home[None])[0])  # type: ignore[union-attr]
        moves = np.linalg.solve(jacobian @ mobility @ jacobian.T, jacobian @ mobility).T @ self.plane(robot)[1]
        return replace(task, own=own, parameters=own.parameters, creep=FIRST_DQ / float(np.abs(moves).max()))

    def controlled_by(self, controller: Controller) -> "PressTask":
        """Return the task with this controller; raise UserError if it cannot exert the forces."""
        self._check_force(controller)
        return super().controlled_by(controller)

    def pushing_within(
        self, robot: Robot, friction: np.ndarray, force_max: float | None, speed_near: float | None
    ) -> "PressTask":
        """Return the task with a limit of force and speed at the nominal plane, which admits its forces."""
        limit = push_limit(robot, friction, force_max, speed_near, self.plane(robot), self.force[1], self.stop)
        if limit is not None:
            limit = replace(limit, place=self.place, tilt=float(np.radians(self.tilt)))
        return self._with("push_limit", limit)

    def _check_force(self, controller: Controller) -> None:
        if isinstance(controller, Impedance) and controller.hybrid:
            most = float(controller.parameters[FORCE_MAX])
            if self.force[1] > most:
                raise UserError(
                    f"task.force: expected at most {most:.3g} N, which control.torque_fraction allows, got "
                    f"{self.force[1]:g} N"
                )

    def control(self, robot: Robot) -> Controller:
        """Return the controller: by default `control=hybrid` with small displacements."""
        return self.controller or self.own or super().control(robot)

    def torque_limit(self, robot: Robot) -> np.ndarray:
        """Return (n,) Nm, the largest target torque."""
        limit = self.control(robot).torque_limit if self.controller or self.own else None
        return self._as_reach().torque_limit(robot) if limit is None else limit

    @property
    def observation_summary(self) -> str:
        """Terms and units of an observation."""
        return (
            "q dq tip tanh(height/5 mm) tip_velocity tanh(rate/0.01) force/20 tanh(force_error/10) ahead/5mm effort "
            "limited; rad, rad/s, m, m/s, N"
        )

    @property
    def paper_weights(self) -> np.ndarray:
        """(5,), the weights of the reward terms."""
        return np.ones(5)

    def plane(self, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
        """Return point (3,) m and normal (3,) of the nominal plane."""
        return nominal_plane(robot, self.point, self.normal)

    def expected(self, robot: Robot, dynamics: Dynamics) -> Dynamics:
        """Return the dynamics with a surface of middling stiffness in the nominal plane."""
        point, normal = self.plane(robot)
        return replace(dynamics, surface=Surface(point, normal, *EXPECTED))

    def starts(self, robot: Robot, rng: np.random.Generator, count: int) -> np.ndarray:
        """Return (count, n) rad, home: `begin` replaces it by the goals' start postures."""
        return np.tile(robot.q_home, (count, 1))

    def begin(self, starts: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return (m, n) rad, postures above the touched points."""
        return goals[:, START:]

    def goals(self, robot: Robot, rng: np.random.Generator, count: int) -> np.ndarray:
        """Return goals (count, 9 + n), see the class.

        point ~ U(disc of `spread` on the plane); forces ~ U(force), at least LEAST_STEP of their range apart.

        Raises:
            UserError: the tip does not reach the plane.
        """
        point, normal = self.plane(robot)
        tip, out = Tip(robot), np.empty((count, START + robot.n))
        across = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
        across /= np.linalg.norm(across)
        low, high = self.force
        for row in out:
            for _ in range(20):
                about, away = rng.uniform(0, 2 * np.pi), self.spread * np.sqrt(rng.uniform())
                row[POINT] = point + away * (np.cos(about) * across + np.sin(about) * np.cross(normal, across))
                height = self.clearance + robot.tool.radius  # type: ignore[union-attr]
                q = tip.posture(row[POINT] + height * normal)
                if q is not None:
                    break
            else:
                raise UserError(
                    f"task.point: the tip of {robot.name} does not reach {np.round(point, 3).tolist()} m; choose a "
                    "nearer one"
                )
            first = rng.uniform(low, high)
            second = first
            while abs(second - first) < LEAST_STEP * (high - low):
                second = rng.uniform(low, high)
            row[NORMAL], row[FORCES], row[HEIGHT], row[START:] = normal, (first, second), height, q
        return out

    def goal_positions(self, goals: np.ndarray) -> np.ndarray:
        """Return (m, 3) m, the touched points of the nominal plane."""
        return goals[:, POINT]

    def contact(self, t: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return (m, 4), normal and force N of hybrid control at t (m,) s; it steps at `force_rate`."""
        first, second = goals[:, 6], goals[:, 7]
        moved = (self.force_rate * (t - self.step_s)).clip(0.0)
        force = first + np.sign(second - first) * np.minimum(moved, np.abs(second - first))
        return np.concatenate([goals[:, NORMAL], force[:, None]], axis=1)

    def target(self, t: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return the target (m, 6) of an impedance, m and m/s: place, and direction of friction.

        The place moves from the start along the normal through the nominal plane, until the spring to a surface at
        the farthest allowed place has the larger force. Its velocity is so small that the feedforward of friction is
        that of joints about to move: against the normal while the force rises, with it after a step down.
        """
        share = np.where(goals[:, 7] < goals[:, 6], ((t - self.step_s) / REVERSAL_S).clip(0.0, 1.0), 0.0)
        place = goals[:, POINT] - self._depth(t, goals)[:, None] * goals[:, NORMAL]
        return np.concatenate([place, (self.creep * (2.0 * share - 1.0))[:, None] * goals[:, NORMAL]], axis=1)

    def _depth(self, t: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return (m,) m, how far the target of the tip's centre is below the nominal plane at t (m,) s.

        It moves at approach_speed until the tip has touched for sure, then so that the force rises at force_rate.
        """
        height, K = goals[:, HEIGHT], self._spring()
        touched = self._beyond + LAG_M - (height - self.clearance)  # the tip's centre is a radius above its surface
        slow = self.approach_speed * t - height
        late = (t - (touched + height) / self.approach_speed).clip(0.0)
        return np.minimum(
            slow.clip(None, touched) + self.force_rate / K * late, touched + goals[:, FORCES].max(1) / K
        )

    def _spring(self) -> float:
        """Return the stiffness, N/m, of the controller's spring; of the task's own one if it has none."""
        for control in (self.controller, self.own):
            if isinstance(control, Impedance) and control.parameters[K_DEFAULT] > 0:
                return float(control.parameters[K_DEFAULT])
        raise UserError("task: press needs a model of the arm; call with_model first")

    def observation_scale(self, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and standard deviation (3 n + 12,) to normalise `observe` by: the task's own scales."""
        n = robot.n
        low, high = robot.q_range
        mean = np.zeros(3 * n + 12)
        mean[:n] = 0.5 * (low + high)
        scale = [0.15 * (high - low), np.full(n, 0.1), np.full(3, 0.02), np.ones(1), np.full(3, 0.02), np.ones(4)]
        scale += [np.full(n, 0.3), np.full(1, 0.3)]
        return mean, np.concatenate(scale)

    def observe(self, state: State, goals: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Return the observations (m, 3 n + 12) float32; see `observation_terms`."""
        place, jacobian = self._tip(state.q)
        normal = goals[:, NORMAL]
        offset = place - goals[:, POINT]
        height, velocity = (offset * normal).sum(1), np.einsum("mkn,mn->mk", jacobian, state.dq)
        rate = (velocity * normal).sum(1)
        force, asked = self.estimate(state, normal, jacobian), self.contact(state.t, goals)[:, 3]
        ahead = height + self._depth(state.t, goals)
        own = [np.tanh(rate / FINE_V), asked / 20.0, np.tanh((asked - force) / HARD_N), np.tanh(ahead / FINE_M)]
        rows = [state.q, state.dq, offset, np.tanh(height / FINE_M)[:, None], velocity, np.stack(own, 1)]
        return np.concatenate([*rows, state.effort / torque, state.limited[:, None]], axis=1, dtype=np.float32)

    def observation_terms(self, robot: Robot) -> list[ObservationTerm]:
        """Return the terms of an observation, in the order of `observe`."""
        torque = tuple(self.torque_limit(robot).tolist())
        return [
            ObservationTerm("q", "rad", "q"),
            ObservationTerm("dq", "rad/s", "dq"),
            ObservationTerm("tip - point", "m", "tip"),
            ObservationTerm(f"tanh(height / {FINE_M:g} m)", "1", "height", divided_by=FINE_M, tanh=True),
            ObservationTerm("velocity of the tip", "m/s", "tip_velocity"),
            ObservationTerm(f"tanh(rate / {FINE_V:g} m/s)", "1", "rate", divided_by=FINE_V, tanh=True),
            ObservationTerm("force / 20 N", "1", "force", divided_by=20.0),
            ObservationTerm(f"tanh(force error / {HARD_N:g} N)", "1", "force_error", divided_by=HARD_N, tanh=True),
            ObservationTerm(f"tanh(ahead / {FINE_M:g} m)", "1", "ahead", divided_by=FINE_M, tanh=True),
            ObservationTerm("effort / torque", "1", "effort", divided_by=torque),
            ObservationTerm("limited", "1", "limited"),
        ]

    def estimate(self, state: State, normal: np.ndarray, jacobian: np.ndarray | None = None) -> np.ndarray:
        """Return (m,) N, the estimated force against the normal (m, 3), of q, dq and the last command.

        Quasi-static: least squares of J^T F = tau - model(q, dq). At rest friction hides up to its level over the
        lever; errors of the model are its bias.
        """
        if self.model is None or self.parameters is None:
            raise UserError("task: press estimates the force with a model of the arm; call with_model first")
        jacobian = self._tip(state.q)[1] if jacobian is None else jacobian
        q, dq = np.ascontiguousarray(state.q), np.ascontiguousarray(state.dq)
        external = state.tau - self.model(q, dq, np.zeros_like(q), dq)
        square = jacobian @ jacobian.swapaxes(1, 2) + REGULAR * np.eye(3)
        force = np.linalg.solve(square, np.einsum("mkn,mn->mk", jacobian, external)[..., None])[..., 0]
        return -(force * normal).sum(1)

    def _tip(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return place (m, 3) m and Jacobian (m, 3, n) m/rad of the tip's centre at q (m, n) rad."""
        if self.parameters is None:
            raise UserError("task: press needs a model of the arm; call with_model first")
        return _tips(np.ascontiguousarray(q), self.parameters)

    def tip_velocity(self, state: State) -> np.ndarray:
        """Return (m, 3) m/s, the velocity of the tip's centre in base axes."""
        return np.einsum("mkn,mn->mk", self._tip(state.q)[1], state.dq)

    def normals(self, goals: np.ndarray) -> np.ndarray:
        """Return (m, 3), the outward normals of the nominal plane."""
        return goals[:, NORMAL]

    def forces(self, state: State, goals: np.ndarray) -> np.ndarray:
        """Return (m, 2) N, the force against the nominal normal, and the one asked for (a step)."""
        asked = np.where(state.t < self.step_s + 0.5 / self.ctrl_hz, goals[:, 6], goals[:, 7])
        if state.force is None:
            return np.stack([np.zeros(len(goals)), asked], 1)
        return np.stack([-(state.force * goals[:, NORMAL]).sum(1), asked], 1)

    def distance_scale(self, state: State, goals: np.ndarray) -> np.ndarray:
        """Return (m,) ones: the reward takes forces in N."""
        return np.ones(len(goals))

    def judge(
        self, state: State, ddq: np.ndarray, goals: np.ndarray, scale: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the force error (m,) N, and the reward terms (m, 5).

        force -tanh(error / 5 N); precision 1 - tanh(error / 5 N) / 2 - tanh(error / 0.5 N) / 2; excess: -tanh of the
        force beyond the one asked for / 10 N; smoothness -0.03 sum tanh(|ddq| / 10 rad/s^2); filter_penalty -limited.
        """
        exerted = self.forces(state, goals)
        error = np.abs(exerted[:, 0] - exerted[:, 1])
        excess = np.tanh((exerted[:, 0] - exerted[:, 1]).clip(0.0) / HARD_N)
        near = 1.0 - 0.5 * (np.tanh(error / FAR_N) + np.tanh(error / FINE_N))
        rough = 0.03 * np.tanh(np.abs(ddq) / 10.0).sum(1)
        return error, np.stack([-np.tanh(error / FAR_N), near, -excess, -rough, -state.limited], axis=1)

    def measures(self, episodes: Episodes) -> dict[str, float]:
        """Return one row of evaluations.csv, see `press_measures`."""
        return press_measures(episodes, round(self.step_s * self.ctrl_hz), self.ctrl_hz)

    def score(self, row: Mapping[str, float]) -> float:
        """Return 10 per unit of success minus the RMSE in N, minus 1 for every percent of stopped episodes."""
        rmse = row["force_rmse_N"] if np.isfinite(row["force_rmse_N"]) else 1e3
        return 10 * row["success"] - rmse - 100 * row["stopped"]


@njit(cache=True, error_model="numpy")
def _tips(q, parameters):
    """Return place (m, 3) m and Jacobian (m, 3, n) of the tip at q (m, n) rad; parameters of an impedance."""
    m, n = q.shape
    places, out = np.empty((m, 3)), np.empty((m, 3, n))
    frames, jacobian = np.empty((n, POSE)), np.empty((6, n))
    for i in range(m):
        arm_pose(q[i], parameters, frames, jacobian, places[i])
        out[i] = jacobian[:3]
    return places, out
