"""Policies that are told of their arm: the truth in training, an estimate or a latent on an arm, zeros of none."""

import json
import pickle
from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
import torch
from conftest import ROOT
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from test_adapters import FILTER_S, PANDA, known, swing, truth

from r2s.adaptation.adapter import Tells
from r2s.adaptation.adapters import history, osi, rma
from r2s.adaptation.history import Network, inputs
from r2s.adaptation.network_file import NETWORK, save_network
from r2s.adaptation.observer import Observer
from r2s.adaptation.telling import Latent, said_count, said_scale
from r2s.adaptation.telling import truth as right
from r2s.arm.deploy import DrivenArm
from r2s.arm.live import LiveArm
from r2s.arm.simulated import SimulatedArm
from r2s.errors import UserError
from r2s.learning.altered import ERROR_KG, ERROR_SHARE, Altered
from r2s.learning.env import TaskEnv
from r2s.learning.evaluate import make_evaluation
from r2s.learning.networks import Told
from r2s.learning.policy import load_policy, make_policy, save_policy
from r2s.physics.payload import Payload, ball, loaded
from r2s.stages import pipeline
from r2s.stages.train import train
from r2s.stages.transfer import transfer
from r2s.tasks.episode import rollout
from r2s.tasks.reach import ReachTask
from r2s.typed import check_overrides

N = PANDA.n
C = said_count(N)
TASK = ReachTask(episode_s=0.4, torque_fraction=0.3)
PRIVILEGED, LATENT = Told(C), Told(C, 8)


def dynamics(rng, m):
    """Return the arm that is believed, as a draw."""
    return truth()


CHANGED = Altered(PANDA, truth(), dynamics)


@cache
def policies():
    """Return what is told the truth, and what is told its latent."""
    torch.manual_seed(0)
    teacher = make_policy(PANDA, TASK, (16,), LATENT)
    return teacher, teacher.by_latent()


def shown(told=None, seed=0, rows=5):
    """Return observations of reaching, with something told or not."""
    mean, std = (torch.from_numpy(x).float() for x in TASK.observation_scale(PANDA))
    own = mean + std * torch.randn(rows, len(mean), generator=torch.Generator().manual_seed(seed))
    return own if told is None else torch.cat([own, torch.as_tensor(told).float().expand(rows, -1)], 1)


class Remembers:
    """A policy that remembers what it was shown, and asks for nothing."""

    def __init__(self):
        self.seen = []

    def action(self, observation):  # noqa: D102
        self.seen.append(observation.clone())
        return torch.zeros(len(observation), N)


def test_what_there_is_to_tell_is_exact():
    """Mass, first moments and shares of what was put on and changed; zeros of the arm that is believed."""
    assert not right(PANDA, truth(), truth()).any()
    rng, m = np.random.default_rng(0), 4
    mass, centre = rng.uniform(0, 1.5, m), rng.uniform(-0.04, 0.04, (m, 3))
    share = rng.uniform(0.7, 1.2, (m, N))
    phi = truth().phi * np.where(np.arange(3) == 0, share[..., None], 1.0)  # eq. (5) is linear in its first
    arms = loaded(PANDA, replace(truth(), phi=phi), Payload(mass, centre, ball(mass)))
    expected = np.column_stack([mass, mass[:, None] * centre, share - 1])
    np.testing.assert_allclose(right(PANDA, truth(), arms), expected, atol=1e-14)


def test_an_arm_that_equals_its_model_is_told_as_unloaded():
    """Nothing of what may as well be nothing: no policy asks for 1e-3 Nm more or less than if nothing were told."""
    teller, told = osi(known()), []

    class Heard:
        """The teller, and what it told."""

        begin = teller.begin

        def __call__(self, *cycle):
            added = teller(*cycle)
            told.append(teller.told)
            return added

    swing(Heard(), rate=0.6, seconds=2.5)
    policy = make_policy(PANDA, TASK, (64, 64), PRIVILEGED)
    with torch.no_grad():
        one, other = policy(shown(np.array(told)[::100].max(0))), policy(shown())
    assert np.abs(torch.sub(one, other).numpy()).max() < 1e-3
    assert len(told) > 2000


