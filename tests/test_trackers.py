"""Trackers: the run read back with each library, and no tracker can end a run."""

import json
import sqlite3
import time
from collections.abc import Iterator
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

import pytest
from conftest import ROOT
from hydra import compose, initialize_config_dir
from PIL import Image

from r2s.errors import UserError
from r2s.override_checks import check_overrides
from r2s.reporting.trackers import async_tracker
from r2s.reporting.trackers.async_tracker import Trackers, finite
from r2s.reporting.trackers.tracker import Tracked
from r2s.stages.build import GROUP, open_run
from r2s.tasks.measures import Measure, MeasureTable, write_measures

PACKAGES = {"tensorboard": "tensorboard", "mlflow": "mlflow", "wandb": "wandb", "trackio": "trackio"}
INSTALLED = [name for name, package in PACKAGES.items() if find_spec(package)]
RETURNS = {1000: -400.0, 2000: -300.0, 3000: -100.0}  # of the evaluations that are logged, by their env_steps


def composed(*words: str):
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        return compose("config", list(words))


def needed(name: str):
    return pytest.importorskip(PACKAGES[name], reason="pip install 'r2s[trackers]' brings what this test reads back")


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    """A root with a job of a sweep, shown by all trackers that are installed: stopped after 2000, resumed at 1000."""
    root = tmp_path_factory.mktemp("runs")
    held = MeasureTable((Measure("held", "held", "time in contact", "%", 100),), ("held",))
    cfg = composed(f"tracker=[{','.join(['csv', *INSTALLED])}]", f"root={root}", "name=job", "algo.lr=1e-3")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(GROUP, "sweep of today")
        patch.delenv("TRACKIO_DIR", raising=False)
        with suppress(KeyboardInterrupt), open_run(cfg, ["algo.lr=1e-3"]) as run:
            write_measures(run.folder, held)
            for step in (1000, 2000):
                run.log("evaluations", {"env_steps": step, "return_paper": RETURNS[step]})
            raise KeyboardInterrupt
        patch.setenv(GROUP, "another sweep, which repeats it")
        cfg.resume = str(run.folder)
        with open_run(cfg, ["algo.lr=1e-3"]) as run:
            run.rewind("evaluations", "env_steps", 1000)
            for step in (2000, 3000):
                run.log("evaluations", {"env_steps": step, "return_paper": RETURNS[step]})
            run.summary({"best": {"held": 0.75, "none": None}, "rows": [1, 2]})
            Image.new("RGB", (8, 4), "red").save(run.figure("learning"))
            (run.folder / "recording.rrd").write_bytes(b"looks")
    return root


