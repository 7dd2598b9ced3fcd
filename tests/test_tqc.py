"""TQC is TorchRL's TQC: the same losses and gradients from the same weights and the same noise."""

import copy

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import MLP, ProbabilisticActor, ValueOperator
from torchrl.modules.distributions import TanhNormal
from torchrl.objectives import TQCLoss

from r2s.learning.learner import sample_tanh
from r2s.learning.tqc import TQC, quantile_huber

D, N, B = 11, 3, 64
HIDDEN = (32, 24)
BIG = {"n_critics": 3, "n_quantiles": 17, "drop_per_critic": 4, "gamma": 0.93, "alpha_init": 0.2}


def make(seed=0, **change):
    """Return a small learner whose targets differ from its critics, as they do in training."""
    torch.manual_seed(seed)
    scale = torch.linspace(-1, 1, D), torch.linspace(0.5, 2, D)
    algo = TQC(scale, torch.tensor([3.0, 2.0, 1.0]), hidden=HIDDEN, **change)
    with torch.no_grad():
        for parameter in [*algo.targets.parameters(), *algo.critics.norm_scale, *algo.critics.norm_shift]:
            parameter.add_(0.1 * torch.randn_like(parameter))
    return algo


def make_batch(seed=1, size=B):
    generator = torch.Generator().manual_seed(seed)
    normal = {k: torch.randn(size, D, generator=generator) for k in ("observation", "next_observation")}
    return normal | {
        "action": torch.rand(size, N, generator=generator) * 2 - 1,
        "reward": 2 * torch.randn(size, generator=generator),
        "terminated": (torch.rand(size, generator=generator) < 0.3).float(),
    }


def critic_parts(critics, k):
    """Return the tensors of critic k of the batched network, in the order of an MLP with LayerNorm."""
    for i, (weight, bias) in enumerate(zip(critics.weight, critics.bias, strict=True)):
        yield weight, k, lambda w: w.T
        yield bias, k, lambda b: b[0]
        if i < len(critics.norm_scale):
            yield critics.norm_scale[i], k, lambda g: g[0]
            yield critics.norm_shift[i], k, lambda s: s[0]


def unbatch(critics):
    """Return the ensemble as separate TorchRL networks with the same weights."""
    count, _, outputs = critics.weight[-1].shape
    networks = []
    for k in range(count):
        net = MLP(
            in_features=D + N,
            out_features=outputs,
            num_cells=list(HIDDEN),
            activation_class=nn.ReLU,
            norm_class=nn.LayerNorm,
            norm_kwargs=[{"normalized_shape": h} for h in HIDDEN],
        )
        with torch.no_grad():
            for mine, (theirs, i, turn) in zip(net.parameters(), critic_parts(critics, k), strict=True):
                mine.copy_(turn(theirs[i]))
        networks.append(ValueOperator(net, in_keys=["observation", "action"]))
    return networks


