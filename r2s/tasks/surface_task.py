"""Base class of tasks on a surface: nominal plane, approach, force estimate, and functions for reward terms.

The task contains only the nominal plane. The true plane, stiffness and friction of the surface are part of the
dynamics (`dr=contact`, `arm.surface`). The policy observes a contact force that is estimated from q, dq and the
commanded torque. Neither observation nor controller uses the true force.
"""

from dataclasses import dataclass, field, replace
from functools import partial
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
LAG_M = 0.01  # m, lag of the tip behind its target, caused by damping at approach_speed and a friction error of 2 N
# With the default controller, an action of 1 adds this share of the largest force: 2 N of 20 N. On the model of
# elastic twin 0, policies wipe equally well with 1 N; with 5 N, they wipe worse than the controller alone
RESIDUAL = 0.1
FINE_M, FINE_V, FAR_N, FINE_N, HARD_N = 5e-3, 0.01, 5.0, 0.5, 10.0  # m, m/s, N: tanh scales
# 1/rad, see `cartesian_impedance`; low, because a null-space torque pushes the tip if joints stick. On models of
# twins 0 and 1, force errors of the reference controller are similar from 0.02 to 0.05, up to twice as large at 0.2
NULL_STIFFNESS = 0.05
REGULAR = 1e-3  # m^2/rad^2, regularization: the force estimate is 0 in directions in which no joint moves the tip
EXPECTED = 1.4e4, 1.25, 1.5, 0.3  # stiffness N/m, exponent, damping s/m, friction: mid-range of conf/dr/contact.yaml
POSTURES = 12  # approximate number of points per path for which r2s checks the reach


