"""docs/how_to/extending.md: the tests write its files as they stand and run its commands."""

import json
import re
import shlex
import subprocess
import sys

import pytest
from cli_runs import TOY, r2s, succeed
from conftest import ROOT

PAGE = (ROOT / "docs" / "how_to" / "extending.md").read_text()
EXAMPLES = {part.split("\n")[0]: part for part in re.split(r"^## ", PAGE, flags=re.M)[1:]}
LINES = 60  # about a screen


# their laws are compiled anew; the fast tests have laws of one's own in test_control.py and test_family_plugin.py
COMPILED = ("A controller", "A friction family")


@pytest.mark.long
@pytest.mark.parametrize("example", [pytest.param(e, marks=[pytest.mark.slow] * (e in COMPILED)) for e in EXAMPLES])
def test_a_part_is_one_file_one_yaml_and_one_command(example, tmp_path, monkeypatch):
    """The files of an example, in an empty folder, and its command in that folder: the run ends well.

    +experiment=toy names a family, so the example's own is said again, after it.
    """
    assert len(EXAMPLES[example].splitlines()) <= LINES
    blocks = re.findall(r"```(\w+)\n(.*?)```", EXAMPLES[example], flags=re.S)
    commands = [text for kind, text in blocks if kind == "bash"]
    for kind, text in blocks:
        if kind != "bash":
            path = tmp_path / re.sub(r"^(#|<!--) *| *-->$", "", text.splitlines()[0])
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
    assert len(blocks) - len(commands) == 2
    for command in commands:
        words = shlex.split(command.removeprefix("python run.py"))
        words += [
            f"friction.family={family}" for family in re.findall(r"^family: (\S+)", EXAMPLES[example], flags=re.M)
        ]
        out = succeed(*words, *TOY, at=tmp_path)
        (folder,) = re.findall(r"written: (\S+)", out)
        assert (tmp_path / folder / "summary.json").is_file()


def files_of(*titles: str) -> dict[str, str]:
    """Return {path: text} of the files of these examples."""
    blocks = [b for title in titles for b in re.findall(r"```(\w+)\n(.*?)```", EXAMPLES[title], flags=re.S)]
    return {text.splitlines()[0].removeprefix("# "): text for kind, text in blocks if kind != "bash"}


@pytest.mark.slow  # the fast tests train with that task
def test_a_task_with_its_own_action_space_goes_through_every_stage(tmp_path):
    """Eight values per action, a law and a measure of its own, a reward and a tracker from outside r2s.

    Training, transfer to a second engine and a twin, comparison, list and export know them through the task alone.
    A run folder that names them is read where the user trusts their modules. The exported law runs without r2s'
    compiler, and gives the torque of the driver.
    """
    for path, text in files_of("A task with its own action space", "A reward", "A tracker").items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(text)
    own = "--config-dir", "my_conf"
    parts = "task=soft", "reward=gentle", "tracker=lines"
    succeed(*own, *parts, "name=soft", *TOY, at=tmp_path)
    run = tmp_path / "runs" / "train" / "soft"
    assert "torque_Nm" in json.loads((run / "summary.json").read_text())["best"]
    assert '"table": "summary"' in (run / "lines.jsonl").read_text()
    transfer = "stage=transfer", "policy=runs/train/soft", "name=soft", "evaluation.episodes=2", "threads=1"
    refused = r2s(*transfer, "simulator=mujoco", "arm=none", at=tmp_path)
    assert refused.returncode == 2
    assert "add trust=[gentle,lines,soft]" in refused.stderr
    transfer = *transfer, "trust=[gentle,lines,soft]"
    out = succeed(*own, *transfer, "simulator=dart", "arm=twin", at=tmp_path)
    assert "torque, Nm" in out
    rows = json.loads((tmp_path / "runs" / "transfer" / "soft" / "summary.json").read_text())
    assert {"dart", "twin"} <= rows.keys()
    assert all(row["torque_Nm"] > 0 for row in rows.values())
    succeed("stage=compare", "runs=runs/train/*", at=tmp_path)
    assert "success at 1 cm" in succeed("list", at=tmp_path)
    succeed("export", "runs/train/soft", "trust=gentle,lines,soft", at=tmp_path)
    contract = json.loads((run / "bundle" / "contract.json").read_text())
    assert contract["control"]["name"] == "impedance"
    assert len(contract["control"]["action_scale"]) == 8
    check = subprocess.run([sys.executable, "-c", CHECK], cwd=run / "bundle", capture_output=True, text=True)
    assert check.returncode == 0, check.stderr
    assert check.stdout.strip() == "[]"


CHECK = """
import json, sys
import numpy as np
from r2s_runtime import Arm, Runtime
contract = json.load(open("contract.json"))
limits, torque = contract["limits"], contract["torque"]
arm = Arm(contract["joints"], 1000, torque["convention"], limits["q_min_rad"], limits["q_max_rad"],
          limits["dq_max_rad_per_s"], torque["max_Nm"], torque["max_rate_Nm_per_s"])
runtime, q = Runtime(".", arm), np.array(contract["start"]["q_rad"])
runtime.reset()
for _ in range(40):
    tau = runtime(q, np.zeros(7), np.zeros(7), np.array([0.4, 0.1, 0.5]))
assert np.isfinite(tau).all() and np.abs(tau).max() > 0 and runtime.driver.stopping is None
print([m for m in sys.modules if m.split(".")[0] in ("r2s", "numba", "torch")])
"""
