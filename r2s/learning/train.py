"""Train any algorithm: act, step all arms, store transitions, update, and evaluate at intervals.

The budget limits wall-clock minutes, env steps, or both; a curriculum depends on the used share of the budget. If
only env_steps is limited, runs with equal seeds and equal numbers of threads agree bit for bit, even after a stop and
resumption. If minutes are limited, the curriculum depends on the clock, so runs differ.

The arms step in a separate thread while the learner updates, so an update uses only transitions of earlier steps. On
one core, steps and updates alternate, with the same result as in parallel. Physics and updates have separate OpenMP
threads. If they shared threads, the threads would spin for milliseconds after each update, on cores that the physics
needs. On a busy machine, each synchronization of shared threads would also wait for suspended threads.
"""

import copy
import ctypes
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from r2s.errors import UserError, check_number
from r2s.learning.checkpoint import Checkpoint
from r2s.learning.demonstrations import Demonstrator
from r2s.learning.env import TaskEnv
from r2s.learning.learner import Learner
from r2s.learning.networks import Policy
from r2s.learning.replay import Replay
from r2s.tasks.task import Episodes

LOG_UPDATES = 1000  # updates between two rows of metrics.csv


@dataclass(frozen=True)
class Budget:
    """Length of a training, which ends after `minutes` of wall-clock time or `env_steps`, whichever is first.

    Raises:
        UserError: neither minutes nor env_steps is set, or a value is not positive.
    """

    minutes: float | None
    env_steps: int | None

    def __post_init__(self):
        if self.minutes is None and self.env_steps is None:
            raise UserError("budget: set budget.minutes or budget.env_steps; a training needs an end")
        for name in ("minutes", "env_steps"):
            value = getattr(self, name)
            if value is not None:
                check_number(f"budget.{name}", value, "(0, inf)")

    def spent(self, seconds: float, env_steps: int) -> float:
        """Return the share of the budget that the training has used; the training ends at 1."""
        time_share = seconds / (60.0 * self.minutes) if self.minutes else 0.0
        step_share = env_steps / self.env_steps if self.env_steps else 0.0
        return max(time_share, step_share)


@dataclass(frozen=True)
class Loop:
    """Settings of the training loop, independent of the algorithm.

    Attributes:
        batch_size: transitions per update. updates_per_step: updates per step of all arms.
        learning_starts: env steps before the first update; their actions are random or from the demonstrator.
        replay_size: capacity of the replay buffer in transitions.
        lr_decay, lr_end: after the share lr_decay of the budget, the learning rate falls linearly to lr_end times its
            initial value.
        explore_end: final / initial exploration noise; the noise falls geometrically over the budget.
        eval_env_steps: env steps between two evaluations; a training ends with one more evaluation.
        compile: whether to compile the losses first; budget.minutes includes the compilation. concurrent: whether
            arms step during updates.
        matmul: precision of float32 matrix products in updates, for torch.set_float32_matmul_precision: "medium"
            allows bfloat16 factors; "auto" selects the result of `fastest_matmul`.

    Raises:
        UserError: a value is out of range.
    """

    batch_size: int = 256
    learning_starts: int = 3200
    updates_per_step: int = 1
    replay_size: int = 1_000_000
    lr_decay: float = 0.6
    lr_end: float = 0.1
    explore_end: float = 1.0
    eval_env_steps: int = 80_000
    compile: bool = False
    concurrent: bool = False
    matmul: str = "highest"

    def __post_init__(self):
        check_number("algo.batch_size", self.batch_size, "[1, inf)", whole=True)
        check_number("algo.learning_starts", self.learning_starts, "[0, inf)", whole=True)
        check_number("algo.updates_per_step", self.updates_per_step, "[1, inf)", whole=True)
        check_number("algo.replay_size", self.replay_size, f"[{self.batch_size}, inf)", whole=True)
        check_number("algo.lr_decay", self.lr_decay, "[0, 1]")
        check_number("algo.lr_end", self.lr_end, "[0, 1]")
        check_number("algo.explore_end", self.explore_end, "(0, 1]")
        check_number("evaluation.env_steps", self.eval_env_steps, "[1, inf)", whole=True)
        if not isinstance(self.compile, bool):
            raise UserError(f"compile: expected true or false, got {self.compile!r}")
        if self.matmul not in ("auto", "medium", "high", "highest"):
            raise UserError(f"matmul: expected auto, medium, high or highest, got {self.matmul!r}")

    def lr_share(self, spent: float) -> float:
        """Return learning rate / initial learning rate after the share `spent` of the budget."""
        return 1.0 - (1.0 - self.lr_end) * max(0.0, spent - self.lr_decay) / max(1.0 - self.lr_decay, 1e-9)


