"""Arms that differ from the identified one are heard; a network learns what they lack (`adapt=history`) from that.

Another `Lesson` makes another network of the same: student.py.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Protocol

import numpy as np
import torch

from r2s.adaptation.balance import SPAN
from r2s.adaptation.believed import believed
from r2s.adaptation.history import Network, Seen
from r2s.errors import check_number
from r2s.learning.altered import altered, check_changes
from r2s.learning.randomization import Draw, carried
from r2s.physics.actuation import Actuation, low_pass_factor
from r2s.physics.dynamics import AXES, Dynamics
from r2s.physics.limits import limits
from r2s.physics.robot import SIM_DT, Robot
from r2s.physics.simulator import Simulator
from r2s.tasks.model_torque import ModelTorque
from r2s.tasks.task import State, Task
from r2s.tasks.track import TrackTask

QUIET, LOUD = 1e-3, 4e-3  # rad/s, of the speeds' noise before their filter
FILTER_HZ = 90.0  # of it
HELD_OUT = 0.1  # of the arms
BATCH, RATE = 512, 2e-3


@dataclass(frozen=True)
class Lessons:
    """What a network is taught with.

    Attributes:
        arms: at once. rounds: of them, an episode each. parts: of an episode, each with another arm.
        payload: least and most kg, put on at any time in the first half of a part. friction: least and most of what
            was identified. late: s, the most by which commands come later.
        hidden: units of each of two layers. epochs: passes over all. paths: drawn in all.
    """

    arms: int = 64
    rounds: int = 12
    parts: int = 1
    payload: tuple[float, float] = (0.0, 1.5)
    friction: tuple[float, float] = (0.7, 1.2)
    late: float = 0.005
    hidden: int = 128
    epochs: int = 30
    paths: int = 48

    def __post_init__(self):
        check_changes(self.payload, self.friction, self.late)
        for name in ("arms", "rounds", "parts", "hidden", "epochs", "paths"):
            check_number(f"training.{name}", getattr(self, name), "[1, inf)", whole=True)


def drawn(robot: Robot, draw: Draw, lessons: Lessons, rng: np.random.Generator) -> tuple[Dynamics, Dynamics]:
    """Return arms as `draw` has them with other friction and delay, without and with a payload."""
    base = altered(robot, draw, lessons.friction, lessons.late, rng, lessons.arms)
    return base, carried(robot, base, lessons.payload, rng, lessons.arms)


Answer = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]  # q, dq, ddq (n,) -> (k,)


class Lesson(Protocol):
    """What a network is to answer, and how an arm moves that has an answer.

    Attributes:
        count: numbers of an answer.
    """

    @property
    def count(self) -> int: ...  # noqa: D102 (said above)

    def answer(self, arm: Dynamics) -> Answer:
        """Return the right answers for one arm."""
        ...

    def target(self, state: State, goals: np.ndarray, torque: np.ndarray, answers: np.ndarray) -> np.ndarray:
        """Return (m, n) Nm, what arms that were given answers (m, k) are commanded."""
        ...


@dataclass(frozen=True)
class Lacking:
    """The `Lesson` of what an arm lacks: it moves by computed torque, and what is answered is added."""

    robot: Robot
    task: TrackTask
    center: Dynamics

    @property
    def count(self) -> int:
        """One of each joint."""
        return self.robot.n

    def answer(self, arm: Dynamics) -> Answer:
        """Return q, dq, ddq (n,) -> (n,) Nm, what this arm needs more than the one of `center`."""
        own, model = ModelTorque(self.robot, arm), ModelTorque(self.robot, self.center)

        def lacks(*motion: np.ndarray) -> np.ndarray:
            q, dq, ddq = (x[None] for x in motion)
            return (own(q, dq, ddq, dq) - model(q, dq, ddq, dq))[0]

        return lacks

    def target(self, state: State, goals: np.ndarray, torque: np.ndarray, answers: np.ndarray) -> np.ndarray:
        """Return (m, n) Nm."""
        none = np.zeros_like(state.q)
        return np.clip(self.task.target(none, state, goals, torque), -torque, torque) + answers


def heard(
    robot: Robot,
    task: Task,
    center: Dynamics,
    draw: Draw,
    lessons: Lessons,
    plans: np.ndarray,
    seed: int,
    lesson: Lesson,
) -> tuple[np.ndarray, np.ndarray]:
    """Return inputs (arms, spans, d) and answers (arms, spans, k), of an episode of each arm.

    Of the right answer each arm has a share that is drawn, so that there is motion with and without one.

    Args:
        robot, task: the arm, and what is asked of it. center: what is believed of it. draw: arms about `center`.
        lessons: see there. plans: goals, to choose from. seed: of the draws. lesson: what is answered.
    """
    rng, m, n = np.random.default_rng([seed, 17]), lessons.arms, robot.n
    arms = [d for _ in range(lessons.parts) for d in drawn(robot, draw, lessons, rng)]  # bare, laden, bare, ...
    answers = [[lesson.answer(d.one(k)) for k in range(m)] for d in arms]
    goals = plans[rng.integers(len(plans), size=m)]
    part = task.steps // lessons.parts
    helps, on = rng.uniform(0, 1.1, m).clip(0, 1), rng.integers(0, part // 2, (lessons.parts, m))
    sim, torque = Simulator(robot, arms[0], m, 1), task.torque(robot)
    sim.drive(limits(robot, torque))
    sim.reset(task.begin(np.tile(robot.q_home, (m, 1)), goals), np.zeros((m, n)))
    actuation = Actuation(robot, m, cutoff_hz=task.cutoff_hz)
    noise, factor = rng.uniform(QUIET, LOUD, (m, n)), low_pass_factor(FILTER_HZ)
    seen = [Seen(believed(robot, center)) for _ in range(m)]
    rows: list[list] = [[] for _ in range(m)]
    (filtered, before), right = np.zeros((2, m, n)), np.zeros((m, lesson.count))
    holds, never, limited = np.zeros(m, dtype=int), np.zeros(m, dtype=bool), np.zeros(m)
    for step in range(task.steps):
        now = min(step // part, lessons.parts - 1)
        laden = step - now * part >= on[now]
        for which in (0, 1):
            if (new := np.flatnonzero((laden == which) & (holds != 2 * now + which))).size:
                sim.set_dynamics(some(arms[2 * now + which], new), new)
                holds[new] = 2 * now + which
        t = np.full(m, step / task.ctrl_hz)
        share = (sim.limited - limited) / task.substeps
        state = State(t, sim.q, sim.dq, sim.ee, sim.jacobian, sim.tau, actuation.last, never, share)
        target, limited = lesson.target(state, goals, torque, helps[:, None] * right), sim.limited.copy()
        for _ in range(task.substeps):
            filtered += factor * (sim.dq + noise * rng.normal(size=(m, n)) - filtered)
            q = sim.q.copy()
            sim.rollout(actuation(target, 1), record=())
            sent = sim.tau
            for k in range(m):
                inputs = seen[k](q[k], filtered[k], sent[k])
                if inputs is not None:
                    ddq = (sim.dq[k] - before[k]) / (SPAN * SIM_DT)
                    before[k] = sim.dq[k]
                    right[k] = answers[holds[k]][k](sim.q[k], sim.dq[k], ddq)
                    rows[k].append((inputs, right[k].copy()))
        sim.kinematics()
    return np.array([[x for x, _ in row] for row in rows]), np.array([[y for _, y in row] for row in rows])


def some(dynamics: Dynamics, ids: np.ndarray) -> Dynamics:
    """Return those of a batch that `ids` (k,) numbers; fields that all arms share stay as they are."""
    values = {name: (getattr(dynamics, name), axes) for name, axes in AXES.items()}
    return replace(dynamics, **{name: v[ids] for name, (v, axes) in values.items() if np.ndim(v) > axes})


def fit(inputs: np.ndarray, lacks: np.ndarray, lessons: Lessons, seed: int) -> tuple[Network, float]:
    """Return the network, and which share of what lacked it explains of arms that it was not taught with.

    Args:
        inputs: (E, spans, d). lacks: (E, spans, n) Nm. lessons: see there. seed: of weights and batches.
    """
    generator = torch.Generator().manual_seed(seed)
    test = max(1, round(HELD_OUT * len(inputs)))
    mean, scale = inputs[test:].mean((0, 1)), inputs[test:].std((0, 1)) + 1e-6
    size = np.sqrt((lacks[test:] ** 2).mean((0, 1))) + 1e-6
    x = torch.from_numpy((inputs - mean) / scale).float()
    y = torch.from_numpy(lacks / size).float()
    torch.manual_seed(seed)
    widths = (x.shape[-1], lessons.hidden, lessons.hidden, y.shape[-1])
    linear = [torch.nn.Linear(a, b) for a, b in pairwise(widths)]
    net = torch.nn.Sequential(linear[0], torch.nn.Tanh(), linear[1], torch.nn.Tanh(), linear[2])
    rows, targets = x[test:].reshape(-1, x.shape[-1]), y[test:].reshape(-1, y.shape[-1])
    steps = lessons.epochs * -(-len(rows) // BATCH)
    optimizer = torch.optim.AdamW(net.parameters(), lr=RATE, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=steps)
    for _ in range(lessons.epochs):
        order = torch.randperm(len(rows), generator=generator)
        for batch in order.split(BATCH):
            loss = torch.nn.functional.mse_loss(net(rows[batch]), targets[batch])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
    with torch.no_grad():
        left = float(((net(x[:test]) - y[:test]) ** 2).mean() / (y[:test] ** 2).mean())
    layers = tuple(p.detach().numpy().astype(float).T.copy() for layer in linear for p in (layer.weight, layer.bias))
    return Network(mean, scale, size, layers), 1.0 - left


def teach(
    robot: Robot,
    task: TrackTask,
    center: Dynamics,
    draw: Draw,
    lessons: Lessons,
    seed: int,
    progress: Callable[[int, int], None],
) -> tuple[Network, float]:
    """Return the network for the arm of `center`, and what it explains; arguments as of `heard`.

    progress: called with the rounds that were heard, and all.
    """
    task = task.believing(robot, center)
    return learn(robot, task, center, draw, lessons, seed, progress, Lacking(robot, task, center))


def learn(
    robot: Robot,
    task: Task,
    center: Dynamics,
    draw: Draw,
    lessons: Lessons,
    seed: int,
    progress: Callable[[int, int], None],
    lesson: Lesson,
) -> tuple[Network, float]:
    """Return the network that learnt `lesson`, and what it explains; other arguments as of `teach`."""
    plans, heard_of = task.goals(robot, np.random.default_rng([seed, 3]), lessons.paths), []
    for k in range(lessons.rounds):
        heard_of.append(heard(robot, task, center, draw, lessons, plans, seed + 1000 * k, lesson))
        progress(k + 1, lessons.rounds)
    inputs, answers = (np.concatenate([h[i] for h in heard_of]) for i in (0, 1))
    return fit(inputs, answers, lessons, seed)
