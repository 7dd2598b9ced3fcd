"""Runs in the viewer: one as its recording.rrd is, several side by side in one recording."""

import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pandas as pd

from r2s.errors import UserError
from r2s.physics.robot import Robot
from r2s.reporting.identification_figures import torque_figure
from r2s.reporting.learning_figures import learning_figure
from r2s.reporting.pages import unstack
from r2s.reporting.reach_figures import reach_figure
from r2s.reporting.viewer import write_recording
from r2s.reporting.viewer_layout import Overlay

LOOPBACK = "127.0.0.1"


def side_by_side(folder: Path, robot: Robot, runs: Mapping[str, Path]) -> list[Path]:
    """Write what runs left to look at into `folder`: recording.rrd with all of them, and the same as PNGs.

    Arms stand in a row, learning curves share their plots, each identification has a tab of torques.

    Args:
        robot: of all of them. runs: {label: run folder}.

    Returns:
        The PNGs.
    """
    episodes, overlays, curves = {}, {}, {}
    for label, run in runs.items():
        for path in sorted(run.glob("episodes_*.npz")):
            episodes[f"{label}, {path.stem.removeprefix('episodes_')}"] = unstack(path)
        if (run / "torque.npz").is_file():
            with np.load(run / "torque.npz", allow_pickle=False) as saved:
                predicted = {k: saved[k] for k in ("nominal", "identified")}
                overlays[label] = Overlay(saved["t"], saved["measured"], predicted)
        if (run / "evaluations.csv").is_file():
            curves[label] = pd.read_csv(run / "evaluations.csv")
    if not episodes and not overlays and not curves:
        raise UserError(f"look: nothing to see in {', '.join(map(str, runs.values()))}")
    folder.mkdir(parents=True, exist_ok=True)
    pictures = {}
    if curves:
        pictures["learning"] = learning_figure(folder / "learning.png", curves)
    write_recording(
        folder / "recording.rrd", robot, episodes=episodes, overlays=overlays, curves=curves, figures=pictures
    )
    if episodes:
        pictures["reach"] = reach_figure(folder / "reach.png", episodes)
    for label, o in overlays.items():
        path = folder / f"torque_{re.sub(r'[^A-Za-z0-9.-]+', '_', label)}.png"
        pictures[path.stem] = torque_figure(path, o.t, o.measured, o.predicted, label)
    return list(pictures.values())


def has_screen() -> bool:
    """Return whether a window can be opened here."""
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def open_native(recordings: Sequence[Path]) -> None:
    """Open the viewer on recordings and wait until it is closed."""
    with _viewer(map(str, recordings)):
        pass


def show_in_browser(recordings: Sequence[Path], port: int) -> None:
    """Serve the viewer to browsers on this computer alone, at `port`, until Ctrl-C.

    Raises:
        UserError: something else listens at one of the two ports, or the viewer failed.
    """
    if taken := [p for p in (port, port + 1) if _answers(p)]:
        raise UserError(
            f"look: something listens at port {taken[0]} already; --port {port + 2} or another is allowed"
        )
    words = ["--serve-web", "--bind", LOOPBACK, "--web-viewer-port", str(port), "--port", str(port + 1)]
    with _viewer([*words, *map(str, recordings)]) as process:
        while process.poll() is None and not all(map(_answers, (port, port + 1))):
            time.sleep(0.1)
        if process.poll() is None:
            source = f"rerun%2Bhttp://{LOOPBACK}:{port + 1}/proxy"
            print(f"look: http://{LOOPBACK}:{port}/?url={source} (Ctrl-C ends it)", flush=True)


def _answers(port: int) -> bool:
    """Return whether something listens at a port of this computer."""
    try:
        socket.create_connection((LOOPBACK, port), timeout=1.0).close()
    except OSError:
        return False
    return True


@contextmanager
def _viewer(words: Iterable[str]) -> Iterator[subprocess.Popen]:
    """Start the viewer, and wait for it; it ends with this process, also where that is interrupted or terminated.

    Raises:
        UserError: it failed.
    """
    before = signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    # a session of its own: `python -m rerun` starts another process, and does not take it along
    process = subprocess.Popen([sys.executable, "-m", "rerun", *words], start_new_session=True)
    try:
        yield process
        status = process.wait()
    finally:
        if process.poll() is None:
            _end_group(process)
        signal.signal(signal.SIGTERM, before)
    if status:
        raise UserError(f"the rerun viewer ended with exit status {status}, see above")


def _end_group(process: subprocess.Popen) -> None:
    """End a process and those that it started, where the system has groups."""
    if sys.platform == "win32":
        process.terminate()
    else:
        os.killpg(process.pid, signal.SIGTERM)
    process.wait()
