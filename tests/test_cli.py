"""The commands of docs/reference/commands.md at toy size, their run folders, and a user's mistakes."""

# ruff: noqa: F811 (the arguments are fixtures of cli_runs.py)

import fcntl
import json
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from cli_runs import SHORT, TOY, one_line, r2s, recording, root, started, succeed, trained  # noqa: F401 (fixtures)
from conftest import ROOT, conf, in_blocks

from r2s.engines.gazebo import RELEASES
from r2s.runs import read_meta
from r2s.tasks.rewards import TERMS


@pytest.fixture(scope="module")
def identified(root) -> Path:
    succeed("stage=identify", "name=seed_run", f"root={root}", *TOY)
    return root / "identify" / "seed_run"


@pytest.fixture(scope="module")
def stopped(root) -> Path:
    """Return the folder of an identification that was killed in the middle of its searches."""
    words = ["stage=identify", "name=killed", f"root={root}", *TOY]
    folder = root / "identify" / "killed"
    process = started(*words, at=ROOT)
    while not (folder / "checkpoints" / "search_1.npz").is_file():
        assert process.is_alive(), "it ended before it could be killed"
        time.sleep(0.02)
    process.kill()
    process.join()
    assert not (folder / "parameters.yaml").exists()
    return folder


@pytest.mark.long
def test_kill_ends_a_run_as_ctrl_c_does(root):
    """SIGTERM, as `kill` and batch systems send it: one line, exit code 130, status `stopped`."""
    folder, err = root / "identify" / "terminated", root / "terminated.txt"
    err.touch()
    process = started("stage=identify", "name=terminated", f"root={root}", *TOY, at=ROOT, err=str(err))
    while not (folder / "checkpoints" / "search_1.npz").is_file():
        assert process.is_alive(), "it ended before it could be terminated"
        time.sleep(0.02)
    process.terminate()
    process.join()
    assert process.exitcode == 130
    assert f"interrupted; {folder} keeps what was written; resume={folder} goes on" in err.read_text()
    assert read_meta(folder)["status"] == "stopped"


@pytest.mark.long
def test_a_resumed_identification_ends_where_an_uninterrupted_one_does(stopped, identified):
    """Killed, then `resume=`: the same numbers in every file that holds results; resumed again it is refused."""
    succeed(f"resume={stopped}")
    for name in ("parameters.yaml", "summary.json"):
        texts = [(f / name).read_text().replace(str(f), "") for f in (stopped, identified)]
        assert texts[0] == texts[1]
    with np.load(stopped / "posterior.npz") as a, np.load(identified / "posterior.npz") as b:
        assert np.array_equal(a["samples"], b["samples"])
    done = r2s(f"resume={stopped}")
    assert done.returncode == 2
    assert "is finished" in done.stderr


COMMANDS = [c.removeprefix("python run.py ") for c in in_blocks(ROOT / "docs" / "reference" / "commands.md")]


COSTLY = ("task=track", "stage=estimate", "-m stage=transfer")  # others do it in process; six transfers
OWN_TESTS = r"resume=|list|look|export|check|convert|engines|.*data\.contact=|.*gazebo_classic|.*experiment=results"
TYPED = [c for c in COMMANDS if not re.match(OWN_TESTS, c)]


@pytest.mark.long
@pytest.mark.parametrize(
    "command", [pytest.param(c, marks=[pytest.mark.slow] if c.startswith(COSTLY) else []) for c in TYPED]
)
def test_command(command, root, recording, trained, identified):
    """Every `python run.py` line of docs/reference/commands.md ends well and prints its run folder."""
    command = command.replace("FILE", str(recording)).replace("IDENTIFY_FOLDER", str(identified))
    if "adapt=" in command:  # adapters need an identified model
        succeed(f"calibration={identified}", "dr=identified", "name=known", f"root={root}", *SHORT)
        trained = root / "train" / "known"
    if "runs/transfer" in command:
        words = ["stage=transfer", f"policy={trained}", "evaluation.episodes=1", f"root={root}"]
        succeed(*words, "name=carried", "simulator=none", *TOY)
        command = command.replace("runs/transfer", f"{root}/transfer")
    command = command.replace("TRAIN_FOLDER", str(trained)).replace("runs/train", f"{root}/train")
    command = command.replace("budget.minutes=4", "budget.minutes=0.05")
    toy = TOY if re.search("stage=|oracle", command) else SHORT
    if "pipeline" in command:
        toy = [*SHORT, "pipeline.train_minutes=null"]
    if "stage=excite" in command:
        toy = [*TOY, "excite.seconds=3", "excite.effort=5"]
    if "search=ga" in command:
        toy = ["data.seconds=2", "data.ramp_poses=1", "search.0.population=4", "search.0.generations=2"]
        toy += [
            "friction.family=sigmoid",
            "identify.terms.commanded=[offset]",
            "identify.candidate_terms.commanded=[]",
        ]
    out = succeed(*shlex.split(command), f"root={root}", *toy)
    folders = [root / Path(f).relative_to(root) for f in re.findall(r"written: (\S+)", out)]
    assert folders
    for folder in folders:
        meta = json.loads((folder / "meta.json").read_text())
        assert meta["status"] == "done"
        assert (folder / "summary.json").is_file()
        assert (folder / "recording.rrd").stat().st_size > 1000
        assert list((folder / "figures").glob("*.png"))


