"""`task=wipe`: follow a timed path on a surface of roughly known position while pressing with a normal force."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import numpy as np
from scipy.interpolate import CubicSpline

from r2s.control.impedance import fastest_spring
from r2s.errors import UserError, check_number, instead_of
from r2s.physics.dynamics import Dynamics
from r2s.physics.impedance import SLIDES
from r2s.physics.inverse_dynamics import InverseDynamics
from r2s.physics.robot import Robot
from r2s.physics.tip import Tip
from r2s.tasks.measures import MeasureTable
from r2s.tasks.surface_task import FAR_N, HARD_N, NORMAL, SurfaceTask, near, rough
from r2s.tasks.task import Episodes, ObservationTerm, State
from r2s.tasks.trajectory import KINDS, V, X, clock, curve
from r2s.tasks.wipe_measures import GOOD_M, GOOD_N, WIPE, wipe_measures

A = slice(6, 9)  # columns of the acceleration in a path, after position and velocity
SLOW_V = 0.01  # m/s, tip speed from which the expected friction of the surface is constant
FAR_M = 0.01  # m, tanh scale of the path error
REST_S = 0.3  # s, pause at full force before the path, and pause after the path
STEADY = 0.25  # integral rate as a share of its stability limit: a gain margin of 12 dB


@dataclass(frozen=True)
class WipeTask(SurfaceTask):
    """Wipe a surface; a `Task` (r2s/tasks/task.py) from conf/task/wipe.yaml.

    A goal begins as in `SurfaceTask`; its two forces, at the start and the end of the path, are equal in random
    goals. A goal ends with the path: one row (9,) of position, velocity and acceleration for the start and for each
    step.

    Attributes:
        speed: (low, high) m/s, range of random peak speeds. size: (low, high) m, range of random path radii. kinds:
            curves from KINDS, equally probable. ramp_s: s, duration of acceleration and of deceleration on a path.
        friction: expected friction coefficient of the surface. Other attributes: see `SurfaceTask`.
        inertia: (3, 3) kg, effective mass matrix of the tip at the nominal plane.
    """

    episode_s: float = 8.0
    spread: float = 0.08
    speed: tuple[float, float] = (0.05, 0.2)
    size: tuple[float, float] = (0.03, 0.05)
    kinds: tuple[str, ...] = KINDS
    ramp_s: float = 0.4
    friction: float = 0.3
    inertia: np.ndarray = field(default=None, repr=False)  # type: ignore[arg-type, assignment]
    measure_table: ClassVar[MeasureTable] = WIPE
    approaches: ClassVar[int] = SLIDES
    reward_terms = "force", "path", "precision", "excess", "smoothness", "filter_penalty"
    observation_summary = (
        "q dq tip tanh(height/5 mm) tip_velocity tanh(rate/0.01) force/20 tanh(force_error/10) ahead/5mm effort "
        "limited tanh(path_error/3 mm) path_velocity; rad, rad/s, m, m/s, N"
    )

    def __post_init__(self):
        super().__post_init__()
        self._check_range("speed", "m/s", equal=True)
        self._check_range("size", "m", equal=True)
        for kind in self.kinds or ("",):
            if kind not in KINDS:
                raise UserError(f"task.kinds: '{kind}'; {instead_of(kind, KINDS)}")
        check_number(
            "task.size", self.size[1], f"(0, {self.spread / np.sqrt(2):.3g}]"
        )  # `path` centers the bounding box, whose corners are up to sqrt(2) size away
        check_number("task.ramp_s", self.ramp_s, "(0, inf)")
        check_number("task.friction", self.friction, "[0, inf)")
        check_number("task.episode_s", self.episode_s, f"[{self.begin_s + 2 * self.ramp_s + REST_S:g}, 60]")

    @property
    def begin_s(self) -> float:
        """Start time, s, of the path; by then, the tip presses with full force even on the lowest allowed surface."""
        return self.down_s + self.force[1] / self.force_rate + REST_S

    def with_model(self, robot: Robot, dynamics: Dynamics) -> Self:
        """Return the task with the model `dynamics` of one arm, and with `inertia`; see `SurfaceTask.with_model`."""
        tip = Tip(robot)
        q = tip.posture(self.plane(robot)[0])
        q = robot.q_home if q is None else q  # if the point is out of reach, `goals` raises an error
        jacobian, mass = tip(q)[1], InverseDynamics(robot, dynamics).mass(q[None])[0]
        inertia = np.linalg.inv(jacobian @ np.linalg.solve(mass, jacobian.T))
        return super(WipeTask, replace(self, inertia=inertia)).with_model(robot, dynamics)

    @property
    def own_settings(self) -> dict[str, Any]:
        """Stiffness K, N/m, and integral rate r, 1/s, of the default controller, derived from the tip's inertia.

        To follow a path, the spring is as stiff as latency allows: K = m w^2, where m is the smallest effective mass
        and w the result of `fastest_spring`. With critical damping, the loop of the largest effective mass M has the
        characteristic equation M s^3 + 2 (K M)^(1/2) s^2 + K s + K r = 0. The loop is stable for r < r0 = 2
        (K/M)^(1/2) (Routh, Hurwitz); r2s sets r = STEADY r0.
        """
        masses = np.linalg.eigvalsh(self.inertia)
        K = float(masses[0] * fastest_spring(self) ** 2)
        return {"stiffness": K, "integral_rate": float(STEADY * 2.0 * np.sqrt(K / masses[-1]))}

    def path(self, rng: np.random.Generator, axes: np.ndarray) -> np.ndarray:
        """Return (steps + 1, 3) m, a random curve with peak speed ~ U(speed) at a random position within `spread`."""
        size, speed = rng.uniform(*self.size), rng.uniform(*self.speed)
        shape = curve(self.kinds[rng.integers(len(self.kinds))], rng, size, axes)
        t = np.arange(self.steps + 1) / self.ctrl_hz - self.begin_s
        path = shape(speed * clock(t.clip(0.0), self.episode_s - REST_S - self.begin_s, self.ramp_s)[0])
        flat = path @ axes.T  # centered in the plane's axes, so that the path stays in the plane
        flat -= 0.5 * (flat.max(0) + flat.min(0))
        free = self.spread - np.linalg.norm(flat, axis=1).max()
        about, away = rng.uniform(0, 2 * np.pi), free * np.sqrt(rng.uniform())
        return (flat + away * np.array([np.cos(about), np.sin(about)])) @ axes

    def forces_of(self, rng: np.random.Generator) -> tuple[float, float]:
        """Return a random force ~ U(force), N, twice: for the start and for the end of the path."""
        force = rng.uniform(*self.force)
        return force, force

    def rest_of(self, path: np.ndarray) -> np.ndarray:
        """Return the path as 9 (steps + 1) numbers: rows of position m, velocity m/s and acceleration m/s^2."""
        spline = CubicSpline(np.arange(len(path)) / self.ctrl_hz, path)
        return np.hstack([path, spline(spline.x, 1), spline(spline.x, 2)]).ravel()

    def rows(self, goals: np.ndarray) -> np.ndarray:
        """Return (m, steps + 1, 9), the paths of the goals."""
        return goals[:, -9 * (self.steps + 1) :].reshape(len(goals), -1, 9)

    def now(self, t: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return (m, 9), position, velocity and acceleration of the paths at t (m,) s, interpolated linearly."""
        rows, which = self.rows(goals), np.arange(len(t))
        k = (t * self.ctrl_hz).clip(0.0, self.steps)
        low = np.minimum(k.astype(np.int64), self.steps - 1)
        share = (k - low)[:, None]
        return (1.0 - share) * rows[which, low] + share * rows[which, low + 1]

    def goal_positions(self, goals: np.ndarray) -> np.ndarray:
        """Return (m, steps, 3) m, the path on the nominal plane after each step."""
        return self.rows(goals)[:, 1:, X]

    def at(self, t: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return (m, 3) m, the point of the path at t (m,) s."""
        return self.now(t, goals)[:, X]

    def contact(self, t: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return (m, 4), normal and requested force N, for hybrid control; force is linear in time along the path."""
        share = ((t - self.begin_s) / (self.episode_s - REST_S - self.begin_s)).clip(0.0, 1.0)
        force = goals[:, 6] + share * (goals[:, 7] - goals[:, 6])
        return np.concatenate([goals[:, NORMAL], force[:, None]], axis=1)

    def target(self, t: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return the target (m, 6) of impedance control half a control period after t (m,) s.

        The target consists of position (m, 3) m, then velocity (m, 3) m/s.
        """
        middle, normal = t + 0.5 / self.ctrl_hz, goals[:, NORMAL]
        now, down = self.now(middle, goals), self.depth(middle, goals)[:, None] * normal
        return np.concatenate([now[:, X] - down, now[:, V]], axis=1)

    def pull(self, t: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Return the feedforward force (m, 3) N: inertial force along the path plus expected friction."""
        now, force = self.now(t + 0.5 / self.ctrl_hz, goals), self.contact(t, goals)[:, 3:]
        speed = np.linalg.norm(now[:, V], axis=1, keepdims=True)
        return now[:, A] @ self.inertia + self.friction * force * now[:, V] / np.maximum(speed, SLOW_V)

    def observation_scale(self, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
        """Return fixed mean and standard deviation (3 n + 18,) that normalize observations."""
        mean, std = super().observation_scale(robot)
        return np.append(mean, np.zeros(6)), np.concatenate([std, np.ones(3), np.full(3, 0.5 * self.speed[1])])

    def observe(self, state: State, goals: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Return the observations (m, 3 n + 18) float32; see `observation_terms`."""
        n, now, normal = state.q.shape[1], self.now(state.t, goals), goals[:, NORMAL]
        first = super().observe(state, goals, torque)
        offset = first[:, 2 * n : 2 * n + 3]
        away = offset - (offset * normal).sum(1, keepdims=True) * normal
        return np.concatenate([first, np.tanh(away / GOOD_M), now[:, V]], axis=1, dtype=np.float32)

    def observation_terms(self, robot: Robot) -> list[ObservationTerm]:
        """Return the terms of an observation in the order in which `observe` returns them."""
        return [
            *super().observation_terms(robot),
            ObservationTerm(f"tanh(path error / {GOOD_M:g} m)", "1", "path_error", divided_by=GOOD_M, tanh=True),
            ObservationTerm("velocity of the path", "m/s", "velocity"),
        ]

    def forces(self, state: State, goals: np.ndarray) -> np.ndarray:
        """Return (m, 2) N, the force on the surface against the nominal normal, and the requested force."""
        return self.pressed(state, goals, self.contact(state.t, goals)[:, 3])

    def judge(
        self, state: State, ddq: np.ndarray, goals: np.ndarray, scale: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the distance d (m,) m from the path along the nominal plane, and the reward terms (m, 6).

        Terms, with the force error e = exerted - requested force: force = -tanh(|e| / 5 N); path = -tanh(d / 1 cm);
        precision = `near`(|e|, 5 N, 2 N) `near`(d, 1 cm, 3 mm); excess = -tanh(max(e, 0) / 10 N); smoothness = -0.03
        sum tanh(|ddq| / 10 rad/s^2); filter_penalty = -`State.limited`.
        """
        beyond, normal = -np.diff(self.forces(state, goals))[:, 0], goals[:, NORMAL]
        offset = self.tip(state.q)[0] - self.at(state.t, goals)
        away = np.linalg.norm(offset - (offset * normal).sum(1, keepdims=True) * normal, axis=1)
        error, precise = np.abs(beyond), near(np.abs(beyond), FAR_N, GOOD_N) * near(away, FAR_M, GOOD_M)
        terms = [-np.tanh(error / FAR_N), -np.tanh(away / FAR_M), precise, -np.tanh(beyond.clip(0.0) / HARD_N)]
        return away, np.stack([*terms, -rough(ddq), -state.limited], axis=1)

    def measures(self, episodes: Episodes) -> dict[str, float]:
        """Return one row of evaluations.csv; see `wipe_measures`."""
        return wipe_measures(episodes, round(self.begin_s * self.ctrl_hz), self.ctrl_hz)

    def score(self, row: Mapping[str, float]) -> float:
        """Return 100 (wiped - stopped), where `wiped` is a share of steps, and `stopped` a share of episodes."""
        return 100 * (row["wiped"] - row["stopped"])
