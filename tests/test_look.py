"""`r2s list` and `r2s look`: the table of run folders, and the viewer on them."""

import base64
import io
import json
import multiprocessing
import os
import platform
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pandas as pd
import psutil
import pytest
import yaml
from conftest import ROOT, conf
from matplotlib.colors import to_rgb
from PIL import Image
from rich.console import Console

from r2s import cli
from r2s.errors import UserError
from r2s.reporting.figures.colours import KNOWN
from r2s.reporting.run_list import ago, print_runs, run_rows
from r2s.reporting.viewer import look
from r2s.reporting.viewer.data import Content, Overlay
from r2s.runs import Job, Run, status_of

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
WRAPPER = """
import pathlib, subprocess
inner = subprocess.Popen(["sleep", "60"])
pathlib.Path("part").write_text(str(inner.pid))
pathlib.Path("part").rename("pid")
inner.wait()
"""
GONE = 2**22 - 3  # a process id beyond what Linux gives by default


def folder(root: Path, stage: str, name: str, status: str, summary: dict | None = None, **more) -> Path:
    """Write a run folder, begun two hours ago by a process that is gone, with two evaluations."""
    at = root / stage / name
    at.mkdir(parents=True)
    start = (datetime.now().astimezone() - timedelta(hours=2)).isoformat(timespec="seconds")
    process = {"host": platform.node(), "pid": GONE}
    (at / "meta.json").write_text(
        json.dumps({"status": status, "stage": stage, "start": start, "process": process} | more)
    )
    robot = {"_target_": "r2s.physics.robot.load_robot", **conf("robot/panda")}
    (at / "config.yaml").write_text(yaml.safe_dump({"robot": robot}))
    curve = {
        "env_steps": [1000, 2000],
        "wall_clock_s": [1.0, 2.0],
        "success_5cm": [0.5, 1.0],
        "success_2cm": [0.2, 0.9],
    }
    curve |= {"success_1cm": [0.1, 0.75], "success_5mm": [0.0, 0.5], "distance_median_m": [0.1, 0.01]}
    pd.DataFrame(curve | {"return_paper": [-300.0, -90.0]}).to_csv(at / "evaluations.csv", index=False)
    if summary:
        (at / "summary.json").write_text(json.dumps(summary))
        (at / "recording.rrd").write_bytes(b"")
    return at


@pytest.fixture
def root(tmp_path) -> Path:
    reach = {"success_1cm": 0.98, "return_paper": -85.2}
    folder(tmp_path, "train", "good", "done", {"best": reach, "last": reach})
    folder(tmp_path, "train", "shot", "running")
    folder(tmp_path, "train", "wrong", "failed", error="UserError: no such thing")
    folder(tmp_path, "train", "halted", "stopped")
    error = {"torque_rmse_Nm": [0.2, 0.4], "nominal_torque_rmse_Nm": [1.0, 2.0]}
    folder(tmp_path, "identify", "found", "done", {"train": error, "validation": error})
    folder(tmp_path, "transfer", "there", "done", {"mujoco": reach, "twin": reach | {"success_1cm": 0.9}})
    (tmp_path / "train" / "no run").mkdir()
    return tmp_path


def test_the_status_of_a_killed_run():
    """SIGKILL leaves `running` in meta.json; the process of another computer cannot be checked."""
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    meta = {"status": "running", "process": {"host": platform.node(), "pid": child.pid}}
    assert status_of(meta) == "running"
    child.kill()
    child.wait()
    assert status_of(meta) == "killed"
    assert status_of(meta | {"process": {"host": "elsewhere", "pid": child.pid}}) == "running"
    assert status_of(meta | {"status": "done"}) == "done"


def test_the_list_has_figures_of_searches_and_surfaces(tmp_path):
    """stage=tune has its best trial; an identification of presses alone has the surface."""
    summaries = {
        "tune": {"best": {"value": -91.234}, "trials": {"complete": 3, "pruned": 1}},
        "identify": {"contact": {"slope_N_per_m": 12345.6, "friction": 0.3}},
    }
    for stage, summary in summaries.items():
        with Run(tmp_path, Job(stage, "a", "", [], 0, 1)) as run:
            run.summary(summary)
    shown = run_rows(tmp_path)["result"]
    assert shown["tune/a"] == "best of 4 trials: -91.23"
    assert shown["identify/a"] == "surface 1.23e+04 N/m, friction 0.3"


def test_the_list_has_status_figures_and_age(root):
    """It has every run with the key figures of its stage."""
    rows = run_rows(root)
    assert rows["status"].to_dict() == {
        "train/good": "done",
        "train/shot": "killed",
        "train/wrong": "failed",
        "train/halted": "stopped",
        "identify/found": "done",
        "transfer/there": "done",
    }
    assert set(rows["age"]) == {"2 h"}
    figures = rows["result"]
    assert figures["train/good"] == "success at 1 cm 98 %, return (eq. 2) -85.2"
    assert figures["train/shot"] == "success at 1 cm 75 %, return (eq. 2) -90.0 after 2k env steps"
    assert figures["train/wrong"] == "UserError: no such thing"
    assert figures["identify/found"] == "torque RMSE 0.3 Nm, nominal 1.5"
    assert figures["transfer/there"] == "success at 1 cm, %: mujoco 98, twin 90"
    assert set(run_rows(root, failed=True).index) == {"train/shot", "train/wrong"}
    assert set(run_rows(root, stage="identify").index) == {"identify/found"}
    assert run_rows(root / "nowhere").empty
    assert [ago(s) for s in (3, 90, 7200, 3e5)] == ["3 s", "2 min", "2 h", "3 d"]


