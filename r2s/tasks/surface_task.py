"""What tasks on a surface share: a nominal plane, a way down to it, an estimate of the force, its reward terms.

The arm knows a nominal plane. The true one, its stiffness and its friction are part of the dynamics (`dr=contact`,
`arm.surface`). Neither observation nor controller contains the true force. The policy observes an estimate from q, dq
and the commanded torque.
"""

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import numpy as np

from r2s.control.controller import Controller
from r2s.control.impedance import Impedance, cartesian_impedance
from r2s.errors import UserError, check_number
from r2s.physics.dynamics import Dynamics
from r2s.physics.impedance import FORCE_MAX, K_DEFAULT, arm_tips
from r2s.physics.inverse_dynamics import InverseDynamics
from r2s.physics.push_limit import push_limit
from r2s.physics.robot import Robot
from r2s.physics.surface import Surface
from r2s.physics.tip import Tip, nominal_plane
from r2s.tasks.task import ObservationTerm, State
from r2s.tasks.tip_task import TipTask

POINT, NORMAL, FORCES, HEIGHT, START = slice(0, 3), slice(3, 6), slice(6, 8), 8, 9  # columns of a goal
LAG_M = 0.01  # m, by which the tip may follow its target: damping at approach_speed, and 2 N of wrong friction
RESIDUAL_M = 5e-3  # m, displacement of an action of 1 under the task's own controller: a quarter of 20 N on the Panda
FINE_M, FINE_V, FAR_N, FINE_N, HARD_N = 5e-3, 0.01, 5.0, 0.5, 10.0  # m, m/s, N: tanh scales
# 1/rad, see `cartesian_impedance`: where joints stick, a torque of the null space reaches the tip. From 0.02 to 0.05
# the forces of press.py on twins 0 and 1 are alike, at 0.2 a fifth worse
NULL_STIFFNESS = 0.05
REGULAR = 1e-3  # m^2/rad^2, of the least squares of the force: blind directions of the Jacobian count as force-free
EXPECTED = 1.4e4, 1.25, 1.5, 0.3  # stiffness N/m, exponent, damping s/m, friction: middle of conf/dr/contact.yaml
POSTURES = 12  # of a path, which the arm must reach


