"""DDPG, TD3 and SAC have the losses and gradients of TorchRL, and a penalty on actions adds its share alone."""

import copy

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from test_algorithms import ALL, make
from test_tqc import HIDDEN, B, D, N, as_tensordict, critic_parts, make_batch, unbatch
from torchrl.modules import ProbabilisticActor
from torchrl.modules.distributions import TanhNormal
from torchrl.objectives import DDPGLoss, SACLoss, TD3Loss

from r2s.learning.ddpg import DDPG
from r2s.learning.networks import Critics
from r2s.learning.sac import SAC
from r2s.learning.td3 import TD3
from r2s.learning.tqc import TQC

NEAR = {"rtol": 1e-5, "atol": 1e-5}


def deterministic(actor):
    """Return the mode of `actor` as a TorchRL policy."""

    class Mode(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.net = copy.deepcopy(actor)

        def forward(self, observation):
            return self.net.mode(observation)

    return TensorDictModule(Mode(), in_keys=["observation"], out_keys=["action"])


def stochastic(actor):
    gaussian = TensorDictModule(copy.deepcopy(actor), in_keys=["observation"], out_keys=["loc", "scale"])
    return ProbabilisticActor(gaussian, in_keys=["loc", "scale"], distribution_class=TanhNormal, return_log_prob=True)


def assert_same_gradients(algo, reference, critic_params):
    """Compare the gradients of actor and critics with those of a TorchRL loss."""
    theirs = [p for p in reference.actor_network_params.parameters() if p.requires_grad]
    for p, q in zip(algo.actor.parameters(), theirs, strict=True):
        torch.testing.assert_close(p.grad, q.grad, **NEAR)
    names = [name for name, _ in unbatch(algo.critics)[0].named_parameters()]
    largest = 0.0
    for k in range(len(algo.critics.weight[0])):
        for name, (p, i, turn) in zip(names, critic_parts(algo.critics, k), strict=True):
            torch.testing.assert_close(turn(p.grad[i]), critic_params(k, name).grad, **NEAR)
            largest = max(largest, p.grad[i].abs().max().item())
    assert largest > 1e-2
    assert max(p.grad.abs().max() for p in algo.actor.parameters()) > 1e-3
    assert all(p.grad is None for name, p in algo.named_parameters() if "target" in name)


def stacked(reference):
    """Return (k, name) -> parameter of critic k of a TorchRL loss with several critics, its gradient with it."""
    found = reference.qvalue_network_params.flatten_keys(".")

    def one(k, name):
        part = found.get(name)[k].detach()
        part.grad = found.get(name).grad[k]
        return part

    return one


def set_critic_targets(reference, algo):
    targets = torch.stack([TensorDict.from_module(net) for net in unbatch(algo.targets)])
    reference.target_qvalue_network_params.data.update_(targets.data)


@pytest.mark.filterwarnings("ignore:No target network updater")
@pytest.mark.parametrize("gamma", [0.0, 0.93])
def test_ddpg_is_torchrls(gamma):
    """Values and gradients equal DDPGLoss with delayed actor and critic."""
    algo, batch = make(DDPG, gamma=gamma), make_batch()
    reference = DDPGLoss(deterministic(algo.actor), unbatch(algo.critics)[0], loss_function="l2", delay_actor=True)
    reference.make_value_estimator(gamma=gamma)
    target_actor = TensorDict.from_module(deterministic(algo.target_actor))
    reference.target_actor_network_params.data.update_(target_actor.data)
    reference.target_value_network_params.data.update_(TensorDict.from_module(unbatch(algo.targets)[0]).data)
    own, theirs = algo.losses(batch), reference(as_tensordict(batch))
    for mine, other in (("loss_critic", "loss_value"), ("loss_actor", "loss_actor")):
        torch.testing.assert_close(own[mine], theirs[other], **NEAR)
    (own["loss_critic"] + own["loss_actor"]).backward()
    (theirs["loss_value"] + theirs["loss_actor"]).backward()
    found = reference.value_network_params.flatten_keys(".")
    assert_same_gradients(algo, reference, lambda k, name: found.get(name))


@pytest.mark.filterwarnings("ignore:No target network updater")
@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"n_critics": 3, "smoothing_std": 0.6, "smoothing_clip": 0.3},
        {"smoothing_std": 2.0, "smoothing_clip": 1.5},
    ],
)
def test_td3_is_torchrls(settings):
    """Values and gradients equal TD3Loss from the same normal draw."""
    algo, batch = make(TD3, **settings), make_batch()
    networks = unbatch(algo.critics)
    reference = TD3Loss(
        deterministic(algo.actor),
        networks,
        bounds=(-1.0, 1.0),
        num_qvalue_nets=len(networks),
        policy_noise=algo.smoothing_std,
        noise_clip=algo.smoothing_clip,
        loss_function="l2",
    )
    reference.make_value_estimator(gamma=algo.gamma)
    target_actor = TensorDict.from_module(deterministic(algo.target_actor))
    reference.target_actor_network_params.data.update_(target_actor.data)
    set_critic_targets(reference, algo)
    torch.manual_seed(7)
    own = algo.losses(batch, torch.randn(B, N))
    torch.manual_seed(7)
    theirs = reference(as_tensordict(batch))
    for mine, other in (("loss_critic", "loss_qvalue"), ("loss_actor", "loss_actor")):
        torch.testing.assert_close(own[mine], theirs[other], **NEAR)
    (own["loss_critic"] + own["loss_actor"]).backward()
    (theirs["loss_qvalue"] + theirs["loss_actor"]).backward()
    assert_same_gradients(algo, reference, stacked(reference))


