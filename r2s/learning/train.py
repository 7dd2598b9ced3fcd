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
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers import RandomSampler

from r2s.errors import UserError, check_number
from r2s.learning.checkpoint import Checkpoint
from r2s.learning.env import TaskEnv
from r2s.learning.learner import Learner
from r2s.learning.networks import Policy
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


@dataclass(frozen=True)
class Loop:
    """How a training goes.

    Attributes:
        batch_size: transitions per update. learning_starts: environment steps of uniform random actions.
        updates_per_step: per step of all arms. replay_size: transitions kept.
        lr_decay, lr_end: from this fraction of the budget on the learning rate falls linearly, to this share.
        eval_env_steps: environment steps between two evaluations; one more comes at the end.
        compile: turn the losses into machine code first; the time counts.
        matmul: precision of the products within an update, for torch.set_float32_matmul_precision: "highest", or
            "medium", which rounds their factors to bfloat16 where the processor multiplies those faster.

    Raises:
        UserError: a number outside its range, or no such precision.
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
        if self.matmul not in ("medium", "high", "highest"):
            raise UserError(f"matmul: '{self.matmul}' is not allowed; medium, high and highest are")


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
    weights: Callable[[float], np.ndarray],
    *,
    budget: Budget,
    batch_size: int = 256,
    learning_starts: int = 3200,
    updates_per_step: int = 1,
    replay_size: int = 1_000_000,
    lr_decay: float = 0.6,
    lr_end: float = 0.1,
    eval_env_steps: int = 80_000,
    compile: bool = False,
    matmul: str = "highest",
    checkpoint: Checkpoint | None = None,
    dump: Path | None = None,
    log: Callable[[dict], None] = lambda row: None,
    evaluated: Callable[[dict], None] = lambda row: None,
    progress: Callable[[float, dict], None] = lambda share, row: None,
) -> None:
    """Train `algo` in place.

    Args:
        env: arms to learn on.
        algo: a learner (r2s/learning/tqc.py).
        evaluate: policy -> Episodes (r2s/learning/evaluate.py).
        weights: fraction of the budget -> (3,) weights of the reward terms (r2s/tasks/rewards.py).
        budget: when to stop.
        batch_size: transitions per update. updates_per_step: per step of all arms.
        learning_starts: environment steps of uniform random actions.
        replay_size: transitions kept.
        lr_decay, lr_end: from this fraction of the budget on the learning rate falls linearly, to this share.
        eval_env_steps: environment steps between two evaluations; one more comes at the end.
        compile: turn the losses into machine code first; the time counts.
        matmul: precision of the products within an update, for torch.set_float32_matmul_precision: "highest", or
            "medium", which rounds their factors to bfloat16 where the processor multiplies those faster.
        checkpoint: written after every evaluation; where it holds a state, training goes on from there.
        dump: file for what led to a number that is not finite, for `replay`.
        log: gets a row of metrics about every thousand updates. evaluated: a row of evaluations.csv.
        progress: gets the fraction spent and what is worth showing, every step.

    Raises:
        FloatingPointError: an action, observation, reward or loss is not finite.
    """
    keep_memory()
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # it tells of every storage it makes
    began, env_steps, updates, next_eval = time.perf_counter(), 0, 0, eval_env_steps
    device = algo.torque.device
    if compile:
        with products(matmul):
            algo.compile(batch_size)
    storage = LazyTensorStorage(replay_size, device=device)
    replay = TensorDictReplayBuffer(storage=storage, sampler=RandomSampler(), batch_size=batch_size)
    state = env.reset()
    row: dict = {}
    shown: dict = {}
    if checkpoint and (saved := checkpoint.load(replay, replay_size)):
        algo.load_state_dict(saved["algo"])
        env.set_state(_arrays(saved["env"]))
        state = state.update(saved["state"])
        env_steps, updates, next_eval = saved["env_steps"], saved["updates"], saved["next_eval"]
        shown, began = saved["shown"], began - saved["seconds"]
        torch.set_rng_state(saved["torch"])

    def evaluation() -> dict:
        try:
            out = env.task.measures(evaluate(copy.deepcopy(algo.policy).cpu()))
        except FloatingPointError as error:
            when = f"{env_steps} env steps, in an evaluation"
            raise _dumped(error, dump, {"algo": algo.state_dict()}, when) from None
        return {"env_steps": env_steps, "updates": updates, "wall_clock_s": time.perf_counter() - began} | out

    while (spent := budget.spent(time.perf_counter() - began, env_steps)) < 1.0:
        env.weights = weights(spent)
        algo.set_lr(1.0 - (1.0 - lr_end) * max(0.0, spent - lr_decay) / max(1.0 - lr_decay, 1e-9))
        warm = env_steps >= learning_starts
        seen = state["observation"].to(device)
        state["action"] = algo.explore(seen).cpu() if warm else env.action_spec.rand()
        before = env.state()
        try:
            step, state_next = env.step_and_maybe_reset(state)
        except FloatingPointError as error:
            where = {"env": before, "action": state["action"], "weights": env.weights}
            raise _dumped(error, dump, where, f"{env_steps} env steps") from None
        replay.extend(_transition(step))
        state = state_next
        env_steps += env.nsim
        if env_steps < learning_starts:
            continue
        price = torch.from_numpy(env.weights.astype(np.float32)).to(device)
        for _ in range(updates_per_step):
            batch = replay.sample()
            batch["reward"] = batch["reward_terms"] @ price
            random = torch.get_rng_state()
            try:
                with products(matmul):
                    row = algo.update(batch)
            except FloatingPointError as error:
                where = {"algo": algo.state_dict(), "batch": batch.to_dict(), "torch": random, "matmul": matmul}
                raise _dumped(error, dump, where, f"{env_steps} env steps") from None
            updates += 1
        if updates % 1000 < updates_per_step or updates == updates_per_step:
            numbers = {k: float(v) for k, v in row.items()}
            head = {"env_steps": env_steps, "updates": updates, "wall_clock_s": time.perf_counter() - began}
            log(head | numbers | {f"weight_{i}": float(w) for i, w in enumerate(env.weights)})
        if env_steps >= next_eval:
            next_eval += eval_env_steps
            shown = evaluation()
            evaluated(shown)
            if checkpoint:
                now = {"env_steps": env_steps, "updates": updates, "next_eval": next_eval, "shown": shown}
                now |= {"seconds": time.perf_counter() - began, "torch": torch.get_rng_state()}
                now |= {"algo": algo.state_dict(), "env": _tensors(env.state()), "state": state.to_dict()}
                checkpoint.save(now, replay, env_steps, replay_size)
        progress(spent, shown | {"env_steps": env_steps, "updates": updates})
    evaluated(evaluation())


def _dumped(error: FloatingPointError, path: Path | None, where: dict[str, Any], when: str) -> FloatingPointError:
    """Write what led to the error and return one that says so."""
    if path is None:
        return FloatingPointError(f"{error}, after {when}")
    torch.save(_tensors(where), path)
    return FloatingPointError(f"{error}, after {when}; replay it with r2s.learning.train.replay on {path}")


def replay(path: Path, env: TaskEnv, algo: Learner, evaluate: Callable[[Policy], Episodes]) -> None:
    """Do again what led to a number that is not finite.

    Args:
        path: the dump. env, algo, evaluate: made as they were for the training.

    Raises:
        FloatingPointError: the same as then.
        UserError: there is no dump.
    """
    if not path.is_file():
        raise UserError(f"{path} is no dump of a training")
    where = torch.load(path, weights_only=True)
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
    env.weights = where["weights"].numpy()
    state = env.read()
    state["action"] = where["action"]
    env.step(state)


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
    from tensordict import TensorDict

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