@pytest.mark.parametrize("terminal", [True, False])
def test_the_list_has_one_line_per_run(root, terminal):
    """A terminal cuts long ones; a file or a pipe holds them whole."""
    rows = run_rows(root)
    long = "train/2026-11-25_21-43-17_" + 9 * "algo=tqc_", "why " * 40
    rows.loc[long[0]] = ["failed", "2 h", long[1]]
    console = Console(file=io.StringIO(), width=100, force_terminal=terminal, color_system=None)
    print_runs(console, rows, "runs")
    head, *lines = [line for line in console.file.getvalue().splitlines() if "/" in line or "result" in line]
    assert len(lines) == len(rows)
    assert ("…" in lines[-1]) == terminal
    assert (long[0] in lines[-1]) != terminal
    assert (max(map(len, lines)) <= 100) == terminal
    assert lines[-1].strip().startswith(long[0][:40])
    assert all(line.index(status) == head.index("status") for line, status in zip(lines, rows["status"], strict=True))


def typed(*words: str, monkeypatch, capsys) -> tuple[int, str, str]:
    """Do a command in this process: exit status, output, errors."""
    monkeypatch.setattr(sys, "argv", ["r2s", *words])
    status = 0
    try:
        cli.main()
    except SystemExit as end:
        status = end.code
    return status, *capsys.readouterr()


def test_the_command_lists(root, monkeypatch, capsys):
    """`r2s list --failed`, and a stage that is none."""
    status, out, _ = typed("list", "--root", str(root), "--failed", monkeypatch=monkeypatch, capsys=capsys)
    assert status == 0
    assert "train/shot" in out
    assert "train/good" not in out
    status, _, err = typed("list", "--stage", "trian", monkeypatch=monkeypatch, capsys=capsys)
    assert status == 2
    assert "did you mean 'train'" in err


def test_without_a_screen_it_writes_pictures(root, monkeypatch, capsys):
    """Two runs side by side: one recording with both, and their curves as a PNG."""
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    other = shutil.copytree(root / "train" / "good", root / "train" / "twice")
    runs = [str(root / "train" / "good"), str(other)]
    status, out, err = typed("look", *runs, monkeypatch=monkeypatch, capsys=capsys)
    assert status == 0, err
    assert "no screen (neither DISPLAY" in out
    (picture,) = re.findall(r"^  (\S+\.png)$", out, flags=re.M)
    assert Path(picture).stat().st_size > 5000
    assert (Path(picture).parent / "recording.rrd").stat().st_size > 1000


def test_what_cannot_be_looked_at_is_one_line(root, monkeypatch, capsys):
    """A wrong argument, a wrong folder, an unfinished run, different arms."""
    for words, expected in (
        (["list", "--faild"], "no argument '--faild'"),
        (["look"], "required: RUN; see r2s look"),
    ):
        status, _, err = typed(*words, monkeypatch=monkeypatch, capsys=capsys)
        assert status == 2
        assert len(err.splitlines()) == 1
        assert expected in err
    for word, expected in (("god", "did you mean 'good'"), ("halted", "the run did not reach its end")):
        run = str(root / "train" / word)
        status, _, err = typed("look", run, monkeypatch=monkeypatch, capsys=capsys)
        assert status == 2
        assert len(err.splitlines()) == 1
        assert expected in err
    other = root / "transfer" / "there"
    (other / "config.yaml").write_text("robot: {name: ur10e}\n")
    runs = [str(root / "train" / "good"), str(other)]
    status, _, err = typed("look", *runs, monkeypatch=monkeypatch, capsys=capsys)
    assert "another robot" in err


def test_only_this_computer_is_served(monkeypatch):
    """`--web` binds to the loopback address."""
    seen = []

    class Viewer:
        def __init__(self, words, **_):
            seen.extend(words)

        def poll(self):
            return 1

        def wait(self):
            return 1

    monkeypatch.setattr(look.subprocess, "Popen", Viewer)
    with pytest.raises(UserError, match="exit status 1"):
        look.show_in_browser([Path("recording.rrd")], 9090)
    assert seen[seen.index("--bind") + 1] == "127.0.0.1"


def test_a_port_that_is_taken_is_one_line():
    """`--web` refuses a port in use; it needs the next port too."""
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        for asked in (port, port - 1):
            with pytest.raises(UserError, match=f"port {port} is in use; try --port {asked + 2}"):
                look.show_in_browser([Path("recording.rrd")], asked)


