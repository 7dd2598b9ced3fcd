"""The training loop, the same for every algorithm: act, step all arms, store, update, now and then evaluate.

The budget is wall-clock minutes or environment steps, whichever ends first; the curriculum follows what is spent.
With env_steps alone a seed gives the same run, bit for bit at a fixed number of threads, stopped and resumed or not;
minutes make the curriculum follow the clock.
"""

import copy
import ctypes
import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers import RandomSampler

from r2s.errors import UserError, check_number
from r2s.learning.checkpoint import Checkpoint, load_tensors, save_tensors
from r2s.learning.env import TaskEnv
from r2s.learning.learner import Learner
from r2s.learning.networks import Policy
from r2s.tasks.rewards import Curriculum
from r2s.tasks.task import Episodes


@dataclass(frozen=True)
class Budget:
    """When training ends: minutes of wall clock, env_steps, or whichever of both comes first.

    Raises:
        UserError: it never ends, or before it began.
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
        """Return the fraction spent; 1 and above is the end."""
        time_share = seconds / (60.0 * self.minutes) if self.minutes else 0.0
        step_share = env_steps / self.env_steps if self.env_steps else 0.0
        return max(time_share, step_share)


MATMUL = ("medium", "high", "highest")


@dataclass(frozen=True)
class Loop:
    """How the loop runs, whatever the algorithm.

    Attributes:
        batch_size: transitions per update. updates_per_step: per step of all arms.
        learning_starts: environment steps of uniform random actions.
        replay_size: transitions kept.
        lr_decay, lr_end: from this fraction of the budget on the learning rate falls linearly, to this share.
        eval_env_steps: environment steps between two evaluations; one more comes at the end.
        compile: turn the losses into machine code first; the time counts.
        matmul: precision of the products within an update, for torch.set_float32_matmul_precision: "highest", or
            "medium", which rounds their factors to bfloat16 where the processor multiplies those faster.

    Raises:
        UserError: a value out of its range.
    """

    batch_size: int = 256
    learning_starts: int = 3200
    updates_per_step: int = 1
    replay_size: int = 1_000_000
    lr_decay: float = 0.6
    lr_end: float = 0.1
    eval_env_steps: int = 80_000
    compile: bool = False
    matmul: str = "highest"

    def __post_init__(self):
        check_number("algo.batch_size", self.batch_size, "[1, inf)", whole=True)
        check_number("algo.learning_starts", self.learning_starts, "[0, inf)", whole=True)
        check_number("algo.updates_per_step", self.updates_per_step, "[1, inf)", whole=True)
        check_number("algo.replay_size", self.replay_size, f"[{self.batch_size}, inf)", whole=True)
        check_number("algo.lr_decay", self.lr_decay, "[0, 1]")
        check_number("algo.lr_end", self.lr_end, "[0, 1]")
        check_number("evaluation.env_steps", self.eval_env_steps, "[1, inf)", whole=True)
        if not isinstance(self.compile, bool):
            raise UserError(f"compile: {self.compile!r} is not allowed; true and false are")
        if self.matmul not in MATMUL:
            raise UserError(f"matmul: '{self.matmul}' is not allowed; medium, high and highest are")

    def lr_share(self, spent: float) -> float:
        """Return the learning rate's share at the fraction `spent` of the budget."""
        return 1.0 - (1.0 - self.lr_end) * max(0.0, spent - self.lr_decay) / max(1.0 - self.lr_decay, 1e-9)


@dataclass(frozen=True)
class Listeners:
    """Who is told while a training runs.

    Attributes:
        log: gets a row of metrics about every thousand updates. evaluated: a row of evaluations.csv.
        progress: gets the fraction spent and what is worth showing, every step.
    """

    log: Callable[[dict], None] = lambda row: None
    evaluated: Callable[[dict], None] = lambda row: None
    progress: Callable[[float, dict], None] = lambda share, row: None


def keep_memory() -> None:
    """Let glibc keep freed blocks: it gives large ones back at once, and every update would fault them in again."""
    try:
        libc = ctypes.CDLL("libc.so.6")
        libc.mallopt(-3, 1 << 30)  # M_MMAP_THRESHOLD
        libc.mallopt(-1, (1 << 31) - 1)  # M_TRIM_THRESHOLD
    except (OSError, AttributeError):
        pass  # another C library: only slower