def test_a_payload_is_told():
    """As a share of what is sure: of 1 kg in motion, after 2 s, within a tenth, its first moments within 1 cm."""
    thing, teller = Payload(np.array(1.0), np.array([0.02, -0.01, 0.05]), ball(np.array(1.0))), osi(known())
    swing(teller, payload=thing, seconds=2.0, rate=3.0, noise=1e-3)
    assert abs(teller.told[0] - 1.0) < 0.1
    np.testing.assert_allclose(teller.told[1:4], thing.centre, atol=0.01)
    assert np.abs(teller.told[4:]).max() < 0.2
    teller.begin()
    assert not teller.told.any()
    of_load = replace(known(), dynamics=loaded(PANDA, truth(), None, thing))
    assert osi(of_load)._load == pytest.approx([1.0, *thing.centre])


def test_of_what_is_drawn_the_truth_is_told_after_a_while():
    """Zeros first, then the same until the episode ends."""
    env = TaskEnv(PANDA, TASK, CHANGED, 64, nthread=1, seed=3)
    at, rows = env.reset(), []
    for _ in range(TASK.steps):
        at["action"] = torch.zeros(64, N)
        at = env._step(at)
        rows.append(at["observation"][:, -C:].numpy().copy())
    rows = np.array(rows)
    assert rows.shape == (TASK.steps, 64, C)
    late = rows[-1].any(1)
    assert 0.2 < late.mean() < 0.6  # 0.4 s of a second
    changes = (np.diff(rows, axis=0) != 0).any(2).sum(0)
    assert changes.max() == 1


def test_errors_are_of_an_estimate_s_size():
    rng = np.random.default_rng(0)
    drawn = CHANGED(rng, 2000)
    told, since = CHANGED.said(rng, drawn)
    error = told - right(PANDA, truth(), drawn)
    # of 2000 draws the standard deviation is known to 1 / sqrt(4000), 1.6 %
    np.testing.assert_allclose(error.std(0)[[0, 4, 10]], [ERROR_KG, ERROR_SHARE, ERROR_SHARE], rtol=0.08)
    assert (since >= 0).all()
    assert (since <= 1).all()


def test_an_environment_that_tells_goes_back_to_its_state():
    one, other = (TaskEnv(PANDA, TASK, CHANGED, 3, nthread=1, seed=1, stagger=True) for _ in range(2))
    actions = torch.rand(50, 3, N, generator=torch.Generator().manual_seed(0)) * 2 - 1

    def on(env, at):
        seen = []
        for action in actions:
            at["action"] = action
            step, at = env.step_and_maybe_reset(at)
            seen.append(step["next"]["observation"])
        return torch.stack(seen)

    first = one.reset()
    on(one, first)
    kept = one.state()
    other.reset()
    other.set_state(kept)
    assert torch.equal(on(one, one.read()), on(other, other.read()))


def test_evaluations_tell_and_are_twice_the_same():
    once = []
    for _ in range(2):
        policy = Remembers()
        make_evaluation(PANDA, TASK, CHANGED, episodes=4, nthread=1)(policy)
        once.append(torch.stack(policy.seen[1:]))
    assert torch.equal(*once)
    assert once[0][-1, :, -C:].any()


def test_a_policy_that_is_told_nothing_takes_its_arm_for_what_is_believed():
    """To the bit, with a latent and without; and told the latent it does as one that is told the truth."""
    teacher, policy = policies()
    with torch.no_grad():
        for one in (make_policy(PANDA, TASK, (16,), PRIVILEGED), teacher):
            assert torch.equal(one.action(shown()), one.action(shown(np.zeros(C))))
        assert torch.equal(policy.action(shown()), teacher.action(shown()))
        told = said_scale(N) * np.random.default_rng(0).normal(size=C)
        latent = teacher.latent(torch.from_numpy(told)[None].float())
        assert latent.abs().max() > 0.1
        # float32 products of one row and of five are rounded differently
        torch.testing.assert_close(policy.action(shown(latent)), teacher.action(shown(told)), rtol=0, atol=1e-6)
        assert not torch.equal(policy.action(shown(latent)), policy.action(shown()))


def test_files_of_policies(tmp_path):
    """One that is told nothing is the file that it was; what another is told is known from its file."""
    for told in (None, PRIVILEGED, LATENT):
        policy = make_policy(PANDA, TASK, (16,), told)
        save_policy(tmp_path, policy)
        kept = torch.load(tmp_path / "policy.pt", weights_only=True)
        assert kept.keys() == {"state", "hidden"} | ({"told"} if told else set())
        again = load_policy(tmp_path, PANDA, TASK)
        assert again.told == told
        assert torch.equal(again.action(shown()), policy.action(shown()))


