"""Recordings for the viewer open, and hold what was asked for where the arm was."""

import subprocess
import sys

import numpy as np
import pytest
import rerun as rr
from made_content import entities, make_curve, make_episode, make_overlay
from rerun.chunk import RrdReader

from r2s.physics.robot import load_robot
from r2s.reporting.figures.learning import learning_figure
from r2s.reporting.figures.log_rows import without_pauses
from r2s.reporting.viewer.data import Content
from r2s.reporting.viewer.layout import PAUSE, starts_of
from r2s.reporting.viewer.recording import write_recording
from r2s.tasks.reach import REACH

CURVES = [REACH[key] for key in REACH.curves]
EVERY_SHAPE = """
<mujoco model="shapes">
  <asset><mesh name="wedge" vertex="0 0 0  0.1 0 0  0 0.1 0  0 0 0.1"/></asset>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body name="goal"><joint axis="0 0 1" range="-2 2" actuatorfrcrange="-9 9"/>
      <geom type="box" size="0.05 0.05 0.1"/><geom type="sphere" size="0.06" pos="0 0 0.2"/>
      <body pos="0 0 0.2"><joint axis="0 1 0" range="-2 2" actuatorfrcrange="-9 9"/>
        <geom type="ellipsoid" size="0.03 0.04 0.1"/><geom type="mesh" mesh="wedge"/>
        <geom type="capsule" size="0.02 0.1"/><geom type="cylinder" size="0.03 0.01" rgba="0 0 0 1"/>
        <site name="tip" pos="0 0 0.2"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(autouse=True)
def strict():
    """Let rerun raise where it would only log."""
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


@pytest.mark.long
def test_the_recording_verifies_and_holds_what_was_asked_for(tmp_path, panda):
    path = tmp_path / "recording.rrd"
    picture = learning_figure(tmp_path / "learning.png", {"a": make_curve()}, CURVES)
    labels = {"mujoco": 3, "twin, nominal": 2, "a/b": 1}
    content = Content(
        REACH,
        {label: [make_episode(panda, k) for k in range(count)] for label, count in labels.items()},
        {"validation": make_overlay(panda.n)},
        {"tqc": make_curve()},
        {"learning": picture},
        np.full(panda.n, 5.0),
    )
    assert write_recording(path, panda, content) == path
    assert [p.name for p in tmp_path.glob("*.rrd")] == ["recording.rrd"]
    checked = subprocess.run([sys.executable, "-m", "rerun", "rrd", "verify", path], capture_output=True, text=True)
    assert checked.returncode == 0, checked.stderr
    found = entities(path)
    for label in labels:
        base = rr.new_entity_path(["arms", label])
        assert {f"{base}/goal", f"{base}/trail", f"{base}/links/link7"} <= found
        for j in range(panda.n):
            assert rr.new_entity_path(["command", f"joint {j + 1}", label]) in found
    assert rr.new_entity_path(["command", "joint 7", "upper limit"]) in found
    for name in ("1 measured", "2 nominal", "3 identified"):
        assert rr.new_entity_path(["torque", "validation", "joint 7", name]) in found
    assert rr.new_entity_path(["learning", "success at 1 cm", "tqc"]) in found
    assert "/figures/learning" in found


def test_the_drawn_links_are_where_the_arm_was(tmp_path, panda):
    """The last link of every frame, in the recording, ends at the end effector of the episode."""
    episode = make_episode(panda, 3)
    path = write_recording(tmp_path / "r.rrd", panda, Content(REACH, {"arm": [episode]}))
    chunks = [c for c in RrdReader(path).stream() if c.entity_path == "/arms/arm/links/link7" and not c.is_static]
    assert sum(c.num_rows for c in chunks) == len(episode.t)
    assert chunks[0].timeline_names == ["time"]
    columns = chunks[0].to_record_batch().to_pydict()
    origin = np.array(columns["Transform3D:translation"])[:, 0]
    flange = np.linalg.norm(episode.ee - origin, axis=1)
    assert np.allclose(flange, 0.107, atol=1e-5)


def test_episodes_follow_one_another_and_all_arms_start_together(panda):
    long, short = make_episode(panda, 0, rows=60), make_episode(panda, 1, rows=20)
    starts = starts_of({"a": [short, long], "b": [long]})
    assert starts.tolist() == pytest.approx([0, 1.18 + PAUSE, 2 * (1.18 + PAUSE)])


def test_a_clock_that_stops_or_restarts_still_runs_forward():
    clock, _ = without_pauses(np.array([5.0, 5.01, 9.0, 9.01, 0.0, 0.01]))
    assert clock.tolist() == pytest.approx([0, 0.01, 0.11, 0.12, 0.22, 0.23])


def test_pauses_are_cut_short():
    clock, pauses = without_pauses(np.array([5.0, 5.01, 5.02, 9.0, 9.01, 0.0, 0.01]))
    assert clock.tolist() == pytest.approx([0, 0.01, 0.02, 0.12, 0.13, 0.23, 0.24])
    assert pauses.tolist() == [3, 5]


def test_every_kind_of_geom_is_drawn_and_other_arms_work(tmp_path):
    """Even with a body named as one of our own entities; a plane is not part of an arm."""
    (tmp_path / "arm.xml").write_text(EVERY_SHAPE)
    robot = load_robot(str(tmp_path / "arm.xml"))
    path = write_recording(tmp_path / "r.rrd", robot, Content(REACH, {"arm": [make_episode(robot, 0)], "none": []}))
    found = entities(path)
    assert not any(entity.startswith("/arms/none") for entity in found)
    assert len([entity for entity in found if "/geom" in entity]) == 6
    assert {"/arms/arm/goal", "/arms/arm/links/goal"} <= found


def test_a_recording_that_fails_leaves_nothing(tmp_path, panda):
    with pytest.raises(FileNotFoundError):
        write_recording(tmp_path / "r.rrd", panda, Content(figures={"gone": tmp_path / "gone.png"}))
    assert not list(tmp_path.iterdir())
