"""Train `adapt=history`: arms that differ from the identified one follow paths; a network learns what they lack."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch

from r2s.adaptation.balance import SPAN
from r2s.adaptation.believed import believed
from r2s.adaptation.history import Network, Seen
from r2s.errors import check_number
from r2s.learning.randomization import Draw, carried, check_payload
from r2s.physics.actuation import Actuation, low_pass_factor
from r2s.physics.dynamics import AXES, Dynamics
from r2s.physics.limits import limits
from r2s.physics.robot import SIM_DT, Robot
from r2s.physics.simulator import Simulator
from r2s.tasks.model_torque import ModelTorque
from r2s.tasks.task import State
from r2s.tasks.track import TrackTask

QUIET, LOUD = 1e-3, 4e-3  # rad/s, of the speeds' noise before their filter
FILTER_HZ = 90.0  # of it
LEVEL = ("coulomb", "viscous", "phi1")  # parameters of friction families that a warmth multiplies
HELD_OUT = 0.1  # of the arms
BATCH, RATE = 512, 2e-3


@dataclass(frozen=True)
class Lessons:
    """What a network is taught with.

    Attributes:
        arms: at once. rounds: of them, an episode each. payload: least and most kg, put on at any time in half of an
            episode. friction: least and most of what was identified. late: s, the most by which commands come later.
        hidden: units of each of two layers. epochs: passes over all. paths: drawn in all.
    """

    arms: int = 64
    rounds: int = 12
    payload: tuple[float, float] = (0.0, 1.5)
    friction: tuple[float, float] = (0.7, 1.2)
    late: float = 0.005
    hidden: int = 128
    epochs: int = 30
    paths: int = 48

    def __post_init__(self):
        check_payload(self.payload)
        for name in ("arms", "rounds", "hidden", "epochs", "paths"):
            check_number(f"training.{name}", getattr(self, name), "[1, inf)", whole=True)
        check_number("training.late", self.late, "[0, 0.01]")


def drawn(robot: Robot, draw: Draw, lessons: Lessons, rng: np.random.Generator) -> tuple[Dynamics, Dynamics]:
    """Return arms as `draw` has them with other friction and delay, without and with a payload."""
    m = lessons.arms
    base = draw(rng, m)
    names = base.family.names[: base.phi.shape[-1]]
    scale = np.where([n in LEVEL for n in names], rng.uniform(*lessons.friction, (m, robot.n, 1)), 1.0)
    late = base.delay + rng.uniform(0, lessons.late, m)
    base = replace(base, phi=base.phi * scale, delay=late)
    return base, carried(robot, base, lessons.payload, rng, m)


def lacking(robot: Robot, center: Dynamics, arm: Dynamics) -> Callable[..., np.ndarray]:
    """Return (q, dq, ddq (k, n)) -> (k, n) Nm, what this arm needs more than the one of `center`."""
    own, model = ModelTorque(robot, arm), ModelTorque(robot, center)
    return lambda q, dq, ddq: own(q, dq, ddq, dq) - model(q, dq, ddq, dq)


def heard(
    robot: Robot, task: TrackTask, center: Dynamics, draw: Draw, lessons: Lessons, plans: np.ndarray, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return inputs (arms, spans, d) and what lacked (arms, spans, n) Nm, of an episode of each arm.

    Arms are commanded by computed torque with the model; of what lacks a share that is drawn for each arm is added,
    as an adapter would, so that there is motion with and without one.

    Args:
        robot, task: the arm, and which paths it follows, with `center` as its model. draw: arms about `center`.
        lessons: see there. plans: to choose from. seed: of the draws.
    """
    rng, m, n = np.random.default_rng([seed, 17]), lessons.arms, robot.n
    bare, full = drawn(robot, draw, lessons, rng)
    lacks = [[lacking(robot, center, d.one(k)) for k in range(m)] for d in (bare, full)]
    goals = plans[rng.integers(len(plans), size=m)]
    helps, on = rng.uniform(0, 1.1, m).clip(0, 1), rng.integers(0, task.steps // 2, m)
    sim, torque = Simulator(robot, bare, m, 1), task.torque(robot)
    sim.drive(limits(robot, torque))
    sim.reset(task.begin(np.tile(robot.q_home, (m, 1)), goals), np.zeros((m, n)))
    actuation = Actuation(robot, m, cutoff_hz=task.cutoff_hz)
    noise, factor = rng.uniform(QUIET, LOUD, (m, n)), low_pass_factor(FILTER_HZ)
    seen = [Seen(believed(robot, center)) for _ in range(m)]
    rows: list[list] = [[] for _ in range(m)]
    filtered, before, more, none = (np.zeros((m, n)) for _ in range(4))
    holds, never = np.zeros(m, dtype=int), np.zeros(m, dtype=bool)
    for step in range(task.steps):
        if (new := np.flatnonzero(on == step)).size:
            sim.set_dynamics(some(full, new), new)
            holds[new] = 1
        t = np.full(m, step / task.ctrl_hz)
        state = State(t, sim.q, sim.dq, sim.ee, sim.jacobian, sim.tau, none, never, none[:, 0])
        target = np.clip(task.target(none, state, goals, torque), -torque, torque) + helps[:, None] * more
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
                    more[k] = lacks[holds[k]][k](sim.q[k][None], sim.dq[k][None], ddq[None])[0]
                    rows[k].append((inputs, more[k].copy()))
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
    plans, heard_of = task.goals(robot, np.random.default_rng([seed, 3]), lessons.paths), []
    for k in range(lessons.rounds):
        heard_of.append(heard(robot, task, center, draw, lessons, plans, seed + 1000 * k))
        progress(k + 1, lessons.rounds)
    inputs, lacks = (np.concatenate([h[i] for h in heard_of]) for i in (0, 1))
    return fit(inputs, lacks, lessons, seed)
