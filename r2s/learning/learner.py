"""Base classes of DDPG, TD3, SAC and TQC: networks, optimizer, target networks and interface of a learner."""

import copy
import math
import warnings
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from r2s.errors import UserError, check_number
from r2s.learning.networks import Actor, Critics, Normalizer, Policy

KERNELS = 4  # largest number of C++ files in a compiled update


class Learner(nn.Module, ABC):
    """An off-policy actor-critic algorithm.

    The training loop calls `explore`, `update`, `set_lr`, `policy`, `state_dict` and `load_state_dict`. The state
    dict includes the optimizer and the number of updates, so a restored learner continues with equal results, bit for
    bit.

    Args:
        scale: mean and standard deviation (d,) that normalize an observation.
        action_scale: (a,), factor from an action in [-1, 1] to SI units; saved with the policy.
        critics: (number of critics, number of outputs per critic).
        hidden: number of units in each hidden layer of actor and critics.
        gamma: discount. tau: Polyak step of the target networks. lr: learning rate of Adam.
        action_l2: weight of the mean squared action in the actor's loss (Andrychowicz et al. 2017, HER). Where the
            critics hardly distinguish actions, `action_l2` favors small actions over full torque of alternating sign.
        explore_correlation: correlation of an arm's exploration noise between successive steps; 0 means white noise.
            Exploration noise is a first-order autoregressive process of constant variance. Correlated noise moves an
            arm as far as white noise does, but with less acceleration (Lillicrap et al. 2016; Eberhard et al. 2023,
            Pink Noise Is All You Need).

    Raises:
        UserError: a setting has the wrong type or is out of range.
    """

    action_scale: Tensor
    compiled: tuple[str, ...] = ("gradients",)  # the methods that `compile` compiles: the slowest ones

    def __init__(
        self,
        scale: tuple[Tensor, Tensor],
        action_scale: Tensor,
        critics: tuple[int, int],
        *,
        hidden: Sequence[int] = (128, 128),
        gamma: float = 0.95,
        tau: float = 0.01,
        lr: float = 1e-3,
        action_l2: float = 0.0,
        explore_correlation: float = 0.0,
    ):
        super().__init__()
        check_hidden(hidden)
        check_number("n_critics", critics[0], "[1, inf)", whole=True)
        check_number("gamma", gamma, "[0, 1)")
        check_number("tau", tau, "(0, 1]")
        check_number("lr", lr, "(0, 1]")
        check_number("lr", lr, "[1e-12, 1]")  # smaller steps vanish in float32 rounding
        check_number("action_l2", action_l2, "[0, inf)")
        check_number("explore_correlation", explore_correlation, "[0, 1)")
        obs_dim, act_dim = len(scale[0]), len(action_scale)
        self.normalizer = Normalizer(*scale)
        self.actor = Actor(obs_dim, act_dim, tuple(hidden))
        self.critics = Critics(obs_dim, act_dim, tuple(hidden), *critics)
        self.targets = copy.deepcopy(self.critics).requires_grad_(False)
        self.register_buffer("action_scale", action_scale.float())
        self.gamma, self.tau, self.lr, self.action_l2 = gamma, tau, lr, action_l2
        self.explore_correlation, self.explore_share = explore_correlation, 1.0
        self._noise: Tensor | None = None  # last exploration noise
        self.updates = 0
        # One optimizer suffices: Adam skips parameters without a gradient, such as the actor's in a delayed update.
        self.optimizer = torch.optim.Adam([*self.actor.parameters(), *self.critics.parameters()], lr=lr, fused=True)

    def begin_at_zero(self) -> None:
        """Set the actor's last layer so that the policy returns zero actions (residual RL, Johannink et al. 2019)."""
        actions = len(self.action_scale)
        with torch.no_grad():
            for parameter in self.actor.body[-1].parameters():
                parameter[:actions] = 0.0

    @abstractmethod
    def explore(self, observation: Tensor) -> Tensor:
        """Return exploratory actions (B, a) in [-1, 1] for observations (B, d) in SI units."""

    @abstractmethod
    def losses(self, batch: Mapping[str, Tensor], *noise: Any) -> dict[str, Tensor]:
        """Return the losses of a batch, with names that begin with loss_, and further scalars to log.

        The random numbers are arguments, so that tests can compare the losses with the losses of TorchRL.

        Args:
            batch: as for `update`, but with normalized observations.
            noise: random numbers that the algorithm uses.
        """

    @abstractmethod
    def update(self, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Take one gradient step and return detached scalars to log.

        Args:
            batch: observation, next_observation (B, d) in SI units; action (B, a); reward, terminated (B,).
        """

    def gradients(self, batch: Mapping[str, Tensor], *noise: Any) -> tuple[dict[str, Tensor], tuple[Tensor, ...]]:
        """Return the `losses` of a batch in SI units, and the gradient of `total` with respect to `trained`.

        One function computes losses and gradient, so that torch compiles one graph; `backward` would need two graphs.
        """
        return differentiate(self.losses(self.normalized(batch), *noise), self.trained)

    @property
    def policy(self) -> Policy:
        """The deterministic policy, whose networks are those of this learner."""
        return Policy(self.normalizer, self.actor, self.action_scale)

    def set_lr(self, share: float) -> None:
        """Set the learning rate to `share` times its initial value."""
        for group in self.optimizer.param_groups:
            group["lr"] = share * self.lr

    def set_exploration(self, share: float) -> None:
        """Set the standard deviation of the exploration noise to `share` times its initial value."""
        self.explore_share = share

    def noise(self, like: Tensor) -> Tensor:
        """Draw standard normal exploration noise (B, a) for the next step of B arms."""
        fresh = torch.randn_like(like)
        if self._noise is not None and self._noise.shape == like.shape:
            kept = self.explore_correlation
            fresh = kept * self._noise + math.sqrt(1.0 - kept**2) * fresh
        self._noise = fresh
        return fresh

    def normalized(self, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the batch with normalized observations."""
        both = {k: self.normalizer(batch[k]) for k in ("observation", "next_observation")}
        return both | {k: batch[k] for k in ("action", "reward", "terminated")}

    @property
    def trained(self) -> list[Tensor]:
        """The parameters that the optimizer changes: all except the parameters of the target networks."""
        return [p for p in self.parameters() if p.requires_grad]

    def compile(self, batch_size: int) -> bool:  # type: ignore[override]
        """Compile the losses and their gradient for a batch size, before the first update.

        Compilation takes half a minute on one core, or some seconds with a cached result. On a GPU, torch also
        captures a CUDA graph. If compilation fails (e.g. no C++ compiler), r2s warns and uses the uncompiled losses.

        Returns:
            Whether the losses are compiled.
        """
        from torch._dynamo import config as dynamo
        from torch._inductor import config as inductor

        mode = "reduce-overhead" if self.action_scale.is_cuda else "default"
        eager = {name: getattr(self, name) for name in self.compiled}
        before = copy.deepcopy(self.state_dict())
        sizes = {"observation": len(self.normalizer.mean), "action": len(self.action_scale)}
        sizes["next_observation"] = sizes["observation"]
        batch = {k: torch.zeros(batch_size, size, device=self.action_scale.device) for k, size in sizes.items()}
        batch |= {k: torch.zeros(batch_size, device=self.action_scale.device) for k in ("reward", "terminated")}
        devices = [self.action_scale.device] if self.action_scale.is_cuda else []
        # by default torch starts one compiling process per core: too many for the parallel jobs of a sweep
        workers = {} if devices else {"compile_threads": min(torch.get_num_threads(), KERNELS)}
        try:
            for name, method in eager.items():
                setattr(self, name, torch.compile(method, dynamic=False, mode=mode))
            traced = dynamo.patch(trace_autograd_ops=True)  # the graph contains torch.autograd.grad
            with traced, inductor.patch(workers), torch.random.fork_rng(devices):  # the update draws noise
                self.update(batch)
        except RuntimeError as error:
            why = (str(error).strip().splitlines() or [type(error).__name__])[0]
            warnings.warn(f"the losses are not compiled, updates take about twice as long: {why}", stacklevel=2)
            for name in eager:
                delattr(self, name)
            return False
        finally:
            self.zero_grad(set_to_none=True)
            self.load_state_dict(before)
        return True

    def descend(self, losses: Mapping[str, Tensor], trained: Sequence[Tensor], gradients: Sequence[Tensor]) -> None:
        """Change the parameters `trained` by one Adam step with their gradients, if the losses are finite.

        Raises:
            FloatingPointError: a loss is not finite; the learner is unchanged.
        """
        loss = float(total(losses))
        if not math.isfinite(loss):
            raise FloatingPointError(f"the loss of update {self.updates + 1} is {loss}")
        for parameter, gradient in zip(trained, gradients, strict=True):
            parameter.grad = gradient
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        self.updates += 1

    def get_extra_state(self) -> dict:
        """Return the state that torch's state dict lacks: optimizer, number of updates, last exploration noise."""
        return {"optimizer": self.optimizer.state_dict(), "updates": self.updates, "noise": self._noise}

    def set_extra_state(self, state: dict) -> None:
        """Restore a state that `get_extra_state` returned."""
        # torch stores references to the loaded Adam moments: without a copy, two learners would overwrite shared
        # moments
        self.optimizer.load_state_dict(copy.deepcopy(state["optimizer"]))
        noise = state.get("noise")  # older checkpoints contain no noise
        self.updates, self._noise = state["updates"], None if noise is None else noise.to(self.action_scale.device)


class DeterministicLearner(Learner):
    """Base class of DDPG and TD3: a deterministic policy with a target network, and Gaussian exploration noise.

    Args:
        scale, action_scale, critics, shared: see `Learner`.
        explore_std: standard deviation of the noise on an action in [-1, 1].
    """

    def __init__(
        self,
        scale: tuple[Tensor, Tensor],
        action_scale: Tensor,
        critics: tuple[int, int],
        *,
        explore_std: float = 0.1,
        **shared: Any,
    ):
        check_number("explore_std", explore_std, "[0, inf)")
        super().__init__(scale, action_scale, critics, **shared)
        self.target_actor = copy.deepcopy(self.actor).requires_grad_(False)
        self.explore_std = explore_std

    @torch.no_grad()
    def explore(self, observation: Tensor) -> Tensor:
        """Return the policy's actions (B, a) with noise, for observations (B, d)."""
        action = self.actor.mode(self.normalizer(observation))
        std = self.explore_share * self.explore_std
        return (action + std * self.noise(action)).clamp(-1.0, 1.0)


class EntropyLearner(Learner):
    """Base class of SAC and TQC: a stochastic policy, and a temperature that controls the policy's entropy.

    Args:
        scale, action_scale, critics, shared: see `Learner`.
        alpha_init: initial temperature. target_entropy: desired entropy of the policy; if None, minus the number of
            action components.
    """

    entropy_goal: Tensor

    def __init__(
        self,
        scale: tuple[Tensor, Tensor],
        action_scale: Tensor,
        critics: tuple[int, int],
        *,
        alpha_init: float = 0.01,
        target_entropy: float | None = None,
        **shared: Any,
    ):
        check_number("alpha_init", alpha_init, "(0, inf)")
        if target_entropy is not None:
            check_number("target_entropy", target_entropy, "(-inf, inf)")
        super().__init__(scale, action_scale, critics, **shared)
        self.target_entropy = -float(len(action_scale)) if target_entropy is None else target_entropy
        # a tensor, so that compiled losses use its current value
        self.register_buffer("entropy_goal", torch.tensor(float(self.target_entropy)), persistent=False)
        self.log_alpha = nn.Parameter(torch.tensor(float(alpha_init)).log())
        self.optimizer.add_param_group({"params": [self.log_alpha]})

    def set_exploration(self, share: float) -> None:
        """Add n log(share) to the target entropy: the entropy change of a Gaussian in R^n scaled by `share`."""
        super().set_exploration(share)
        self.entropy_goal.fill_(self.target_entropy + len(self.action_scale) * math.log(share))

    @abstractmethod
    def losses(self, batch: Mapping[str, Tensor], noise: tuple[Tensor, Tensor]) -> dict[str, Tensor]:  # type: ignore[override]
        """Return critic, actor and alpha losses and the entropy of a batch; see `Learner.losses`.

        Args:
            batch: as for `update`, but with normalized observations.
            noise: two standard normal samples (B, a), for the next action and for the action in the actor's loss.
        """

    @torch.no_grad()
    def explore(self, observation: Tensor) -> Tensor:
        """Return random actions (B, a) of the stochastic policy for observations (B, d)."""
        loc, scale = self.actor(self.normalizer(observation))
        return torch.tanh(loc + scale * self.noise(loc))

    def update(self, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Take one gradient step and return losses, entropy and alpha."""
        out, gradients = self.gradients(batch, (torch.randn_like(batch["action"]), torch.randn_like(batch["action"])))
        self.descend(out, self.trained, gradients)
        polyak(self.targets, self.critics, self.tau)
        return out | {"alpha": self.log_alpha.detach().exp()}

    def entropy_losses(self, alpha: Tensor, value: Tensor, action: Tensor, log_prob: Tensor) -> dict[str, Tensor]:
        """Return actor loss, alpha loss and entropy; value, log_prob: (B,), Q-values and log-densities of actions."""
        actor = (alpha * log_prob - value).mean() + self.action_l2 * action.square().mean()
        temperature = -(self.log_alpha * (log_prob.detach() + self.entropy_goal)).mean()
        return {"loss_actor": actor, "loss_alpha": temperature, "entropy": -log_prob.mean()}


def sample_tanh(gaussian: tuple[Tensor, Tensor], noise: Tensor) -> tuple[Tensor, Tensor]:
    """Return the action tanh(loc + scale * noise) (B, a) and the log-density (B,) of the action; noise ~ N(0, 1).

    The identity log(1 - tanh(x)^2) = 2 (log 2 - x - softplus(-2 x)) avoids an infinite log-density where tanh
    saturates.
    """
    loc, scale = gaussian
    x = loc + scale * noise
    log_prob = -0.5 * noise.square() - scale.log() - 0.9189385332046727  # log(2 pi) / 2
    log_prob = log_prob - 2.0 * (0.6931471805599453 - x - F.softplus(-2.0 * x))
    return torch.tanh(x), log_prob.sum(-1)


def total(losses: Mapping[str, Tensor]) -> Tensor:
    """Return the sum of all losses: scalars with names that begin with loss_."""
    return torch.stack([v for k, v in losses.items() if k.startswith("loss_")]).sum()


def differentiate(
    losses: Mapping[str, Tensor], trained: Sequence[Tensor]
) -> tuple[dict[str, Tensor], tuple[Tensor, ...]]:
    """Return `losses` as detached scalars, and the gradient of `total` with respect to the parameters `trained`."""
    return {k: v.detach() for k, v in losses.items()}, torch.autograd.grad(total(losses), trained)


@torch.no_grad()
def polyak(target: nn.Module, source: nn.Module, tau: float) -> None:
    """Move every parameter of `target` by the fraction tau towards the corresponding parameter of `source`."""
    torch._foreach_lerp_(list(target.parameters()), list(source.parameters()), tau)


def check_hidden(hidden: object) -> None:
    """Raise UserError unless `hidden` (units of each hidden layer) is a non-empty list of positive integers."""
    if not isinstance(hidden, Sequence) or isinstance(hidden, str) or not hidden:
        raise UserError(f"hidden: expected units per layer such as [128, 128], got {hidden!r}")
    for units in hidden:
        check_number("hidden", units, "[1, inf)", whole=True)