def test_tensorboard_holds_it(root):
    """Event files: the curve without what was written twice, settings, commit, figures."""
    needed("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
    from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

    events = EventAccumulator(str(root / "train" / "job" / "tensorboard")).Reload()
    curve = events.Scalars("evaluations/return_paper")
    assert {e.step: e.value for e in curve} == RETURNS
    assert len(curve) == len(RETURNS)
    assert events.Scalars("summary/best/held")[0].value == 0.75
    assert "figures/learning" in events.Tags()["images"]
    data = events.SummaryMetadata("_hparams_/session_start_info").plugin_data.content
    experiment = events.SummaryMetadata("_hparams_/experiment").plugin_data.content
    metrics = HParamsPluginData.FromString(experiment).experiment.metric_infos
    assert [m.name.tag for m in metrics] == ["summary/best/held"]  # of the task, which is not of r2s
    settings = HParamsPluginData.FromString(data).session_start_info.hparams
    assert settings["algo.lr"].number_value == 1e-3
    assert settings["git_commit"].string_value == commit(root)


def commit(root: Path) -> str:
    return str(json.loads((root / "train" / "job" / "meta.json").read_text())["git"]["commit"])


def test_mlflow_holds_it(root):
    """The SQLite store: one run for both parts, with parameters, metrics by step, tags and artifacts."""
    needed("mlflow")
    from mlflow.tracking import MlflowClient

    client = MlflowClient(f"sqlite:///{root}/mlflow.db")
    (found,) = client.search_runs([client.get_experiment_by_name("r2s").experiment_id])
    assert found.info.run_id == json.loads((root / "train" / "job" / "trackers.json").read_text())["mlflow"]
    assert found.info.run_name == "train/job"
    assert found.info.status == "FINISHED"
    curve = client.get_metric_history(found.info.run_id, "evaluations/return_paper")
    assert {m.step: m.value for m in curve} == RETURNS
    assert found.data.metrics["summary/best/held"] == 0.75
    assert float(found.data.params["algo.lr"]) == 1e-3
    assert found.data.params["git_commit"] == commit(root)
    assert found.data.tags["group"] == "sweep of today"
    assert {a.path for a in client.list_artifacts(found.info.run_id)} == {"figures", "recording.rrd", "measures.json"}


def blocks(log: bytes) -> Iterator[bytes]:
    """Give the records of a log of wandb, which has the format of LevelDB (doc/log_format.md there)."""
    at, record = 7, b""  # after ":W&B", magic and version
    while at + 7 <= len(log):
        if 32768 - at % 32768 < 7:
            at += 32768 - at % 32768
            continue
        size, kind = int.from_bytes(log[at + 4 : at + 6], "little"), log[at + 6]
        record += log[at + 7 : at + 7 + size]
        at += 7 + size
        if kind in (1, 4):  # whole, or its last piece
            yield record
            record = b""


def test_wandb_holds_it(root):
    """Two offline parts of one run: settings, group, rows and files."""
    needed("wandb")
    from wandb.proto.wandb_internal_pb2 import Record

    folders = sorted((root / "train" / "job" / "wandb").glob("offline-run-*"))
    name = json.loads((root / "train" / "job" / "trackers.json").read_text())["wandb"]
    assert len(folders) == 2
    rows, config, runs = {}, {}, []
    for folder in folders:
        for data in blocks((folder / f"run-{name}.wandb").read_bytes()):
            record = Record.FromString(data)
            if record.HasField("run"):
                runs.append(record.run)
                config |= {u.key: json.loads(u.value_json) for u in record.run.config.update}
            row = {i.key or "/".join(i.nested_key): json.loads(i.value_json) for i in record.history.item}
            if "evaluations/return_paper" in row:
                rows[row["evaluations/step"]] = row["evaluations/return_paper"]
    assert rows == RETURNS
    assert {run.run_id for run in runs} == {name}
    assert {run.run_group for run in runs} == {"sweep of today"}
    assert config["algo.lr"] == 1e-3
    assert config["git_commit"] == commit(root)
    assert (folders[1] / "files" / "recording.rrd").is_file()
    assert list((folders[1] / "files" / "media" / "images" / "figures").glob("learning*.png"))


def test_trackio_holds_it(root):
    """Its database: one run of the group, with settings and rows by step; figure and recording beside it."""
    needed("trackio")
    with sqlite3.connect(root / "trackio" / "r2s.db") as base:
        rows = [(n, s, json.loads(m)) for n, s, m in base.execute("SELECT run_name, step, metrics FROM metrics")]
        ((config,),) = base.execute("SELECT config FROM configs").fetchall()
        artifacts = base.execute("SELECT name FROM artifacts").fetchall()
    assert {n for n, _, _ in rows} == {"train/job"}
    key = "evaluations/return_paper"
    assert {s: m[key] for _, s, m in rows if key in m} == RETURNS
    config = json.loads(config)
    assert config["algo.lr"] == 1e-3
    assert config["git_commit"] == commit(root)
    assert config["_Group"] == "sweep of today"
    assert sorted(artifacts) == [("measures.json",), ("recording.rrd",)]
    assert list((root / "trackio" / "media").rglob("*.png"))


def test_csv_is_the_run_folder(root):
    """tracker=csv, the default, adds nothing to the run folder."""
    assert (root / "train" / "job" / "evaluations.csv").read_text().split() == [
        "env_steps,return_paper",
        *(f"{step},{value:g}" for step, value in RETURNS.items()),
    ]
    cfg = composed(f"root={root}", "name=plain")
    assert cfg.tracker == {"csv": None}
    with open_run(cfg, []) as run:
        assert run.tracker is None
    assert not (run.folder / "trackers.json").exists()


@pytest.mark.long
def test_several_are_a_list():
    """`tracker=[csv,mlflow]` takes both, `tracker=wandb` one, and their settings can be typed."""
    assert set(composed("tracker=[csv,mlflow]").tracker) == {"csv", "mlflow"}
    cfg = composed("tracker=[wandb,trackio]", "tracker.wandb.offline=false", "root=here")
    assert cfg.tracker.wandb.offline is False
    assert cfg.tracker.trackio.folder == "here/trackio"
    assert set(composed("tracker=tensorboard").tracker) == {"tensorboard"}
    with pytest.raises(UserError, match=r"no option 'mlfow'; allowed: csv, mlflow, .* did you mean 'mlflow'"):
        check_overrides(["tracker=[csv,mlfow]"], None)


class Broken:
    """Fails from one call on."""

    def __init__(self, call: str):
        self.call, self.calls = call, []

    def __getattr__(self, name: str):
        def called(*given):
            self.calls.append(name)
            if name == self.call:
                raise ConnectionError("connection\nrefused")

        return called


def tracked(folder: Path) -> Tracked:
    return Tracked(folder, "train", None, {}, {"git": {"commit": None, "dirty": None}}, False)


@pytest.mark.parametrize("call", ["start", "log", "summary", "finish"])
def test_a_tracker_that_fails_warns_once(call, tmp_path, capsys):
    """One warning in one line, then no more; the other trackers get all calls."""
    broken, well = Broken(call), Broken("")
    both = Trackers({"broken": broken, "well": well}, tracked(tmp_path))
    for k in range(3):
        both.log("metrics", {"loss": float(k)})
    both.summary({})
    both.finish("done")
    assert capsys.readouterr().err.splitlines() == [
        "warning: tracker=broken: ConnectionError: connection refused; the run continues without it"
    ]
    assert well.calls == ["start", "log", "log", "log", "summary", "finish"]
    assert broken.calls[-1] == call
    assert broken.calls.count(call) == 1


def test_a_tracker_that_hangs_holds_nothing_up(tmp_path, capsys, monkeypatch):
    """Calls return at once, the end of the run waits for LAST_S, and a full queue ends the tracker."""
    monkeypatch.setattr(async_tracker, "LAST_S", 0.2)
    monkeypatch.setattr(async_tracker, "MOST_WAITING", 5)
    slow = Broken("")
    slow.start = lambda run: time.sleep(3.0)
    both = Trackers({"slow": slow}, tracked(tmp_path))
    began = time.monotonic()
    for k in range(10):
        both.log("metrics", {"loss": float(k)})
    both.finish("done")
    assert time.monotonic() - began < 2.0
    assert capsys.readouterr().err.count("warning: tracker=slow") == 1


def test_only_finite_numbers_are_shown():
    """Strings, missing and infinite values stay in the CSV."""
    assert finite({"a": 1, "b": "word", "c": float("nan"), "d": None, "e": True, "f": [1]}) == {"a": 1.0, "e": 1.0}
