"""What people read: figures that show something, tables that hold the numbers given, a recording to open."""

import subprocess
import sys
from io import StringIO
from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
import pytest
import rerun as rr
from matplotlib.image import imread
from rerun.chunk import RrdReader
from rich.console import Console

from r2s import report, viewer
from r2s.friction import friction_torque
from r2s.identify import Identified
from r2s.parameters import nominal_dynamics, parameter_space
from r2s.robot import Robot, load_robot
from r2s.viewer import Episode, Overlay

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


def make_episode(robot: Robot, seed: int, rows: int = 60) -> Episode:
    """A random walk about the home pose."""
    rng = np.random.default_rng(seed)
    q = robot.q_home + np.cumsum(0.01 * rng.normal(size=(rows, robot.n)), axis=0)
    model = robot.model(gravity=False)
    data, ee = mujoco.MjData(model), np.empty((rows, 3))
    for k in range(rows):
        data.qpos[:] = q[k]
        mujoco.mj_kinematics(model, data)
        ee[k] = data.site(robot.ee_site).xpos
    return Episode(0.02 * np.arange(rows), q, ee, ee[-1] + 0.02, rng.normal(size=q.shape))


def make_curve(rows: int = 12) -> pd.DataFrame:
    steps, success = 1000 * np.arange(1, rows + 1), np.linspace(0, 1, rows)
    table = {key: success for key in ("success_5cm", "success_2cm", "success_1cm", "success_5mm")}
    extra = {"distance_median_m": 0.3 - 0.2 * success, "return_paper": -100 + 50 * success}
    return pd.DataFrame({"env_steps": steps, "wall_clock_s": steps / 100, **table, **extra})


def make_overlay(n: int, rows: int = 400) -> Overlay:
    t = 0.01 * np.arange(rows)
    measured = np.sin(t[:, None] * (1 + np.arange(n)))
    return Overlay(t, measured, {"nominal": 0.7 * measured, "identified": measured + 0.01})


@pytest.fixture(scope="module")
def identified(panda) -> Identified:
    nominal = nominal_dynamics(panda, phi1=0.5, phi2=8.0, phi3=0.01)
    bounds = {"phi1": [0.05, 5], "phi2": [1, 50], "inertia_scale": [0.2, 5], "offset": [-1, 1]}
    space = parameter_space(panda, nominal, bounds)
    x = space.from_unit(space.to_unit(space.start) + 0.05)
    known = np.arange(len(x)) % 3 > 0
    rows = [{"search": "ga", "evaluations": 10 * k, "cost": 100.0 / k, "seconds": k} for k in range(1, 9)]
    rows += [{"search": "breakaway", "evaluations": 9, "seconds": 9.0 + k} for k in range(3)]
    rows += [{"search": "least_squares", "evaluations": 9, "cost": 5.0 / k, "seconds": 12.0 + k} for k in (1, 2)]
    return Identified(space, x, (x - 0.123, x + 0.123), known, pd.DataFrame(rows))


@pytest.fixture
def console() -> Console:
    return Console(file=StringIO(), width=110)


def printed(console: Console) -> str:
    assert isinstance(console.file, StringIO)
    return console.file.getvalue()


def entities(path: Path) -> set[str]:
    return {chunk.entity_path for chunk in RrdReader(path).stream()}


@pytest.fixture(autouse=True)
def strict():
    """Let rerun raise where it would only log."""
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


