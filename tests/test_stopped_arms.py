"""What an arm that stops, or fails, does to its command and to the jobs after it."""

import json
import re

import numpy as np
import pytest
from cli_runs import TOY, r2s, root, trained  # noqa: F401 (fixtures)

STOPPING = """
from r2s.arm.interface import ArmStopped, NotCleared
from r2s.arm.simulated import SimulatedArm
from r2s.physics.dynamics import nominal_dynamics


class Stopping(SimulatedArm):
    \"""An arm without an operator; a user stop ends its second motion.\"""

    def __init__(self, robot, noise=0, motions=0, stop_s=0.15, error=None):
        self.operator, self.blocked, self._motions = (lambda reason: False), None, 0
        dynamics = nominal_dynamics(robot, phi1=[1.0] * 7, phi2=[9.0] * 7, phi3=[0.0] * 7)
        super().__init__(robot, dynamics, position_noise=0.0, velocity_noise=0.0)
        self._motions, self._stop_s, self._error = noise + motions, stop_s, error

    def move_to(self, q):
        if self.blocked is not None:
            raise NotCleared(self.blocked)
        self._motions += 1
        return super().move_to(q)

    def command(self, tau):
        if self._motions == 2 and self.read().t >= self._stop_s:
            if self._error:
                raise FloatingPointError(self._error)
            self.blocked = "user stop"
            raise ArmStopped(self.blocked)
        super().command(tau)
"""
STOPPING_YAML = "_target_: stopping.Stopping\nname: stopping\nmotions: 0\nstop_s: 0.15\nerror: null\n"


@pytest.fixture
def stopping(tmp_path):
    """A folder with an arm that is stopped in its second motion: `--config-dir conf arm=stopping`."""
    (tmp_path / "stopping.py").write_text(STOPPING)
    (tmp_path / "conf" / "arm").mkdir(parents=True)
    (tmp_path / "conf" / "arm" / "stopping.yaml").write_text(STOPPING_YAML)
    return tmp_path


@pytest.mark.long
def test_a_stopped_arm_ends_a_transfer_with_3(trained, stopping):  # noqa: F811
    """Without an operator: two of 4 goals are done, the tables show it, and the arm gets no further command."""
    words = ["stage=transfer", f"policy={trained.resolve()}", "arm=stopping", "simulator=none", "name=a"]
    done = r2s("--config-dir", "conf", *words, *TOY, at=stopping)
    assert done.returncode == 3, done.stdout + done.stderr
    assert re.search(r"^stopped: 2 of 4 goals done on arm=stopping: user stop; see ", done.stderr, flags=re.M)
    assert "2 of 4 goals done" in done.stdout
    folder = stopping / "runs" / "transfer" / "a"
    assert json.loads((folder / "meta.json").read_text())["status"] == "stopped"
    row = json.loads((folder / "summary.json").read_text())["stopping"]
    assert (row["episodes"], row["asked"], row["stops"]) == (2, 4, 1)
    with np.load(folder / "episodes_stopping.npz") as saved:
        assert len(saved["q"]) == 2
    assert (folder / "stops.txt").read_text() == "episode 2, 0.15 s: user stop\n"


@pytest.mark.long
def test_an_arm_that_stops_in_its_last_episode_moves_in_no_later_job(trained, stopping):  # noqa: F811
    """All goals began, but no operator agreed to another motion: a sweep ends before its second job."""
    words = [
        "stage=transfer",
        f"policy={trained.resolve()}",
        "arm=stopping",
        "simulator=none",
        "evaluation.episodes=2",
    ]
    done = r2s("-m", "--config-dir", "conf", *words, *TOY, "seed=0,1", at=stopping)
    assert done.returncode == 3, done.stdout + done.stderr
    assert re.search(r"^stopped: 2 of 2 goals done on arm=stopping: user stop; see ", done.stderr, flags=re.M)
    assert len(list((stopping / "runs" / "transfer").iterdir())) == 1


@pytest.mark.long
def test_an_error_while_an_arm_moves_ends_the_sweep(trained, stopping):  # noqa: F811
    """The arm moves in no later job before the operator has seen why this one failed."""
    words = ["stage=transfer", f"policy={trained.resolve()}", "arm=stopping", "arm.error=tau is nan"]
    done = r2s("-m", "--config-dir", "conf", *words, *TOY, "simulator=none", "seed=0,1", at=stopping)
    assert done.returncode == 3, done.stdout + done.stderr
    assert "stopped: arm=stopping: tau is nan; the sweep ends with the job that failed" in done.stderr
    assert len(list((stopping / "runs" / "transfer").iterdir())) == 1


@pytest.mark.long
def test_an_estimate_of_a_stopped_arm_ends_with_3(stopping):
    """The estimate of the motion before the stop is written, and the recording's name says that it is not whole."""
    words = ["stage=estimate", "data=arm", "arm=stopping", "arm.motions=1", "arm.stop_s=1.0", "name=a"]
    done = r2s("--config-dir", "conf", *words, "data.seconds=2.0", at=stopping)
    assert done.returncode == 3, done.stdout + done.stderr
    assert re.search(r"^stopped: while the arm was recorded: user stop; the estimate", done.stderr, flags=re.M)
    folder = stopping / "runs" / "estimate" / "a"
    assert json.loads((folder / "meta.json").read_text())["status"] == "stopped"
    assert (folder / "estimate.csv").is_file()
    assert not (folder / "recording.npz").exists()
    with np.load(folder / "recording_until_stop.npz") as part:
        assert len(part["t"]) == 1000


@pytest.mark.long
def test_a_stopped_arm_ends_an_identification_with_3(stopping):
    """What was recorded before is kept, and what had been of the motion that was stopped."""
    words = ["stage=identify", "data=arm", "arm=stopping", "name=a", *TOY, "data.seconds=2.0"]
    done = r2s("--config-dir", "conf", *words, at=stopping)
    assert done.returncode == 3, done.stdout + done.stderr
    line = r"^stopped: .*user stop; .*resume=runs/identify/a"
    assert re.search(line, done.stderr, flags=re.M), done.stderr
    folder = stopping / "runs" / "identify" / "a"
    assert json.loads((folder / "meta.json").read_text())["status"] == "stopped"
    with np.load(folder / "train.npz") as whole, np.load(folder / "validation_until_stop.npz") as part:
        assert (len(whole["t"]), len(part["t"])) == (2001, 150)
