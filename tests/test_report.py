"""Figures show something, and tables and pages hold the numbers given."""

import base64
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from io import StringIO
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import rerun as rr
from made_content import entities, make_curve, make_episode, make_overlay
from matplotlib.image import imread
from rich.console import Console
from scipy.stats import t as student

from r2s.errors import UserError
from r2s.export.card import card
from r2s.identification.base_parameters import base_table
from r2s.identification.friction.breakaway import Breakaway
from r2s.identification.link_inertia import LINK
from r2s.identification.parameters import ParameterEstimate, parameter_space
from r2s.identification.prediction import prediction_errors
from r2s.identification.result import IdentificationResult
from r2s.physics.dynamics import nominal_dynamics, with_family
from r2s.physics.friction import BRISTLE
from r2s.physics.robot import Robot
from r2s.recordings.recording import Recording
from r2s.reporting import pages
from r2s.reporting.document import KEPT, report_html, report_markdown
from r2s.reporting.figures.colours import colours
from r2s.reporting.figures.episodes import error_figure
from r2s.reporting.figures.learning import learning_figure
from r2s.reporting.identification.figures import (
    _running,
    convergence_figure,
    friction_figure,
    position_figure,
    torque_figure,
)
from r2s.reporting.identification.identifiability import _grouped
from r2s.reporting.identification.page import Evidence, identification_page, identification_sections
from r2s.reporting.identification.tables import identification_table, identification_tables
from r2s.reporting.identification.whiteness import autocorrelation, whiteness_figure, whiteness_table
from r2s.reporting.measures import measures_of
from r2s.reporting.run_list import run_rows
from r2s.reporting.tables import diagnostic_rows, print_measures
from r2s.tasks.measures import Measure, MeasureTable, write_measures
from r2s.tasks.reach import REACH

CURVES = [REACH[key] for key in REACH.curves]


def make_identified(robot: Robot, bounds: dict, family: str = "sigmoid") -> IdentificationResult:
    """A result: every third parameter not identifiable, the fifth unseen, draws of 1 % of the bounds."""
    nominal = with_family(nominal_dynamics(robot, phi1=0.5, phi2=8.0, phi3=0.01), family)
    space = parameter_space(robot, nominal, bounds)
    rng = np.random.default_rng(0)
    u = space.to_unit(space.start)
    u = np.where(np.arange(len(u)) == 4, u, u + 0.05)
    x, samples = space.from_unit(u), space.from_unit(u + 0.01 * rng.normal(size=(400, len(u))))
    low, high = np.quantile(samples, [0.025, 0.975], axis=0)
    found = ParameterEstimate(x, low, high, np.arange(len(x)) % 3 > 0, samples)
    rows = [{"search": f"family {f}", "evaluations": 0, "cost": 9.0, "done": k, "total": 3, "seconds": 0.2 * k}
            for k, f in enumerate(("sigmoid", "coulomb", "stribeck"), 1)]  # fmt: skip
    for search, count, start in (("ga", 8, 1.0), ("torque", 3, 9.0), ("torque", 3, 12.0), ("breakaway", 3, 15.0)):
        for k in range(1, count + 1):
            row = {"search": search, "evaluations": 10 * k, "done": k, "total": count, "seconds": start + k}
            rows.append(row if search == "breakaway" else row | {"cost": 100.0 / k})
    null = [(0.97, {"phi1[2]": -0.8, "phi2[2]": 0.6}), (0.9, {space.names[4]: 1.0})]
    families = {"sigmoid": 1.0, "coulomb": 1.21, "stribeck": 1.01}
    return IdentificationResult(space, found, pd.DataFrame(rows), families, null, [space.names[4]])


BOUNDS = {"phi1": [0.05, 5], "phi2": [1, 50], "offset": [-1, 1], "delay": [0, 0.01]}
SCALES = BOUNDS | {"inertia_scale": [0.2, 5]}
LINKS = BOUNDS | {name: [-0.5, 0.5] for name in LINK}


@pytest.fixture(scope="module")
def identified(panda) -> IdentificationResult:
    return make_identified(panda, SCALES)