def test_run_folders_hold_what_the_contract_says(trained, identified):
    """Names and keys of a training's and an identification's run folder."""
    summary = json.loads((trained / "summary.json").read_text())
    keys = {"env_steps", "wall_clock_s", "success_5cm", "success_2cm", "success_1cm", "success_5mm"}
    assert keys | {"distance_median_m", "return_paper"} <= set(summary["best"]) & set(summary["last"])
    assert {"config.yaml", "overrides.yaml", "policy.pt", "policy.onnx", "metrics.csv", "evaluations.csv"} <= {
        p.name for p in trained.iterdir()
    }
    assert yaml.safe_load((trained / "overrides.yaml").read_text())[0] == "name=seed_run"
    errors = json.loads((identified / "summary.json").read_text())
    for side in ("train", "validation"):
        for key in ("torque_rmse_Nm", "nominal_torque_rmse_Nm", "position_rmse_mrad", "nominal_position_rmse_mrad"):
            assert len(errors[side][key]) == 7
        assert "0.1" in errors[side]["ee_error_mm"]
    assert json.loads((identified / "verdict.json").read_text())["verdict"] in ("pass", "warn")
    first = []
    for side in ("train", "validation"):
        with np.load(identified / f"{side}.npz") as file:
            first.append(file["dq"][0])
    assert not np.any(first[0] == first[1])  # at rest there is only noise: each recording has its own
    parameters = yaml.safe_load((identified / "parameters.yaml").read_text())["parameters"]
    assert set(parameters) == {"phi1", "phi2", "phi3", "inertia_scale", "offset", "delay"}
    assert parameters["phi1"]["unit"] == "Nm"
    assert len(parameters["phi1"]["identifiable"]) == 7


def test_every_number_and_figure_is_explained(trained, identified):
    """docs/reference/metrics.md names the keys of summaries and metrics.csv, report sections and figures."""
    page = (ROOT / "docs" / "reference" / "metrics.md").read_text()
    named, rows = set(re.findall(r"`(\w+)`", page)), set(re.findall(r"^\|([^`|]+)\|", page, flags=re.M))
    summary, errors = (json.loads((f / "summary.json").read_text()) for f in (trained, identified))
    head = (trained / "metrics.csv").read_text().splitlines()[0].split(",")
    clock = {"env_steps", "updates", "wall_clock_s"}
    terms = {f"{kind}_{name}" for kind in ("weight", "term") for name in TERMS}
    known = named | clock | terms | {f"nominal_{name}" for name in named}
    assert {*summary["best"], *errors["validation"], *head} - known == set()
    assert {p.stem for f in (trained, identified) for p in (f / "figures").glob("*.png")} <= named
    sections = re.findall(r"^## (.+)", (identified / "report.md").read_text(), flags=re.M)
    assert set(sections) <= rows


def test_exported_policy_is_the_trained_policy(trained):
    """policy.onnx gives the torques of policy.pt, within 1e-5 of their scale, and carries what a driver needs."""
    import onnxruntime

    from r2s.learning.policy import load_policy
    from r2s.physics.robot import load_robot
    from r2s.tasks.reach import ReachTask

    config = yaml.safe_load((trained / "config.yaml").read_text())
    task = ReachTask(**(conf("task/reach") | {"reach": tuple(config["robot"]["reach"])}))
    policy = load_policy(trained, load_robot(**conf("robot/panda")), task)
    session = onnxruntime.InferenceSession(str(trained / "policy.onnx"))
    seen = torch.randn(5, 54)
    torque = session.run(None, {"observation": seen.numpy()})[0]
    scale = policy.action_scale.numpy()
    assert np.abs((torque - policy(seen).detach().numpy()) / scale).max() < 1e-5
    facts = session.get_modelmeta().custom_metadata_map
    assert facts["policy_hz"] == "50"
    assert len(facts["action_scale"].split()) == 7
    assert facts["joints"].split() == [f"joint{j}" for j in range(1, 8)]
    assert facts["q_min_rad"].split()[3] == "-3.0718"


@pytest.mark.slow  # test_checkpoint.py compares two trainings of one seed to the bit, one of them killed
def test_same_seed_same_training(root, trained):
    """With a budget of environment steps, the seed decides every number."""
    succeed("name=again", f"root={root}", *TOY)

    def rows(folder: Path) -> list[list[str]]:
        table = [line.split(",") for line in (folder / "evaluations.csv").read_text().splitlines()]
        clock = table[0].index("wall_clock_s")
        return [row[:clock] + row[clock + 1 :] for row in table]

    assert rows(root / "train" / "again") == rows(trained)


