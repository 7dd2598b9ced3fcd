"""Deep Deterministic Policy Gradient (Lillicrap et al. 2016, arXiv:1509.02971).

The losses are those of `torchrl.objectives.DDPGLoss` with both networks delayed, which the tests hold this file to.
The networks and their normalisation are those of all algorithms here, LayerNorm where the paper has batch norm; the
noise of exploration is white, which Fujimoto et al. 2018 found as good as the paper's Ornstein-Uhlenbeck process.
"""

import copy
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from r2s.errors import check_number
from r2s.learning.learner import Learner, polyak


class DDPG(Learner):
    """Learner of a deterministic policy, with one critic.

    Args:
        scale, torque, hidden, gamma, tau, lr, action_l2: see r2s.learning.networks.Learner.
        explore_std: of the Gaussian noise on an action in [-1, 1].

    Raises:
        UserError: a setting of the wrong kind or out of range.
    """

    def __init__(
        self,
        scale: tuple[Tensor, Tensor],
        torque: Tensor,
        *,
        hidden: Sequence[int] = (128, 128),
        gamma: float = 0.95,
        tau: float = 0.01,
        lr: float = 1e-3,
        explore_std: float = 0.1,
        action_l2: float = 0.0,
    ):
        check_number("explore_std", explore_std, "[0, inf)")
        super().__init__(
            scale, torque, hidden=hidden, n_critics=1, outputs=1, gamma=gamma, tau=tau, lr=lr, action_l2=action_l2
        )
        self.target_actor = copy.deepcopy(self.actor).requires_grad_(False)
        self.explore_std = explore_std

    @torch.no_grad()
    def explore(self, observation: Tensor) -> Tensor:
        """Return the policy's actions (B, n) with noise, for observations (B, d)."""
        action = self.actor.mode(self.normalizer(observation))
        return (action + self.explore_std * torch.randn_like(action)).clamp(-1.0, 1.0)

    def losses(self, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return critic and actor losses of a batch.

        Args:
            batch: observation, next_observation (B, d), already normalised; action (B, n); reward, terminated (B,).
        """
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
        """Do one gradient step on a batch in SI units; return the losses (detached)."""
        out = self.losses(self.normalized(batch))
        self.descend(out["loss_critic"] + out["loss_actor"])
        polyak(self.targets, self.critics, self.tau)
        polyak(self.target_actor, self.actor, self.tau)
        return {k: v.detach() for k, v in out.items()}