@pytest.fixture(scope="module")
def recording(panda) -> Recording:
    """Two trajectories of a sway about home, with a pause between them."""
    t = 1e-3 * np.arange(1200)
    w = 2 * np.pi * (0.6 + 0.1 * np.arange(panda.n))
    q = panda.q_home + 0.2 * np.sin(w * t[:, None])
    tau = np.tanh(5 * np.cos(w * t[:, None])) + 0.01 * np.random.default_rng(0).normal(size=q.shape)
    both = {
        "q": np.tile(q, (2, 1)),
        "dq": np.tile(0.2 * w * np.cos(w * t[:, None]), (2, 1)),
        "tau": np.tile(tau, (2, 1)),
    }
    trajectory = np.repeat([0, 1], len(t))
    return Recording(t=np.r_[t, t + 20], **both, torque="commanded", trajectory=trajectory, name="sway")


@pytest.fixture
def console() -> Console:
    return Console(file=StringIO(), width=100)


def printed(console: Console) -> str:
    assert isinstance(console.file, StringIO)
    return console.file.getvalue()


@pytest.fixture(autouse=True)
def strict():
    """Let rerun raise where it would only log."""
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


def figures(folder: Path, robot: Robot, found: IdentificationResult) -> list[Path]:
    overlay, rng = make_overlay(robot.n), np.random.default_rng(0)
    windows = rng.normal(size=(9, 40, robot.n))
    near = {"nominal": windows + 0.01 * rng.normal(size=windows.shape), "identified": windows}
    dq = rng.uniform(-2, 2, (300, robot.n))
    cloud = dq, found.dynamics.friction(dq)
    laws = {"nominal": found.space.nominal, "identified": found.dynamics}
    draws = found.space.dynamics(found.found.samples).phi
    episodes = {"mujoco": [make_episode(robot, k) for k in range(5)], "arm": [make_episode(robot, 9)]}
    errors = {name: tau - overlay.measured for name, tau in overlay.predicted.items()}
    return [
        torque_figure(folder / "torque.png", overlay.t, overlay.measured, overlay.predicted, "torque"),
        position_figure(folder / "position.png", windows, near),
        friction_figure(folder / "friction.png", laws, robot.dq_max, cloud, draws),
        convergence_figure(folder / "convergence.png", found.history),
        whiteness_figure(folder / "whiteness.png", overlay.t, errors, 10.0, 0.4),
        learning_figure(folder / "learning.png", {"a": make_curve(), "b": make_curve(1)}, CURVES),
        error_figure(folder / "reach.png", episodes, REACH),
    ]


@pytest.mark.long
def test_every_figure_is_written_and_shows_something(tmp_path, panda, identified):
    """Also where an error is zero (identified = measured), and where one arm has fewer episodes."""
    for path in figures(tmp_path / "figures", panda, identified):
        pixels = imread(path)[..., :3]
        assert pixels.shape[1] > 1000, path.name
        assert pixels.std() > 0.03, f"{path.name} is nearly blank"
        few = (255 * pixels[::4, ::4]).astype(int) @ (1, 256, 65536)
        assert len(np.unique(few)) > 20, f"{path.name} has no colours"


def test_colours_are_fixed_by_meaning_and_differ():
    labels = ["mujoco", "twin, identified", "twin, nominal", "measured", "arm, identified", "dart"]
    found = colours(labels)
    assert len(set(found.values())) == len(labels)
    assert found["twin, nominal"] == colours(["nominal"])["nominal"]


SUMMARY = {
    "torque_rmse_Nm": [0.111] * 7,
    "nominal_torque_rmse_Nm": [0.444] * 6 + [0.1],
    "position_rmse_mrad": [1.5] * 7,
    "nominal_position_rmse_mrad": [6.25] * 7,
    "ee_error_mm": {"0.1": 0.81, "2": 77.0},
    "nominal_ee_error_mm": {"0.1": 4.21, "2": 451.0},
}


def test_the_identification_table_holds_the_numbers_in_100_columns(console, panda, identified):
    identification_table(console, panda, identified, {"train": SUMMARY, "validation": SUMMARY})
    text = printed(console)
    assert max(map(len, text.splitlines())) <= 100
    f = identified.found
    parameters = (f"{f.x[1]:.3g}", f"±{0.5 * (f.high[1] - f.low[1]):.2g}", "nominal 0.5", f"{1e3 * f.x[21]:.3g}")
    for expected in (*parameters, "0.111", "0.444", "0.25", "6.25", "0.81", "451", "mean", "delay, ms"):
        assert expected in text
    assert text.count("kept") == 1 + text.count("?: the interval is")
    assert text.count("? ") == np.sum(~f.identifiable)


