"""A run folder holds data only and its status is correct, whatever happens; see also tests/test_fuzz.py."""

import ast
import fcntl
import json
import os
import re
import shutil
import tomllib
from importlib.metadata import PackageNotFoundError, requires

import numpy as np
import pytest
import torch
from conftest import ROOT
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from packaging.requirements import Requirement

from r2s.cli import differing, typed_overrides
from r2s.errors import UserError
from r2s.learning.checkpoint import load_tensors, save_tensors
from r2s.override_checks import check_option
from r2s.provenance import sha256
from r2s.runs import Job, Run, is_done, is_locked, load_arrays, read_summary
from r2s.stages.build import CONF, open_run

SOURCES = [*sorted((ROOT / "r2s").rglob("*.py")), *sorted((ROOT / "hydra_plugins").glob("*.py")), ROOT / "run.py"]
NEVER = {
    "pickle.load",
    "pickle.loads",
    "pickle.Unpickler",
    "joblib.load",
    "pd.read_pickle",
    "dill.load",
    "eval",
    "exec",
}
NEVER |= {"yaml.load", "yaml.unsafe_load", "yaml.full_load", "torch.jit.load", "marshal.loads", "shelve.open"}
ALWAYS = {"torch.load": ("weights_only", True), "np.load": ("allow_pickle", False)}
SERVES = {"bind", "serve_grpc", "serve_web", "serve_web_viewer", "HTTPServer", "ThreadingHTTPServer", "create_server"}
NO_SOCKET = ("batch", "_batch", "_arms", "inspect.signature(make)")  # whose bind is another
HOSTS = ("self.address", "'127.0.0.1'", "LOOPBACK")  # the first is that of the server's socket


def calls(path):
    """Return (name, call) of every call in a file: ("np.load", node)."""
    tree = ast.parse(path.read_text())
    return [(ast.unparse(node.func), node) for node in ast.walk(tree) if isinstance(node, ast.Call)]


