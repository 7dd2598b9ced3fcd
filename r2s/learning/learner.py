"""What DDPG, TD3, SAC and TQC have in common: networks, optimiser, targets, and the verbs of a learner."""

import copy
import warnings
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from r2s.errors import UserError, check_number
from r2s.learning.networks import Actor, Critics, Normalizer, Policy, Told


class Learner(nn.Module, ABC):
    """What DDPG, TD3, SAC and TQC have in common; r2s/learning/train.py needs no more than this.

    The verbs are `explore`, `update`, `set_lr`, `policy`, `state_dict` and `load_state_dict`; the last two carry the
    optimiser and the number of updates as well, so that a copy goes on bit for bit. Beside them each algorithm has
    `losses`, which takes its random draws as arguments and is what the tests hold against TorchRL.

    Args:
        scale: mean and standard deviation (d,) that normalise an observation.
        torque: (n,) Nm, what an action of 1 asks for; goes into the policy.
        hidden: units per layer, of actor and critics.
        n_critics, outputs: critics in the ensemble, numbers that each returns.
        gamma: discount. tau: step of the target networks. lr: of Adam, for all.
        action_l2: weight of the mean squared action in the actor's loss (Andrychowicz et al. 2017, HER): where the
            critics hardly tell actions apart, the small one wins, instead of full torque one way and the other.
        told: what the policy is told, at the end of its observations; critics see it as it is. None: nothing.

    Raises:
        UserError: a setting of the wrong kind or out of range.
    """

    torque: Tensor
    heavy: tuple[str, ...] = ("losses",)  # the methods that an update spends its time in

    def __init__(
        self,
        scale: tuple[Tensor, Tensor],
        torque: Tensor,
        *,
        hidden: Sequence[int],
        n_critics: int,
        outputs: int,
        gamma: float,
        tau: float,
        lr: float,
        action_l2: float,
        told: Told | None = None,
    ):
        super().__init__()
        check_hidden(hidden)
        check_number("n_critics", n_critics, "[1, inf)", whole=True)
        check_number("gamma", gamma, "[0, 1)")
        check_number("tau", tau, "(0, 1]")
        check_number("lr", lr, "(0, 1]")
        check_number("lr", lr, "[1e-12, 1]")  # below it float32 learns nothing
        check_number("action_l2", action_l2, "[0, inf)")
        obs_dim, act_dim = len(scale[0]), len(torque)
        self.normalizer = Normalizer(*scale)
        self.actor = Actor(obs_dim, act_dim, tuple(hidden), told=told)
        self.critics = Critics(obs_dim, act_dim, tuple(hidden), n_critics, outputs)
        self.targets = copy.deepcopy(self.critics).requires_grad_(False)
        self.register_buffer("torque", torque.float())
        self.gamma, self.tau, self.lr, self.action_l2 = gamma, tau, lr, action_l2
        self.updates = 0
        # one optimiser: a parameter without a gradient, as the actor's between delayed updates, is left alone
        self.optimizer = torch.optim.Adam([*self.actor.parameters(), *self.critics.parameters()], lr=lr, fused=True)

    @abstractmethod
    def explore(self, observation: Tensor) -> Tensor:
        """Return actions (B, n) in [-1, 1] to try, for observations (B, d) in SI units."""

    @abstractmethod
    def update(self, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Do one gradient step on a batch in SI units; return what is worth logging, scalars, detached.

        Args:
            batch: observation, next_observation (B, d); action (B, n); reward, terminated (B,).
        """

    @property
    def policy(self) -> Policy:
        """The deterministic policy, sharing this learner's weights."""
        return Policy(self.normalizer, self.actor, self.torque)

    def set_lr(self, share: float) -> None:
        """Set the learning rate to this share of its first value."""
        for group in self.optimizer.param_groups:
            group["lr"] = share * self.lr

    def normalized(self, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return what an update needs of the batch, with both observations normalised."""
        both = {k: self.normalizer(batch[k]) for k in ("observation", "next_observation")}
        return both | {k: batch[k] for k in ("action", "reward", "terminated")}

    def compile(self, batch_size: int) -> bool:  # type: ignore[override]
        """Turn the losses and their gradients into machine code for batches of this size, before the first update.

        Takes 5 to 20 s, less when it was done before on the same machine. On a GPU the code is captured as a graph.
        Where it cannot be done, as without a C++ compiler, one warning says so and the learner stays as it is.

        Returns:
            Whether it was done.
        """
        mode = "reduce-overhead" if self.torque.is_cuda else "default"
        eager = {name: getattr(self, name) for name in self.heavy}
        before, random = copy.deepcopy(self.state_dict()), torch.get_rng_state()
        sizes = {"observation": len(self.normalizer.mean), "action": len(self.torque)}
        sizes["next_observation"] = sizes["observation"]
        batch = {k: torch.zeros(batch_size, size, device=self.torque.device) for k, size in sizes.items()}
        batch |= {k: torch.zeros(batch_size, device=self.torque.device) for k in ("reward", "terminated")}
        try:
            for name, method in eager.items():
                setattr(self, name, torch.compile(method, dynamic=False, mode=mode))
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
            torch.set_rng_state(random)
        return True

    def descend(self, loss: Tensor) -> None:
        """Take one step of Adam down the gradient of `loss`.

        Raises:
            FloatingPointError: the loss is not finite; nothing has changed.
        """
        if not torch.isfinite(loss):
            raise FloatingPointError(f"the loss of update {self.updates + 1} is {float(loss.detach())}")
        loss.backward()
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        self.updates += 1

    def get_extra_state(self) -> dict:
        """Return what state_dict holds beyond parameters and buffers."""
        return {"optimizer": self.optimizer.state_dict(), "updates": self.updates}

    def set_extra_state(self, state: dict) -> None:
        """Take over what get_extra_state returned."""
        # torch would keep the moments it is given, and then two learners would write into them
        self.optimizer.load_state_dict(copy.deepcopy(state["optimizer"]))
        self.updates = state["updates"]


class EntropyLearner(Learner):
    """What SAC and TQC have in common: a stochastic policy and a temperature that holds its entropy.

    Args:
        scale, torque, shared: see Learner.
        alpha_init: first temperature. target_entropy: None is minus the number of joints.

    Raises:
        UserError: a setting of the wrong kind or out of range.
    """

    def __init__(
        self,
        scale: tuple[Tensor, Tensor],
        torque: Tensor,
        *,
        alpha_init: float,
        target_entropy: float | None,
        **shared: Any,
    ):
        check_number("alpha_init", alpha_init, "(0, inf)")
        if target_entropy is not None:
            check_number("target_entropy", target_entropy, "(-inf, inf)")
        super().__init__(scale, torque, **shared)
        self.target_entropy = -float(len(torque)) if target_entropy is None else target_entropy
        self.log_alpha = nn.Parameter(torch.tensor(float(alpha_init)).log())
        self.optimizer.add_param_group({"params": [self.log_alpha]})

    @abstractmethod
    def losses(self, batch: Mapping[str, Tensor], noise: tuple[Tensor, Tensor]) -> dict[str, Tensor]:
        """Return critic, actor and alpha losses and the entropy of a batch.

        Args:
            batch: observation, next_observation (B, d), already normalised; action (B, n); reward, terminated (B,).
            noise: two standard normal draws (B, n), for the next action and for the action of the actor's loss.
        """

    @torch.no_grad()
    def explore(self, observation: Tensor) -> Tensor:
        """Return sampled actions (B, n) for observations (B, d)."""
        loc, scale = self.actor(self.normalizer(observation))
        return torch.tanh(loc + scale * torch.randn_like(loc))

    def update(self, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Do one gradient step on a batch in SI units; return the losses, entropy and alpha (detached)."""
        batch = self.normalized(batch)
        out = self.losses(batch, (torch.randn_like(batch["action"]), torch.randn_like(batch["action"])))
        self.descend(out["loss_critic"] + out["loss_actor"] + out["loss_alpha"])
        polyak(self.targets, self.critics, self.tau)
        return {k: v.detach() for k, v in out.items()} | {"alpha": self.log_alpha.detach().exp()}


@torch.no_grad()
def polyak(target: nn.Module, source: nn.Module, tau: float) -> None:
    """Move every parameter of `target` by the share tau towards that of `source`."""
    torch._foreach_lerp_(list(target.parameters()), list(source.parameters()), tau)


def check_hidden(hidden: object) -> None:
    """Check the units per hidden layer; raise UserError where they are not one or more positive whole numbers."""
    if not isinstance(hidden, Sequence) or isinstance(hidden, str) or not hidden:
        raise UserError(f"hidden: {hidden!r} is not allowed; units per layer are, such as [128, 128]")
    for units in hidden:
        check_number("hidden", units, "[1, inf)", whole=True)
