"""A run folder may be anybody's: r2s neither imports nor calls what its files name, unless it is trusted."""

import shutil
import sys
from pathlib import Path

import pytest
import yaml
from conftest import ROOT
from made_bundles import drawn
from omegaconf import OmegaConf

from r2s import cli, commands
from r2s.errors import UserError
from r2s.identification.parameter_file import load_parameters
from r2s.physics.robot import load_robot
from r2s.stages import build, pipeline, transfer
from r2s.stages.run_config import TRUST, checked, modules, run_config

OPEN = "from pathlib import Path\nPath({!r}).touch()\n"  # a module that leaves a file where it is imported


@pytest.fixture(scope="module")
def honest(tmp_path_factory) -> Path:
    """The run folder of a training, with r2s's own parts."""
    run = drawn(tmp_path_factory.mktemp("runs") / "train" / "honest").run
    (run / "overrides.yaml").write_text("[]\n")
    (run / "recording.rrd").touch()
    return run


@pytest.fixture
def left(tmp_path, monkeypatch) -> Path:
    """The file that appears if foreign code runs; the module `intruder` makes it when it is imported."""
    there = tmp_path / "left"
    (tmp_path / "intruder.py").write_text(OPEN.format(str(there)) + "def robot(**_):\n    pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    yield there
    sys.modules.pop("intruder", None)


def copied(honest: Path, to: Path, **changes) -> Path:
    """Return a copy of the run folder with other settings."""
    shutil.copytree(honest, to)
    config = OmegaConf.to_container(OmegaConf.load(to / "config.yaml"), resolve=True) | changes
    (to / "config.yaml").write_text(yaml.safe_dump(config, sort_keys=False))
    return to


def looked(run: Path) -> None:
    commands.run_command(["look", str(run)])


def exported(run: Path) -> None:
    commands.run_command(["export", str(run)])


def transferred(run: Path) -> None:
    transfer.make_request(composed(f"policy={run}", "stage=transfer"))


def resumed(run: Path) -> None:
    cfg, _ = cli.resumed(composed(f"resume={run}"), [f"resume={run}"])
    build.make_robot(cfg)


def composed(*words: str):
    from hydra import compose, initialize_config_dir

    with initialize_config_dir(str(build.CONF.resolve()), version_base="1.3"):
        return compose("config", list(words))


def attacks(left: Path) -> dict[str, dict]:
    """Return settings of config.yaml that leave a file, by how they hide what they call."""
    call = {"path": str(left)}
    return {
        "a function": {"robot": {"_target_": "os.mkdir", **call}},
        "through a module of r2s": {"robot": {"_target_": "r2s.stages.build.os.mkdir", **call}},
        "through a part of r2s": {
            "robot": {"_target_": "r2s.stages.parts.part", "node": {"_target_": "os.mkdir", **call}, "group": "robot"}
        },
        "an import": {"robot": {"_target_": "intruder.robot"}},
        "an interpolation": {"robot": {"_target_": "${where}", **call}, "where": "os.mkdir"},
        "an interpolated node": {"robot": "${where}", "where": {"_target_": "os.mkdir", **call}},
        "a resolver": {"robot": {"_target_": "${oc.decode:os.mkdir}", **call}},
        "a resolver of a node": {"robot": f"${{oc.create:{{_target_:os.mkdir,path:'{left}'}}}}"},
        "its own trust": {"robot": {"_target_": "os.mkdir", **call}, "trust": ["os"]},
        "another group": {"robot": {"_target_": "r2s.learning.tqc.TQC"}},
        "a friction family": {"friction": {"family": "intruder.FAMILY"}},
    }


KINDS = tuple(attacks(Path("x")))


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("enter", [looked, exported, transferred, resumed])
def test_a_foreign_part_is_refused_before_it_is_imported(honest, left, tmp_path, enter, kind):
    """In one line with the file, the key, the target, and the word that allows it."""
    run = copied(honest, tmp_path / "run", **attacks(left)[kind])
    if enter is resumed:
        (run / "summary.json").unlink()
        (run / "meta.json").write_text('{"status": "stopped", "stage": "train", "inputs": {}, "typed": 0}')
    with pytest.raises(UserError) as refused:
        enter(run)
    said = str(refused.value)
    assert said.startswith(f"{run / 'config.yaml'}: ")
    assert "trust=" in said
    assert "\n" not in said
    assert not left.exists()
    assert "intruder" not in sys.modules


def test_the_message_names_all_that_has_to_be_trusted(honest, tmp_path):
    run = copied(honest, tmp_path / "run", robot={"_target_": "b.robot"}, task={"_target_": "a.Task"})
    with pytest.raises(UserError, match=r"config.yaml: task._target_ is 'a.Task', .* add trust=\[a,b\]$"):
        run_config(run)
    with pytest.raises(UserError, match=r"robot._target_ is 'b.robot', .* add trust=\[a,b\]$"):
        checked(OmegaConf.create({"robot": {"_target_": "b.robot"}}), "file", "a")


def test_a_trusted_module_is_trusted_for_its_own_parts_alone(honest, left, tmp_path):
    """`trust=intruder` allows what is defined there, not what can be reached from there."""
    run = copied(honest, tmp_path / "run", robot={"_target_": "intruder.robot"})
    assert run_config(run, "intruder").robot._target_ == "intruder.robot"
    assert left.exists()
    run = copied(honest, tmp_path / "other", robot={"_target_": "intruder.Path.touch"})
    with pytest.raises(UserError, match="no part of r2s"):
        run_config(run, ["intruder"])


def test_what_is_typed_is_trusted_as_before(left):
    """A config that the user composes may name any part."""
    cfg = composed("robot._target_=intruder.robot")
    assert build.make_robot(cfg) is None
    assert left.exists()


def test_an_honest_run_reads_as_it_was(honest):
    """All groups of conf/ pass, interpolations keep their values, and the config's trust is the user's."""
    before, after = OmegaConf.load(honest / "config.yaml"), run_config(honest)
    assert OmegaConf.to_container(after) | {"trust": None} == OmegaConf.to_container(before, resolve=True)
    assert after.trust == []


@pytest.mark.long
@pytest.mark.parametrize(
    "word",
    [
        "arm=panda",
        "arm=fr3_emulated",
        "simulator=gazebo",
        "simulator=gazebo_classic",
        "task=track",
        "search=ga",
        "tracker=[mlflow,wandb,tensorboard]",
        "adapt=rls",
        "algo=oracle",
        "dr=identified",
    ],
)
def test_every_option_of_conf_passes(word):
    assert checked(composed(word), "conf").seed == 0


def test_the_friction_family_of_a_calibration_is_not_imported(left, tmp_path):
    """parameters.yaml with a dotted path: calibration=, dr=identified and adapt= read it."""
    robot = load_robot(str(ROOT / "tests" / "models" / "six_joints.xml"))
    file = tmp_path / "parameters.yaml"
    file.write_text(yaml.safe_dump({"robot": robot.name, "joints": 6, "friction_family": "intruder.FAMILY"}))
    for trust in ((), ("other",)):
        with pytest.raises(UserError, match=r"parameters.yaml: friction_family is 'intruder.FAMILY'.*trust=intruder"):
            load_parameters(tmp_path, robot, trust)
    cfg = composed(f"calibration={tmp_path}")
    with pytest.raises(UserError, match="trust=intruder"):
        build.make_dynamics(cfg, robot)
    assert not left.exists()
    with pytest.raises(UserError, match=r"is not a parameters.yaml"):  # it goes on reading
        load_parameters(tmp_path, robot, ("intruder",))


@pytest.mark.parametrize("word", ["hydra.searchpath=[file:///tmp]", "+hydra.job.name=x", "hydra/launcher=ray"])
def test_overrides_of_a_run_folder_set_nothing_of_hydra(honest, tmp_path, word):
    run = copied(honest, tmp_path / "run")
    (run / "overrides.yaml").write_text(yaml.safe_dump([word]))
    with pytest.raises(UserError, match="is damaged"):
        cli.typed_overrides(run)


def test_trainings_of_a_resumed_search_check_what_they_replay(left, monkeypatch):
    """They are commands of words from the folder, so their composed config counts as one of a run folder."""
    from hydra import initialize_config_dir

    words = ["robot._target_=os.mkdir", f"+robot.path={left}"]
    with initialize_config_dir(str(build.CONF.resolve()), version_base="1.3"):
        pipeline.compose_step(words, "tune.space")
        monkeypatch.setenv(TRUST, "")
        with pytest.raises(UserError, match=r"^resume: robot._target_ is 'os.mkdir'.*trust=os$"):
            pipeline.compose_step(words, "tune.space")
        monkeypatch.setenv(TRUST, "os")
        with pytest.raises(UserError, match="no part of r2s"):  # os.mkdir is of the module posix
            pipeline.compose_step(words, "tune.space")
    assert not left.exists()


def test_trust_is_a_name_several_or_a_list():
    assert modules(None) == modules("") == []
    assert modules("a") == ["a"]
    assert modules("[a,b]") == modules("a, b") == modules(OmegaConf.create(["a", "b"])) == ["a", "b"]
    for wrong in (5, True, [5]):
        with pytest.raises(UserError, match="trust: expected names of modules"):
            modules(wrong)


def test_truth_is_a_file_of_conf(tmp_path):
    """data.truth= of a resumed run names no file elsewhere, which could name a friction family."""
    for group in ("friction", "inertia"):
        (tmp_path / group).mkdir()
    cfg = composed("stage=identify", "data=simulated")
    cfg.data.truth = "../friction/paper"
    with pytest.raises(UserError, match=r"data.truth: no '\.\./friction/paper'"):
        build.make_truth(cfg, None)