def torchrl_loss(algo, **settings):
    """Return a TQCLoss with the weights of `algo`."""
    actor = ProbabilisticActor(
        TensorDictModule(copy.deepcopy(algo.actor), in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    networks = unbatch(algo.critics)
    loss = TQCLoss(
        actor,
        networks,
        num_qvalue_nets=len(networks),
        top_quantiles_to_drop_per_net=settings["drop_per_critic"],
        alpha_init=settings["alpha_init"],
        target_entropy=algo.target_entropy,
    )
    loss.make_value_estimator(gamma=settings["gamma"])
    targets = torch.stack([TensorDict.from_module(net) for net in unbatch(algo.targets)])
    loss.target_qvalue_network_params.data.update_(targets.data)
    return loss


def as_tensordict(batch):
    ended = batch["terminated"].bool()[:, None]
    after = {"observation": batch["next_observation"], "reward": batch["reward"][:, None]}
    after |= {"terminated": ended, "done": ended}
    return TensorDict(
        {"observation": batch["observation"], "action": batch["action"], "next": TensorDict(after, [B])}, [B]
    )


@pytest.mark.filterwarnings("ignore:No target network updater")
@pytest.mark.parametrize(
    "settings", [BIG, {"n_critics": 2, "n_quantiles": 25, "drop_per_critic": 0, "gamma": 0.98, "alpha_init": 0.01}]
)
def test_losses_and_gradients_are_torchrls(settings):
    """Values and gradients of actor, critics and temperature equal TQCLoss within 1e-5 from the same normal draws."""
    algo, batch = make(**settings), make_batch()
    reference = torchrl_loss(algo, **settings)
    torch.manual_seed(7)
    noise = torch.randn(B, N), torch.randn(B, N)
    own = algo.losses(batch, noise)
    torch.manual_seed(7)  # TQCLoss draws the next action first, then the present one, as `noise`
    theirs = reference(as_tensordict(batch))
    for mine, other in (("loss_critic", "loss_qvalue"), ("loss_actor", "loss_actor"), ("loss_alpha", "loss_alpha")):
        torch.testing.assert_close(own[mine], theirs[other], rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(own["entropy"], theirs["entropy"].mean(), rtol=1e-5, atol=1e-5)

    (own["loss_critic"] + own["loss_actor"] + own["loss_alpha"]).backward()
    (theirs["loss_qvalue"] + theirs["loss_actor"] + theirs["loss_alpha"]).backward()
    near = {"rtol": 1e-5, "atol": 1e-5}
    torch.testing.assert_close(algo.log_alpha.grad, reference.log_alpha.grad, **near)
    actor = [p for p in reference.actor_network_params.parameters() if p.requires_grad]
    for p, q in zip(algo.actor.parameters(), actor, strict=True):
        torch.testing.assert_close(p.grad, q.grad, **near)
    found = reference.qvalue_network_params.flatten_keys(".")
    names = [name for name, _ in unbatch(algo.critics)[0].named_parameters()]
    largest = 0.0
    for k in range(settings["n_critics"]):
        for name, (p, i, turn) in zip(names, critic_parts(algo.critics, k), strict=True):
            torch.testing.assert_close(turn(p.grad[i]), found.get(name).grad[k], **near)
            largest = max(largest, p.grad[i].abs().max().item())
    assert largest > 1e-2
    assert all(p.grad is None for p in algo.targets.parameters())


def all_pairs(quantiles, target):
    """Return the quantile Huber loss as TQCLoss writes it, in double precision."""
    theta, y = quantiles.double(), target.double()
    delta = y[None, :, None, :] - theta[..., None]
    huber = torch.where(delta.abs() <= 1, 0.5 * delta.square(), delta.abs() - 0.5)
    fraction = (torch.arange(theta.shape[-1], dtype=torch.float64) + 0.5) / theta.shape[-1]
    weight = (fraction[:, None] - (delta.detach() < 0).double()).abs()
    return (weight * huber).mean((-1, -2)).sum(0).mean()


def compare(quantiles, target):
    """Assert that value and gradient are those of `all_pairs`; the tolerance is single precision's."""
    quantiles = quantiles.clone().requires_grad_(True)
    value = quantile_huber(quantiles, target)
    (gradient,) = torch.autograd.grad(value, quantiles)
    expected = all_pairs(quantiles, target)
    (expected_gradient,) = torch.autograd.grad(expected, quantiles)
    torch.testing.assert_close(value.double(), expected, rtol=1e-5, atol=1e-7)
    torch.testing.assert_close(gradient.double(), expected_gradient.double(), rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("spread", [1e-3, 0.3, 1.0, 30.0, 1e4])
@pytest.mark.parametrize("shift", [0.0, 1.0, -2000.0])
def test_the_quantile_loss_is_that_of_the_paper(spread, shift):
    """Loss and gradient at any spread, also far from zero."""
    torch.manual_seed(2)
    compare(shift + spread * torch.randn(3, 16, 9), shift + spread * torch.randn(16, 23))


def test_ties_are_no_exception():
    """Quantiles on a target, and exactly 1 from it, where the loss changes its form."""
    torch.manual_seed(3)
    compare(torch.randint(-3, 4, (2, 50, 7)).float(), torch.randint(-3, 4, (50, 11)).float())
    compare(torch.zeros(2, 4, 5), torch.zeros(4, 6))
    compare(torch.ones(1, 1, 1), torch.zeros(1, 1))


def test_the_density_of_a_squashed_gaussian():
    """sample_tanh gives the action and log-density of TanhNormal, and stays finite where tanh saturates."""
    torch.manual_seed(5)
    loc, scale, noise = torch.randn(40, N), torch.rand(40, N) + 0.1, torch.randn(40, N)
    action, density = sample_tanh((loc, scale), noise)
    reference = torch.distributions.TransformedDistribution(
        torch.distributions.Normal(loc.double(), scale.double()), torch.distributions.TanhTransform()
    )
    expected = reference.log_prob(torch.tanh(loc.double() + scale.double() * noise.double())).sum(-1)
    torch.testing.assert_close(action, torch.tanh(loc + scale * noise))
    torch.testing.assert_close(density.double(), expected, rtol=1e-4, atol=1e-3)
    far = torch.full((1, N), 60.0, requires_grad=True)
    _, saturated = sample_tanh((far, torch.ones(1, N)), torch.zeros(1, N))
    saturated.sum().backward()
    assert saturated.isfinite().all()
    assert far.grad.isfinite().all()


def in_si(batch):
    return batch | {k: 2 * batch[k] + 0.5 for k in ("observation", "next_observation")}


def test_targets_take_a_polyak_step():
    """After an update the targets are (1 - tau) old + tau new critics, element by element."""
    algo = make(tau=0.03)
    old = copy.deepcopy(algo.targets)
    before = copy.deepcopy(algo.critics)
    algo.update(in_si(make_batch()))
    for new, was, critic, was_critic in zip(
        algo.targets.parameters(), old.parameters(), algo.critics.parameters(), before.parameters(), strict=True
    ):
        torch.testing.assert_close(new, 0.97 * was + 0.03 * critic)
        assert not torch.equal(critic, was_critic)


def test_a_seed_gives_the_same_updates_twice():
    """Five updates from one seed end in the same bits; another seed draws other noise."""
    results = []
    for seed in (0, 0, 1):
        algo, batch = make(), make_batch()
        torch.manual_seed(seed)
        for _ in range(5):
            row = algo.update(in_si(batch))
        results.append(torch.cat([p.detach().flatten() for p in algo.parameters()]))
        assert all(torch.isfinite(v) for v in row.values())
    assert torch.equal(results[0], results[1])
    assert not torch.equal(results[0], results[2])


def test_an_update_normalises_what_the_losses_get():
    """`update` on SI units has the losses of the normalised batch, limited to 10 deviations, for the same noise."""
    algo, batch = make(lr=1e-3), in_si(make_batch())
    twin = copy.deepcopy(algo)
    torch.manual_seed(0)
    row = algo.update(batch)
    torch.manual_seed(0)
    noise = torch.randn(B, N), torch.randn(B, N)
    normal = batch | {
        k: ((batch[k] - twin.normalizer.mean) / twin.normalizer.std).clamp(-10, 10)
        for k in ("observation", "next_observation")
    }
    expected = twin.losses(normal, noise)
    for key in ("loss_critic", "loss_actor", "loss_alpha"):
        torch.testing.assert_close(row[key], expected[key].detach())


@pytest.mark.long
def test_the_critics_learn_a_known_return():
    """Where every transition ends the episode, the quantiles' mean goes to the reward of that state."""
    algo, batch = make(lr=3e-3), make_batch()
    batch |= {"terminated": torch.ones(B), "reward": batch["observation"][:, 0] + batch["action"][:, 1]}
    first = algo.update(in_si(batch))["loss_critic"]
    for _ in range(250):
        last = algo.update(in_si(batch))["loss_critic"]
    normal = algo.normalizer(in_si(batch)["observation"])
    error = algo.critics(normal, batch["action"]).mean((0, 2)) - batch["reward"]
    assert last < 0.1 * first
    assert error.abs().mean() < 0.1


def test_the_policy_is_the_learners_mode_in_torque():
    """`policy` shares the actor's weights and gives tanh of the mean, times the torque of an action of 1."""
    algo = make()
    policy, seen = algo.policy, torch.randn(6, D)
    loc, scale = algo.actor(algo.normalizer(seen))
    torch.testing.assert_close(policy(seen), torch.tanh(loc) * torch.tensor([3.0, 2.0, 1.0]))
    algo.update(in_si(make_batch()))
    assert not torch.equal(policy.action(seen), torch.tanh(loc))
    torch.manual_seed(0)
    draws = torch.stack([algo.explore(seen) for _ in range(2000)])
    loc, scale = algo.actor(algo.normalizer(seen))
    torch.testing.assert_close(torch.atanh(draws.double()).std(0).float(), scale.detach(), rtol=0.1, atol=0)
    assert draws.abs().max() <= 1


def test_a_loss_that_is_no_number_stops_the_training():
    """NaN in a reward reaches the loss, which is refused before it changes anything."""
    algo, batch = make(), in_si(make_batch())
    batch["reward"] = batch["reward"].clone()
    batch["reward"][3] = float("nan")
    before = copy.deepcopy(algo.state_dict())
    with pytest.raises(FloatingPointError, match=r"^the loss of update 1 is nan$"):
        algo.update(batch)
    assert all(torch.equal(v, before[k]) for k, v in algo.state_dict().items() if isinstance(v, torch.Tensor))