@dataclass(frozen=True)
class Callbacks:
    """Functions that `train` calls to report rows and progress.

    Attributes:
        log: called with each row of metrics.csv. evaluated: called with each row of evaluations.csv.
        progress: called after every step that includes an update; receives the used share of the budget and numbers
            to show.
    """

    log: Callable[[dict], None] = lambda row: None
    evaluated: Callable[[dict], None] = lambda row: None
    progress: Callable[[float, dict], None] = lambda share, row: None


def train(
    env: TaskEnv,
    algo: Learner,
    evaluate: Callable[[Policy], Episodes],
    loop: Loop,
    budget: Budget,
    *,
    demonstrator: Demonstrator | None = None,
    checkpoint: Checkpoint | None = None,
    callbacks: Callbacks = Callbacks(),
) -> None:
    """Train `algo` in place.

    Args:
        env: environment with arms, task and reward.
        algo: a learner, for example r2s.learning.tqc.TQC.
        evaluate: function that runs a policy and returns `Episodes`, see r2s/learning/evaluate.py.
        loop, budget: settings of the training loop, and length of the training.
        demonstrator: source of the actions in the first loop.learning_starts env steps; if None, the actions are
            uniformly random.
        checkpoint: saves the training after every evaluation except the last. A training with a saved checkpoint
            resumes from the checkpoint. If None, the training is not saved.
        callbacks: functions that receive logs and progress.

    Raises:
        FloatingPointError: an action, observation, reward or loss is not finite.
    """
    keep_memory()
    run = Training(env, algo, evaluate, loop, demonstrator)
    if checkpoint:
        run.restore(checkpoint)
    while (spent := budget.spent(run.seconds, run.env_steps)) < 1.0:
        env.weights = env.reward.weights(env.task, spent, run.factor)
        algo.set_lr(loop.lr_share(spent))
        algo.set_exploration(loop.explore_end**spent)
        learns = run.env_steps >= max(1, loop.learning_starts)  # an update needs at least one transition
        with run.step(spent):
            for _ in range(loop.updates_per_step if learns else 0):
                losses = run.update()
        if not learns:
            continue
        if run.updates % LOG_UPDATES < loop.updates_per_step or run.updates == loop.updates_per_step:
            callbacks.log(run.metrics(losses))
        if run.env_steps >= run.next_eval:
            while run.next_eval <= run.env_steps:  # one evaluation, even if several are due after the random steps
                run.next_eval += loop.eval_env_steps
            callbacks.evaluated(run.evaluate())
            if checkpoint:
                run.save(checkpoint)
        callbacks.progress(spent, run.evaluation | {"env_steps": run.env_steps, "updates": run.updates})
    callbacks.evaluated(run.evaluate())