def test_widest_parameters_stay_in_one_table_of_100_columns(console, panda):
    """All parameters of a presliding family, of both signs and every size, with other nominal values per joint."""
    signed = ("asymmetry", "rise_asymmetry", "offset", "drag_sin", "drag_cos", "gain")
    names = {name: [-1e-3, 1e-3] for name in signed}
    names |= {"coulomb": [0.05, 5], "viscous": [0, 5], "stribeck_velocity": [0.01, 0.5], "presliding": [1e-4, 1e-2]}
    found = make_identified(panda, names, "bristle")
    nominal = replace(found.space.nominal, offset=-1.234e-4 * np.arange(panda.n))
    found = replace(found, space=replace(found.space, nominal=nominal))
    identification_table(console, panda, found, {})
    text = printed(console)
    assert max(map(len, text.splitlines())) <= 100
    assert text.count("identified parameters") == 1
    (table, *_) = identification_tables(panda, found, {}).values()
    assert all(part in text for row in table.to_numpy() for cell in row for part in cell.split("\n"))


def test_ten_numbers_per_link_take_one_line_in_the_terminal(console, panda):
    found = make_identified(panda, LINKS)
    identification_table(console, panda, found, {})
    text = printed(console)
    assert max(map(len, text.splitlines())) <= 100
    assert "link_" not in text
    assert f"{panda.mass[3]:.3g} → {found.dynamics.mass[3]:.3g}" in text
    assert len(text.splitlines()) < 60


def everything(robot, found, recording, nominal=None) -> dict:
    base = base_table(found.space, found.found, rotors=True)
    evidence = Evidence({}, np.ones(robot.n), pd.DataFrame(), base, window_s=0.2, cutoff_hz=10.0)
    summary = {"train": SUMMARY | {"seconds": 8.0}, "validation": SUMMARY | {"seconds": 2.0}}
    return identification_sections(robot, nominal or found.space.nominal, found, recording, summary, evidence)


def words_of(sections: dict) -> str:
    """Everything that is not a table."""
    items = [i for section in sections.values() for i in section]
    return "\n".join(line for i in items if isinstance(i, (str, list)) for line in ([i] if isinstance(i, str) else i))


def tables_of(sections: dict, title: str) -> list[pd.DataFrame]:
    return [
        i for heading, items in sections.items() if title in heading for i in items if isinstance(i, pd.DataFrame)
    ]


def test_tables_one_to_four_hold_old_new_and_interval(panda, identified, recording):
    sections, f, space = everything(panda, identified, recording), identified.found, identified.space
    offsets = tables_of(sections, "Table I:")[0]
    assert offsets["new"].str.removesuffix(" ?").astype(float).to_numpy() == pytest.approx(
        space.block(f.x, "offset"), rel=6e-3
    )
    assert offsets.loc["2", "95 % interval"] == f"[{f.low[15]:.3g}, {f.high[15]:.3g}]"
    scales, tensors = tables_of(sections, "Table III")
    assert list(tensors.columns) == ["Ixx", "Iyy", "Izz", "Ixy", "Ixz", "Iyz"]
    assert tensors.loc["3", "Ixz"].startswith(f"{1e3 * panda.inertia[2, 0, 2]:.3g} → ")
    assert scales.loc["3", "new"].split()[0] == f"{space.block(f.x, 'inertia_scale')[2]:.3g}"
    friction = tables_of(sections, "Table IV")[0]
    assert friction.loc["5", "phi1\nNm"] == f"0.5\n{KEPT}"
    assert friction.loc["1", "phi1\nNm"].split("\n")[0].endswith(" ?")


def test_mass_and_centre_carry_the_interval_of_the_joint_distribution(panda, recording):
    """The mass goes with exp(2 alpha), and is identifiable if alpha is."""
    found = make_identified(panda, LINKS)
    links, tensors = tables_of(everything(panda, found, recording), "Table III")
    alpha = found.space.block(found.found.samples, "link_alpha")
    low, high = panda.mass[1] * np.exp(2 * np.quantile(alpha[:, 1], [0.025, 0.975]))
    value, interval = links.loc["2", "mass, kg"].split("\n")
    assert [float(x) for x in interval.strip("[]").split(", ")] == pytest.approx([low, high], rel=6e-3)
    known = dict(zip(found.space.names, found.found.identifiable, strict=True))
    assert value.endswith("?") == (not known["link_alpha[2]"])
    assert len(tensors.columns) == 6


