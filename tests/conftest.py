"""What every test needs: the embedded Panda with the limits of conf/robot/panda.yaml, and the real recording.

Also here: at the end of a session nothing that it started may still run.
"""

import gc
import os
import re
import subprocess
import sys
import time
import uuid
from copy import copy
from itertools import combinations
from pathlib import Path
from typing import Any

import psutil
import pytest
import torch
import yaml
from omegaconf import OmegaConf

from r2s.physics.robot import OF_TASKS, Robot, load_robot

pytest.register_assert_rewrite("cli_runs", "made_bundles")  # what differs is said for their asserts too
gc.set_threshold(100_000, 20, 20)  # collections of what torch and numba keep would cost a tenth of the suite
ROOT = Path(__file__).parent.parent
REAL = ROOT.parent / "shared" / "data" / "gaz2019_panda" / "train.npz"
# What takes seconds to make: tests that share one of a group run on one worker, so that it is made once.
TOGETHER = {
    "runs": ("trained", "identified", "stopped"),
    "identified": ("found", "directly", "linked"),
    "own_family": ("own_family",),
    **{name: (name,) for name in ("sides", "servers", "hard", "installed", "results")},
}
# What most tests call is compiled before the workers start, in two processes: each worker would compile it all.
SHARED = (
    "from r2s.physics.mujoco_callback import install; install()",
    "import test_adapters as t; from r2s.arm.warm_up import warm_up; from r2s.tasks.reach import ReachTask\n"
    "for make in t.MAKES: warm_up(t.PANDA, ReachTask(), make(t.context()))",
)
SESSION = "R2S_TEST_SESSION"  # every process that a session starts inherits this variable, whoever its parent is
SERVERS = ("from multiprocessing.forkserver ", "from multiprocessing.resource_tracker ")
NAME = pytest.StashKey[str]()
GRACE_S = 10.0  # a server that watches its parent needs a moment to see that it is gone


@pytest.fixture(autouse=True)
def _seeded():
    """A test that makes an untrained policy sees the same weights alone, in any order and on any worker."""
    torch.manual_seed(0)


def conf(path: str) -> dict:
    """Read one file of conf/ as plain YAML: the arguments of what its `_target_` names, for the Panda."""
    document = yaml.safe_load((ROOT / "conf" / f"{path}.yaml").read_text())
    group = path.split("/")[0]
    if group == "algo":
        bases = [conf(f"algo/{name}") for name in document.get("defaults", [])]
        document = {k: v for one in (*bases, document) for k, v in one.items()}
    if group == "task":
        panda = yaml.safe_load((ROOT / "conf/robot/panda.yaml").read_text())
        document = OmegaConf.to_container(OmegaConf.create({"robot": panda, "task": document}), resolve=True)["task"]
    beside = {"_target_", "defaults", *(OF_TASKS if group == "robot" else ())}
    return {k: v for k, v in document.items() if k not in beside} if isinstance(document, dict) else document


def in_blocks(page: Path) -> list[str]:
    """Return the commands in a page's ```bash blocks, a line each, joined where they go on, without comments."""
    blocks = re.findall(r"^```bash\n(.*?)^```", page.read_text(), flags=re.S | re.M)
    whole = [re.sub(r" *\\\n *", " ", block) for block in blocks]
    lines = [re.sub(r"(^| +)# .*", "", line).strip() for block in whole for line in block.splitlines()]
    return [line for line in lines if line]


def unfenced(robot: Robot, task: Any) -> Any:
    """Return a task in which everything may touch, so that its driver has no fence, as in training."""
    model = robot.model(gravity=False)
    bodies = [model.body(k).name for k in range(model.nbody)]
    task = copy(task)
    object.__setattr__(task, "may_touch", tuple(combinations([*bodies, "table"], 2)))
    return task


@pytest.fixture(scope="session")
def panda() -> Robot:
    return load_robot(**conf("robot/panda"))


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Put the tests that share an expensive fixture, as an argument or as a parameter's value, into one group."""
    for item in items:
        values = item.callspec.params.values() if hasattr(item, "callspec") else ()
        used = {*item.fixturenames, *(v for v in values if isinstance(v, str))}
        for group, fixtures in TOGETHER.items():
            if used & set(fixtures):
                item.add_marker(pytest.mark.xdist_group(group))


def pytest_configure(config):
    """Name the session, unless this is a worker of one or a run of pytest within a test."""
    if SESSION not in os.environ:
        os.environ[SESSION] = config.stash[NAME] = uuid.uuid4().hex


@pytest.hookimpl(tryfirst=True)
def pytest_sessionstart(session):
    """Compile SHARED, if workers are about to run the whole suite."""
    config = session.config
    whole = config.args_source is pytest.Config.ArgsSource.TESTPATHS
    if whole and getattr(config.option, "numprocesses", None):
        here = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])}
        halves = [subprocess.Popen([sys.executable, "-c", code], env=here) for code in SHARED]
        for half in halves:
            half.wait()  # what fails here fails in a test as well


def left_running(name: str) -> dict[psutil.Process, str]:
    """Return the processes of session `name` besides this one, with their command lines.

    Python's own SERVERS of this very process do not count: they end with it.
    """
    found = {}
    for process in psutil.process_iter():
        try:
            if process.pid != os.getpid() and process.environ().get(SESSION) == name:
                command = " ".join(process.cmdline())
                if process.ppid() != os.getpid() or not any(server in command for server in SERVERS):
                    found[process] = command
        except psutil.Error:
            pass  # gone meanwhile, or somebody else's
    return found


@pytest.hookimpl(wrapper=True, trylast=True)
def pytest_sessionfinish(session):
    """Fail a session that leaves processes behind, and end them."""
    yield  # xdist ends its workers in here
    if (name := session.config.stash.get(NAME, None)) is None:
        return
    deadline = time.monotonic() + GRACE_S
    while (left := left_running(name)) and time.monotonic() < deadline:
        time.sleep(0.2)
    for process, command in left.items():
        line = f"\nstill running {GRACE_S:g} s after the last test: {process.pid} {command}"
        session.config.get_terminal_writer().line(line, red=True)
        process.kill()
        session.exitstatus = pytest.ExitCode.TESTS_FAILED
