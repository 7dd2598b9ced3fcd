"""What every test needs: the embedded Panda with the limits of conf/robot/panda.yaml, and the real recording."""

from pathlib import Path

import pytest
import yaml

from r2s.physics.robot import Robot, load_robot

ROOT = Path(__file__).parent.parent
REAL = ROOT.parent / "shared" / "data" / "gaz2019_panda" / "train.npz"


def conf(path: str) -> dict:
    """Read one file of conf/ as plain YAML: the arguments of what its `_target_` names, for the Panda."""
    document = yaml.safe_load((ROOT / "conf" / f"{path}.yaml").read_text())
    group = path.split("/")[0]
    if group == "task":
        document["torque_fraction"] = yaml.safe_load((ROOT / "conf/robot/panda.yaml").read_text())["torque_fraction"]
    beside = {"_target_", "torque_fraction"} if group == "robot" else {"_target_"}
    return {k: v for k, v in document.items() if k not in beside} if isinstance(document, dict) else document


@pytest.fixture(scope="session")
def panda() -> Robot:
    return load_robot(**conf("robot/panda"))