class Training:
    """State of a training: arms, learner, replay buffer and counters; for the arguments, see `train`.

    Attributes:
        env_steps, updates: numbers of env steps and updates so far. next_eval: number of env steps at which the next
            evaluation is due.
        factor: last result of `Reward.adapt`, initially `Reward.factor`. evaluation: last row of evaluations.csv.
    """

    def __init__(
        self,
        env: TaskEnv,
        algo: Learner,
        evaluate: Callable[[Policy], Episodes],
        loop: Loop,
        demonstrator: Demonstrator | None = None,
    ):
        self._began = time.perf_counter()
        self._env, self._algo, self._evaluate, self._loop = env, algo, evaluate, loop
        self._demonstrator = demonstrator
        self.env_steps, self.updates, self.next_eval = 0, 0, loop.eval_env_steps
        if demonstrator and demonstrator.at_zero:
            self.next_eval = 0  # the first policy nearly equals the demonstrator and may be the best: evaluate it
        self.factor = env.reward.factor
        self.evaluation: dict[str, Any] = {}
        self._terms: list[np.ndarray] = []  # mean reward terms of each step since the last row of metrics
        self._device = algo.action_scale.device
        self._matmul = fastest_matmul(self._device) if loop.matmul == "auto" else loop.matmul
        if loop.compile:
            with matmul_precision(self._matmul):
                algo.compile(loop.batch_size)
        self._replay = Replay(loop.replay_size, self._device)
        self._submit = ThreadPoolExecutor(1).submit if loop.concurrent else run_now
        self._state = env.reset()

    @property
    def seconds(self) -> float:
        """Wall-clock time of the training, s, including the time before a resumption."""
        return time.perf_counter() - self._began

    @contextmanager
    def step(self, spent: float) -> Iterator[None]:
        """Step all arms while the `with` block runs, then store the transitions. spent: share of the budget used."""
        env, state = self._env, self._state
        state["action"] = self._action(state["observation"])
        with self._dated_errors():
            pending = self._submit(env.step_and_maybe_reset, state)
        yield
        with self._dated_errors():
            step, self._state = pending.result()
        self._replay.extend(_transition(step))
        terms = step["next", "reward_terms"].mean(0).numpy()
        self.factor = env.reward.adapt(self.factor, spent, terms, env.nsim)
        self._terms.append(terms)
        self.env_steps += env.nsim

    def _action(self, observation: Tensor) -> Tensor:
        """Return the next actions (nsim, a): at first the demonstrator's or random actions, then the learner's."""
        if self.env_steps >= self._loop.learning_starts:
            return self._algo.explore(observation.to(self._device)).cpu()
        return self._demonstrator.action(observation) if self._demonstrator else self._env.action_spec.rand()

    def update(self) -> dict[str, torch.Tensor]:
        """Do one gradient update on a batch with the current reward weights; return the losses."""
        weights = torch.from_numpy(self._env.weights.astype(np.float32)).to(self._device)
        batch = self._replay.sample(self._loop.batch_size)
        batch["reward"] = batch.pop("reward_terms") @ weights
        with self._dated_errors(), matmul_precision(self._matmul):
            losses = self._algo.update(batch)
        self.updates += 1
        return losses

    def metrics(self, losses: dict[str, torch.Tensor]) -> dict[str, float]:
        """Return a row of metrics.csv, with reward terms averaged over the steps since the previous row."""
        names, means = self._env.reward.terms(self._env.task), np.mean(self._terms, axis=0)
        self._terms = []
        row = {"env_steps": self.env_steps, "updates": self.updates, "wall_clock_s": self.seconds}
        row |= {k: float(v) for k, v in losses.items()}
        row |= {f"weight_{name}": float(w) for name, w in zip(names, self._env.weights, strict=True)}
        return row | {f"term_{name}": float(x) for name, x in zip(names, means, strict=True)}

    def evaluate(self) -> dict[str, Any]:
        """Evaluate the current policy; return a row of evaluations.csv."""
        with self._dated_errors(", in an evaluation"):
            measures = self._env.task.measures(self._evaluate(copy.deepcopy(self._algo.policy).cpu()))
        counters = {"env_steps": self.env_steps, "updates": self.updates, "wall_clock_s": self.seconds}
        self.evaluation = counters | measures
        return self.evaluation

    def save(self, checkpoint: Checkpoint) -> None:
        """Write the state and the replay buffer to a checkpoint."""
        state: dict[str, Any] = {"env_steps": self.env_steps, "updates": self.updates, "next_eval": self.next_eval}
        state |= {
            "factor": torch.as_tensor(np.asarray(self.factor, dtype=float)),
            "seconds": self.seconds,
            "evaluation": self.evaluation,
        }
        state |= {"terms": torch.tensor(np.array(self._terms))} | generators(self._device)
        state |= {"algo": self._algo.state_dict(), "env": _tensors(self._env.state()), "state": self._state.to_dict()}
        checkpoint.save(state, self._replay)

    def restore(self, checkpoint: Checkpoint) -> None:
        """Restore the state in `checkpoint`; do nothing if no checkpoint was saved."""
        saved = checkpoint.load(self._replay)
        if saved is None:
            return
        self._algo.load_state_dict(saved["algo"])
        self._env.set_state(_arrays(saved["env"]))
        self._state = self._state.update(saved["state"])
        self.env_steps, self.updates, self.next_eval = saved["env_steps"], saved["updates"], saved["next_eval"]
        self.factor, self.evaluation = saved["factor"].numpy(), saved["evaluation"]
        self._terms = list(saved["terms"].numpy())
        self._began -= saved["seconds"]
        set_generators(saved, self._device)

    @contextmanager
    def _dated_errors(self, when: str = "") -> Iterator[None]:
        """Add the number of env steps to the message of a FloatingPointError that the `with` block raises."""
        try:
            yield
        except FloatingPointError as error:
            raise FloatingPointError(f"{error}, after {self.env_steps} env steps{when}") from None


