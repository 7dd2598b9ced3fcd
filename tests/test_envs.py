"""r2s's environments for other libraries: options as on the command line, and TorchRL's collectors and losses."""

import sys

import numpy as np
import pytest
from conftest import ROOT, conf
from hydra import compose, initialize_config_dir
from hydra.core.utils import JobRuntime
from hydra.version import VersionBase
from packaging import version
from torchrl.envs.utils import check_env_specs

from r2s.envs import torchrl_env
from r2s.errors import UserError
from r2s.identification.parameter_file import save_parameters
from r2s.identification.parameters import ParameterEstimate, parameter_space
from r2s.physics.dynamics import nominal_dynamics

SHORT = ("task.episode_s=0.2",)
SMALL = {"task": "reach", "num_envs": 2, "threads": 1, "overrides": SHORT}


@pytest.fixture
def calibration(panda, tmp_path):
    """Return the run folder of an identification, whose name Hydra must not parse."""
    space = parameter_space(panda, nominal_dynamics(panda, **conf("friction/paper")), {"offset": [-1.0, 1.0]})
    x = np.linspace(-0.3, 0.3, panda.n)
    folder = tmp_path / "it's a=run, [1]"
    folder.mkdir()
    found = ParameterEstimate(x, x, x, np.ones(len(x), dtype=bool), x + np.linspace(0.0, 0.1, 5)[:, None])
    save_parameters(folder / "parameters.yaml", space, found, {})
    return folder


@pytest.mark.long
def test_an_environment_has_the_arms_of_its_calibration(calibration):
    """dr=none gives every arm the identified offsets, dr=identified draws of their posterior."""
    env = torchrl_env(**SMALL, calibration=calibration, dr="none")
    np.testing.assert_allclose(env.draw(np.random.default_rng(0), 2).offset, np.linspace(-0.3, 0.3, 7))
    check_env_specs(env)
    drawn = torchrl_env(**SMALL, calibration=str(calibration), dr="identified")
    offset = drawn.draw(np.random.default_rng(0), 50).offset - np.linspace(-0.3, 0.3, 7)
    np.testing.assert_allclose(np.unique(offset.round(6)), np.linspace(0.0, 0.1, 5), atol=1e-6)


def test_options_reach_task_control_and_reward():
    env = torchrl_env(
        **SMALL | {"task": "track", "overrides": ["task.pool=2"]}, control="torque", reward="paper", robot="fr3"
    )
    assert (type(env.task).__name__, env.task.pool, env.control.name) == ("TrackTask", 2, "torque")
    np.testing.assert_allclose(env.robot.dq_max, conf("robot/fr3")["dq_max"])
    np.testing.assert_array_equal(env.weights, [1, 1, 0, 0, 0])


@pytest.mark.long
@pytest.mark.parametrize(
    ("settings", "line"),
    [
        ({"robot": "pando"}, r"robot: no option 'pando'.*did you mean 'panda'"),
        ({"calibration": "no/such"}, "calibration: no parameters.yaml at no/such"),
        ({"dr": "identified"}, "give calibration=RUN_FOLDER"),
        ({"overrides": ["task.episode=3"]}, "unknown option 'task.episode'; did you mean 'task.episode_s'"),
        ({"overrides": ["algo.lr=3"]}, "an environment does not read 'algo.lr=3'"),
        ({"overrides": "task.height=0.2"}, "overrides: expected a list of KEY=VALUE, got 'task.height=0.2'"),
        ({"num_envs": 0}, r"num_envs: expected a whole number in \[1, inf\), got 0"),
        ({"threads": -1}, "threads: expected a whole number"),
        ({"task": "reech"}, "did you mean 'reach'"),
    ],
)
def test_a_wrong_value_is_one_line(settings, line):
    with pytest.raises(UserError, match=line) as caught:
        torchrl_env(**SMALL | settings)
    assert "\n" not in str(caught.value)


def test_a_wrong_name_is_a_type_error():
    """As of any function; sb3 calls again without render_mode then."""
    with pytest.raises(TypeError, match=r"'calibraton'.*did you mean 'calibration'"):
        torchrl_env(**SMALL, calibraton="run")


def test_the_hydra_of_the_calling_program_stays(tmp_path):
    """A Hydra job of the user's own makes an environment, and its config is composed as before."""
    (tmp_path / "config.yaml").write_text("name: theirs\n")
    with initialize_config_dir(str(tmp_path), job_name="theirs", version_base="1.2"):
        torchrl_env(**SMALL)
        assert compose("config") == {"name": "theirs"}
        assert JobRuntime.instance().get("name") == "theirs"
        assert VersionBase.instance().getbase() == version.Version("1.2")


def test_without_gymnasium_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.delitem(sys.modules, "r2s.learning.gym_env", raising=False)
    from r2s.envs import gym_env

    with pytest.raises(
        UserError, match=r"^r2s.envs.gym_env needs gymnasium, which is not installed: pip install 'r2s\[gym\]'"
    ):
        gym_env(task="reach", overrides=SHORT)


@pytest.mark.long
def test_sac_of_torchrl_trains_on_it(monkeypatch):
    """The example: its collector, transforms, buffer, loss and targets, for some hundred steps."""
    monkeypatch.syspath_prepend(ROOT / "examples")
    import torchrl_sac

    assert len((ROOT / "examples" / "torchrl_sac.py").read_text().splitlines()) <= 60
    monkeypatch.setattr(torchrl_sac, "RANDOM", 320)
    measures = [torchrl_sac.train(640, *SHORT, "threads=1", episodes=4) for _ in range(2)]
    np.testing.assert_equal(*measures)
    assert np.isfinite(measures[0]["return_paper"])
