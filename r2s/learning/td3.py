"""Twin Delayed Deep Deterministic policy gradient (Fujimoto et al. 2018, arXiv:1802.09477).

DDPG with three changes: the smaller of two critics as target, noise on the target's action, and an actor and targets
that move at every other update only. The losses are those of `torchrl.objectives.TD3Loss` with the paper's squared
error, which the tests hold this file to.
"""

import copy
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from r2s.errors import check_number
from r2s.learning.learner import Learner, polyak


class TD3(Learner):
    """Learner of a deterministic policy, with pessimistic critics.

    Args:
        scale, torque, hidden, gamma, tau, lr, action_l2: see r2s.learning.networks.Learner.
        n_critics: the smallest of their values is the target; the actor follows the first.
        explore_std: of the Gaussian noise on an action in [-1, 1].
        smoothing_std, smoothing_clip: of the noise on the target's action, and what it is limited to.
        policy_delay: updates of the critics for one of the actor and of the targets.

    Raises:
        UserError: a setting of the wrong kind or out of range.
    """

    last_actor_loss: Tensor

    heavy = ("_critic_loss", "_actor_loss")

    def __init__(
        self,
        scale: tuple[Tensor, Tensor],
        torque: Tensor,
        *,
        hidden: Sequence[int] = (128, 128),
        n_critics: int = 2,
        gamma: float = 0.95,
        tau: float = 0.01,
        lr: float = 1e-3,
        explore_std: float = 0.1,
        smoothing_std: float = 0.2,
        smoothing_clip: float = 0.5,
        policy_delay: int = 2,
        action_l2: float = 0.0,
    ):
        check_number("explore_std", explore_std, "[0, inf)")
        check_number("smoothing_std", smoothing_std, "[0, inf)")
        check_number("smoothing_clip", smoothing_clip, "[0, inf)")
        check_number("policy_delay", policy_delay, "[1, inf)", whole=True)
        super().__init__(
            scale,
            torque,
            hidden=hidden,
            n_critics=n_critics,
            outputs=1,
            gamma=gamma,
            tau=tau,
            lr=lr,
            action_l2=action_l2,
        )
        self.target_actor = copy.deepcopy(self.actor).requires_grad_(False)
        self.explore_std, self.policy_delay = explore_std, policy_delay
        self.smoothing_std, self.smoothing_clip = smoothing_std, smoothing_clip
        self.register_buffer("last_actor_loss", torch.zeros(()))

    @torch.no_grad()
    def explore(self, observation: Tensor) -> Tensor:
        """Return the policy's actions (B, n) with noise, for observations (B, d)."""
        action = self.actor.mode(self.normalizer(observation))
        return (action + self.explore_std * torch.randn_like(action)).clamp(-1.0, 1.0)

    def losses(self, batch: Mapping[str, Tensor], noise: Tensor) -> dict[str, Tensor]:
        """Return critic and actor losses of a batch.

        Args:
            batch: observation, next_observation (B, d), already normalised; action (B, n); reward, terminated (B,).
            noise: a standard normal draw (B, n), for the next action.
        """
        return {"loss_critic": self._critic_loss(batch, noise), "loss_actor": self._actor_loss(batch)}

    def update(self, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Do one gradient step on a batch in SI units; return the losses (detached).

        Between the updates of the actor its loss is the last one that was worked out.
        """
        batch = self.normalized(batch)
        loss = critic = self._critic_loss(batch, torch.randn_like(batch["action"]))
        due = self.updates % self.policy_delay == 0  # the first update is: every row of a log has a loss to show
        if due:
            actor = self._actor_loss(batch)
            self.last_actor_loss = actor.detach().clone()  # a captured graph writes over its outputs
            loss = critic + actor
        self.descend(loss)
        if due:
            polyak(self.targets, self.critics, self.tau)
            polyak(self.target_actor, self.actor, self.tau)
        return {"loss_critic": critic.detach(), "loss_actor": self.last_actor_loss}

    def _critic_loss(self, batch: Mapping[str, Tensor], noise: Tensor) -> Tensor:
        with torch.no_grad():
            smoothing = (self.smoothing_std * noise).clamp(-self.smoothing_clip, self.smoothing_clip)
            next_action = (self.target_actor.mode(batch["next_observation"]) + smoothing).clamp(-1.0, 1.0)
            next_value = self.targets(batch["next_observation"], next_action)[..., 0].min(0).values
            target = batch["reward"] + self.gamma * (1.0 - batch["terminated"]) * next_value
        values = self.critics(batch["observation"], batch["action"])[..., 0]
        return (values - target).square().mean(1).sum()

    def _actor_loss(self, batch: Mapping[str, Tensor]) -> Tensor:
        action = self.actor.mode(batch["observation"])
        value = self.critics.frozen(batch["observation"], action, 1)[0, :, 0]
        return -value.mean() + self.action_l2 * action.square().mean()