def run_now(function: Callable[..., Any], *given: Any) -> Future:
    """Call `function` at once and return a future with the result, in place of `Executor.submit`."""
    done: Future = Future()
    done.set_result(function(*given))
    return done


def generators(device: torch.device) -> dict[str, torch.Tensor]:
    """Return the states of the torch generators from which a training on this device draws."""
    states = {"torch": torch.get_rng_state()}
    return states | {"cuda": torch.cuda.get_rng_state(device)} if device.type == "cuda" else states


def set_generators(states: Mapping[str, Any], device: torch.device) -> None:
    """Restore the states that `generators` returned, for the torch generators of `device`."""
    torch.set_rng_state(states["torch"])
    if device.type == "cuda" and "cuda" in states:
        torch.cuda.set_rng_state(states["cuda"], device)


def keep_memory() -> None:
    """Set glibc to reuse freed memory, because returning large blocks to the system would slow every update."""
    try:
        libc = ctypes.CDLL("libc.so.6")
        libc.mallopt(-3, 1 << 30)  # M_MMAP_THRESHOLD
        libc.mallopt(-1, (1 << 31) - 1)  # M_TRIM_THRESHOLD
    except (OSError, AttributeError):
        pass  # another C library: slower updates with equal results


def fastest_matmul(device: torch.device) -> str:
    """Return the fastest precision of matrix products: "medium" if the device has bfloat16 units, else "highest".

    On a CPU with AVX-512 but without bfloat16 units, "medium" saves no time for hidden layers of 128 to 256 units:
    rounding the factors takes as long as the faster products save (benchmarks/results/speed.md).
    """
    units = device.type == "cuda" or torch.cpu.get_capabilities().get("amx_bf16", False)
    return "medium" if units else "highest"


@contextmanager
def matmul_precision(precision: str) -> Iterator[None]:
    """Set the precision of float32 matrix products inside a `with` block, and "highest" after the block."""
    torch.set_float32_matmul_precision(precision)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision("highest")


def _tensors(node: Any) -> Any:
    """Convert the arrays in nested dicts to tensors, which torch loads without pickle."""
    if isinstance(node, dict):
        return {k: _tensors(v) for k, v in node.items()}
    return torch.from_numpy(np.ascontiguousarray(node)) if isinstance(node, np.ndarray) else node


def _arrays(node: Any) -> Any:
    """Convert the tensors in nested dicts to arrays."""
    if isinstance(node, dict):
        return {k: _arrays(v) for k, v in node.items()}
    return node.numpy() if isinstance(node, torch.Tensor) else node


def _transition(step) -> dict[str, Tensor]:
    """Return the transitions of a step: the values that the replay buffer stores and an update needs."""
    after = step["next"]
    return {
        "observation": step["observation"],
        "action": step["action"],
        "next_observation": after["observation"],
        "reward_terms": after["reward_terms"],
        "terminated": after["terminated"][:, 0].float(),
    }
