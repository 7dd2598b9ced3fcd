"""Truncated Quantile Critics (Kuznetsov et al. 2020, arXiv:2005.04269).

The losses equal those of `torchrl.objectives.TQCLoss`; the tests compare values and gradients (tolerance 1e-5). One
batched network represents all critics, which is faster than TorchRL's vmap over networks.
"""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from r2s.errors import check_number
from r2s.learning.learner import EntropyLearner, sample_tanh


class TQC(EntropyLearner):
    """Learn a stochastic policy with quantile critics; the target omits the highest quantiles (atoms).

    Args:
        scale, action_scale, shared: see `EntropyLearner`.
        n_critics: number of critics. n_quantiles: atoms per critic. drop_per_critic: omitted atoms per critic.
    """

    def __init__(
        self,
        scale: tuple[Tensor, Tensor],
        action_scale: Tensor,
        *,
        n_critics: int = 2,
        n_quantiles: int = 25,
        drop_per_critic: int = 2,
        **shared: Any,
    ):
        check_number("n_quantiles", n_quantiles, "[1, inf)", whole=True)
        check_number("drop_per_critic", drop_per_critic, f"[0, {n_quantiles})", whole=True)
        super().__init__(scale, action_scale, (n_critics, n_quantiles), **shared)
        self.keep = n_critics * (n_quantiles - drop_per_critic)

    def losses(self, batch: Mapping[str, Tensor], noise: tuple[Tensor, Tensor]) -> dict[str, Tensor]:
        """Return critic, actor and alpha losses and the entropy; see `EntropyLearner.losses`."""
        alpha = self.log_alpha.exp().detach()
        with torch.no_grad():
            next_action, next_log_prob = sample_tanh(self.actor(batch["next_observation"]), noise[0])
            atoms = self.targets(batch["next_observation"], next_action).transpose(0, 1).flatten(1)
            atoms = atoms.sort(-1).values[:, : self.keep] - (alpha * next_log_prob)[:, None]
            discount = self.gamma * (1.0 - batch["terminated"])
            target = batch["reward"][:, None] + discount[:, None] * atoms
        quantiles = self.critics(batch["observation"], batch["action"])
        critic = quantile_huber(quantiles, target)

        action, log_prob = sample_tanh(self.actor(batch["observation"]), noise[1])
        value = self.critics.frozen(batch["observation"], action).mean((0, 2))
        return {"loss_critic": critic} | self.entropy_losses(alpha, value, action, log_prob)


def quantile_huber(quantiles: Tensor, target: Tensor) -> Tensor:
    """Return the quantile Huber loss (Dabney et al. 2018, arXiv:1710.10044), summed over the critics.

    A critic's loss is the mean over the batch, the critic's quantiles and the target atoms.
    The loss of a quantile and a target atom is |tau - [delta < 0]| huber(delta), where delta = atom - quantile, and
    tau is the quantile's probability. huber(delta) is delta^2 / 2 for |delta| <= 1, otherwise |delta| - 1/2.

    Args:
        quantiles: (C, B, N), N quantiles of C critics. target: (B, M), M target atoms.
    """
    n = quantiles.shape[-1]
    tau = ((torch.arange(n, device=quantiles.device) + 0.5) / n)[:, None]
    delta = target[:, None, :] - quantiles[..., None]
    within = delta.clamp(-1.0, 1.0)
    return (torch.where(delta < 0.0, 1.0 - tau, tau) * within * (delta - 0.5 * within)).mean((1, 2, 3)).sum()