@pytest.mark.filterwarnings("ignore:No target network updater")
@pytest.mark.parametrize("settings", [{}, {"n_critics": 3, "gamma": 0.8, "alpha_init": 0.3, "target_entropy": -10}])
def test_sac_is_torchrls(settings):
    """Values and gradients of actor, critics and temperature equal SACLoss from the same normal draws."""
    algo, batch = make(SAC, **settings), make_batch()
    networks = unbatch(algo.critics)
    reference = SACLoss(
        stochastic(algo.actor),
        networks,
        num_qvalue_nets=len(networks),
        loss_function="l2",
        alpha_init=settings.get("alpha_init", 0.01),
        target_entropy=algo.target_entropy,
    )
    reference.make_value_estimator(gamma=algo.gamma)
    set_critic_targets(reference, algo)
    torch.manual_seed(7)
    noise = torch.randn(B, N), torch.randn(B, N)
    own = algo.losses(batch, noise)
    torch.manual_seed(7)  # SACLoss draws the next action first, then the present one, as `noise`
    theirs = reference(as_tensordict(batch))
    for mine, other in (("loss_critic", "loss_qvalue"), ("loss_actor", "loss_actor"), ("loss_alpha", "loss_alpha")):
        torch.testing.assert_close(own[mine], theirs[other], **NEAR)
    torch.testing.assert_close(own["entropy"], theirs["entropy"], **NEAR)
    (own["loss_critic"] + own["loss_actor"] + own["loss_alpha"]).backward()
    (theirs["loss_qvalue"] + theirs["loss_actor"] + theirs["loss_alpha"]).backward()
    torch.testing.assert_close(algo.log_alpha.grad, reference.log_alpha.grad, **NEAR)
    assert_same_gradients(algo, reference, stacked(reference))


def test_judging_leaves_the_critics_alone():
    """`frozen` has the values and the action's gradient of `forward`, of as many critics as asked, and no other."""
    torch.manual_seed(0)
    critics, seen, action = Critics(D, N, HIDDEN, 3, 2), torch.randn(5, D), torch.randn(5, N, requires_grad=True)
    torch.testing.assert_close(critics.frozen(seen, action), critics(seen, action))
    frozen = critics.frozen(seen, action, 2)
    torch.testing.assert_close(frozen, critics(seen, action)[:2])
    (expected,) = torch.autograd.grad(critics(seen, action)[:2].sum(), action)
    frozen.sum().backward()
    torch.testing.assert_close(action.grad, expected)
    assert all(p.grad is None for p in critics.parameters())


@pytest.mark.parametrize("kind", ALL)
def test_action_l2_is_the_mean_square_in_the_actors_loss(kind):
    """action_l2 adds its weight times the mean squared action to the actor's loss and nothing to the critic's."""
    batch, noise = make_batch(), (torch.randn(B, N), torch.randn(B, N))
    draws = {DDPG: (), TD3: noise[:1], SAC: (noise,), TQC: (noise,)}[kind]
    plain, weighed = (make(kind, action_l2=w) for w in (0.0, 0.7))
    loc, scale = plain.actor(batch["observation"])
    action = torch.tanh(loc + scale * noise[1]) if kind in (SAC, TQC) else torch.tanh(loc)
    one, other = plain.losses(batch, *draws), weighed.losses(batch, *draws)
    torch.testing.assert_close(other["loss_actor"] - one["loss_actor"], 0.7 * action.square().mean())
    torch.testing.assert_close(other["loss_critic"], one["loss_critic"])