def test_the_breakaway_table_shows_how_it_was_measured(panda, identified, recording):
    edges = np.stack([np.full(7, -0.3), np.full(7, 0.4)], -1)
    old = identified.space.nominal
    scanned = replace(identified, space=replace(identified.space, nominal=replace(old, breakaway=edges)))
    sections = everything(panda, scanned, recording, nominal=old)
    assert tables_of(sections, "Table II:")[0].loc["1"].tolist() == ["0", "-0.3", "0", "0.4"]
    assert "found by search in the recording" in words_of(sections)
    spread, count, tried = np.full((7, 2), 0.01), np.full((7, 2), 2), np.zeros((7, 2))
    spread[6, 1], spread[5, 1], count[6, 1], count[5, 1], tried[6, 1] = np.nan, np.nan, 0, 1, 0.7
    rest = {"ramped": 0 * count + 2, "held": tried, "resolution": 0 * tried, "command": edges}
    rest |= dict.fromkeys(("value", "misfit", "joint", "sign", "pose"), np.zeros(0))
    ramps = replace(scanned, edges=Breakaway(spread=spread, count=count, **rest))
    ramped = tables_of(everything(panda, ramps, recording, nominal=old), "Table II:")[0]
    half = student.ppf(0.975, 3) * 0.01 / np.sqrt(2)
    assert ramped.loc["1", "negative\n95 % interval"] == f"[{-0.3 - half:.3g}, {-0.3 + half:.3g}]"
    assert ramped.loc["1", "positive\nrepeatability"] == "0.01"
    assert ramped.loc["6", "positive\nrepeatability"] == "-"
    assert ramped.loc["7", "positive\nrepeatability"] == "not reached"
    assert ramped.loc["7", "positive\nnew"] == "0.4 ?"
    assert ramped.loc["7", "positive\n95 % interval"] == "[0.4, 12]"  # contains the value; up to tau_max
    terminal = identification_tables(panda, ramps, {})["breakaway, Nm of command and offset"]
    assert terminal.loc["7", "positive"] == "0.4, not reached: held against 0.7 Nm"
    measured = replace(recording, torque="measured")
    assert not tables_of(everything(panda, scanned, measured, nominal=old), "Table II:")


def test_a_presliding_family_holds_without_a_dead_zone(panda, recording):
    bounds = {"coulomb": [0.05, 5], "asymmetry": [-0.5, 0.5], "viscous": [0, 5], "rise": [0, 1]}
    found = make_identified(panda, bounds, "bristle")
    p = found.dynamics.phi[2]
    held = tables_of(everything(panda, found, recording), "Table II:")[0]
    assert held.loc["3", "negative\nnew"] == f"{-p[0] * (1 - p[1]) * (1 + p[3]):.3g}"
    assert found.dynamics.family == BRISTLE


def test_identifiability_is_stated_in_words(panda, identified, recording):
    text = words_of(everything(panda, identified, recording))
    assert "97 %: 0.80 phi1 of joint 2 - 0.60 phi2 of joint 2" in text
    assert "phi1 of joint 5" in text
    assert "and 1 more, mostly of parameters kept nominal" in text
    assert "worse than nominal: joint 7 (1.11)" in text
    assert "zero-phase low-pass of 10 Hz" in text
    assert "40 Hz (4 times the cutoff)" in text
    everywhere = [f"{b}[{j}]" for b in ("phi3", "link_d1") for j in range(1, 8)] + ["delay"]
    assert _grouped(everywhere, 7) == "phi3 of all joints; d1 of all links; delay"


def test_the_family_that_was_chosen_is_named(panda, identified, recording):
    families = tables_of(everything(panda, identified, recording), "families")[0]
    assert families.loc["coulomb"].tolist() == ["1.210", ""]
    assert families.loc["sigmoid"].tolist() == ["1.000", "chosen"]


def test_filtered_white_noise_is_called_white_and_a_drift_is_not():
    """In 40 draws, far lags leave the band as often as they should; pauses do not matter."""
    rng, t = np.random.default_rng(1), 1e-3 * np.arange(30_000)
    noise = rng.normal(size=(len(t), 40))
    zero = np.zeros((len(t), 40))
    motion = Recording(t=t, q=zero, dq=zero, tau=noise, torque="measured", trajectory=np.zeros(len(t)))
    tau, t = motion.smooth(10.0).tau[::10], t[::10]
    paused = t + 5.0 * (t > 12.0)
    column = "far lags outside the band, %"
    for clock in (t, paused):
        outside = whiteness_table(clock, tau, 10.0)[column].astype(float)
        assert 2 < outside.mean() < 9
    slow = tau + 0.3 * np.sin(2 * np.pi * 0.2 * t)[:, None]
    table = whiteness_table(t, slow, 10.0)
    assert table[column].astype(float).min() > 50
    assert float(table.loc["1", "mean, Nm"]) == pytest.approx(slow[:, 0].mean(), rel=1e-2, abs=1e-3)


