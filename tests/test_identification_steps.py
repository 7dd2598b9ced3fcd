"""Each step of an identification is a function of an immutable state."""

from dataclasses import FrozenInstanceError

import numpy as np
import pytest
from test_identify import BOUNDS, SETTINGS, TORQUE, arm, motion, truth, wrong  # noqa: F401

from r2s.identification.identify import STEPS, History, State, identify, reweight, select_family
from r2s.identification.posterior import posterior
from r2s.identification.result import conclude
from r2s.identification.search.genetic import Genetic
from r2s.identification.settings import Settings
from r2s.identification.terms import scaled_prior


@pytest.fixture(scope="module")
def start(arm, wrong, motion):  # noqa: F811
    """The state before the first step, of a commanded recording without ramps."""
    settings = Settings(BOUNDS, SETTINGS["prior"]["commanded"], ["offset", "delay", "lag"], breakaway=None, nthread=1)
    short = motion.select(motion.t < 3.0)
    history = History(lambda row: None, lambda name, make: make())
    prior = scaled_prior(settings.prior, arm, short)
    return State(arm, wrong, short, [TORQUE], settings, None, prior, history, settings.terms)


@pytest.fixture(scope="module")
def states(start):
    """The state before each step, and the last one."""
    out = [start]
    for step in STEPS:
        out.append(step(out[-1]))
    return out


def same(a: State, b: State) -> bool:
    """Return whether two states have the same parameters, solution, weights and prior."""
    arrays = [(s.u, s.problem.sigma, s.problem.on_torque.residual(s.u[None])) for s in (a, b)]
    return a.terms == b.terms and all(map(np.array_equal, *arrays))


def test_a_step_repeated_gives_the_same_state(states):
    """Steps change neither their input nor the weights of its residuals."""
    for step, before, after in zip(STEPS, states, states[1:], strict=False):
        if before.problem is not None:
            assert same(step(before), after), step.__name__


def test_the_steps_are_the_identification(start, states):
    """`identify` is the steps, the posterior and the conclusion, to the bit."""
    s, last = start, states[-1]
    found = identify(s.robot, s.nominal, s.recording, s.searches, s.settings)
    sure = posterior(last.problem, last.u, s.settings.seed)._asdict()
    again = conclude(last.problem, last.space, sure, history=found.history, families={})
    np.testing.assert_array_equal(again.x, found.x)
    np.testing.assert_array_equal(again.found.samples, found.found.samples)


def test_a_state_is_immutable(states):
    with pytest.raises(FrozenInstanceError):
        states[-1].u = None
    with pytest.raises(FrozenInstanceError):
        states[-1].problem.sigma = None


def test_steps_without_a_task_return_their_state(states, start):
    """A given family needs no comparison, and a search that is not local is not repeated."""
    assert select_family(start).nominal.family.name == start.settings.family
    assert select_family(start).families == {}
    before = states[len(STEPS) - 3]
    other = State(**vars(before) | {"searches": [Genetic()]})
    assert reweight(other) is other