@pytest.mark.parametrize("by", [signal.SIGINT, signal.SIGTERM])
def test_a_viewer_ends_with_its_command(by, tmp_path, monkeypatch):
    """Interrupted or terminated, alone and not its group, the command takes along what the viewer has started."""
    (tmp_path / "rerun.py").write_text(WRAPPER)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.chdir(tmp_path)

    def typed() -> None:
        signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background of a shell has none
        look.open_native([])

    command = multiprocessing.get_context("fork").Process(target=typed)
    command.start()
    inner = psutil.Process(int(waited(lambda: Path("pid").exists() and Path("pid").read_text())))
    os.kill(command.pid, by)
    command.join(20)
    assert command.exitcode not in (None, 0)
    assert waited(lambda: not inner.is_running() or inner.status() == psutil.STATUS_ZOMBIE)


@pytest.mark.slow
@pytest.mark.skipif(not CHROMIUM, reason="no Chromium here")
def test_the_web_viewer_opens_without_an_error(root, panda, tmp_path):
    """`r2s look --web` in headless Chromium: curves of the recording are drawn and its console has no error."""
    from websockets.sync.client import connect

    from r2s.reporting.viewer.recording import write_recording

    run = root / "identify" / "found"
    t = np.arange(4000) * 1e-3
    torque = np.sin(np.outer(t, np.arange(1, 8)))
    overlay = Overlay(t, torque, {"nominal": 0.5 * torque, "identified": 0.95 * torque})
    write_recording(run / "recording.rrd", panda, Content(overlays={"torque": overlay}))
    web = [sys.executable, str(ROOT / "run.py"), "look", str(run), "--web", "--port", "9490"]
    log = open(tmp_path / "web.log", "w+")  # noqa: SIM115
    surf = [
        CHROMIUM,
        "--headless=new",
        "--no-sandbox",
        "--use-gl=angle",
        "--use-angle=swiftshader",
        "--remote-debugging-port=9492",
    ]
    surf += [
        "--enable-unsafe-swiftshader",
        "--window-size=1300,800",
        f"--user-data-dir={tmp_path / 'chromium'}",
        "about:blank",
    ]
    with (
        subprocess.Popen(web, stdout=log, stderr=subprocess.STDOUT, cwd=ROOT) as server,
        subprocess.Popen(surf, stderr=subprocess.PIPE, text=True) as browser,
    ):
        try:
            tab = waited(lambda: next(iter(re.findall(r"ws://\S+", browser.stderr.readline())), None))
            url = waited(
                lambda: next(iter(re.findall(r"look: (http://\S+)", (tmp_path / "web.log").read_text())), None)
            )
            errors, picture = visited(connect, tab, url)
        finally:
            browser.terminate()
            server.terminate()
    (tmp_path / "look.png").write_bytes(picture)
    if kept := os.environ.get("R2S_KEEP"):
        shutil.copy(tmp_path / "look.png", kept)
    assert errors == []
    assert curves(picture) > CURVES, "no recording is seen"


CURVES = 1000  # pixels of seven curves, each some hundreds wide


def curves(picture: bytes) -> int:
    """Return how many pixels of a PNG have the colour of a nominal model."""
    seen = np.asarray(Image.open(io.BytesIO(picture)).convert("RGB"), dtype=float)
    return int((np.abs(seen - 255 * np.array(to_rgb(KNOWN["nominal"]))).max(-1) < 12).sum())


def waited(ask, seconds: float = 90.0):
    """Return the first answer that is one."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if answer := ask():
            return answer
        time.sleep(0.2)
    raise TimeoutError


def visited(connect, tab: str, url: str, seconds: float = 240.0) -> tuple[list[str], bytes]:
    """Return the console errors of a page until its curves appear, or for `seconds`, and a PNG.

    The viewer asks for news and sends statistics; where there is no way out, those two fail.
    """
    with connect(tab, max_size=None) as spoken:
        count, errors = 0, []

        def ask(method: str, session: str | None = None, **params) -> dict:
            nonlocal count
            count += 1
            words = {"id": count, "method": method, "params": params} | ({"sessionId": session} if session else {})
            spoken.send(json.dumps(words))
            while (answer := json.loads(spoken.recv(timeout=90))).get("id") != count:
                handle(answer)
            return answer["result"]

        def handle(message: dict) -> None:
            kind, params = message.get("method"), message.get("params", {})
            if kind == "Runtime.exceptionThrown":
                errors.append(json.dumps(params))
            if kind == "Runtime.consoleAPICalled" and params["type"] == "error":
                errors.append(json.dumps(params["args"]))

        target = ask("Target.createTarget", url="about:blank")["targetId"]
        session = ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        ask("Runtime.enable", session)
        ask("Page.enable", session)
        ask("Page.navigate", session, url=url)
        deadline, picture = time.monotonic() + seconds, b""
        while time.monotonic() < deadline and (not picture or curves(picture) < CURVES):
            looked = time.monotonic() + 5.0
            while (left := looked - time.monotonic()) > 0:
                with suppress(TimeoutError):
                    handle(json.loads(spoken.recv(timeout=left)))
            picture = base64.b64decode(ask("Page.captureScreenshot", session, format="png")["data"])
    return [e for e in errors if "Failed to fetch" not in e], picture
