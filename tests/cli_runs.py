"""Commands as a user types them, each in a process of its own, and the runs that several test files use."""

import multiprocessing
import os
import re
import runpy
import subprocess
import sys
import tempfile
import traceback
from functools import cache
from multiprocessing import forkserver
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from conftest import ROOT, conf

from r2s.physics.robot import load_robot
from r2s.stages import pipeline

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
        "cli_runs",
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


def one_line(done, pattern):
    """Check that a command printed one line on stderr and ended with status 2."""
    assert done.returncode == 2, done.stdout + done.stderr
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    assert len(lines) == 1, done.stderr
    assert re.search(pattern, lines[0])


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
