"""DDPG, TD3 and SAC equal TorchRL's; all four algorithms repeat, save, learn and refuse alike.

tests/test_tqc.py holds what is TQC's own, and the helpers for batches and TorchRL critics.
"""

import copy
import math
import re
from dataclasses import fields
from functools import partial

import pytest
import torch
import yaml
from conftest import ROOT, conf
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from test_tqc import HIDDEN, B, D, N, as_tensordict, critic_parts, in_si, make_batch, unbatch
from torch._inductor import config as inductor
from torchrl.modules import ProbabilisticActor
from torchrl.modules.distributions import TanhNormal
from torchrl.objectives import DDPGLoss, SACLoss, TD3Loss

from r2s.errors import UserError
from r2s.learning.ddpg import DDPG
from r2s.learning.learner import KERNELS, Learner
from r2s.learning.networks import Critics
from r2s.learning.policy import export_onnx, load_policy, save_policy
from r2s.learning.sac import SAC
from r2s.learning.td3 import TD3
from r2s.learning.tqc import TQC
from r2s.learning.train import Loop
from r2s.stages.parts import arguments
from r2s.tasks.reach import ReachTask

PAGE = ROOT / "docs" / "reference" / "algorithms.md"
ALL = (DDPG, TD3, SAC, TQC)
NEAR = {"rtol": 1e-5, "atol": 1e-5}


def make(kind, seed=0, **change):
    """Return a small learner whose targets differ from what they follow, as they do in training."""
    torch.manual_seed(seed)
    scale = torch.linspace(-1, 1, D), torch.linspace(0.5, 2, D)
    algo = kind(scale, torch.tensor([3.0, 2.0, 1.0]), **{"hidden": HIDDEN} | change)
    with torch.no_grad():
        for name, parameter in algo.named_parameters():
            if "target" in name or "critics.norm_scale" in name or "critics.norm_shift" in name:
                parameter.add_(0.1 * torch.randn_like(parameter))
    return algo


def bits(algo):
    """Return everything that a learner has learned, as one vector."""
    return torch.cat([p.detach().flatten() for p in algo.parameters()])


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
def test_a_seed_gives_the_same_updates_twice(kind):
    """Five updates and a draw of actions from one seed end in the same bits; another seed in others."""
    results = []
    for seed in (0, 0, 1):
        algo, batch = make(kind), in_si(make_batch())
        torch.manual_seed(seed)
        for _ in range(5):
            row = algo.update(batch)
            assert all(torch.isfinite(v) for v in row.values())
        assert all(v.shape == () and not v.requires_grad for v in row.values())
        results.append(torch.cat([bits(algo), algo.explore(batch["observation"]).flatten()]))
    assert torch.equal(results[0], results[1])
    assert not torch.equal(results[0], results[2])


@pytest.mark.parametrize("kind", ALL)
@pytest.mark.parametrize("before", [0, 1])
def test_a_saved_learner_goes_on_bit_for_bit(kind, before, tmp_path):
    """State through a file: moments, temperature, learning rate and the turn of a delayed update come back."""
    delay = {"policy_delay": 3} if kind is TD3 else {}
    algo, batches = make(kind, **delay), [in_si(make_batch(seed)) for seed in range(9)]
    for batch in batches[:before]:
        algo.update(batch)
    algo.set_lr(0.3)
    algo.update(batches[3])
    torch.save(algo.state_dict(), tmp_path / "learner.pt")
    twin = make(kind, seed=5, **delay)
    twin.update(batches[4])
    twin.load_state_dict(torch.load(tmp_path / "learner.pt", weights_only=True))
    ends = []
    for one in (algo, twin):
        torch.manual_seed(11)
        rows = [one.update(batch) for batch in batches[4:]]
        ends.append((bits(one), one.updates, *[torch.stack(list(row.values())) for row in rows]))
    for mine, theirs in zip(*ends, strict=True):
        assert torch.equal(torch.as_tensor(mine), torch.as_tensor(theirs))