@contextmanager
def products(precision: str) -> Iterator[None]:
    """Let float32 matrix products in here have this precision; elsewhere, as in a policy's, it is the highest."""
    torch.set_float32_matmul_precision(precision)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision("highest")


def train(
    env: TaskEnv,
    algo: Learner,
    evaluate: Callable[[Policy], Episodes],
    weights: Curriculum,
    loop: Loop,
    budget: Budget,
    *,
    checkpoint: Checkpoint | None = None,
    dump: Path | None = None,
    listeners: Listeners = Listeners(),
) -> None:
    """Train `algo` in place.

    Args:
        env: arms to learn on.
        algo: a learner (r2s/learning/tqc.py).
        evaluate: policy -> Episodes (r2s/learning/evaluate.py).
        weights: of the reward terms, over the budget; of the last of them, as what was seen asks for.
        loop: how. budget: when to stop.
        checkpoint: written after every evaluation; where it holds a state, training goes on from there.
        dump: file for what led to a number that is not finite, for `replay_dump`.
        listeners: who is told.

    Raises:
        FloatingPointError: an action, observation, reward or loss is not finite.
    """
    keep_memory()
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # it tells of every storage it makes
    began, env_steps, updates, next_eval = time.perf_counter(), 0, 0, loop.eval_env_steps
    dearer = 1.0  # factor on the price of what the driver's law had to change
    since: list[np.ndarray] = []  # mean reward terms of each step since the last row of metrics
    device = algo.torque.device
    if loop.compile:
        with products(loop.matmul):
            algo.compile(loop.batch_size)
    storage = LazyTensorStorage(loop.replay_size, device=device)
    replay = TensorDictReplayBuffer(storage=storage, sampler=RandomSampler(), batch_size=loop.batch_size)
    state = env.reset()
    row: dict = {}
    shown: dict = {}
    origin: dict = {}  # the environment's state before `actions`
    actions: list[torch.Tensor] = []
    if checkpoint and (saved := checkpoint.load(replay, loop.replay_size)):
        algo.load_state_dict(saved["algo"])
        env.set_state(_arrays(saved["env"]))
        state = state.update(saved["state"])
        env_steps, updates, next_eval = saved["env_steps"], saved["updates"], saved["next_eval"]
        shown, began, dearer = saved["shown"], began - saved["seconds"], saved.get("dearer", 1.0)
        since = list(saved["since"].numpy()) if "since" in saved else []
        torch.set_rng_state(saved["torch"])

    def evaluation() -> dict:
        try:
            out = env.task.measures(evaluate(copy.deepcopy(algo.policy).cpu()))
        except FloatingPointError as error:
            when = f"{env_steps} env steps, in an evaluation"
            raise _dumped(error, dump, {"algo": algo.state_dict()}, when) from None
        return {"env_steps": env_steps, "updates": updates, "wall_clock_s": time.perf_counter() - began} | out

    while (spent := budget.spent(time.perf_counter() - began, env_steps)) < 1.0:
        env.weights = weights(spent, dearer)
        algo.set_lr(loop.lr_share(spent))
        warm = env_steps >= loop.learning_starts
        seen = state["observation"].to(device)
        state["action"] = algo.explore(seen).cpu() if warm else env.action_spec.rand()
        if len(actions) % env.task.steps == 0:
            origin, actions = env.state(), []  # a dump replays from here: a copy at every step takes its time
        actions.append(state["action"])
        try:
            step, state_next = env.step_and_maybe_reset(state)
        except FloatingPointError as error:
            where = {"env": origin, "actions": torch.stack(actions)}
            raise _dumped(error, dump, where, f"{env_steps} env steps") from None
        replay.extend(_transition(step))
        terms = step["next", "reward_terms"].mean(0).numpy()
        dearer = weights.dearer(dearer, spent, terms, env.nsim)
        since.append(terms)
        state = state_next
        env_steps += env.nsim
        if env_steps < loop.learning_starts:
            continue
        price = torch.from_numpy(env.weights.astype(np.float32)).to(device)
        for _ in range(loop.updates_per_step):
            batch = replay.sample()
            batch["reward"] = batch["reward_terms"] @ price
            random = torch.get_rng_state()
            try:
                with products(loop.matmul):
                    row = algo.update(batch)
            except FloatingPointError as error:
                where = {"algo": algo.state_dict(), "batch": batch.to_dict(), "torch": random, "matmul": loop.matmul}
                raise _dumped(error, dump, where, f"{env_steps} env steps") from None
            updates += 1
        if updates % 1000 < loop.updates_per_step or updates == loop.updates_per_step:
            numbers = {k: float(v) for k, v in row.items()}
            head = {"env_steps": env_steps, "updates": updates, "wall_clock_s": time.perf_counter() - began}
            paid = {f"weight_{i}": float(w) for i, w in enumerate(env.weights)}
            paid |= {f"term_{i}": float(x) for i, x in enumerate(np.mean(since, axis=0))}
            listeners.log(head | numbers | paid)
            since = []
        if env_steps >= next_eval:
            next_eval += loop.eval_env_steps
            shown = evaluation()
            listeners.evaluated(shown)
            if checkpoint:
                now = {"env_steps": env_steps, "updates": updates, "next_eval": next_eval, "shown": shown}
                now |= {"dearer": dearer, "seconds": time.perf_counter() - began, "torch": torch.get_rng_state()}
                now |= {"since": torch.tensor(np.array(since))}
                now |= {"algo": algo.state_dict(), "env": _tensors(env.state()), "state": state.to_dict()}
                checkpoint.save(now, replay, env_steps, loop.replay_size)
        listeners.progress(spent, shown | {"env_steps": env_steps, "updates": updates})
    listeners.evaluated(evaluation())


