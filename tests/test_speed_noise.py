"""Velocity noise is estimated from recordings and added to the observations of a simulated arm."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import ROOT, conf

from r2s.errors import UserError
from r2s.learning.env import TaskEnv
from r2s.learning.vector_arms import VectorArms
from r2s.physics.dynamics import nominal_dynamics
from r2s.physics.robot import load_robot
from r2s.recordings.recording import Recording
from r2s.recordings.speed_noise import speed_noise
from r2s.tasks.reach import SPEED_NOISE, ReachTask
from r2s.tasks.rollout import rollout

PANDA = load_robot(**conf("robot/panda"))
NEW = nominal_dynamics(PANDA, **conf("friction/paper"))
SETTINGS = {k: tuple(v) if isinstance(v, list) else v for k, v in conf("task/reach").items()}
TASK = ReachTask(**SETTINGS | {"speed_noise": 0.0})
ENCODER = 1e-5  # rad


def swinging(noise, step=1e-3, seconds=20.0):
    """Return a recording of joints that swing at 0.3 to 0.9 Hz; noise (n,) rad/s is that of their speeds."""
    rng, t = np.random.default_rng(0), np.arange(0.0, seconds, step)
    n = len(noise)
    w, size = 2 * np.pi * rng.uniform(0.3, 0.9, (3, n)), rng.uniform(0.1, 0.3, (3, n))
    q = sum(size[k] * np.sin(w[k] * t[:, None]) for k in range(3)) + ENCODER * rng.normal(size=(len(t), n))
    dq = sum(size[k] * w[k] * np.cos(w[k] * t[:, None]) for k in range(3)) + noise * rng.normal(size=(len(t), n))
    return Recording(t, q, dq, np.zeros_like(q), "commanded")


def test_added_noise_is_estimated():
    """White noise of 1 to 30 mrad/s. A tenth of 20,000 rows: the median of 40 pieces of 50 is within 7 %, at 3 sigma.

    (One piece's mean square has a deviation of sqrt(2 / 50), a median 1.25 times that of a mean, a root half of it:
    1.25 sqrt(2 / 50 / 40) / 2 = 2 %, less 0.7 % for the median of chi squared.) The angles' own noise adds up to 2 %.
    """
    noise = np.array([1e-3, 2e-3, 4e-3, 1e-2, 3e-2])
    np.testing.assert_allclose(speed_noise([swinging(noise)]), noise, rtol=0.09)


def test_two_recordings_are_one():
    """Two halves of a recording give the same noise as the whole."""
    whole = swinging(np.full(3, 2e-3))
    half = len(whole.t) // 2
    halves = slice(0, half), slice(half, None)
    parts = [Recording(*(getattr(whole, f)[s] for f in ("t", "q", "dq", "tau")), "commanded") for s in halves]
    np.testing.assert_allclose(speed_noise(parts), speed_noise([whole]), rtol=0.05)


@pytest.mark.parametrize("step", [0.004, 0.008, 0.01])
def test_noise_of_coarse_recordings(step):
    """At 100 to 250 Hz a window has at least nine rows. The calmest tenth gives an estimate within 17 %.

    (At 100 Hz there are 1600 pieces of 5 rows, 160 of them calm: 1.25 sqrt(2 / 5 / 160) / 2 = 3.1 %, 9.4 % at 3
    sigma, and below the truth by up to 7 % more: the median of chi squared with 5 degrees is 13 % below its mean.)
    """
    truth = np.array([5e-3, 1e-2, 3e-2])
    found = speed_noise([swinging(truth, step, seconds=80.0)])
    np.testing.assert_allclose(found, truth, rtol=0.17)


def test_a_recording_below_80_hz_gives_no_estimate():
    """A window that is long enough for a cubic would blur the motion, and the estimate is 0."""
    assert not speed_noise([swinging(np.full(3, 2e-3), step=1 / 60)]).any()


def test_lost_samples_change_nothing():
    """Recordings without a few of their rows have the noise of the whole."""
    whole = swinging(np.full(3, 2e-3))
    kept = np.delete(np.arange(len(whole.t)), [100, 7000, 7001, 15_000])
    some = Recording(*(getattr(whole, f)[kept] for f in ("t", "q", "dq", "tau")), "commanded")
    np.testing.assert_allclose(speed_noise([some]), speed_noise([whole]), rtol=0.05)


def test_wrong_velocities_are_an_error():
    """A noise above the limit of training is an error with the joint, raised when the recording is read."""
    with pytest.raises(UserError, match=r"^dq of joint 2 is .* rad/s off the slope of its q .*at most 1 is allowed"):
        speed_noise([swinging(np.array([1e-3, 2.0, 1e-3]))])


@pytest.mark.parametrize("name", ["coulomb", "lugre", "paper", "sigmoid", "stribeck"])
def test_the_noise_of_independent_arms(name):
    """Recordings of another simulator in free motion have the white noise of its parameters."""
    folder = ROOT.parent / "shared" / "data" / "independent_arms" / name
    if not folder.is_dir():
        pytest.skip("the independent arms are not part of the project")
    data = np.load(folder / "train.npz")
    recording = Recording(*(data[k] for k in ("t", "q", "dq")), np.zeros_like(data["q"]), "commanded")
    truth = np.array(json.loads((folder / "truth.json").read_text())["noise"]["sd"]["dq"])
    np.testing.assert_allclose(speed_noise([recording]), truth, rtol=0.09)


class Recorder:
    """A policy with zero action that records its observations."""

    def __init__(self):
        self.shown = []

    def action(self, observation):
        """Record the observation and return zero."""
        self.shown.append(observation.numpy().copy())
        return torch.zeros(len(observation), PANDA.n)


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_noise_is_in_the_observation_and_not_in_the_measures(noise):
    """Arms at rest without a command: observed velocities are white noise, recorded states are at rest."""
    arms = VectorArms(PANDA, TASK, replace(NEW, speed_noise=np.full(PANDA.n, noise)), 3, 1)
    starts = np.tile(PANDA.q_home, (3, 1))
    policy, again = Recorder(), Recorder()
    done = rollout(policy, arms, TASK, starts, TASK.goals(PANDA, np.random.default_rng(0), 3))
    rollout(again, arms, TASK, starts, TASK.goals(PANDA, np.random.default_rng(0), 3))
    everything = np.array(policy.shown[1:])  # the first is asked for to compile
    np.testing.assert_array_equal(np.array(again.shown[1:]), everything)  # noise begins anew
    shown = everything[..., PANDA.n : 2 * PANDA.n]
    assert not done.dq.any()
    count = shown.size
    assert shown.std() == pytest.approx(noise, rel=5 / np.sqrt(2 * count))
    assert abs(shown.mean()) <= 5 * noise / np.sqrt(count)


def test_training_draws_noise_up_to_the_tasks():
    """Each arm has a draw of its own, or its own noise where that is more; the reward is of the true motion.

    Over draws the mean square is a third of the largest; of 200 arms it is known to 6 %, a root to 3 %.
    """
    for own, expected, rtol in ((0.001, 0.05 / np.sqrt(3), 5 * 0.032), (0.1, 0.1, 5 / np.sqrt(2 * 1400))):
        task = replace(TASK, speed_noise=0.05)
        env = TaskEnv(PANDA, task, lambda rng, m, own=own: replace(NEW, speed_noise=np.full(7, own)), 200, nthread=1)
        observation = env.reset()["observation"].numpy()
        assert observation[:, PANDA.n : 2 * PANDA.n].std() == pytest.approx(expected, rel=rtol)
        step = env.step(env.reset().set("action", torch.zeros(200, PANDA.n)))["next"]
        assert not step["reward_terms"][:, 1].any()


def test_an_identified_arm_gets_noise_and_the_papers_model_none():
    """By default; what is typed stands."""
    default = ReachTask(**SETTINGS)
    identified = replace(NEW, speed_noise=np.full(PANDA.n, 2e-3))
    assert default.with_model(PANDA, identified).speed_noise == SPEED_NOISE
    assert default.with_model(PANDA, NEW).speed_noise == 0.0
    assert replace(default, speed_noise=0.01).with_model(PANDA, identified).speed_noise == 0.01