def figures(folder: Path, robot: Robot, found: Identified) -> list[Path]:
    overlay, rng = make_overlay(robot.n), np.random.default_rng(0)
    windows = rng.normal(size=(9, 40, robot.n))
    near = {"nominal": windows + 0.01 * rng.normal(size=windows.shape), "identified": windows}
    dq = rng.uniform(-2, 2, (300, robot.n))
    cloud = dq, friction_torque(dq, found.dynamics.phi)
    laws = {"nominal": found.space.nominal, "identified": found.dynamics}
    episodes = {"mujoco": [make_episode(robot, k) for k in range(5)], "arm": [make_episode(robot, 9)]}
    return [
        report.torque_figure(folder / "torque.png", overlay.t, overlay.measured, overlay.predicted, "torque"),
        report.position_figure(folder / "position.png", windows, near),
        report.friction_figure(folder / "friction.png", laws, robot.dq_max, cloud),
        report.convergence_figure(folder / "convergence.png", found.history),
        report.learning_figure(folder / "learning.png", {"a": make_curve(), "b": make_curve(1)}),
        report.reach_figure(folder / "reach.png", episodes),
    ]


def test_every_figure_is_written_and_shows_something(tmp_path, panda, identified):
    """Also where an error is zero (identified = measured), and where one arm has fewer episodes."""
    for path in figures(tmp_path / "figures", panda, identified):
        pixels = imread(path)[..., :3]
        assert pixels.shape[1] > 1000, path.name
        assert pixels.std() > 0.03, f"{path.name} is nearly blank"
        few = (255 * pixels[::4, ::4]).astype(int) @ (1, 256, 65536)
        assert len(np.unique(few)) > 20, f"{path.name} has no colours"


def test_the_recording_verifies_and_holds_what_was_asked_for(tmp_path, panda):
    path = tmp_path / "recording.rrd"
    picture = report.learning_figure(tmp_path / "learning.png", {"a": make_curve()})
    labels = {"mujoco": 3, "twin, nominal": 2, "a/b": 1}
    written = viewer.write_recording(
        path,
        panda,
        episodes={label: [make_episode(panda, k) for k in range(count)] for label, count in labels.items()},
        overlays={"validation": make_overlay(panda.n)},
        curves={"tqc": make_curve()},
        figures={"learning": picture},
    )
    assert written == path
    assert [p.name for p in tmp_path.glob("*.rrd")] == ["recording.rrd"]
    checked = subprocess.run([sys.executable, "-m", "rerun", "rrd", "verify", path], capture_output=True, text=True)
    assert checked.returncode == 0, checked.stderr
    found = entities(path)
    for label in labels:
        base = rr.new_entity_path(["arms", label])
        assert {f"{base}/goal", f"{base}/trail", f"{base}/links/link7"} <= found
        for j in range(panda.n):
            assert rr.new_entity_path(["command", f"joint {j + 1}", label]) in found
    for name in ("1 measured", "2 nominal", "3 identified"):
        assert rr.new_entity_path(["torque", "validation", "joint 7", name]) in found
    assert rr.new_entity_path(["learning", "success at 1 cm", "tqc"]) in found
    assert "/figures/learning" in found


def test_the_drawn_links_are_where_the_arm_was(tmp_path, panda):
    """The last link of every frame, in the recording, ends at the end effector of the episode."""
    episode = make_episode(panda, 3)
    path = viewer.write_recording(tmp_path / "r.rrd", panda, episodes={"arm": [episode]})
    chunks = [c for c in RrdReader(path).stream() if c.entity_path == "/arms/arm/links/link7" and not c.is_static]
    assert sum(c.num_rows for c in chunks) == len(episode.t)
    assert chunks[0].timeline_names == ["time"]
    columns = chunks[0].to_record_batch().to_pydict()
    origin = np.array(columns["Transform3D:translation"])[:, 0]
    flange = np.linalg.norm(episode.ee - origin, axis=1)
    assert np.allclose(flange, 0.107, atol=1e-5)


def test_episodes_follow_one_another_and_all_arms_start_together(panda):
    long, short = make_episode(panda, 0, rows=60), make_episode(panda, 1, rows=20)
    starts = viewer._starts({"a": [short, long], "b": [long]})
    assert starts.tolist() == pytest.approx([0, 1.18 + viewer.PAUSE, 2 * (1.18 + viewer.PAUSE)])


def test_a_clock_that_stops_or_restarts_still_runs_forward():
    clock = viewer._clock(np.array([5.0, 5.01, 9.0, 9.01, 0.0, 0.01]))
    assert clock.tolist() == pytest.approx([0, 0.01, 0.11, 0.12, 0.22, 0.23])


