"""What every test needs: the embedded Panda with the limits of conf/robot/panda.yaml, and the real recording."""

from pathlib import Path

import pytest
import yaml

from r2s.physics.robot import Robot, load_robot

ROOT = Path(__file__).parent.parent
REAL = ROOT.parent / "shared" / "data" / "gaz2019_panda" / "train.npz"


def conf(path: str) -> dict:
    """Read one file of conf/ as plain YAML."""
    return yaml.safe_load((ROOT / "conf" / f"{path}.yaml").read_text())


@pytest.fixture(scope="session")
def panda() -> Robot:
    return load_robot(**conf("robot/panda"))