def test_what_an_adapter_tells_reaches_the_policy():
    """Of an arm with a payload; zeros as a motion begins; one that tells nothing changes no observation."""
    thing = {"mass": 1.0, "centre": [0.02, -0.01, 0.05]}
    carries = Payload(np.array(thing["mass"]), np.array(thing["centre"]), ball(np.array(1.0)))
    starts, goals = np.tile(PANDA.q_home, (2, 1)), np.tile([0.5, 0.1, 0.4], (2, 1))
    wide = len(TASK.observation_scale(PANDA)[0])
    for adapter, more in ((osi(known()), C), (Observer(known().arm, FILTER_S), 0)):
        assert isinstance(adapter, Tells) == bool(more)
        arm = SimulatedArm(PANDA, truth(), position_noise=0.0, velocity_noise=1e-3, payload=carries)
        policy, driven = Remembers(), DrivenArm(arm, TASK, truth().level, adapter=adapter)
        rollout(policy, driven, TASK, starts, goals)
        first, *seen = policy.seen  # the first is what is compiled with
        assert first.shape[1] == wide
        assert {s.shape[1] for s in seen} == {wide + more}
        if more:
            assert not seen[0][:, wide:].any()
            assert seen[TASK.steps - 1][:, wide:].any()
            assert not seen[TASK.steps][:, wide:].any()


def test_a_latent_is_told_through_a_low_pass():
    """As the network says it after a while; nothing as a motion begins, and there where it is sent."""
    d, latent = inputs(N), np.linspace(-1, 1, 8)
    says = Network(np.zeros(d), np.ones(d), np.ones(8), (np.zeros((d, 8)), latent))
    for teller in (Latent(known().arm, says), pickle.loads(pickle.dumps(Latent(known().arm, says)))):
        for _ in range(400):
            assert not teller(PANDA.q_home, np.zeros(N), np.zeros(N)).any()
        np.testing.assert_allclose(teller.told, latent, atol=1e-6)
        teller.begin()
        assert not teller.told.any()


def test_a_student_is_known_by_its_policy(tmp_path):
    d = inputs(N)
    network = Network(np.zeros(d), np.ones(d), np.ones(8), (np.zeros((d, 8)), np.zeros(8)))
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        torch.manual_seed(ord(name))
        save_policy(tmp_path / name, make_policy(PANDA, TASK, (16,), LATENT))
        save_network(tmp_path / name / NETWORK, known().arm, network, tmp_path / name)
    of_a = replace(known(), policy=tmp_path / "a")
    assert rma(of_a, None).told.shape == (8,)
    with pytest.raises(UserError, match=r"^network: .*b says the latent of another policy; the folder of this"):
        rma(of_a, tmp_path / "b")
    with pytest.raises(UserError, match=r"^network: '.*' is no run folder of stage=train adapt=rma"):
        rma(of_a, tmp_path)
    torques = Network(np.zeros(d), np.ones(d), np.ones(N), (np.zeros((d, N)), np.zeros(N)))
    save_network(tmp_path / "b" / NETWORK, known().arm, torques)
    with pytest.raises(UserError, match=r"^network: .*b is of another kind of adapter"):
        rma(of_a, tmp_path / "b")
    with pytest.raises(UserError, match=r"^network: .*a is of another kind of adapter"):
        history(known(), tmp_path / "a")


def composed(*words):
    """Return the config of a command."""
    with initialize_config_dir(str(ROOT / "conf"), version_base=None):
        return compose("config", overrides=list(words))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["dr.payload=[0,1]"], r"^dr\.payload: with adapt=osi it is adapt\.training\.payload=; leave it out"),
        (["dr=force"], r"^dr: a policy of adapt=osi is not told of random forces"),
        (["algo=sac"], r"^algo=sac: its policies are told nothing; with adapt=osi tqc is allowed"),
        (["adapt.training.payload=[0,2]"], r"^dr\.payload: 2 is not allowed|payload"),
        (["adapt.training.friction=[1.2,0.7]"], r"friction: 1\.2 is above 0\.7; the least goes first"),
        (["adapt.training.late=0.02"], r"late: 0\.02 is not allowed"),
    ],
)
def test_what_a_told_policy_cannot_be_trained_with_is_said_in_one_line(words, message, tmp_path):
    cfg = composed(f"root={tmp_path}", "adapt=osi", *words)
    with pytest.raises(UserError, match=message) as error:
        train(cfg, words)
    assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())