def test_a_restored_learner_explores_on_its_own_device():
    """The noise of a checkpoint, which is read on the processor, goes where the learner is."""
    algo = make(TD3)
    algo.explore(in_si(make_batch())["observation"])
    other = make(TD3).to("meta")
    other.set_extra_state(algo.get_extra_state())
    observation = in_si(make_batch())["observation"].to("meta")
    assert other.noise(other.actor.mode(observation)).device.type == "meta"


@pytest.mark.parametrize("kind", ALL)
def test_two_learners_from_one_state_are_apart(kind):
    """Updates of a learner that took over a state leave the other's weights and moments as they were."""
    algo, batch = make(kind), in_si(make_batch())
    algo.update(batch)
    twin, alone = make(kind), make(kind)
    twin.load_state_dict(algo.state_dict())
    alone.load_state_dict(copy.deepcopy(algo.state_dict()))
    for _ in range(3):
        twin.update(batch)
    for one in (algo, alone):
        torch.manual_seed(3)
        for _ in range(2):
            one.update(batch)
    assert torch.equal(bits(algo), bits(alone))


SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    ("kind", "backend"), [(TQC, "aot_eager"), *(pytest.param(k, "inductor", marks=SLOW) for k in ALL)]
)
def test_compiled_learns_the_same(kind, backend, monkeypatch):
    """Compiled losses give the same updates within 1e-4 after several, and leave random numbers alone.

    `aot_eager` traces losses and gradients as the compiler does, without half a minute of C++.
    """
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend=backend))
    plain, compiled = make(kind), make(kind)
    random = torch.get_rng_state()
    assert compiled.compile(B)
    assert torch.equal(torch.get_rng_state(), random)
    assert torch.equal(bits(plain), bits(compiled))
    for seed in range(3):
        logs = []
        for algo in (plain, compiled):
            torch.manual_seed(seed)
            logs.append(algo.update(in_si(make_batch(seed))))
        torch.testing.assert_close(*logs, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(bits(plain), bits(compiled), rtol=1e-4, atol=1e-5)


def test_compiling_takes_no_more_processes_than_threads(monkeypatch):
    """Jobs of a sweep share the cores; torch's own default is a process per core in each job."""
    algo, seen = make(TQC), []
    monkeypatch.setattr(torch, "compile", lambda method, **how: method)
    monkeypatch.setattr(
        algo, "losses", lambda *given: seen.append(inductor.compile_threads) or TQC.losses(algo, *given)
    )
    before = inductor.compile_threads
    assert algo.compile(B)
    assert seen == [min(torch.get_num_threads(), KERNELS)]
    assert inductor.compile_threads == before


def test_without_a_compiler_one_warning(tmp_path, monkeypatch):
    """The learner stays as it is and learns on."""
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))
    torch.compiler.reset()  # forget what other tests of this process have compiled
    algo = make(DDPG)
    before = bits(algo).clone()
    none = inductor.patch({"cpp.cxx": (None, str(tmp_path / "none"))})
    with none, pytest.warns(UserWarning, match="the losses are not compiled") as seen:
        assert not algo.compile(B)
    assert sum("not compiled" in str(w.message) for w in seen) == 1
    assert torch.equal(bits(algo), before)
    algo.update(in_si(make_batch()))
    assert not torch.equal(bits(algo), before)


@pytest.mark.parametrize("kind", [DDPG, TD3])
def test_targets_take_a_polyak_step(kind):
    """After an update both target networks are (1 - tau) old + tau new, element by element."""
    algo = make(kind, tau=0.03)
    old = copy.deepcopy(algo)
    algo.update(in_si(make_batch()))
    for target, source in (("targets", "critics"), ("target_actor", "actor")):
        parts = (getattr(algo, target), getattr(old, target), getattr(algo, source))
        for new, was, followed in zip(*(part.parameters() for part in parts), strict=True):
            torch.testing.assert_close(new, 0.97 * was + 0.03 * followed)
            assert not torch.equal(new, was) or torch.equal(was, followed)


