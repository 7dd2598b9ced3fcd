"""Networks of all algorithms: normalizer, actor, ensemble of critics, and the policy that an arm runs."""

from collections.abc import Iterable
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

CLIP = 10.0  # largest normalized observation, in standard deviations
LOG_STD = -5.0, 2.0  # bounds of the logarithm of the actor's standard deviation


class Normalizer(nn.Module):
    """Normalize observations x to (x - mean) / std, with fixed mean (d,) and std (d,)."""

    mean: Tensor
    std: Tensor

    def __init__(self, mean: Tensor, std: Tensor):
        super().__init__()
        self.register_buffer("mean", mean.float())
        self.register_buffer("std", std.float())

    def forward(self, x: Tensor) -> Tensor:
        """Return normalized x, clipped to [-CLIP, CLIP]."""
        return ((x - self.mean) / self.std).clamp(-CLIP, CLIP)


class Actor(nn.Module):
    """Map observations (B, d) to loc and scale (B, a) of a Gaussian; tanh of a sample is the action.

    Deterministic algorithms use only `mode` and do not train the scale. The network still has outputs for the scale,
    so that all algorithms write policies of equal size and file format.
    """

    def __init__(self, obs_dim: int, act_dim: int, hidden: tuple[int, ...]):
        super().__init__()
        sizes = [obs_dim, *hidden]
        layers: list[nn.Module] = []
        for i, o in pairwise(sizes):
            layers += [nn.Linear(i, o), nn.ReLU()]
        self.body = nn.Sequential(*layers, nn.Linear(sizes[-1], 2 * act_dim))

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Return loc and scale (B, a) of the Gaussian; tanh of a sample is the action."""
        loc, log_std = self.body(observation).chunk(2, -1)
        return loc, log_std.clamp(*LOG_STD).exp()

    def mode(self, observation: Tensor) -> Tensor:
        """Return the deterministic action (B, a), tanh(loc)."""
        return torch.tanh(self.body(observation).chunk(2, -1)[0])


class Policy(nn.Module):
    """A deterministic policy: observation (B, d) -> action (B, a), both in SI units.

    Args:
        normalizer, actor: networks. scale, offset: (a,); offset + scale x action converts an action in [-1, 1] to SI
            units, as in `r2s.control.controller.Controller`. If None, the offset is 0.
    """

    action_scale: Tensor
    action_offset: Tensor

    def __init__(self, normalizer: Normalizer, actor: Actor, scale: Tensor, offset: Tensor | None = None):
        super().__init__()
        self.normalizer, self.actor = normalizer, actor
        self.register_buffer("action_scale", scale)
        self.register_buffer("action_offset", torch.zeros_like(scale) if offset is None else offset, persistent=False)

    def action(self, observation: Tensor) -> Tensor:
        """Return the deterministic action (B, a) in [-1, 1]."""
        return self.actor.mode(self.normalizer(observation))

    def forward(self, observation: Tensor) -> Tensor:
        """Return actions in SI units; for control=torque, Nm without gravity, before low-pass and safety filter."""
        return self.action_offset + self.action(observation) * self.action_scale


class Critics(nn.Module):
    """C critics with LayerNorm in one batched network: observation (B, d), action (B, a) -> (C, B, outputs)."""

    def __init__(self, obs_dim: int, act_dim: int, hidden: tuple[int, ...], count: int, outputs: int):
        super().__init__()
        sizes = [obs_dim + act_dim, *hidden, outputs]
        self.weight, self.bias = nn.ParameterList(), nn.ParameterList()
        self.norm_scale, self.norm_shift = nn.ParameterList(), nn.ParameterList()
        for i, o in pairwise(sizes):
            bound = i**-0.5  # as in torch.nn.Linear
            self.weight.append(nn.Parameter(torch.empty(count, i, o).uniform_(-bound, bound)))
            self.bias.append(nn.Parameter(torch.empty(count, 1, o).uniform_(-bound, bound)))
        for o in hidden:
            self.norm_scale.append(nn.Parameter(torch.ones(count, 1, o)))
            self.norm_shift.append(nn.Parameter(torch.zeros(count, 1, o)))

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        """Return the outputs (C, B, outputs) of all critics."""
        return _outputs(observation, action, self.weight, self.bias, self.norm_scale, self.norm_shift)

    def frozen(self, observation: Tensor, action: Tensor, count: int | None = None) -> Tensor:
        """Return the outputs (C, B, outputs) of the first `count` critics, by default of all, for the actor's loss.

        The outputs have a gradient with respect to the action, but not to the critics' parameters.
        """
        groups = (self.weight, self.bias, self.norm_scale, self.norm_shift)
        return _outputs(observation, action, *([p.detach()[:count] for p in group] for group in groups))


def _outputs(
    observation: Tensor,
    action: Tensor,
    weight: Iterable[Tensor],
    bias: Iterable[Tensor],
    gain: Iterable[Tensor],
    shift: Iterable[Tensor],
) -> Tensor:
    *weights, last_weight = weight
    *biases, last_bias = bias
    x = torch.cat([observation, action], -1)
    x = x.expand(len(last_weight), *x.shape)
    for w, b, g, s in zip(weights, biases, gain, shift, strict=True):
        x = torch.baddbmm(b, x, w)
        x = F.relu(torch.addcmul(s, F.layer_norm(x, x.shape[-1:]), g))
    return torch.baddbmm(last_bias, x, last_weight)
