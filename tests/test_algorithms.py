"""All four algorithms repeat, save, compile, explore and learn alike.

tests/test_tqc.py holds what is TQC's own, and the helpers for batches and TorchRL critics.
"""

import copy
import math
from functools import partial

import pytest
import torch
from conftest import conf
from test_tqc import HIDDEN, B, D, N, in_si, make_batch
from torch._inductor import config as inductor

from r2s.learning.ddpg import DDPG
from r2s.learning.learner import KERNELS, Learner
from r2s.learning.policy import export_onnx, load_policy, save_policy
from r2s.learning.sac import SAC
from r2s.learning.td3 import TD3
from r2s.learning.tqc import TQC
from r2s.tasks.reach import ReachTask

ALL = (DDPG, TD3, SAC, TQC)


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


@pytest.mark.long
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


@pytest.mark.long
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


@pytest.mark.long
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


@pytest.mark.long
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