def test_autocorrelation_does_not_cross_a_pause():
    t = np.r_[np.arange(50), 500 + np.arange(50)] * 0.01
    x = np.repeat([1.0, -1.0], 50)[:, None]
    assert autocorrelation(t, x, 30)[:, 0] == pytest.approx(np.ones(30))
    assert autocorrelation(0.01 * np.arange(100), x, 30)[-1, 0] < 0.6


def test_seconds_of_a_resumed_run_go_on():
    assert _running(np.array([1.0, 2.0, 0.5, 1.5])).tolist() == [1.0, 2.0, 2.5, 3.5]


def test_a_measure_table_with_an_unknown_key_is_refused():
    """The message names the list, the key and the nearest match."""
    force = Measure("force_N", "force", "force error", "N")
    with pytest.raises(UserError, match=r"measure_table.rows: no measure 'forse_N'; .*did you mean 'force_N'"):
        MeasureTable((force,), ("force_N",), rows=("forse_N",))


def test_a_task_from_outside_r2s_shows_its_own_measures(tmp_path, panda, console):
    """Pages, list and tables read the measures from the run folder, whatever their keys."""
    force = Measure("force_N", "force", "RMS force error", "N", 1, 2, lower_is_better=True)
    held = Measure("held", "held", "time in contact", "%", 100, 0)
    table = MeasureTable((force, held), ("held", "force_N"), description="It presses on a surface.")
    folder = tmp_path / "train" / "press"
    (folder / "figures").mkdir(parents=True)
    write_measures(folder, table)
    row = {"env_steps": 2000, "updates": 10, "wall_clock_s": 60.0, "force_N": 1.234, "held": 0.97}
    pd.DataFrame([row | {"env_steps": 1000, "held": 0.5}, row]).to_csv(folder / "evaluations.csv", index=False)
    meta = {"stage": "train", "status": "done", "start": "2026-01-01T00:00:00+00:00"}
    (folder / "meta.json").write_text(json.dumps(meta))
    assert run_rows(tmp_path)["result"].item() == "time in contact 97 %, RMS force error 1.23 N after 2k env steps"
    (folder / "summary.json").write_text(json.dumps({"best": row, "last": row}))
    assert run_rows(tmp_path)["result"].item() == "time in contact 97 %, RMS force error 1.23 N"
    run = SimpleNamespace(folder=folder, figure=lambda name: folder / "figures" / f"{name}.png")
    pages.training(run, panda)  # type: ignore[arg-type]
    assert "/learning/RMS\\ force\\ error/press" in entities(folder / "recording.rrd")
    print_measures(console, measures_of(folder), {"mujoco": row}, "pressing")
    assert "force, N" in printed(console)
    assert list(diagnostic_rows(table, {"arm": row | {"limited": 0.012}})) == ["filter active, %"]
    config = {"algo": {"name": "tqc"}, "task": {"name": "press"}, "dr": {"name": "none"}, "friction": {}}
    contract = {"rates": {"policy_hz": 50, "cycle_hz": 1000}, "robot": "panda", "goal": {"kind": "point"}}
    sections = card(
        folder,
        config,
        {},
        contract | {"torque": {"convention": "without gravity"}, "law": {"push": None}},
        folder,
        ["twin"],
    )
    assert "It presses on a surface." in sections["tqc for panda, press"][1]
    assert sections["Measured"][0]["held, %"].to_list() == ["97.0"]


class Page(HTMLParser):
    """Collects tags, attributes and text, and checks that what opens closes."""

    def __init__(self):
        super().__init__()
        self.open: list[str] = []
        self.seen: list[tuple[str, dict]] = []
        self.text = ""

    def handle_starttag(self, tag, attrs):  # noqa: D102
        self.seen.append((tag, dict(attrs)))
        if tag not in ("meta", "br", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag):  # noqa: D102
        assert self.open.pop() == tag

    def handle_data(self, data):  # noqa: D102
        self.text += data


