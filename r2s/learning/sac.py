"""Soft Actor-Critic (Haarnoja et al. 2018, arXiv:1801.01290) with the automatic temperature of arXiv:1812.05905.

The losses are those of `torchrl.objectives.SACLoss` without a value network and with the papers' squared error, which
the tests hold this file to.
"""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from r2s.learning.learner import EntropyLearner
from r2s.learning.networks import sample_tanh


class SAC(EntropyLearner):
    """Learner of a stochastic policy, with pessimistic critics.

    Args:
        scale, torque, hidden, gamma, tau, lr, action_l2: see r2s.learning.networks.Learner.
        n_critics: the smallest of their values counts, for target and actor.
        alpha_init, target_entropy: see r2s.learning.networks.EntropyLearner.

    Raises:
        UserError: a setting of the wrong kind or out of range.
    """

    def __init__(
        self,
        scale: tuple[Tensor, Tensor],
        torque: Tensor,
        *,
        hidden: Sequence[int] = (128, 128),
        n_critics: int = 2,
        gamma: float = 0.95,
        tau: float = 0.01,
        lr: float = 5e-4,
        alpha_init: float = 0.01,
        target_entropy: float | None = None,
        action_l2: float = 0.0,
    ):
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
            alpha_init=alpha_init,
            target_entropy=target_entropy,
        )

    def losses(self, batch: Mapping[str, Tensor], noise: tuple[Tensor, Tensor]) -> dict[str, Tensor]:
        """Return critic, actor and alpha losses and the entropy, see EntropyLearner."""
        alpha = self.log_alpha.exp().detach()
        with torch.no_grad():
            next_action, next_log_prob = sample_tanh(self.actor(batch["next_observation"]), noise[0])
            next_value = self.targets(batch["next_observation"], next_action)[..., 0].min(0).values
            live = self.gamma * (1.0 - batch["terminated"])
            target = batch["reward"] + live * (next_value - alpha * next_log_prob)
        values = self.critics(batch["observation"], batch["action"])[..., 0]
        critic = (values - target).square().mean(1).sum()

        action, log_prob = sample_tanh(self.actor(batch["observation"]), noise[1])
        value = self.critics.frozen(batch["observation"], action)[..., 0].min(0).values
        actor = (alpha * log_prob - value).mean() + self.action_l2 * action.square().mean()
        temperature = -(self.log_alpha * (log_prob.detach() + self.target_entropy)).mean()
        return {
            "loss_critic": critic,
            "loss_actor": actor,
            "loss_alpha": temperature,
            "entropy": -log_prob.mean(),
        }