def test_td3_moves_actor_and_targets_at_every_third_update():
    """With policy_delay 3 they move at updates 1, 4, 7; the critics move at each, and the logged loss stays."""
    algo, batch = make(TD3, policy_delay=3), in_si(make_batch())
    moved, logged = [], []
    for _ in range(7):
        was = copy.deepcopy(algo)
        logged.append(algo.update(batch)["loss_actor"].item())
        changes = [
            not torch.equal(a, b)
            for name in ("actor", "target_actor", "targets", "critics")
            for a, b in [
                (
                    torch.nn.utils.parameters_to_vector(getattr(algo, name).parameters()),
                    torch.nn.utils.parameters_to_vector(getattr(was, name).parameters()),
                )
            ]
        ]
        assert changes[3]
        assert len(set(changes[:3])) == 1
        moved.append(changes[0])
    assert moved == [True, False, False, True, False, False, True]
    assert logged[0] == logged[1] == logged[2] != logged[3]
    assert logged[3] == logged[5] != logged[6]


@pytest.mark.parametrize("kind", [DDPG, TD3])
def test_gaussian_exploration(kind):
    """Actions are the policy's plus noise of explore_std, within [-1, 1]; without noise they are the policy's."""
    algo, seen = make(kind, explore_std=0.05), torch.randn(6, D)
    mode = algo.policy.action(seen)
    draws = torch.stack([algo.explore(seen) for _ in range(2000)])
    torch.testing.assert_close(draws.mean(0), mode.detach(), rtol=0, atol=0.01)
    torch.testing.assert_close(draws.std(0), torch.full_like(mode, 0.05), rtol=0.1, atol=0)
    assert make(kind, explore_std=5.0).explore(seen).abs().max() == 1
    still = make(kind, explore_std=0.0)
    torch.testing.assert_close(still.explore(seen), still.policy.action(seen))


@pytest.mark.parametrize("kind", ALL)
def test_exploration_is_correlated_and_falls(kind):
    """Noise of an arm keeps its variance and has the correlation given; its share scales the deviation."""
    algo, count = make(kind, explore_correlation=0.9), 4000
    draws = torch.stack([algo.noise(torch.zeros(6, N)) for _ in range(count)])
    # the correlation leaves (1 - 0.9) / (1 + 0.9) of the draws independent
    wide = 5.0 / (count * 6 * N * 0.1 / 1.9) ** 0.5
    assert abs(float(draws.square().mean()) - 1.0) < 2**0.5 * wide
    assert abs(float((draws[1:] * draws[:-1]).mean()) - 0.9) < 2**0.5 * wide
    other = make(kind, explore_correlation=0.9)
    other.load_state_dict(algo.state_dict())
    torch.manual_seed(1)
    following = algo.noise(torch.zeros(6, N))
    torch.manual_seed(1)
    assert torch.equal(other.noise(torch.zeros(6, N)), following)
    seen = torch.randn(4000, D)
    algo.set_exploration(0.1)
    if kind in (DDPG, TD3):
        algo.explore_std = 0.5
        assert (algo.explore(seen) - algo.policy.action(seen)).std() < 0.06
    else:
        assert float(algo.entropy_goal) == pytest.approx(algo.target_entropy + N * math.log(0.1))


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