@pytest.mark.long
@pytest.mark.skipif(any(find_spec(name.split(".")[0]) for name in RELEASES), reason="Gazebo is here")
def test_a_missing_gazebo_gets_one_line(trained, tmp_path):
    done = r2s("stage=transfer", f"policy={trained}", "simulator=gazebo", "arm=none", f"root={tmp_path / 'runs'}")
    assert done.returncode == 2
    assert re.fullmatch(
        r"error: simulator=gazebo: gz-sim's Python bindings .* are not installed.*", done.stderr.strip()
    )
    assert not (tmp_path / "runs").exists()


IN_TRANSFER = {
    "simulator=none arm=none": r"simulator: expected a simulator or an arm, got simulator=none and arm=none",
    "arm=panda": r"arm.address must be given",
    "arm.payload=-1": r"arm.payload: expected .*, got -1",
    "arm=panda arm.address=127.0.0.1": r"arm=panda: no connection to 127.0.0.1",
}


@pytest.mark.long
@pytest.mark.parametrize("mistake", IN_TRANSFER)
def test_mistake_in_a_transfer_gets_one_line(mistake, trained, tmp_path):
    """Before the first goal and the run folder."""
    if "address" in mistake:
        pytest.importorskip("panda_py")
    done = r2s("stage=transfer", f"policy={trained}", *mistake.split(), f"root={tmp_path / 'runs'}")
    one_line(done, IN_TRANSFER[mistake])
    assert not (tmp_path / "runs").exists()


@pytest.mark.long
def test_a_training_transfers_without_the_identification_that_it_came_from(identified, tmp_path):
    """calibration= and dr=identified: with the identify folder gone, the same policy meets the same arms."""
    folder = tmp_path / "identified"
    shutil.copytree(identified, folder)
    words = [f"calibration={folder}", "dr=identified", "name=a"]
    succeed(*words, f"root={tmp_path}", *SHORT)
    rows = []
    for _ in range(2):
        words = [f"policy={tmp_path / 'train' / 'a'}", "evaluation.episodes=1", f"root={tmp_path}", *TOY]
        out = succeed("stage=transfer", *words)
        (written,) = re.findall(r"written: (\S+)", out)
        rows.append(json.loads((Path(written) / "summary.json").read_text()))
        shutil.rmtree(folder, ignore_errors=True)
    assert rows[0] == rows[1]
    assert set(rows[0]) == {"mujoco", "predicted", "twin"}


@pytest.mark.long
def test_names_that_are_taken_get_one_line(tmp_path):
    """A run folder with other settings, or of another process, is neither used nor overwritten."""
    words = [*SHORT, f"root={tmp_path}", "name=a", "compile=false"]
    succeed(*words)
    config = (tmp_path / "train" / "a" / "config.yaml").read_text()
    done = r2s(*words, "skip_completed=true", "algo.gamma=0.9")
    assert done.returncode == 2
    assert re.search(r"train/a has other settings: algo.gamma was 0.97, is 0.9; give another name=", done.stderr)
    assert (tmp_path / "train" / "a" / "config.yaml").read_text() == config
    (tmp_path / "identify" / "a").mkdir(parents=True)
    done = r2s("stage=pipeline", f"root={tmp_path}", "name=a")
    assert done.returncode == 2
    assert re.search(r"name: a is taken, .*identify/a exists; give another name=", done.stderr)
    assert not (tmp_path / "pipeline").exists()
    meta = tmp_path / "train" / "a" / "meta.json"
    process = {"host": platform.node(), "pid": os.getpid()}
    meta.write_text(json.dumps(json.loads(meta.read_text()) | {"status": "running", "process": process}))
    with open(meta.with_name("overrides.yaml"), "r+") as held:
        fcntl.flock(held, fcntl.LOCK_EX)  # as a run does
        done = r2s(f"resume={tmp_path / 'train' / 'a'}")
    assert done.returncode == 2
    assert re.search(rf"process {os.getpid()} on .* is still writing", done.stderr)


@pytest.mark.long
def test_the_same_policy_in_dart(trained, root):
    """DART and MuJoCo agree on every measure; the summary holds the path gap."""
    succeed("stage=transfer", f"policy={trained}", "simulator=dart", "arm=none", "name=dart", f"root={root}", *TOY)
    rows = json.loads((root / "transfer" / "dart" / "summary.json").read_text())
    assert set(rows) == {"mujoco", "dart"}
    assert rows["dart"]["ee_path_rmse_mm"] < 3.0
    assert rows["dart"]["return_paper"] == pytest.approx(rows["mujoco"]["return_paper"], abs=1.0)


def test_help_does_not_import_torch():
    """--help answers without the heavy libraries."""
    code = "import sys, runpy; sys.argv = ['run.py', '--help']\ntry: runpy.run_path('run.py', run_name='__main__')\n"
    code += "except SystemExit: pass\nprint('LOADED', [m for m in ('torch', 'mujoco', 'rerun') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert "LOADED []" in done.stdout, done.stdout[-500:] + done.stderr
