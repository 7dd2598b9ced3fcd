"""Truncated Quantile Critics (Kuznetsov et al. 2020, arXiv:2005.04269).

The losses equal those of `torchrl.objectives.TQCLoss`; the tests compare values and gradients (1e-5). Two parts are
written differently, for speed on two cores: the critics are one batched network instead of a vmap, and the quantile
loss uses prefix sums over the sorted targets instead of all pairs.
"""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from r2s.errors import check_number
from r2s.learning.learner import EntropyLearner, sample_tanh


class TQC(EntropyLearner):
    """Learner of a stochastic policy with quantile critics; the target drops their highest atoms.

    Args:
        scale, action_scale, shared: see `EntropyLearner`.
        n_critics, n_quantiles: ensemble. drop_per_critic: highest atoms dropped, per critic.
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
        critic = QuantileHuber.apply(quantiles, target)

        action, log_prob = sample_tanh(self.actor(batch["observation"]), noise[1])
        value = self.critics.frozen(batch["observation"], action).mean((0, 2))
        return {"loss_critic": critic} | self.entropy_losses(alpha, value, action, log_prob)


class QuantileHuber(torch.autograd.Function):
    """Quantile Huber loss of quantiles (C, B, N) and sorted targets (B, M), as in TQCLoss: sum over C of the mean.

    With delta = y_j - theta_i, the loss of a pair is |tau_i - [delta < 0]| huber(delta). Its derivative with respect
    to theta is |tau_i - [delta < 0]| clip(-delta, -1, 1). The targets are sorted, so the pairs of one theta form four
    intervals: delta below -1, to 0, to 1, above. Prefix sums of y and y^2 give the exact sum over each interval, with
    three searches instead of N M pairs.
    """

    @staticmethod
    def forward(ctx, quantiles: Tensor, target: Tensor) -> Tensor:
        """Return the scalar loss and save its gradient for `backward`."""
        count, b, n = quantiles.shape
        m = target.shape[-1]
        # Sums of squares cancel in single precision: center the targets of each row and sum in double.
        center = target.double().mean(-1, keepdim=True)
        y = target.double() - center
        theta = quantiles.transpose(0, 1).reshape(b, -1).double() - center
        zero = y.new_zeros(b, 1)
        first = torch.cat([zero, y.cumsum(-1)], -1)
        second = torch.cat([zero, y.square().cumsum(-1)], -1)
        low = torch.searchsorted(y, theta - 1.0)
        mid = torch.searchsorted(y, theta)
        high = torch.searchsorted(y, theta + 1.0, right=True)
        s_low, s_mid, s_high = (first.gather(-1, k) for k in (low, mid, high))
        q_low, q_mid, q_high = (second.gather(-1, k) for k in (low, mid, high))

        def square(k: Tensor, s: Tensor, q: Tensor) -> Tensor:  # sum of (y - theta)^2 / 2 over k targets
            return 0.5 * (q - 2.0 * theta * s + k * theta.square())

        under = low * (theta - 0.5) - s_low + square(mid - low, s_mid - s_low, q_mid - q_low)
        over = square(high - mid, s_high - s_mid, q_high - q_mid)
        over = over + (first[:, -1:] - s_high) - (m - high) * (theta + 0.5)
        d_under = low + (mid - low) * theta - (s_mid - s_low)
        d_over = (high - mid) * theta - (s_high - s_mid) - (m - high)
        fraction = ((torch.arange(n, dtype=y.dtype, device=y.device) + 0.5) / n).repeat(count)
        loss = ((1.0 - fraction) * under + fraction * over).sum() / (n * m * b)
        gradient = ((1.0 - fraction) * d_under + fraction * d_over) / (n * m * b)
        ctx.save_for_backward(gradient.reshape(b, count, n).transpose(0, 1).to(quantiles.dtype))
        return loss.to(quantiles.dtype)

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None]:  # type: ignore[override]
        """Return the saved gradient times the upstream one."""
        return ctx.saved_tensors[0] * grad, None
