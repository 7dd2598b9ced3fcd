"""Twin Delayed Deep Deterministic policy gradient (Fujimoto et al. 2018, arXiv:1802.09477).

TD3 differs from DDPG in three ways. The target uses the smaller value of two critics. The action in the target has
noise. Only every other update changes the actor and the target networks. The losses equal those of
`torchrl.objectives.TD3Loss` with the squared error of Fujimoto et al.; tests compare r2s and torchrl.
"""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from r2s.errors import check_number
from r2s.learning.learner import DeterministicLearner, differentiate, polyak


class TD3(DeterministicLearner):
    """Learn a deterministic policy; the minimum over several critics limits overestimated values.

    Args:
        scale, action_scale, shared: see `DeterministicLearner`.
        n_critics: number of critics; the target uses the minimum over the critics, and the actor loss uses the first.
        smoothing_std, smoothing_clip: standard deviation and limit of the noise on the action in the target.
        policy_delay: number of critic updates per update of the actor and the target networks.
    """

    last_actor_loss: Tensor
    compiled = ("_critic_gradients", "_actor_gradients")

    def __init__(
        self,
        scale: tuple[Tensor, Tensor],
        action_scale: Tensor,
        *,
        n_critics: int = 2,
        smoothing_std: float = 0.2,
        smoothing_clip: float = 0.5,
        policy_delay: int = 2,
        **shared: Any,
    ):
        check_number("smoothing_std", smoothing_std, "[0, inf)")
        check_number("smoothing_clip", smoothing_clip, "[0, inf)")
        check_number("policy_delay", policy_delay, "[1, inf)", whole=True)
        super().__init__(scale, action_scale, (n_critics, 1), **shared)
        self.policy_delay = policy_delay
        self.smoothing_std, self.smoothing_clip = smoothing_std, smoothing_clip
        self.register_buffer("last_actor_loss", torch.zeros(()))

    def losses(self, batch: Mapping[str, Tensor], noise: Tensor) -> dict[str, Tensor]:
        """Return critic and actor losses of a batch.

        Args:
            batch: as for `Learner.update`, but with normalized observations.
            noise: (B, a), standard normal noise for the next action.
        """
        return {"loss_critic": self._critic_loss(batch, noise), "loss_actor": self._actor_loss(batch)}

    def update(self, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Do one gradient step; return the losses. Steps without an actor update return the previous actor loss."""
        critics, actor = list(self.critics.parameters()), list(self.actor.parameters())
        out, gradients = self._critic_gradients(batch, torch.randn_like(batch["action"]))
        due = self.updates % self.policy_delay == 0  # true in the first update, so every logged row has an actor loss
        if due:
            if self.action_scale.is_cuda and "_actor_gradients" in vars(self):
                # on a GPU, each compiled method is a CUDA graph; the second graph overwrites outputs of the first
                out, gradients = {k: v.clone() for k, v in out.items()}, [g.clone() for g in gradients]
            more, of_actor = self._actor_gradients(batch)
            self.last_actor_loss = more["loss_actor"].clone()  # a CUDA graph overwrites its outputs
            self.descend(out | more, [*critics, *actor], [*gradients, *of_actor])
            polyak(self.targets, self.critics, self.tau)
            polyak(self.target_actor, self.actor, self.tau)
        else:
            self.descend(out, critics, gradients)
        return out | {"loss_actor": self.last_actor_loss}

    def _critic_gradients(self, batch: Mapping[str, Tensor], noise: Tensor):
        losses = {"loss_critic": self._critic_loss(self.normalized(batch), noise)}
        return differentiate(losses, list(self.critics.parameters()))

    def _actor_gradients(self, batch: Mapping[str, Tensor]):
        return differentiate({"loss_actor": self._actor_loss(self.normalized(batch))}, list(self.actor.parameters()))

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