@pytest.mark.parametrize("kind", ALL)
def test_learns_to_bring_a_point_to_zero(kind):
    """A point x' = x + a/2 with reward -x'^2: after 580 updates on what it did itself, |x| < 0.2 after five steps."""
    torch.manual_seed(0)
    change: dict = {"explore_std": 0.2} if kind in (DDPG, TD3) else {}
    change |= {"hidden": (32, 32), "gamma": 0.7, "lr": 3e-3, "tau": 0.02}
    algo = kind((torch.zeros(1), torch.ones(1)), torch.ones(1), **change)
    assert isinstance(algo, Learner)
    kept = []
    x = 4 * torch.rand(64, 1) - 2
    for step in range(600):
        if step % 6 == 0:
            x = 4 * torch.rand(64, 1) - 2
        a = algo.explore(x) if step >= 20 else 2 * torch.rand(64, 1) - 1
        after = x + 0.5 * a
        kept.append({"observation": x, "action": a, "next_observation": after, "reward": -(after[:, 0] ** 2)})
        x = after
        if step < 20:
            continue
        if step % 20 == 0:
            replay = {k: torch.cat([row[k] for row in kept]) for k in kept[0]}
        algo.set_lr(min(1.0, 2.0 - step / 300))
        pick = torch.randint(len(replay["reward"]), (128,))
        algo.update({k: v[pick] for k, v in replay.items()} | {"terminated": torch.zeros(128)})
    x = torch.linspace(-2, 2, 41)[:, None]
    with torch.no_grad():
        for _ in range(5):
            x = x + 0.5 * algo.policy.action(x)
    assert x.abs().max() < 0.2


@pytest.mark.parametrize("kind", ALL)
def test_the_policy_goes_onto_disk(kind, panda, tmp_path):
    """policy.pt of any algorithm gives the torques of the learner's policy."""
    task = ReachTask(**{k: tuple(v) if isinstance(v, list) else v for k, v in conf("task/reach").items()})
    policy = learner_of(kind, panda, task).policy
    save_policy(tmp_path, policy)
    loaded = load_policy(tmp_path, panda, task)
    seen = torch.randn(9, len(policy.normalizer.mean))
    assert torch.equal(loaded(seen), policy(seen))


def learner_of(kind, robot, task):
    mean, std = (torch.from_numpy(s) for s in task.observation_scale(robot))
    return kind((mean, std), torch.from_numpy(task.torque_limit(robot)), **{"hidden": HIDDEN})


def test_a_deterministic_policy_becomes_onnx(panda, tmp_path):
    """policy.onnx of TD3 gives the torques of the torch policy, within 1e-5 of their scale."""
    import onnxruntime

    task = ReachTask(**{k: tuple(v) if isinstance(v, list) else v for k, v in conf("task/reach").items()})
    policy = learner_of(TD3, panda, task).policy.eval()
    export_onnx(tmp_path / "policy.onnx", policy, panda, task)
    session = onnxruntime.InferenceSession(str(tmp_path / "policy.onnx"))
    seen = torch.randn(9, len(policy.normalizer.mean))
    (torque,) = session.run(None, {"observation": seen.numpy()})
    difference = (torch.from_numpy(torque) - policy(seen)) / policy.action_scale
    assert difference.abs().max() < 1e-5


SHARED = {
    "hidden": ([], [0], [128, -1], [64.5], 128, "128", None, ["64"]),
    "gamma": (1.0, -0.1, 1.5, float("nan"), "0.9", None, True),
    "tau": (0.0, -0.1, 1.01, float("inf"), "x"),
    "lr": (0.0, -5e-4, 2.0, float("nan"), None, "fast", False),
    "action_l2": (-0.1, float("inf"), None),
    "explore_correlation": (-0.1, 1.0, None),
}
OWN = {
    DDPG: {"explore_std": (-0.1, None, float("nan"))},
    TD3: {
        "n_critics": (0, -1, 1.5, True),
        "explore_std": (-0.1,),
        "smoothing_std": (-0.1, "0.2"),
        "smoothing_clip": (-0.1,),
        "policy_delay": (0, -2, 1.5),
    },
    SAC: {
        "n_critics": (0, 2.5),
        "alpha_init": (0.0, -0.01, None),
        "target_entropy": (float("nan"), "auto", float("-inf")),
    },
    TQC: {
        "n_critics": (0,),
        "n_quantiles": (0, -25, 2.5, None, "25"),
        "drop_per_critic": (-1, 25, 30, 0.5),
        "alpha_init": (0.0, -0.01),
        "target_entropy": ("auto",),
    },
}