def test_every_kind_of_geom_is_drawn_and_other_arms_work(tmp_path):
    """Even with a body named as one of our own entities; a plane is not part of an arm."""
    (tmp_path / "arm.xml").write_text(EVERY_SHAPE)
    robot = load_robot(str(tmp_path / "arm.xml"))
    path = viewer.write_recording(tmp_path / "r.rrd", robot, episodes={"arm": [make_episode(robot, 0)], "none": []})
    found = entities(path)
    assert not any(entity.startswith("/arms/none") for entity in found)
    assert len([entity for entity in found if "/geom" in entity]) == 6
    assert {"/arms/arm/goal", "/arms/arm/links/goal"} <= found


def test_a_recording_that_fails_leaves_nothing(tmp_path, panda):
    with pytest.raises(FileNotFoundError):
        viewer.write_recording(tmp_path / "r.rrd", panda, figures={"gone": tmp_path / "gone.png"})
    assert not list(tmp_path.iterdir())


def test_colours_are_fixed_by_meaning_and_differ():
    labels = ["mujoco", "twin, identified", "twin, nominal", "measured", "arm, identified", "dart"]
    found = viewer.colours(labels)
    assert len(set(found.values())) == len(labels)
    assert found["twin, nominal"] == viewer.colours(["nominal"])["nominal"]


def test_the_identification_table_holds_the_numbers_in_110_columns(console, panda, identified):
    errors = {"torque_rmse_Nm": [0.111] * 7, "nominal_torque_rmse_Nm": [0.444] * 7}
    commanded = {"position_rmse_mrad": [1.5] * 7, "nominal_position_rmse_mrad": [6.25] * 7}
    reached = {"ee_error_mm": {"0.1": 0.81, "2": 77.0}, "nominal_ee_error_mm": {"0.1": 4.21, "2": 451.0}}
    summary = {"train": errors | commanded | reached, "validation": errors}
    report.identification_table(console, panda, identified, summary)
    text = printed(console)
    assert max(map(len, text.splitlines())) <= 110
    x = identified.space.block(identified.x, "phi1")[1]
    parameters = (f"0.5 → {x:.3g}", f"[{x - 0.123:.3g}, {x + 0.123:.3g}]")
    for expected in (*parameters, "0.111", "0.444", "0.25", "6.25", "0.81", "451", "mean"):
        assert expected in text
    assert text.count(" ? ") == np.sum(~identified.identifiable)


def test_the_reach_table_shows_percent_and_dashes_for_what_is_missing(console):
    full = dict.fromkeys(report.SUCCESS, 0.5) | {"distance_median_m": 0.0123, "return_paper": -31.25}
    report.reach_table(console, {"[mujoco]": full, "arm": {"success_5cm": 1.0}}, "reaching")
    lines = printed(console).splitlines()
    mujoco_line = next(line for line in lines if "[mujoco]" in line).split()
    arm_line = next(line for line in lines if " arm " in line).split()
    assert mujoco_line[1:] == ["50.0", "50.0", "50.0", "50.0", "12.3", "-31.2"]
    assert arm_line[1:] == ["100.0", "-", "-", "-", "-", "-"]


def test_the_markdown_report_links_figures_relative_and_holds_the_tables(tmp_path, panda, identified):
    tables = report.identification_tables(panda, identified, {})
    sections = {"Identification": ["Words.", *tables.values()], "Figures": [tmp_path / "figures" / "a b.png"]}
    text = report.report_markdown(tmp_path / "report.md", sections).read_text()
    assert text.startswith("# Identification\n\nWords.\n")
    assert "](figures/a%20b.png)" in text
    assert str(tmp_path) not in text
    rows = [line for line in text.splitlines() if line.startswith("|")]
    assert len(rows) == panda.n + 2
    assert len({line.count("|") for line in rows}) == 1
