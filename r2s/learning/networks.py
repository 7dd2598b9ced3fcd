"""What every algorithm shares: a normaliser, an actor, an ensemble of critics, and the learner that holds them."""

from collections.abc import Iterable
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F


class Normalizer(nn.Module):
    """(x - mean) / std with fixed values (size,); part of the policy it belongs to."""

    mean: Tensor
    std: Tensor

    def __init__(self, mean: Tensor, std: Tensor):
        super().__init__()
        self.register_buffer("mean", mean.float())
        self.register_buffer("std", std.float())

    def forward(self, x: Tensor) -> Tensor:
        """Return normalised x, limited to +-10 standard deviations."""
        return ((x - self.mean) / self.std).clamp(-10.0, 10.0)


class Told(NamedTuple):
    """What a policy is told of its arm beside what it observes: the last `numbers` of its observations.

    Attributes:
        numbers: how many. Zeros say that the arm is as it is believed to be.
        latent: of how many the layers are shown, which an `Encoder` makes of them; 0: of the numbers themselves.
    """

    numbers: int
    latent: int = 0

    @property
    def shown(self) -> int:
        """How many numbers the layers are shown."""
        return self.latent or self.numbers


class Encoder(nn.Module):
    """What is told in fewer numbers, (B, c) -> (B, latent) in (-2, 2); zeros, nothing told, are zeros there."""

    def __init__(self, told: Told, hidden: int = 32):
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(told.numbers, hidden), nn.ReLU(), nn.Linear(hidden, told.latent), nn.Tanh()
        )

    def forward(self, told: Tensor) -> Tensor:
        """Return the latent."""
        return self.layers(told) - self.layers(torch.zeros_like(told[:1]))


class Actor(nn.Module):
    """Gaussian before tanh: observation (B, d) -> loc, scale (B, n); `told`: see there, None: nothing.

    A deterministic algorithm uses `mode` alone and leaves the n outputs of the scale as they are: so every policy is
    the same file, and the networks that are compared have the same size.
    """

    def __init__(
        self,
        obs_dim: int,
        act_dim: int,
        hidden: tuple[int, ...],
        log_std: tuple[float, float] = (-5.0, 2.0),
        told: Told | None = None,
    ):
        super().__init__()
        sizes = [obs_dim - told.numbers + told.shown if told else obs_dim, *hidden]
        layers: list[nn.Module] = []
        for i, o in pairwise(sizes):
            layers += [nn.Linear(i, o), nn.ReLU()]
        self.body = nn.Sequential(*layers, nn.Linear(sizes[-1], 2 * act_dim))
        self.log_std, self.told = log_std, told
        self.encoder = Encoder(told) if told and told.latent else None

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Return loc, scale of the Gaussian whose tanh is the action."""
        loc, log_std = self.body(self._shown(observation)).chunk(2, -1)
        return loc, log_std.clamp(*self.log_std).exp()

    def mode(self, observation: Tensor) -> Tensor:
        """Return the deterministic action (B, n), tanh of loc."""
        return torch.tanh(self.body(self._shown(observation)).chunk(2, -1)[0])

    def _shown(self, observation: Tensor) -> Tensor:
        if self.encoder is None or self.told is None:
            return observation
        own, told = observation.split([observation.shape[-1] - self.told.numbers, self.told.numbers], -1)
        return torch.cat([own, self.encoder(told)], -1)


class Policy(nn.Module):
    """What goes onto the arm: observation in SI units (B, d) -> torque target (B, n) Nm.

    One that may be told of its arm, and is not, takes it for what it is believed to be.
    """

    torque_scale: Tensor

    def __init__(self, normalizer: Normalizer, actor: Actor, torque: Tensor):
        super().__init__()
        self.normalizer, self.actor = normalizer, actor
        self.register_buffer("torque_scale", torque)

    def action(self, observation: Tensor) -> Tensor:
        """Return the deterministic action (B, n) in [-1, 1]."""
        told = self.told
        if told and observation.shape[-1] == len(self.normalizer.mean) - told.numbers:
            observation = torch.cat([observation, observation.new_zeros(len(observation), told.numbers)], -1)
        return self.actor.mode(self.normalizer(observation))

    @property
    def told(self) -> Told | None:
        """What it is told; None: it is told nothing."""
        return self.actor.told

    @torch.no_grad()
    def latent(self, told: Tensor) -> Tensor:
        """Return the latent (B, l) of what is told (B, c), in SI units."""
        assert self.told is not None
        assert self.actor.encoder is not None
        own = self.normalizer.mean.new_zeros(len(told), len(self.normalizer.mean) - self.told.numbers)
        return self.actor.encoder(self.normalizer(torch.cat([own, told], -1))[:, own.shape[-1] :])

    def by_latent(self) -> "Policy":
        """Return the policy that is told the latent itself; its layers are shared."""
        assert self.told is not None
        assert self.told.latent
        own, latent = len(self.normalizer.mean) - self.told.numbers, self.told.latent
        mean, std = (
            torch.cat([x[:own], torch.full((latent,), fill)])
            for x, fill in ((self.normalizer.mean, 0.0), (self.normalizer.std, 1.0))
        )
        actor = Actor(own + latent, len(self.torque_scale), (), self.actor.log_std, Told(latent))
        actor.body = self.actor.body
        return Policy(Normalizer(mean, std), actor, self.torque_scale)

    def forward(self, observation: Tensor) -> Tensor:
        """Return torque targets in Nm, without gravity, before the driver's filters and limits."""
        return self.action(observation) * self.torque_scale


