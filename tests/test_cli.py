"""The command line: the commands of docs/reference/commands.md at toy size, and a user's mistakes."""

import fcntl
import json
import multiprocessing
import os
import platform
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
from functools import cache
from importlib.util import find_spec
from multiprocessing import forkserver
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
import yaml
from conftest import REAL, ROOT, conf, in_blocks

from r2s.arm.clients import fr3_limits
from r2s.engines.gazebo import RELEASES
from r2s.physics.robot import load_robot
from r2s.stages import pipeline
from r2s.stages.transfer import rest_warning
from r2s.tasks.rewards import PAPER, TERMS, Curriculum

TOY = ["+experiment=toy"]
SHORT = [*TOY, "budget.env_steps=1600", "evaluation.env_steps=1600"]  # if the policy does not matter


# Commands are forked off a server that has imported what they import anyway: seconds less for each of a hundred.
FORKS = multiprocessing.get_context("forkserver")
FORKS.set_forkserver_preload(
    [
        "hydra",
        "onnxscript",
        "r2s.arm.policy_runner",
        "r2s.engines.episodes",
        "r2s.reporting.pages",
        "r2s.learning.tqc",
        "r2s.learning.train",
        "torch.export",
        "test_cli",
        "warm",
    ]
)


@cache
def serve() -> None:
    """Start the server, where it finds tests/warm.py: what it does not find it leaves out without a word."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(Path(__file__).parent), prepend=os.pathsep)
        forkserver._forkserver.ensure_running()


def front_door(words: tuple[str, ...], at: Path, out: str, err: str) -> None:
    """Be `python run.py WORDS` in the folder `at`, with its output in files."""
    for number, path in enumerate((out, err), 1):
        os.dup2(os.open(path, os.O_WRONLY), number)
    os.environ["COLUMNS"] = "110"
    os.chdir(at)
    sys.argv = ["run.py", *words]
    pipeline.subprocess = SimpleNamespace(Popen=Step, PIPE=None, STDOUT=None)  # type: ignore[assignment]
    try:
        runpy.run_path(str(ROOT / "run.py"), run_name="__main__")
        status = 0
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
        status = 1
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)  # a process of multiprocessing would wait for the workers of a sweep


def started(*words: str, at: Path, out: str = os.devnull, err: str = os.devnull) -> multiprocessing.Process:
    """Start `python run.py WORDS` in the folder `at`."""
    serve()
    child = FORKS.Process(target=front_door, args=(words, at, out, err))
    child.start()
    return child


class Step:
    """A command that a chain starts, off the same server: as much of subprocess.Popen as the chain uses."""

    def __init__(self, command: list[str], **_: object):
        assert command[:2] == [sys.executable, str(ROOT / "run.py")]
        forkserver._forkserver.ensure_running = lambda: None  # it runs: this process is of it
        self.folder = tempfile.TemporaryDirectory()
        pipe = str(Path(self.folder.name) / "pipe")
        os.mkfifo(pipe)
        self.child = started(*command[2:], at=Path.cwd(), out=pipe, err=pipe)
        self.stdout = open(pipe)  # noqa: SIM115
        self.poll, self.terminate = (lambda: self.child.exitcode), self.child.terminate

    def wait(self) -> int | None:  # noqa: D102
        self.child.join()
        self.folder.cleanup()
        self.returncode = self.child.exitcode
        return self.returncode


def r2s(*words: str, at: Path = ROOT) -> subprocess.CompletedProcess[str]:
    """Run run.py as a user does, without a terminal."""
    with tempfile.NamedTemporaryFile("r") as out, tempfile.NamedTemporaryFile("r") as err:
        child = started(*words, at=at, out=out.name, err=err.name)
        child.join()
        return subprocess.CompletedProcess(words, child.exitcode or 0, out.read(), err.read())


def succeed(*words: str, at: Path = ROOT) -> str:
    done = r2s(*words, at=at)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "INFO" not in done.stdout + done.stderr, "a library logs"
    return done.stdout


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("runs")


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    """A recording of two seconds of a Panda with viscous friction, as CSV with q1..q7 columns and both torques."""
    path = tmp_path_factory.mktemp("data") / "log.csv"
    t = np.arange(2000) * 1e-3
    swing = np.linspace(0.1, 0.2, 7)
    q = np.outer(1 - np.cos(2 * t), swing) + np.array([0, -0.8, 0, -2.3, 0, 1.6, 0.8])
    dq, ddq = np.outer(2 * np.sin(2 * t), swing), np.outer(4 * np.cos(2 * t), swing)
    torques = []
    for gravity in (True, False):
        model = load_robot(**conf("robot/panda")).model(gravity=gravity)
        data, tau = mujoco.MjData(model), 2 * dq
        for k in range(len(t)):
            data.qpos, data.qvel, data.qacc = q[k], dq[k], ddq[k]
            mujoco.mj_inverse(model, data)
            tau[k] += data.qfrc_inverse
        torques.append(tau)
    head = ",".join(["t", *(f"{name}{j}" for name in ("q", "dq", "tau_J", "tau_J_d") for j in range(1, 8))])
    np.savetxt(path, np.column_stack([t, q, dq, *torques]), delimiter=",", header=head, comments="")
    return path


@pytest.fixture(scope="module")
def trained(root) -> Path:
    succeed("name=seed_run", f"root={root}", *TOY)
    return root / "train" / "seed_run"


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


@pytest.mark.long
def test_a_sweep_goes_on_without_the_job_that_fails(tmp_path):
    """One bad value: one line, exit status 2, the other job done; a repeated sweep skips that one."""
    sweep = ["-m", *SHORT, f"root={tmp_path}", "skip_completed=true", "name=lr${algo.lr}", "algo.lr=2.0,1e-3"]
    done = r2s(*sweep)
    assert done.returncode == 2
    assert "error: algo.lr: expected a number in (0, 1], got 2.0\n" in done.stderr
    assert done.stderr.endswith("error: 1 job of the sweep failed, see above; the others are done\n")
    assert json.loads((tmp_path / "train" / "lr0.001" / "meta.json").read_text())["status"] == "done"
    assert [p.name for p in (tmp_path / "train").iterdir()] == ["lr0.001"]
    assert f"already finished: {tmp_path}/train/lr0.001" in r2s(*sweep).stdout


@pytest.mark.long
def test_a_command_that_a_job_of_a_sweep_runs_fails_by_itself(tmp_path):
    """It ends with status 2 and is no failed job of the sweep, so that the job sees that its command failed."""
    env = os.environ | {"R2S_FAILED": str(tmp_path / "failed.txt")}
    command = [sys.executable, "run.py", "seed=-1", f"root={tmp_path}"]
    done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("error: seed: ")
    assert not any(tmp_path.iterdir())


@pytest.mark.slow
def test_the_grid_is_what_its_file_says(tmp_path):
    """paper_grid, cut down to two jobs, runs them side by side in folders named by their settings."""
    grid = ["-m", "+experiment=[paper_grid,toy]", f"root={tmp_path}", 'grid.algo="td3,tqc"', 'grid.lr="1e-3"']
    succeed(*grid, *SHORT[1:], 'grid.batch_size="16"', 'grid.gamma="0.9"', 'grid.seed="3"')
    names = sorted(p.name for p in (tmp_path / "train").iterdir())
    assert names == [f"grid_{a}_lr0.001_batch16_gamma0.9_seed3" for a in ("td3", "tqc")]
    config = yaml.safe_load((tmp_path / "train" / names[0] / "config.yaml").read_text())
    assert (config["seed"], config["threads"], config["algo"]["policy_delay"]) == (3, 1, 2)
    assert all((tmp_path / "train" / name / "policy.onnx").is_file() for name in names)


@pytest.mark.long
def test_the_papers_reward_ends_alone_and_without_noise(tmp_path):
    """experiment=paper_reward ends in eq. (2) alone; noise has fallen 15-fold before, the learning rate threefold."""
    succeed("+experiment=[paper_reward,toy]", f"root={tmp_path}", "name=eq2")
    config = yaml.safe_load((tmp_path / "train" / "eq2" / "config.yaml").read_text())
    reward = Curriculum(**{k: v for k, v in config["reward"].items() if k != "_target_"})
    algo, (_, alone) = config["algo"], reward.anneal
    assert alone < 1
    assert np.array_equal(reward.weights(None, alone), PAPER)
    assert algo["explore_end"] ** alone < 1 / 15
    lr_share = 1 - (1 - algo["lr_end"]) * (alone - algo["lr_decay"]) / (1 - algo["lr_decay"])
    assert lr_share < 1 / 3


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


@pytest.mark.long
def test_every_algorithm_trains(root):
    """A sweep over those that the grid leaves out writes a run folder with a policy each."""
    out = succeed("-m", "algo=ddpg,sac", f"root={root}", *SHORT)
    folders = re.findall(r"written: (\S+)", out)
    assert len(folders) == 2
    assert all((Path(f) / "policy.onnx").is_file() for f in folders)


@pytest.mark.slow  # test_checkpoint.py compares two trainings of one seed to the bit, one of them killed
def test_same_seed_same_training(root, trained):
    """With a budget of environment steps, the seed decides every number."""
    succeed("name=again", f"root={root}", *TOY)

    def rows(folder: Path) -> list[list[str]]:
        table = [line.split(",") for line in (folder / "evaluations.csv").read_text().splitlines()]
        clock = table[0].index("wall_clock_s")
        return [row[:clock] + row[clock + 1 :] for row in table]

    assert rows(root / "train" / "again") == rows(trained)


def one_line(done, pattern):
    """Check that a command printed one line on stderr and ended with status 2."""
    assert done.returncode == 2, done.stdout + done.stderr
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    assert len(lines) == 1, done.stderr
    assert re.search(pattern, lines[0])


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


@pytest.mark.slow
def test_a_policy_for_an_fr3_meets_one(root):
    """Trained with its limits, which are those of the emulator, and through its client without a stop."""
    pytest.importorskip("pylibfranka")
    succeed("robot=fr3", "name=fr3", f"root={root}", *TOY)
    config = yaml.safe_load((root / "train" / "fr3" / "config.yaml").read_text())["robot"]
    np.testing.assert_array_equal(config["q_min"], fr3_limits.Q_MIN)
    np.testing.assert_array_equal(config["q_max"], fr3_limits.Q_MAX)
    np.testing.assert_array_equal(config["dq_max"], fr3_limits.DQ_MAX)
    words = ["arm=fr3_emulated", "simulator=none", "evaluation.episodes=1", "name=fr3", f"root={root}"]
    succeed("stage=transfer", f"policy={root / 'train' / 'fr3'}", *words, *TOY)
    assert (root / "transfer" / "fr3" / "stops.txt").read_text() == "none\n"


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


@pytest.mark.slow
def test_another_arm_needs_no_more_than_its_file(root):
    """Six joints, their own limits, no published friction: the pipeline ends with its table."""
    arm = Path(__file__).parent / "models" / "six_joints.xml"
    words = ["robot=other", f"robot.mjcf={arm}", "pipeline.train_minutes=null", "name=six", f"root={root}", *TOY]
    out = succeed("stage=pipeline", *words)
    assert all(
        f"{model} model, {where}" in out for model in ("identified", "nominal") for where in ("mujoco", "twin")
    )
    config = yaml.safe_load((root / "train" / "six_nominal" / "config.yaml").read_text())
    assert config["friction"]["phi1"] == conf("friction/uniform")["phi1"]
    parameters = yaml.safe_load((root / "identify" / "six" / "parameters.yaml").read_text())
    assert parameters["joints"] == len(parameters["parameters"]["phi1"]["value"]) == 6


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


@pytest.mark.long
@pytest.mark.parametrize(
    ("arm", "package"),
    [
        ("panda_emulated", "panda_py"),
        pytest.param(
            "fr3_emulated", "pylibfranka", marks=pytest.mark.slow
        ),  # above: once, with a policy of its own, also slow
    ],
)
def test_a_policy_through_the_client_that_drives_hardware(arm, package, tmp_path):
    """The whole way, in lock-step against the emulator of the control box: no stop, and twice the same to the bit."""
    pytest.importorskip(package)
    root = tmp_path / "runs"
    succeed("name=gentle", f"root={root}", "algo.demonstrations=0", *TOY)  # of demonstrations it would learn to move
    gentle = root / "train" / "gentle"
    saved = torch.load(gentle / "policy.pt", weights_only=True)
    for name in ("actor.body.4.weight", "actor.body.4.bias"):  # a tenth: it would drift into the fence of the table
        saved["state"][name] *= 0.1
    torch.save(saved, gentle / "policy.pt")
    runs = []
    for k in range(2):
        words = [f"arm={arm}", "simulator=none", "evaluation.episodes=1", f"name={arm}_{k}"]
        succeed("stage=transfer", f"policy={gentle}", f"root={root}", *words, *TOY)
        folder = root / "transfer" / f"{arm}_{k}"
        assert (folder / "stops.txt").read_text() == "none\n"
        with np.load(folder / f"episodes_{arm}.npz") as episodes:
            runs.append({key: episodes[key] for key in episodes.files})
    assert np.ptp(runs[0]["q"], axis=1).max() > 1e-3  # it moved
    for key, values in runs[0].items():
        np.testing.assert_array_equal(runs[1][key], values)


def test_a_policy_that_rests_less_than_predicted_raises_a_warning():
    """No warning without a prediction, or if the task has no such measure."""
    rows = {"predicted": {"rest": 1.0}, "twin": {"rest": 0.49}}
    assert "51 % of the episodes on arm=twin" in rest_warning(rows, "twin")
    assert rest_warning(rows | {"twin": {"rest": 0.98}}, "twin") is None
    assert rest_warning({"twin": {"rest": 0.49}}, "twin") is None
    assert rest_warning({"predicted": {}, "twin": {}}, "twin") is None


def test_a_pipeline_moves_a_physical_arm_with_one_command_at_a_time():
    """Twins and emulated arms are as many as the transfers; a physical arm accepts one client."""
    step = {"identified": ["stage=transfer"], "nominal": ["stage=transfer"]}
    assert pipeline.at_once(step, moves=True) == [{label: words} for label, words in step.items()]
    assert pipeline.at_once(step, moves=False) == [step]


def test_help_does_not_import_torch():
    """--help answers without the heavy libraries."""
    code = "import sys, runpy; sys.argv = ['run.py', '--help']\ntry: runpy.run_path('run.py', run_name='__main__')\n"
    code += "except SystemExit: pass\nprint('LOADED', [m for m in ('torch', 'mujoco', 'rerun') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert "LOADED []" in done.stdout, done.stdout[-500:] + done.stderr


@pytest.mark.slow  # test_identify.py has it without the command
@pytest.mark.skipif(not REAL.is_file(), reason="the real Panda recording is not beside this checkout")
def test_real_panda_is_predicted_better_than_by_the_published_model(tmp_path):
    """The command on the real recording: held-out torque improves on average over the joints."""
    succeed(
        "stage=identify",
        "data=recording",
        f"data.path={REAL}",
        "data.torque=measured",
        "name=real",
        f"root={tmp_path}",
    )
    validation = json.loads((tmp_path / "identify" / "real" / "summary.json").read_text())["validation"]
    assert np.mean(validation["torque_rmse_Nm"]) < 0.75 * np.mean(validation["nominal_torque_rmse_Nm"])
    assert np.all(np.array(validation["torque_rmse_Nm"]) <= 1.02 * np.array(validation["nominal_torque_rmse_Nm"]))