@dataclass(frozen=True)
class SurfaceTask(TipTask):
    """A task that presses the tip of a tool on a surface of roughly known position.

    A goal begins with 9 + n numbers: point of the nominal plane that the tip touches first, m; normal of the plane;
    two forces, N; start height of the tip's center above the touched point, m; start posture, rad.

    Attributes:
        ctrl_hz: policy rate. episode_s: length of an episode, s.
        force: (low, high) N, range of the requested forces. force_rate: N/s, rate of change of a requested force.
        approach_speed: m/s, speed of the target against the nominal normal; at the first touch, the tip is not
            faster than `approach_speed`.
        clearance: m, gap between tip and nominal plane at the start. spread: m, largest distance of a touched point
            from `point`. place, tilt: m and degrees, largest shift and tilt of the true plane from the nominal plane.
        point, normal: point, m, and normal of the nominal plane in the base frame; if None, those of a work table
            below the tip in home posture.
        tool: tool file that the stages load if robot.tool is null.
        torque_fraction, cutoff_hz, speed_noise: see `TipTask`.
        pool: number of different goals in a training run.
        stop: kind of stop in contact, a key of `r2s.physics.push_limit.STOPS`; if None, "release".
        model: model of the arm. own, parameters: default controller and its parameters. `with_model` sets model, own
            and parameters.
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
    approaches: ClassVar[int] = 1  # parameter APPROACH of the law `control=hybrid` (impedance.py)
    target_size: ClassVar[int] = 6

    def __post_init__(self):
        self.as_reach()  # raises UserError for a wrong rate
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
        """Raise UserError unless attribute `name` is (low, high) with 0 < low < high; `equal` allows low = high."""
        pair = getattr(self, name)
        numbers = isinstance(pair, tuple) and len(pair) == 2 and all(isinstance(x, int | float) for x in pair)
        if not numbers or not 0 < pair[0] <= pair[1] or (pair[0] == pair[1] and not equal):
            raise UserError(f"task.{name}: {pair} is not allowed; two numbers above 0 {unit} are, the lesser first")

    @property
    def beyond(self) -> float:
        """Largest distance, m, of the true surface from the nominal plane at a touched point."""
        return self.place + self.spread * float(np.tan(np.radians(self.tilt)))

    def with_model(self, robot: Robot, dynamics: Dynamics) -> Self:
        """Return the task with one arm's model, for the default controller and the force estimate.

        Raises:
            UserError: the robot has no tool, or cannot exert the largest force.
        """
        Tip(robot)
        task = replace(self, model=InverseDynamics(robot, dynamics), speed_noise=self.noise_for(dynamics))
        settings: dict[str, Any] = {"torque_fraction": self.torque_fraction, "null_stiffness": NULL_STIFFNESS}
        make = partial(cartesian_impedance, robot, task, dynamics, hybrid=True, **settings | self.own_settings)
        own = make(displacement=RESIDUAL * self.force[1] / make().parameters[K_DEFAULT])
        task._check_force(own)
        return replace(task, own=own, parameters=own.parameters)

    @property
    def own_settings(self) -> dict[str, Any]:
        """Settings of the default controller that differ from the defaults of `cartesian_impedance`."""
        return {}

    def controlled_by(self, controller: Controller) -> Self:
        """Return the task with `controller`; raise UserError if this controller cannot exert the largest force."""
        self._check_force(controller)
        return super().controlled_by(controller)

    def pushing_within(
        self, robot: Robot, friction: np.ndarray, force_max: float | None, speed_near: float | None
    ) -> Self:
        """Return the task with limits of speed and force at the nominal plane; the limits allow requested forces."""
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
        """Weights (k,) of the reward terms."""
        return np.ones(len(self.reward_terms))

    def plane(self, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
        """Return point (3,) m and normal (3,) of the nominal plane."""
        return nominal_plane(robot, self.point, self.normal)

    def expected(self, robot: Robot, dynamics: Dynamics) -> Dynamics:
        """Return the dynamics with a surface of medium stiffness in the nominal plane."""
        point, normal = self.plane(robot)
        return replace(dynamics, surface=Surface(point, normal, *EXPECTED))

    def begin(self, starts: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return (m, n) rad, start postures with the tip above the first touched points."""
        return goals[:, START : START + starts.shape[1]]

    def path(self, rng: np.random.Generator, axes: np.ndarray) -> np.ndarray:
        """Return (k, 3) m, random points that the tip touches, relative to `point`; axes (2, 3) span the plane."""
        raise NotImplementedError

    def contact(self, t: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return (m, 4), normal and requested force, N, for hybrid control at t (m,) s."""
        raise NotImplementedError

    def forces_of(self, rng: np.random.Generator) -> tuple[float, float]:
        """Return the two random forces of a goal, N."""
        raise NotImplementedError

    def goals(self, robot: Robot, rng: np.random.Generator, count: int) -> np.ndarray:
        """Return random goals (count, 9 + n or more); the class docstring describes a goal.

        Raises:
            UserError: the tip cannot reach a randomly drawn point.
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
        """Return the numbers after a goal's start posture, computed from `path` (k, 3) m; by default none."""
        return np.empty(0)

    def at(self, t: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return the point (m, 3) m of the nominal plane below the tip's target at the times t (m,) s."""
        return goals[:, POINT]

    def depth(self, t: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return (m,) m, the depth of the tip center's target below the nominal plane at the times t (m,) s.

        First, the depth grows at `approach_speed` until the tip touches the lowest surface that `place` and `tilt`
        allow; a tip on a higher surface touches earlier. Then, the depth grows at the speed `force_rate` / `spring`
        (N/s divided by N/m), up to the depth for the largest requested force.
        """
        height, K = goals[:, HEIGHT], self.spring
        touched = self.beyond + LAG_M - (height - self.clearance)  # m, depth at the lowest allowed surface
        slow, late = self.approach_speed * t - height, (t - self.down_s).clip(0.0)
        return np.minimum(
            slow.clip(None, touched) + self.force_rate / K * late, touched + goals[:, FORCES].max(1) / K
        )

    @property
    def down_s(self) -> float:
        """Time, s, at which the tip touches the lowest surface that `place` and `tilt` allow."""
        return (self.beyond + LAG_M + self.clearance) / self.approach_speed

    @property
    def spring(self) -> float:
        """Stiffness, N/m, of the spring in `controller`, or in the default controller if `controller` has none."""
        for control in (self.controller, self.own):
            if isinstance(control, Impedance) and control.parameters[K_DEFAULT] > 0:
                return float(control.parameters[K_DEFAULT])
        raise UserError(f"task: {type(self).__name__} needs a model of the arm; call with_model first")

    def observation_scale(self, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
        """Return fixed mean and standard deviation (3 n + 12,) that normalize observations."""
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
        """Return the terms of an observation in the order in which `observe` returns them."""
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
        """Return (m,) N, the contact force against `normal` (m, 3), estimated from q, dq and the last command.

        The estimate neglects accelerations: the force F is the least-squares solution of J^T F = tau - model(q, dq).
        At rest, joint friction causes an error of up to friction / lever arm. Errors of the arm's model bias the
        force estimate.
        """
        jacobian = self.tip(state.q)[1] if jacobian is None else jacobian
        q, dq = np.ascontiguousarray(state.q), np.ascontiguousarray(state.dq)
        external = state.tau - self.model(q, dq, np.zeros_like(q), dq)  # type: ignore[misc]
        square = jacobian @ jacobian.swapaxes(1, 2) + REGULAR * np.eye(3)
        force = np.linalg.solve(square, np.einsum("mkn,mn->mk", jacobian, external)[..., None])[..., 0]
        return -(force * normal).sum(1)

    def tip(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return position (m, 3) m and Jacobian (m, 3, n) m/rad of the tip's center at q (m, n) rad."""
        return arm_tips(np.ascontiguousarray(q), self.of_model("parameters"))

    def tip_velocity(self, state: State) -> np.ndarray:
        """Return (m, 3) m/s, the velocity of the tip's center in base axes."""
        return np.einsum("mkn,mn->mk", self.tip(state.q)[1], state.dq)

    def normals(self, goals: np.ndarray) -> np.ndarray:
        """Return (m, 3), the outward normals of the nominal plane."""
        return goals[:, NORMAL]

    def pressed(self, state: State, goals: np.ndarray, asked: np.ndarray) -> np.ndarray:
        """Return (m, 2) N, the force against the nominal normal, and the requested force `asked` (m,)."""
        none = np.zeros(len(goals))
        return np.stack([none if state.force is None else -(state.force * goals[:, NORMAL]).sum(1), asked], 1)


def near(error: np.ndarray, coarse: float, fine: float) -> np.ndarray:
    """Return 1 - tanh(error / coarse) / 2 - tanh(error / fine) / 2, which falls from 1 to 0 as `error` (m,) grows."""
    return 1.0 - 0.5 * (np.tanh(error / coarse) + np.tanh(error / fine))


def rough(ddq: np.ndarray) -> np.ndarray:
    """Return (m,), 0.03 times the sum over the joints of tanh(|ddq| / 10 rad/s^2), for ddq (m, n)."""
    return 0.03 * np.tanh(np.abs(ddq) / 10.0).sum(1)