def test_what_a_stage_does_not_read_is_said():
    with pytest.raises(UserError, match=r"^adapt: stage=train does not read it"):
        check_overrides(["adapt=osi", "algo=computed_torque"], None)


def folder(path, **config):
    """Write what a finished training has, as far as it is asked."""
    path.mkdir()
    (path / "summary.json").write_text("{}")
    OmegaConf.save(OmegaConf.merge(composed("task.episode_s=0.4"), OmegaConf.create(config)), path / "config.yaml")
    return path


def test_a_policy_that_is_told_nothing_is_refused(tmp_path):
    own = folder(tmp_path / "plain")
    torch.manual_seed(0)
    save_policy(own, make_policy(PANDA, ReachTask(episode_s=0.4), (16,)))
    cfg = composed("stage=transfer", f"root={tmp_path}/runs", f"policy={own}", "adapt=osi", "evaluation.episodes=1")
    message = r"^adapt=osi: the policy of .*plain was trained with adapt=none, and is told nothing of this kind; give"
    with pytest.raises(UserError, match=message):
        transfer(cfg, [])


@pytest.mark.parametrize(
    ("name", "trained", "policy"), [("osi", 4, "adapted"), ("rma", 4, "adapted"), ("history", 4, "identified")]
)
def test_a_chain_trains_what_its_adapter_needs(name, trained, policy, monkeypatch):
    """A policy that is told, or a network; models and computed torque are trained as without an adapter."""
    monkeypatch.setattr(pipeline, "chosen", lambda *_: [])
    words = ["task=track", f"adapt={name}", "algo.lr=1e-3", "arm.payload=1.0"]
    steps = pipeline.commands(composed("stage=pipeline", *words), "c", words)
    assert len(steps[1]) == trained
    for label, typed in steps[1].items():
        assert (f"adapt={name}" in typed) == (label == "adapted")
        assert ("algo.lr=1e-3" in typed) == (label in ("identified", "nominal") or policy == label)
    adapted = steps[2]["adapted"]
    assert f"adapt={name}" in adapted
    assert f"policy=runs/train/c_{policy}" in adapted
    assert ("adapt.network=runs/train/c_adapted" in adapted) == (name == "history")
    assert not any(w.startswith("adapt") for label in ("identified", "nominal", "computed") for w in steps[2][label])


@pytest.mark.slow
def test_what_is_told_comes_from_the_arm_s_process():
    """Where the arm's cycle is in a process of its own."""
    opens = partial(SimulatedArm, PANDA, truth(), position_noise=0.0, velocity_noise=0.0)
    d = inputs(N)
    says = Network(np.zeros(d), np.ones(d), np.ones(8), (np.zeros((d, 8)), np.ones(8)))
    policy = Remembers()
    with LiveArm(opens, PANDA, TASK, truth().level, adapter=Latent(known().arm, says)) as arms:
        rollout(policy, arms, TASK, PANDA.q_home[None], np.array([[0.5, 0.1, 0.4]]))
    assert not policy.seen[1][0, -8:].any()
    told = policy.seen[-1][0, -8:]
    assert (told == told[0]).all()
    assert 0 < told[0] <= 1


@pytest.mark.slow
@pytest.mark.parametrize(("name", "task"), [("osi", "reach"), ("rma", "reach"), ("rma", "track")])
def test_every_stage_takes_it(name, task, tmp_path):
    """Training, twice the same; of rma the network is in the policy's folder."""
    short = [f"task={task}", f"adapt={name}", "dr=none", "+experiment=toy", "budget.env_steps=900", "threads=1"]
    short += ["task.episode_s=1.5", *(["task.pool=4"] if task == "track" else []), f"root={tmp_path}"]
    if name == "rma":
        short += [f"adapt.training.{k}={v}" for k, v in {"arms": 10, "rounds": 1, "epochs": 2, "paths": 2}.items()]
    for run in ("a", "b"):
        train(composed(*short, f"name={run}"), short)
    files = ["policy.pt", *([NETWORK] if name == "rma" else [])]
    for file in files:
        one, other = (_arrays(tmp_path / "train" / run / file) for run in ("a", "b"))
        assert all(np.array_equal(one[k], other[k]) for k in one if k != "policy")
    summary = json.loads((tmp_path / "train" / "a" / "summary.json").read_text())
    assert ("student" in summary) == (name == "rma")


def _arrays(path):
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as saved:
            return dict(saved)
    return {k: v.numpy() for k, v in torch.load(path, weights_only=True)["state"].items()}
