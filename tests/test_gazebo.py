"""The Gazebo adapter: against a stand-in with the bindings' names and semantics; against Gazebo where it is."""

from dataclasses import replace

import gazebo_standin
import numpy as np
import pytest
from conftest import conf

from r2s.engines.dart import DartEngine
from r2s.engines.gazebo import RELEASES, GazeboEngine, bindings
from r2s.errors import UserError
from r2s.physics.dynamics import nominal_dynamics


@pytest.fixture(scope="module")
def dynamics(panda):
    return nominal_dynamics(panda, **conf("friction/paper"), inertia_scale=conf("inertia/paper")["scale"])


def agree(gazebo, panda, dynamics, apart=(1e-9, 1e-8)):
    """Drive Gazebo and DART alike, with two resets on the way: the same motion within rad and rad/s, which moves."""
    dart = DartEngine(panda, gravity=False, inertias=dynamics.inertia, armature=dynamics.armature)
    rng = np.random.default_rng(0)
    for _ in range(2):
        q, dq = panda.q_home + rng.uniform(-0.2, 0.2, 7), rng.uniform(-0.3, 0.3, 7)
        for engine in (gazebo, dart):
            engine.reset(q, dq)
        for tau in rng.uniform(-0.05, 0.05, (100, 7)) * panda.tau_max:
            a, b = gazebo.step(tau), dart.step(tau)
            for ours, theirs, bound in zip(a, b, apart, strict=True):
                np.testing.assert_allclose(ours, theirs, atol=bound)
        assert np.abs(b[1] - dq).max() > 0.05  # rad/s


def test_steps_resets_and_commands_are_those_of_dart(panda, dynamics):
    agree(GazeboEngine(panda, dynamics, gazebo_standin), panda, dynamics)


def test_rotors_are_there_which_sdf_cannot_say(panda, dynamics):
    rotors = replace(dynamics, armature=2e-3 * panda.tau_max)
    agree(GazeboEngine(panda, rotors, gazebo_standin), panda, rotors)


def test_an_error_inside_a_callback_comes_out(panda, dynamics):
    engine = GazeboEngine(panda, dynamics, gazebo_standin)
    with pytest.raises(TypeError):
        engine.step(None)


def test_a_world_without_the_arm_is_said(panda, dynamics, monkeypatch):
    monkeypatch.setattr(
        gazebo_standin.TestFixture, "on_pre_update", lambda self, call: setattr(self, "before", print)
    )
    with pytest.raises(UserError, match="did not load the arm"):
        GazeboEngine(panda, dynamics, gazebo_standin)


def test_missing_bindings_get_one_clear_line(monkeypatch):
    for name in RELEASES:
        monkeypatch.setitem(__import__("sys").modules, name, None)
    with pytest.raises(UserError, match="OSRF"):
        bindings()


@pytest.mark.gazebo
def test_gazebo_itself(panda, dynamics):
    """The same with the real server."""
    pytest.importorskip("gz", reason="Gazebo's Python bindings are not installed")
    agree(GazeboEngine(panda, dynamics), panda, dynamics)