def test_the_html_report_is_one_file_that_loads_nothing(tmp_path, panda, identified):
    picture = convergence_figure(tmp_path / "convergence.png", identified.history)
    table = pd.DataFrame({"a <b>": ["1 ?\n[0, 2]", "x & y"]}, index=pd.Index(["1", "2"], name="joint"))
    sections = {"Title <script>": ["5 < 6"], "Numbers": [table, ["one", "two"], picture], "Last": ["end"]}
    text = report_html(tmp_path / "report.html", sections).read_text(encoding="utf-8")
    page = Page()
    page.feed(text)
    assert page.open == []
    for expected in ("Title <script>", "5 < 6", "a <b>", "1 ?", "[0, 2]", "x & y", "one", "end"):
        assert expected in page.text
    assert not {"script", "link", "iframe"} & {tag for tag, _ in page.seen}
    assert not re.search(r"https?:|url\(|@import", text)
    sources = [a["src"] for tag, a in page.seen if tag == "img"]
    assert base64.b64decode(sources[0].removeprefix("data:image/png;base64,")) == picture.read_bytes()
    assert [a.get("src") for _, a in page.seen if "src" in a] == sources
    targets = {a["href"].removeprefix("#") for _, a in page.seen if "href" in a}
    assert targets == {a["id"] for _, a in page.seen if "id" in a} == {"s1", "s2"}


@pytest.mark.long
@pytest.mark.parametrize("torque", ["commanded", "measured"])
def test_the_page_of_an_identification_is_complete(tmp_path, panda, identified, recording, torque):
    """Figures, both reports and the recording; the RMSE of the torque shown is that of summary.json."""
    recording, nominal = replace(recording, torque=torque), identified.space.nominal
    how = {"window_s": 0.2, "cutoff_hz": 10.0}
    errors = prediction_errors(panda, nominal, identified.dynamics, recording, nthread=1, **how)

    def figure(name: str) -> Path:
        return tmp_path / f"{name}.png"

    run = SimpleNamespace(folder=tmp_path, figure=figure)
    summary = {"train": errors, "validation": errors}
    identification_page(run, nominal, identified, recording, summary, **how)  # type: ignore[arg-type]
    with np.load(tmp_path / "torque.npz") as saved:
        for name, key in (("identified", "torque_rmse_Nm"), ("nominal", "nominal_torque_rmse_Nm")):
            assert np.sqrt(((saved[name] - saved["measured"]) ** 2).mean(0)) == pytest.approx(errors[key])
    drawn = {"torque", "friction", "whiteness", "convergence"} | ({"position"} if torque == "commanded" else set())
    assert {p.stem for p in tmp_path.glob("*.png")} == drawn
    assert {f"/figures/{name}" for name in drawn - {"torque"}} <= entities(tmp_path / "recording.rrd")
    html, text = ((tmp_path / f"report.{end}").read_text(encoding="utf-8") for end in ("html", "md"))
    assert html.count("<img ") == text.count("![") == len(drawn)
    assert "sway" in html
    for title in ("Table I:", "Table II:", "Table III:", "Table IV:", "Identifiability"):
        assert title in html
        assert f"## {title}" in text


def test_the_table_of_measures_shows_percent_and_dashes_for_missing_values(console):
    full = dict.fromkeys(REACH.rows[:4], 0.5) | {"distance_median_m": 0.0123, "return_smooth": -31.25}
    print_measures(console, REACH, {"[mujoco]": full, "arm": {"success_5cm": 1.0}}, "reaching")
    lines = printed(console).splitlines()
    mujoco_line = next(line for line in lines if "[mujoco]" in line).split()
    arm_line = next(line for line in lines if " arm " in line).split()
    assert mujoco_line[1:] == ["50.0", "50.0", "50.0", "50.0", "12.3", "-31.2", "-"]
    assert arm_line[1:] == ["100.0", *"------"]


def test_the_markdown_report_links_figures_relative_and_holds_the_tables(tmp_path, panda, identified):
    tables = identification_tables(panda, identified, {})
    sections = {"Identification": ["Words.", *tables.values()], "Figures": [tmp_path / "figures" / "a b.png"]}
    text = report_markdown(tmp_path / "report.md", sections).read_text()
    assert text.startswith("# Identification\n\nWords.\n")
    assert "](figures/a%20b.png)" in text
    assert str(tmp_path) not in text
    rows = [line for line in text.splitlines() if line.startswith("|")]
    assert len(rows) == sum(len(table) + 2 for table in tables.values())
    for table in tables.values():
        own, rows = rows[: len(table) + 2], rows[len(table) + 2 :]
        assert {line.count("|") for line in own} == {len(table.columns) + 2}