class Critics(nn.Module):
    """An ensemble of C critics with LayerNorm, as one batched network: (B, d), (B, n) -> (C, B, outputs)."""

    def __init__(self, obs_dim: int, act_dim: int, hidden: tuple[int, ...], count: int, outputs: int):
        super().__init__()
        sizes = [obs_dim + act_dim, *hidden, outputs]
        self.weight, self.bias = nn.ParameterList(), nn.ParameterList()
        self.norm_scale, self.norm_shift = nn.ParameterList(), nn.ParameterList()
        for i, o in pairwise(sizes):
            bound = i**-0.5  # torch.nn.Linear's own
            self.weight.append(nn.Parameter(torch.empty(count, i, o).uniform_(-bound, bound)))
            self.bias.append(nn.Parameter(torch.empty(count, 1, o).uniform_(-bound, bound)))
        for o in hidden:
            self.norm_scale.append(nn.Parameter(torch.ones(count, 1, o)))
            self.norm_shift.append(nn.Parameter(torch.zeros(count, 1, o)))

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        """Return every critic's outputs (C, B, outputs)."""
        return _outputs(observation, action, self.weight, self.bias, self.norm_scale, self.norm_shift)

    def frozen(self, observation: Tensor, action: Tensor, count: int | None = None) -> Tensor:
        """Return the outputs (C, B, outputs) of the first `count` critics (None: all) for an actor's loss.

        The gradient goes through the critics to the action, not into them.
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


def sample_tanh(gaussian: tuple[Tensor, Tensor], noise: Tensor) -> tuple[Tensor, Tensor]:
    """Return tanh(loc + scale * noise) (B, n) and its log-density (B,) for a Gaussian (loc, scale); noise ~ N(0, 1).

    log(1 - tanh(x)^2) = 2 (log 2 - x - softplus(-2 x)) keeps the density finite where tanh saturates.
    """
    loc, scale = gaussian
    x = loc + scale * noise
    log_prob = -0.5 * noise.square() - scale.log() - 0.9189385332046727
    log_prob = log_prob - 2.0 * (0.6931471805599453 - x - F.softplus(-2.0 * x))
    return torch.tanh(x), log_prob.sum(-1)
