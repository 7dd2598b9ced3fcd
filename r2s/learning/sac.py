"""Soft Actor-Critic (Haarnoja et al. 2018, arXiv:1801.01290) with the automatic temperature of arXiv:1812.05905.

The losses equal those of `torchrl.objectives.SACLoss` without a value network and with squared errors, as in both SAC
papers. Tests compare the losses of r2s and torchrl.
"""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from r2s.learning.learner import EntropyLearner, sample_tanh


class SAC(EntropyLearner):
    """Learn a stochastic policy; the minimum over several critics limits overestimated values.

    Args:
        scale, action_scale, shared: see `EntropyLearner`.
        n_critics: number of critics; target and actor loss use the minimum over the critics.
    """

    def __init__(self, scale: tuple[Tensor, Tensor], action_scale: Tensor, *, n_critics: int = 2, **shared: Any):
        super().__init__(scale, action_scale, (n_critics, 1), **shared)

    def losses(self, batch: Mapping[str, Tensor], noise: tuple[Tensor, Tensor]) -> dict[str, Tensor]:
        """Return critic, actor and alpha losses and the entropy; see `EntropyLearner.losses`."""
        alpha = self.log_alpha.exp().detach()
        with torch.no_grad():
            next_action, next_log_prob = sample_tanh(self.actor(batch["next_observation"]), noise[0])
            next_value = self.targets(batch["next_observation"], next_action)[..., 0].min(0).values
            discount = self.gamma * (1.0 - batch["terminated"])
            target = batch["reward"] + discount * (next_value - alpha * next_log_prob)
        values = self.critics(batch["observation"], batch["action"])[..., 0]
        critic = (values - target).square().mean(1).sum()

        action, log_prob = sample_tanh(self.actor(batch["observation"]), noise[1])
        value = self.critics.frozen(batch["observation"], action)[..., 0].min(0).values
        return {"loss_critic": critic} | self.entropy_losses(alpha, value, action, log_prob)
