"""Truncated Quantile Critics (Kuznetsov et al. 2020, arXiv:2005.04269).

The losses are those of `torchrl.objectives.TQCLoss`, which the tests hold this file to (values and gradients, 1e-5).
Two things are written differently because two cores have to do: the critics are one batched network instead of a
vmap, and the quantile loss goes by prefix sums over the sorted targets instead of all pairs.

The verbs are those of r2s.learning.networks.Learner; `losses` is what the tests compare.
"""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from r2s.errors import check_number
from r2s.learning.learner import EntropyLearner
from r2s.learning.networks import Told, sample_tanh


class TQC(EntropyLearner):
    """Learner of a stochastic policy, with quantile critics whose highest atoms are left out.

    Args:
        scale, torque, told, hidden, gamma, tau, lr, action_l2: see r2s.learning.networks.Learner.
        n_critics, n_quantiles: ensemble. drop_per_critic: highest atoms left out of the target, per critic.
        alpha_init, target_entropy: see r2s.learning.networks.EntropyLearner.

    Raises:
        UserError: a setting of the wrong kind or out of range.
    """

    def __init__(
        self,
        scale: tuple[Tensor, Tensor],
        torque: Tensor,
        told: Told | None = None,
        *,
        hidden: Sequence[int] = (128, 128),
        n_critics: int = 2,
        n_quantiles: int = 25,
        drop_per_critic: int = 2,
        gamma: float = 0.95,
        tau: float = 0.01,
        lr: float = 1e-3,
        alpha_init: float = 0.01,
        target_entropy: float | None = None,
        action_l2: float = 0.0,
    ):
        check_number("n_quantiles", n_quantiles, "[1, inf)", whole=True)
        check_number("drop_per_critic", drop_per_critic, f"[0, {n_quantiles})", whole=True)
        super().__init__(
            scale,
            torque,
            hidden=hidden,
            n_critics=n_critics,
            outputs=n_quantiles,
            gamma=gamma,
            tau=tau,
            lr=lr,
            action_l2=action_l2,
            told=told,
            alpha_init=alpha_init,
            target_entropy=target_entropy,
        )
        self.keep = n_critics * (n_quantiles - drop_per_critic)

    def losses(self, batch: Mapping[str, Tensor], noise: tuple[Tensor, Tensor]) -> dict[str, Tensor]:
        """Return critic, actor and alpha losses and the entropy, see EntropyLearner."""
        alpha = self.log_alpha.exp().detach()
        with torch.no_grad():
            next_action, next_log_prob = sample_tanh(self.actor(batch["next_observation"]), noise[0])
            atoms = self.targets(batch["next_observation"], next_action).transpose(0, 1).flatten(1)
            atoms = atoms.sort(-1).values[:, : self.keep] - (alpha * next_log_prob)[:, None]
            live = self.gamma * (1.0 - batch["terminated"])
            target = batch["reward"][:, None] + live[:, None] * atoms
        quantiles = self.critics(batch["observation"], batch["action"])
        critic = QuantileHuber.apply(quantiles, target)

        action, log_prob = sample_tanh(self.actor(batch["observation"]), noise[1])
        value = self.critics.frozen(batch["observation"], action).mean((0, 2))
        actor = (alpha * log_prob - value).mean() + self.action_l2 * action.square().mean()
        temperature = -(self.log_alpha * (log_prob.detach() + self.target_entropy)).mean()
        return {
            "loss_critic": critic,
            "loss_actor": actor,
            "loss_alpha": temperature,
            "entropy": -log_prob.mean(),
        }


class QuantileHuber(torch.autograd.Function):
    """Quantile Huber loss of quantiles (C, B, N) against sorted targets (B, M), as TQCLoss: sum over C of the mean.

    With delta = y_j - theta_i, the loss of a pair is |tau_i - [delta < 0]| huber(delta) and its derivative by theta
    |tau_i - [delta < 0]| clip(-delta, -1, 1). The targets are sorted, so the pairs of one theta fall into four runs
    (delta below -1, to 0, to 1, above), and prefix sums of y and y^2 give the sums over each run exactly: three
    searches instead of N M pairs.
    """

    @staticmethod
    def forward(ctx, quantiles: Tensor, target: Tensor) -> Tensor:
        """Return the scalar loss; the gradient is worked out here and kept."""
        count, b, n = quantiles.shape
        m = target.shape[-1]
        # sums of squares cancel in single precision: centre the targets of each row, sum in double
        centre = target.double().mean(-1, keepdim=True)
        y = target.double() - centre
        theta = quantiles.transpose(0, 1).reshape(b, -1).double() - centre
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
        """Return the kept gradient times what comes from above."""
        return ctx.saved_tensors[0] * grad, None
