"""Gazebo Classic is the same arm as DART and MuJoCo, where a server is installed; what is missing is one line."""

import gc
import os
import subprocess
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from conftest import conf
from test_gazebo import agree

from r2s.engines import gazebo_classic
from r2s.engines.episodes import EngineArms
from r2s.engines.gazebo_classic import PHYSICS, ROOT, GazeboClassicEngine, gzserver
from r2s.engines.installed import installed
from r2s.errors import UserError
from r2s.learning.evaluate import fixed_episodes, make_evaluation
from r2s.learning.policy import make_policy
from r2s.learning.randomization import UniformRandomization
from r2s.physics.dynamics import nominal_dynamics
from r2s.tasks.reach import ReachTask
from r2s.tasks.rollout import rollout

# rad, rad/s after 0.1 s: DART to round-off; ODE keeps the links together only within its tolerance
APART = {"dart": (1e-9, 1e-8), "ode": (1e-4, 5e-2)}


@pytest.fixture(scope="module")
def dynamics(panda):
    return nominal_dynamics(panda, **conf("friction/paper"), inertia_scale=conf("inertia/paper")["scale"])


@pytest.fixture
def server():
    """Skip without a server."""
    try:
        gzserver()
    except UserError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("physics", PHYSICS)
@pytest.mark.parametrize("rotors", [0.0, 2e-3])
def test_steps_resets_and_commands_are_those_of_dart(server, panda, dynamics, physics, rotors):
    """Also with rotors, which SDF cannot represent; commands are clipped; the server ends with the engine."""
    dynamics = replace(dynamics, armature=rotors * panda.tau_max)
    gazebo = GazeboClassicEngine(panda, dynamics, physics)
    agree(gazebo, panda, dynamics, APART[physics])
    states = []
    for share in (1.0, 10.0):
        gazebo.reset(panda.q_home, np.zeros(7))
        states.append(gazebo.step(share * panda.tau_max))
    if physics == "dart":  # ODE's solver starts from its last solution
        np.testing.assert_array_equal(*states)
    process = gazebo._server
    del gazebo
    gc.collect()
    assert process.poll() is not None


@pytest.mark.parametrize("physics", PHYSICS)
def test_a_policy_meets_the_same_arm(server, panda, dynamics, physics):
    """An episode with friction, delay and safety filter is the batch's: within 1e-3 mm (DART), 2 mm (ODE)."""
    task = ReachTask(episode_s=0.4, torque_fraction=0.15)
    truth = replace(dynamics, delay=2e-3, lag=1e-3, mass=1.1 * panda.mass)
    draw = UniformRandomization(panda, truth, phi_relative=0.1, inertia_relative=0.05)
    torch.manual_seed(0)
    policy = make_policy(panda, task, (16,))
    starts, goals = fixed_episodes(panda, task, 2)
    home = make_evaluation(panda, task, draw, episodes=2, nthread=1)(policy)
    assert np.abs(home.dq).max() > 0.3
    arms = EngineArms(gazebo_classic.gazebo_classic(panda, physics), panda, task, draw, 2)
    away = rollout(policy, arms, task, starts, goals)
    assert np.linalg.norm(away.ee - home.ee, axis=-1).max() < {"dart": 1e-6, "ode": 2e-3}[physics]


def test_what_is_missing_is_one_line(panda, dynamics, monkeypatch, tmp_path):
    """Physics, server, root directory, plugin, and a server that ends at once."""
    monkeypatch.delenv(ROOT, raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UserError, match=r"^simulator.physics: expected ode, dart, got 'odes'; did you mean 'ode'\?$"):
        gazebo_classic.gazebo_classic(panda, "odes")
    with pytest.raises(UserError, match=r"gzserver is not on the PATH, and R2S_GAZEBO_ROOT is not set; docs/.*"):
        gazebo_classic.gazebo_classic(panda)
    monkeypatch.setenv(ROOT, str(tmp_path))
    with pytest.raises(UserError, match=f"R2S_GAZEBO_ROOT={tmp_path} is no root directory with gzserver"):
        gzserver()
    monkeypatch.delenv(ROOT)
    fake = tmp_path / "gzserver"
    fake.write_text("#!/bin/sh\necho no display\necho\n")
    fake.chmod(0o755)
    monkeypatch.setattr(gazebo_classic, "PLUGIN", tmp_path / "plugin.so")
    with pytest.raises(UserError, match=r"its plugin is not built: make gazebo-classic$"):
        gzserver()
    (tmp_path / "plugin.so").touch()
    with pytest.raises(UserError, match=r"^simulator=gazebo_classic: gzserver ended: no display$"):
        GazeboClassicEngine(panda, dynamics)
    with pytest.raises(UserError, match=r"^simulator=gazebo_classic: gzserver does not start: no display$"):
        gazebo_classic.version()


def test_the_engines_are_listed(monkeypatch, tmp_path):
    """Installed ones with their version, a missing one with what it needs."""
    monkeypatch.setenv(ROOT, str(tmp_path))
    found = {name: (engine, needs) for name, engine, needs in installed()}
    assert found["mujoco"] == (f"MuJoCo {mujoco.__version__}", "")
    assert found["dart"][0].startswith("DART 6.")
    engine, needs = found["gazebo_classic"]
    assert engine == "missing"
    assert needs.startswith(f"R2S_GAZEBO_ROOT={tmp_path} is no root directory")
    assert "gazebo" in found


def test_the_script_refuses_a_wrong_folder(tmp_path):
    """It changes nothing in a folder that has files, and wants exactly one."""
    (tmp_path / "file").touch()
    script = gazebo_classic.__file__.replace(".py", "_root.sh")
    for words, expected in (([], "expected one argument"), ([str(tmp_path)], "is not empty|root|debootstrap")):
        done = subprocess.run(["sh", script, *words], capture_output=True, text=True)
        assert done.returncode == 2
        assert done.stderr.startswith("error: ")
        assert len(done.stderr.splitlines()) == 1
        assert any(part in done.stderr for part in expected.split("|"))
    assert os.listdir(tmp_path) == ["file"]