@pytest.mark.long
@pytest.mark.parametrize("path", SOURCES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_nothing_that_is_read_runs(path):
    """No call loads a pickle; calls that could are given the option against it."""
    for name, call in calls(path):
        assert name not in NEVER, f"{path}:{call.lineno}: {name}"
        if name in ALWAYS:
            key, value = ALWAYS[name]
            given = {k.arg: ast.literal_eval(k.value) for k in call.keywords if isinstance(k.value, ast.Constant)}
            assert given.get(key) is value, f"{path}:{call.lineno}: {name} without {key}={value}"


@pytest.mark.long
@pytest.mark.parametrize("path", SOURCES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_servers_listen_on_loopback_only(path):
    """Calls that bind a socket or serve name an address, which is a loopback address."""
    assert not re.search(r"""["'](0\.0\.0\.0|::)["']""", path.read_text())
    for name, call in calls(path):
        owner, _, verb = name.rpartition(".")
        if verb not in SERVES or any(owner.endswith(other) for other in NO_SOCKET):
            continue
        words = ast.unparse(call)
        assert any(host in words for host in HOSTS), f"{path}:{call.lineno}: {words} names no loopback address"


def test_every_pin_is_there():
    """constraints.txt names every package that r2s needs, and what those need: an audit of it misses none."""
    pins = {line.split("==")[0].lower().replace("_", "-") for line in (ROOT / "constraints.txt").read_text().split()}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    own = [*project["dependencies"], *project["optional-dependencies"]["dev"]]
    for extra in re.findall(r"\w+", own[len(project["dependencies"])])[1:]:  # of r2s[bags,...]
        own += project["optional-dependencies"][extra]
    waiting, seen, extras = ["r2s"], set(), {}
    while waiting:
        package = waiting.pop()
        try:
            needed = own if package == "r2s" else requires(package) or []
        except PackageNotFoundError:
            continue  # of another system
        for requirement in map(Requirement, needed):
            name = requirement.name.lower().replace("_", "-")
            wanted = [{"extra": e} for e in extras.get(package, {""})]
            if requirement.marker and not any(requirement.marker.evaluate(w) for w in wanted):
                continue
            if name not in seen:
                seen.add(name)
                extras.setdefault(name, {""}).update(requirement.extras)
                waiting.append(name)
    assert len(seen) > 50
    builds = {"r2s"}
    missing = {n for n in seen - pins - builds if not n.startswith(("nvidia", "cuda", "triton"))}
    assert missing == set()


def opened(root, **change):
    """Return a run folder, open."""
    how = {k: change.pop(k) for k in ("resume", "exact_name") if k in change}
    words = {"name": "a", "config": "stage: train\n", "overrides": ["seed=1"], "seed": 1, "threads": 1} | change
    return Run(root, Job("train", **words), **how)


def test_a_run_belongs_to_one_process_at_a_time(tmp_path):
    """While it is open no other process resumes it; an exact name is given once."""
    with opened(tmp_path) as run:
        assert json.loads((run.folder / "meta.json").read_text())["status"] == "running"
        with pytest.raises(UserError, match=rf"process {os.getpid()} on .* is still writing"):
            is_done(run.folder)
        with pytest.raises(UserError, match=r"is still writing"):
            opened(tmp_path, resume=run.folder)
        with pytest.raises(UserError, match=r"train/a is taken"):
            opened(tmp_path, exact_name=True)
        assert {p.name for p in run.folder.parent.iterdir()} == {"a"}
        assert is_locked(run.folder)
    assert is_done(run.folder)
    assert not is_locked(run.folder)
    with opened(tmp_path) as other:
        assert other.folder.name == "a_2"


def test_a_reused_process_id_is_no_reason_to_wait(tmp_path):
    """The lock decides, not the process id in meta.json, which another program may have after a restart."""
    with opened(tmp_path) as run:
        pass
    meta = json.loads((run.folder / "meta.json").read_text())
    meta |= {"status": "running", "process": meta["process"] | {"pid": 1}}
    (run.folder / "meta.json").write_text(json.dumps(meta))
    assert not is_done(run.folder)
    with open(run.folder / "overrides.yaml", "r+") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with pytest.raises(UserError, match=r"process 1 on .* is still writing"):
            is_done(run.folder)


def test_an_overrides_yaml_with_a_missing_line_is_damaged(tmp_path):
    """Cut off between two lines it is still a list, of fewer overrides than the user typed."""
    with opened(tmp_path, overrides=["seed=1", "algo=td3"]) as run:
        assert typed_overrides(run.folder) == ["seed=1", "algo=td3"]
    path = run.folder / "overrides.yaml"
    path.write_text(path.read_text().splitlines(keepends=True)[0])
    with pytest.raises(UserError, match=r"overrides.yaml is damaged: expected 2 overrides, got 1"):
        typed_overrides(run.folder)


@pytest.mark.parametrize("name", ["..", ".", ".hidden", "a/b", "a\0b", "a\nb", "x" * 300])
def test_a_name_that_no_folder_can_have(name, tmp_path):
    with pytest.raises(UserError):
        opened(tmp_path, name=name)
    assert not list(tmp_path.rglob("*.yaml"))


def test_a_resumed_run_lists_its_parts(tmp_path, monkeypatch):
    """Killed, stopped, done: each part has its clock and code; start is the first, the clock their sum."""
    monkeypatch.setattr("r2s.runs.NOTE_S", 0.0)
    run = opened(tmp_path)
    run.log("metrics", {"env_steps": 1})
    os.close(run._lock)  # as the system does when a process is killed
    config = (run.folder / "config.yaml").read_bytes()
    first = json.loads((run.folder / "meta.json").read_text())
    with pytest.raises(KeyboardInterrupt), opened(tmp_path, resume=run.folder, config="other: 1\n"):
        raise KeyboardInterrupt
    with opened(tmp_path, resume=run.folder, threads=2):
        pass
    meta = json.loads((run.folder / "meta.json").read_text())
    assert [p["status"] for p in meta["parts"]] == ["killed", "stopped", "done"]
    assert [p["threads"] for p in meta["parts"]] == [1, 1, 2]
    assert all(p[key] == meta[key] for p in meta["parts"] for key in ("git", "machine", "packages"))
    assert meta["start"] == first["start"] == meta["parts"][0]["start"]
    assert meta["parts"][0]["wall_clock_s"] == first["wall_clock_s"] > 0
    assert meta["wall_clock_s"] == pytest.approx(sum(p["wall_clock_s"] for p in meta["parts"]), abs=2e-3)
    assert (run.folder / "config.yaml").read_bytes() == config


def test_every_file_that_a_training_reads_has_its_digest(tmp_path):
    """Robot, tool, calibration; of a resumed training its own copy counts, so the calibration may be gone."""
    identified, robot, tool = tmp_path / "arm", tmp_path / "arm.xml", tmp_path / "tool.json"
    identified.mkdir()
    for path in (identified / "parameters.yaml", identified / "posterior.npz", robot, tool):
        path.write_text(path.name)
    words = [f"root={tmp_path}", "name=a", f"calibration={identified}", f"robot.mjcf={robot}", f"robot.tool={tool}"]
    cfg = composed(*words)
    with open_run(cfg, words) as run:
        (run.folder / "parameters.yaml").write_text("a copy")
    meta = json.loads((run.folder / "meta.json").read_text())
    expected = {str(p): sha256(p) for p in (robot, tool, *identified.iterdir())}
    assert meta["inputs"] == expected
    assert meta["parents"] == [str(identified)]
    shutil.rmtree(identified)
    cfg.resume = str(run.folder)
    with open_run(cfg, words) as run:
        pass
    again = json.loads((run.folder / "meta.json").read_text())
    assert (again["inputs"], again["parents"]) == (expected, [str(identified)])
    robot.write_text("another arm")
    with pytest.raises(UserError, match=r"resume: .*arm.xml has changed since"):
        open_run(cfg, words)


def composed(*words):
    with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
        return compose("config", list(words))


def test_a_changed_default_is_a_changed_setting(tmp_path):
    """Nothing was typed, and yet the saved config differs; where a run is and on how many cores does not count."""
    saved, now = composed("algo.lr=1e-3"), composed("algo.lr=2e-3", "name=b", "root=other", "threads=3")
    assert differing(saved, now) == ["algo.lr was 0.001, is 0.002"]
    OmegaConf.set_struct(saved, False)
    del saved["safety"]  # of an older r2s: all null, so nothing differs
    assert len(differing(saved, now)) == 1
    del saved["budget"]
    assert differing(saved, now)[1] == "budget.minutes was not there, is 5"
    assert differing(now, now) == []


def test_rewinding_keeps_what_was_whole_as_it_was_written(tmp_path):
    """Rows after the checkpoint, the evaluation at the end of a run, and a row that was cut off go."""
    with opened(tmp_path) as run:
        logged = [run.log("evaluations", {"env_steps": steps, "x": steps / 7}) for steps in (100, 200, 300)]
    path = run.folder / "evaluations.csv"
    whole = path.read_bytes()
    path.write_bytes(whole + b"300,42.9\r\n400,5")
    with opened(tmp_path, resume=run.folder) as again:
        rows = again.rewind("evaluations", "env_steps", 300)
        assert path.read_bytes() == whole
        assert [row["env_steps"] for row in rows] == [100, 200, 300]
        assert rows == logged  # to the last digit: by them the best is chosen
        again.log("evaluations", {"env_steps": 400, "x": 1.0})
    assert path.read_bytes() == whole + b"400,1\r\n"
    with opened(tmp_path, resume=run.folder) as again:
        assert len(again.rewind("evaluations", "env_steps", 0)) == 0
    assert path.read_bytes() == b"env_steps,x\r\n"


def test_a_disk_that_is_full_takes_nothing_away(tmp_path, monkeypatch):
    """A run that cannot write its summary keeps the status running and raises the error."""

    def full(*_):
        raise OSError(28, "No space left on device")

    run = opened(tmp_path)
    before = (run.folder / "meta.json").read_bytes()
    monkeypatch.setattr("os.replace", full)
    with pytest.raises(OSError, match="No space left"), run:
        run.summary({"x": 1})
    monkeypatch.undo()
    assert (run.folder / "meta.json").read_bytes() == before
    assert not (run.folder / "summary.json").exists()
    assert not list(run.folder.glob("*.part*"))
    assert not is_done(run.folder)


@pytest.mark.parametrize("share", [0.0, 0.5, 0.95])
def test_a_truncated_file_gets_one_line(share, tmp_path):
    """Truncated tensors, arrays and JSON raise a UserError that names the file."""
    save_tensors(tmp_path / "a.pt", {"x": torch.zeros(100)})
    np.savez(tmp_path / "a.npz", x=np.arange(100.0))
    (tmp_path / "summary.json").write_text(json.dumps({"best": {"x": 1.0}}))
    readers = {"a.pt": lambda p: load_tensors(p, "policy"), "a.npz": load_arrays}
    readers["summary.json"] = lambda p: read_summary(p.parent, "policy")
    for name, read in readers.items():
        path = tmp_path / name
        assert read(path)
        path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
        with pytest.raises(UserError, match=re.escape(str(path))) as caught:
            read(path)
        assert "\n" not in str(caught.value)


def test_a_pickled_object_in_a_run_folder_is_refused(tmp_path):
    """Also where it would do nothing bad."""
    torch.save({"seen": shutil.which}, tmp_path / "state.pt")
    with pytest.raises(UserError, match=r"state.pt cannot be read"):
        load_tensors(tmp_path / "state.pt", "resume")
    np.savez(tmp_path / "a.npz", x=np.array([shutil.which], dtype=object))
    with pytest.raises(UserError, match=r"a.npz is damaged"):
        load_arrays(tmp_path / "a.npz")


@pytest.mark.parametrize("value", [True, None, -1, 1.5, {"a": 1}, [], [True]])
def test_an_option_of_a_group_is_a_word(value):
    """Hydra raises a traceback for other values; only trackers may be an empty list."""
    with pytest.raises(UserError, match=r"algo: expected one of td3, tqc, got"):
        check_option("algo", value, ["td3", "tqc"])
    check_option("algo", "tqc", ["td3", "tqc"])
    check_option("tracker", [], ["csv"])