def _dumped(error: FloatingPointError, path: Path | None, where: dict[str, Any], when: str) -> FloatingPointError:
    """Write what led to the error and return one that says so."""
    if path is None:
        return FloatingPointError(f"{error}, after {when}")
    save_tensors(path, _tensors(where))
    return FloatingPointError(f"{error}, after {when}; replay it with r2s.learning.train.replay_dump on {path}")


def replay_dump(path: Path, env: TaskEnv, algo: Learner, evaluate: Callable[[Policy], Episodes]) -> None:
    """Do again what led to a number that is not finite.

    Args:
        path: the dump. env, algo, evaluate: made as they were for the training.

    Raises:
        FloatingPointError: the same as then.
        UserError: there is no dump.
    """
    if not path.is_file():
        raise UserError(f"{path} is no dump of a training")
    where = load_tensors(path, "dump")
    if "algo" in where:
        algo.load_state_dict(where["algo"])
        if "batch" not in where:
            evaluate(algo.policy)
            return
        torch.set_rng_state(where["torch"])
        with products(where["matmul"]):
            algo.update(where["batch"])
        return
    env.reset()
    env.set_state(_arrays(where["env"]))
    state: TensorDictBase = env.read()
    for action in where["actions"]:
        state["action"] = action
        _, state = env.step_and_maybe_reset(state)


def _tensors(node: Any) -> Any:
    """Return nested dicts with tensors in place of arrays: what torch loads without pickles."""
    if isinstance(node, dict):
        return {k: _tensors(v) for k, v in node.items()}
    return torch.from_numpy(np.ascontiguousarray(node)) if isinstance(node, np.ndarray) else node


def _arrays(node: Any) -> Any:
    """Return nested dicts with arrays in place of tensors."""
    if isinstance(node, dict):
        return {k: _arrays(v) for k, v in node.items()}
    return node.numpy() if isinstance(node, torch.Tensor) else node


def _transition(step) -> dict:
    """Return what an update needs of a step, flat."""
    after = step["next"]
    return TensorDict(
        {
            "observation": step["observation"],
            "action": step["action"],
            "next_observation": after["observation"],
            "reward_terms": after["reward_terms"],
            "terminated": after["terminated"][:, 0].float(),
        },
        batch_size=step.batch_size,
    )