@pytest.mark.parametrize("kind", ALL)
def test_a_bad_hyper_parameter_gets_one_line(kind):
    """The line names the setting, the value and what is allowed."""
    for name, values in (SHARED | OWN[kind]).items():
        for value in values:
            with pytest.raises(UserError) as raised:
                make(kind, **{name: value})
            line = str(raised.value)
            seen = value[-1] if name == "hidden" and isinstance(value, list) and value else value
            assert line.startswith(f"{name}: "), line
            assert repr(seen) in line
            assert "\n" not in line


@pytest.mark.parametrize(("value", "allowed"), [(-1e-3, "(0, 1]"), (float("nan"), "(0, 1]")])
def test_the_line_says_what_is_allowed(value, allowed):
    with pytest.raises(UserError) as raised:
        make(DDPG, lr=value)
    assert str(raised.value) == f"lr: expected a number in {allowed}, got {value!r}"


def test_edges_of_what_is_allowed():
    """A gamma of 0, tau 1, no action_l2, one quantile kept and a list of one layer are all fine."""
    make(DDPG, gamma=0, tau=1, lr=1, action_l2=0, explore_std=0)
    assert make(TQC, drop_per_critic=24, hidden=[8]).keep == 2


@pytest.mark.parametrize("kind", ALL)
def test_the_committed_settings_are_the_constructors(kind):
    """conf/algo/<name>.yaml and its base hold every setting of the class, and no other than those of the loop."""
    settings = conf(f"algo/{kind.__name__.lower()}")
    assert settings.pop("name") == kind.__name__.lower()
    settings.pop("n_envs"), settings.pop("demonstrations"), settings.pop("residual_l2")
    loop = {f.name for f in fields(Loop)}
    own = {k: v for k, v in settings.items() if k not in loop}
    positional = {"self", "scale", "action_scale", "critics"}
    assert set(own) == arguments(kind).keys() - positional
    kind((torch.zeros(D), torch.ones(D)), torch.ones(N), **own)


def test_what_algorithms_share_lives_in_one_file():
    """No learner's yaml has a value of conf/algo/base.yaml, and the loop has the same defaults."""
    base = yaml.safe_load((ROOT / "conf" / "algo" / "base.yaml").read_text())
    for path in (ROOT / "conf" / "algo").glob("*.yaml"):
        own = yaml.safe_load(path.read_text())
        if "base" in own.get("defaults", []):
            assert not own.keys() & base.keys(), path.name
    defaults = {f.name: f.default for f in fields(Loop)}
    assert {k: defaults[k] for k in base if k in defaults} == {k: base[k] for k in base if k in defaults}


def test_the_page_of_algorithms_has_the_settings_of_their_files():
    """docs/reference/algorithms.md: a cell begins with the value of conf/algo, for each key of the row."""
    rows = [line[1:-1].split("|") for line in PAGE.read_text().splitlines() if line.startswith("|`")]
    _, *names = (cell.strip().lower() for cell in rows[0])
    seen = set()
    for first, *cells in rows[1:]:
        keys = re.findall(r"`(\w+)`", first)
        for algo, cell in zip(names, cells, strict=True):
            settings = conf(f"algo/{algo}")
            if keys[0] not in settings or not cell:
                assert not cell or (algo, cell) == ("ddpg", "1 (1)")
                continue
            expected = [v for k in keys for v in (settings[k] if isinstance(settings[k], list) else [settings[k]])]
            assert [float(v) for v in cell.split(" (")[0].split(", ")] == expected, f"{algo}: {first}"
            seen |= {(algo, k) for k in keys}
    assert {(a, k) for a in names for k in ("gamma", "tau", "lr", "hidden", "batch_size", "n_envs")} <= seen
