"""Deep Deterministic Policy Gradient (Lillicrap et al. 2016, arXiv:1509.02971).

Tests verify that the losses equal the losses of `torchrl.objectives.DDPGLoss` with target networks for actor and
critic. r2s differs from Lillicrap et al.: the critic has LayerNorm instead of batch norm, and by default the
exploration noise is white. Fujimoto et al. 2018 found white noise as good as the Ornstein-Uhlenbeck process of the
DDPG paper.
"""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from r2s.learning.learner import DeterministicLearner, polyak


class DDPG(DeterministicLearner):
    """Learn a deterministic policy with one critic; for the arguments, see `DeterministicLearner`."""

    def __init__(self, scale: tuple[Tensor, Tensor], action_scale: Tensor, **shared: Any):
        super().__init__(scale, action_scale, (1, 1), **shared)

    def losses(self, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return critic and actor losses of a batch with normalized observations; see `Learner.update`."""
        with torch.no_grad():
            next_action = self.target_actor.mode(batch["next_observation"])
            next_value = self.targets(batch["next_observation"], next_action)[0, :, 0]
            target = batch["reward"] + self.gamma * (1.0 - batch["terminated"]) * next_value
        critic = (self.critics(batch["observation"], batch["action"])[0, :, 0] - target).square().mean()

        action = self.actor.mode(batch["observation"])
        value = self.critics.frozen(batch["observation"], action)[0, :, 0]
        actor = -value.mean() + self.action_l2 * action.square().mean()
        return {"loss_critic": critic, "loss_actor": actor}

    def update(self, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Take one gradient step and return the losses."""
        out, gradients = self.gradients(batch)
        self.descend(out, self.trained, gradients)
        polyak(self.targets, self.critics, self.tau)
        polyak(self.target_actor, self.actor, self.tau)
        return out