@dataclass(frozen=True)
class SurfaceTask(TipTask):
    """A task that presses a tool's tip on a surface of roughly known place.

    A goal begins with the row (9 + n,): the first touched point of the nominal plane m, its normal, two forces N,
    height of the tip above the point at the start m, and the start posture rad.

    Attributes:
        ctrl_hz: policy rate. episode_s: length of an episode, s.
        force: (low, high) N, drawn forces. force_rate: N/s, at which the asked force moves.
        approach_speed: m/s, of the target along the nominal normal, so the largest speed of a touch.
        clearance: m, height of the tip above the nominal plane at the start. spread: m, of the touched points about
            `point`. place: m and tilt: degrees, by which the true plane may differ from the nominal one.
        point, normal: of the nominal plane in the base frame, m; None: a table below the tip at home.
        tool: tool file of the robot if robot.tool is null; the stages read it.
        torque_fraction, cutoff_hz, speed_noise: see `TipTask`.
        pool: number of goals that a training draws from.
        stop: what a stop does with a force, of `r2s.physics.push_limit.STOPS`; None: release.
        model, own, parameters: the identified arm, the task's own controller and its parameters; see `with_model`.
    """

    ctrl_hz: int = 100
    episode_s: float = 7.0
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
    torque_fraction: float | tuple[float, ...] = 0.5
    cutoff_hz: float = 100.0
    speed_noise: float | None = None
    pool: int = 512
    stop: str | None = None
    model: InverseDynamics | None = field(default=None, repr=False)
    parameters: np.ndarray | None = field(default=None, repr=False)
    own: Impedance | None = field(default=None, repr=False)
    touches = True
    approaches: ClassVar[int] = 1  # read by `control=hybrid`: its law's APPROACH
    target_size: ClassVar[int] = 6

    def __post_init__(self):
        self.as_reach()  # raises for a wrong rate
        for name, low in (("force_rate", 1e-3), ("approach_speed", 1e-4), ("clearance", 1e-4)):
            check_number(f"task.{name}", getattr(self, name), f"[{low:g}, inf)")
        check_number("task.pool", self.pool, "[1, inf)", whole=True)
        check_number("task.place", self.place, "[0, inf)")
        check_number("task.tilt", self.tilt, "[0, 45]")
        check_number("task.spread", self.spread, "[0, inf)")
        self._check_range("force", "N")
        if self.clearance <= self.beyond:
            raise UserError(
                f"task.clearance: {self.clearance:g} m may lie inside the surface; more than {self.beyond:.3g} m is "
                "allowed, for place, spread and tilt"
            )

    def _check_range(self, name: str, unit: str, equal: bool = False) -> None:
        """Raise UserError unless an attribute is (low, high), above 0; `equal`: both may be the same."""
        pair = getattr(self, name)
        numbers = isinstance(pair, tuple) and len(pair) == 2 and all(isinstance(x, int | float) for x in pair)
        if not numbers or not 0 < pair[0] <= pair[1] or (pair[0] == pair[1] and not equal):
            raise UserError(f"task.{name}: {pair} is not allowed; two numbers above 0 {unit} are, the lesser first")

    @property
    def beyond(self) -> float:
        """Largest distance, m, of the true surface from the nominal plane at a touched point."""
        return self.place + self.spread * float(np.tan(np.radians(self.tilt)))

    def with_model(self, robot: Robot, dynamics: Dynamics) -> Self:
        """Return the task with the model of one arm, for its controller and for the estimate of the force.

        Raises:
            UserError: the robot has no tool, or cannot exert the forces.
        """
        Tip(robot)
        task = replace(self, model=InverseDynamics(robot, dynamics), speed_noise=self.noise_for(dynamics))
        settings = {"torque_fraction": self.torque_fraction, "displacement": RESIDUAL_M} | {
            "null_stiffness": NULL_STIFFNESS,
            **self.own_settings,
        }
        own = cartesian_impedance(robot, task, dynamics, hybrid=True, **settings)
        task._check_force(own)
        return replace(task, own=own, parameters=own.parameters)

    @property
    def own_settings(self) -> dict[str, Any]:
        """Settings of the task's own controller that differ from the defaults of `cartesian_impedance`."""
        return {}

    def controlled_by(self, controller: Controller) -> Self:
        """Return the task with this controller; raise UserError if it cannot exert the forces."""
        self._check_force(controller)
        return super().controlled_by(controller)

    def pushing_within(
        self, robot: Robot, friction: np.ndarray, force_max: float | None, speed_near: float | None
    ) -> Self:
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
                    f"task.force: expected at most {most:.3g} N, which torque_fraction allows, got "
                    f"{self.force[1]:g} N"
                )

    @property
    def paper_weights(self) -> np.ndarray:
        """(k,), the weights of the reward terms."""
        return np.ones(len(self.reward_terms))

    def plane(self, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
        """Return point (3,) m and normal (3,) of the nominal plane."""
        return nominal_plane(robot, self.point, self.normal)

    def expected(self, robot: Robot, dynamics: Dynamics) -> Dynamics:
        """Return the dynamics with a surface of middling stiffness in the nominal plane."""
        point, normal = self.plane(robot)
        return replace(dynamics, surface=Surface(point, normal, *EXPECTED))

    def begin(self, starts: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return (m, n) rad, postures above the first touched points."""
        return goals[:, START : START + starts.shape[1]]

    def path(self, rng: np.random.Generator, axes: np.ndarray) -> np.ndarray:
        """Return (k, 3) m, drawn points about task.point that the tip touches; axes (2, 3) span the plane."""
        raise NotImplementedError

    def contact(self, t: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return (m, 4), normal and force N of hybrid control at t (m,) s."""
        raise NotImplementedError

    def forces_of(self, rng: np.random.Generator) -> tuple[float, float]:
        """Return two drawn forces, N."""
        raise NotImplementedError

    def goals(self, robot: Robot, rng: np.random.Generator, count: int) -> np.ndarray:
        """Return goals (count, 9 + n), see the class.

        Raises:
            UserError: the tip does not reach the plane.
        """
        point, normal = self.plane(robot)
        tip = Tip(robot)
        rows: list[np.ndarray] = []
        across = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
        across /= np.linalg.norm(across)
        axes = np.stack([across, np.cross(normal, across)])
        height = self.clearance + robot.tool.radius  # type: ignore[union-attr]
        for _ in range(count):
            for _ in range(20):
                path = point + self.path(rng, axes)
                some = path[:: max(1, len(path) // POSTURES)] + height * normal
                postures = [q for q in map(tip.posture, some) if q is not None]
                if len(postures) == len(some):
                    break
            else:
                raise UserError(
                    f"task.point: the tip of {robot.name} does not reach {np.round(point, 3).tolist()} m; choose a "
                    "nearer one"
                )
            rows.append(
                np.concatenate([path[0], normal, self.forces_of(rng), [height], postures[0], self.rest_of(path)])
            )
        return np.array(rows)

    def rest_of(self, path: np.ndarray) -> np.ndarray:
        """Return the part of `path` (k, 3) m that a goal stores after its start posture."""
        return np.empty(0)

    def at(self, t: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return (m, 3) m, the point of the nominal plane below the target at t (m,) s."""
        return goals[:, POINT]

    def depth(self, t: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return (m,) m, how far the target of the tip's centre is below the nominal plane at t (m,) s.

        It moves at approach_speed until the tip has touched for sure, then so that the force rises at force_rate.
        """
        height, K = goals[:, HEIGHT], self.spring
        touched = self.beyond + LAG_M - (height - self.clearance)  # the tip's centre is a radius above its surface
        slow, late = self.approach_speed * t - height, (t - self.down_s).clip(0.0)
        return np.minimum(
            slow.clip(None, touched) + self.force_rate / K * late, touched + goals[:, FORCES].max(1) / K
        )

    @property
    def down_s(self) -> float:
        """When the tip has touched for sure, s."""
        return (self.beyond + LAG_M + self.clearance) / self.approach_speed

    @property
    def spring(self) -> float:
        """The stiffness, N/m, of the controller's spring; of the task's own one if it has none."""
        for control in (self.controller, self.own):
            if isinstance(control, Impedance) and control.parameters[K_DEFAULT] > 0:
                return float(control.parameters[K_DEFAULT])
        raise UserError(f"task: {type(self).__name__} needs a model of the arm; call with_model first")

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
        place, jacobian = self.tip(state.q)
        normal = goals[:, NORMAL]
        offset = place - self.at(state.t, goals)
        height, velocity = (offset * normal).sum(1), np.einsum("mkn,mn->mk", jacobian, state.dq)
        rate = (velocity * normal).sum(1)
        force, asked = self.estimate(state, normal, jacobian), self.contact(state.t, goals)[:, 3]
        ahead = height + self.depth(state.t, goals)
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
            ObservationTerm(f"tanh(ahead / {FINE_M:g} m)", "1", "above_target", divided_by=FINE_M, tanh=True),
            ObservationTerm("effort / torque", "1", "effort", divided_by=torque),
            ObservationTerm("limited", "1", "limited"),
        ]

    def estimate(self, state: State, normal: np.ndarray, jacobian: np.ndarray | None = None) -> np.ndarray:
        """Return (m,) N, the estimated force against the normal (m, 3), of q, dq and the last command.

        Quasi-static: least squares of J^T F = tau - model(q, dq). At rest friction hides up to its level over the
        lever; errors of the model are its bias.
        """
        jacobian = self.tip(state.q)[1] if jacobian is None else jacobian
        q, dq = np.ascontiguousarray(state.q), np.ascontiguousarray(state.dq)
        external = state.tau - self.model(q, dq, np.zeros_like(q), dq)  # type: ignore[misc]
        square = jacobian @ jacobian.swapaxes(1, 2) + REGULAR * np.eye(3)
        force = np.linalg.solve(square, np.einsum("mkn,mn->mk", jacobian, external)[..., None])[..., 0]
        return -(force * normal).sum(1)

    def tip(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return place (m, 3) m and Jacobian (m, 3, n) m/rad of the tip's centre at q (m, n) rad."""
        return arm_tips(np.ascontiguousarray(q), self.of_model("parameters"))

    def tip_velocity(self, state: State) -> np.ndarray:
        """Return (m, 3) m/s, the velocity of the tip's centre in base axes."""
        return np.einsum("mkn,mn->mk", self.tip(state.q)[1], state.dq)

    def normals(self, goals: np.ndarray) -> np.ndarray:
        """Return (m, 3), the outward normals of the nominal plane."""
        return goals[:, NORMAL]

    def pressed(self, state: State, goals: np.ndarray, asked: np.ndarray) -> np.ndarray:
        """Return (m, 2) N, the force against the nominal normal, and the asked one (m,)."""
        none = np.zeros(len(goals))
        return np.stack([none if state.force is None else -(state.force * goals[:, NORMAL]).sum(1), asked], 1)


def near(error: np.ndarray, coarse: float, fine: float) -> np.ndarray:
    """Return 1 - tanh(error / coarse) / 2 - tanh(error / fine) / 2: 1 for no error (m,), 0 for a large one."""
    return 1.0 - 0.5 * (np.tanh(error / coarse) + np.tanh(error / fine))


def rough(ddq: np.ndarray) -> np.ndarray:
    """Return (m,) 0.03 sum tanh(|ddq| / 10 rad/s^2) of ddq (m, n)."""
    return 0.03 * np.tanh(np.abs(ddq) / 10.0).sum(1)
