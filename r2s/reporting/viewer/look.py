"""`r2s look`: show one run, or several runs in one recording, in the Rerun viewer."""

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

import pandas as pd

from r2s.errors import UserError
from r2s.physics.robot import Robot
from r2s.reporting.figures.episodes import error_figure
from r2s.reporting.figures.learning import learning_figure
from r2s.reporting.identification.figures import torque_figure
from r2s.reporting.measures import measures_of
from r2s.reporting.viewer.data import Content, Overlay, saved_episodes
from r2s.reporting.viewer.recording import write_recording

LOOPBACK = "127.0.0.1"


def side_by_side(folder: Path, robot: Robot, runs: Mapping[str, Path]) -> list[Path]:
    """Write the episodes, torques and learning curves of {label: run folder} into one recording.rrd in `folder`.

    The recording and the figures show the measures of the first run that has learning curves or episodes.

    Returns:
        Paths of the figures (PNG) of the episodes, torques and learning curves.

    Raises:
        UserError: no run has episodes, torques or evaluations.
    """
    episodes = {f"{k}, {where}": e for k, run in runs.items() for where, e in saved_episodes(run).items()}
    overlays = {k: Overlay.load(run) for k, run in runs.items() if (run / "torque.npz").is_file()}
    paths = {k: run / "evaluations.csv" for k, run in runs.items()}
    curves = {k: pd.read_csv(path) for k, path in paths.items() if path.is_file()}
    if not episodes and not overlays and not curves:
        raise UserError(f"look: no episodes, torques or evaluations in {', '.join(map(str, runs.values()))}")
    with_task = [run for k, run in runs.items() if k in curves or any(run.glob("episodes_*.npz"))]
    measures = measures_of(with_task[0]) if with_task else None
    folder.mkdir(parents=True, exist_ok=True)
    pictures = {}
    if curves and measures:
        panels = [measures[key] for key in measures.curves]
        pictures["learning"] = learning_figure(folder / "learning.png", curves, panels)
    write_recording(folder / "recording.rrd", robot, Content(measures, episodes, overlays, curves, dict(pictures)))
    if episodes and measures:
        pictures["reach"] = error_figure(folder / "reach.png", episodes, measures)
    for label, o in overlays.items():
        path = folder / f"torque_{re.sub(r'[^A-Za-z0-9.-]+', '_', label)}.png"
        pictures[path.stem] = torque_figure(path, o.t, o.measured, o.predicted, label)
    return list(pictures.values())


def has_screen() -> bool:
    """Return whether this computer can open a window."""
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def open_native(recordings: Sequence[Path]) -> None:
    """Open recordings in the Rerun viewer, and wait until the viewer is closed."""
    with _viewer(map(str, recordings)):
        pass


def show_in_browser(recordings: Sequence[Path], port: int) -> None:
    """Serve the viewer to browsers on this computer, at `port`, until Ctrl-C.

    Raises:
        UserError: `port` or `port` + 1 is in use, or the viewer failed.
    """
    if taken := [p for p in (port, port + 1) if _is_open(p)]:
        raise UserError(f"look: port {taken[0]} is in use; try --port {port + 2}")
    words = ["--serve-web", "--bind", LOOPBACK, "--web-viewer-port", str(port), "--port", str(port + 1)]
    with _viewer([*words, *map(str, recordings)]) as process:
        while process.poll() is None and not all(map(_is_open, (port, port + 1))):
            time.sleep(0.1)
        if process.poll() is None:
            source = f"rerun%2Bhttp://{LOOPBACK}:{port + 1}/proxy"
            print(f"look: http://{LOOPBACK}:{port}/?url={source} (Ctrl-C to stop)", flush=True)


def _is_open(port: int) -> bool:
    """Return whether a server accepts connections at a port of this computer."""
    try:
        socket.create_connection((LOOPBACK, port), timeout=1.0).close()
    except OSError:
        return False
    return True


@contextmanager
def _viewer(words: Iterable[str]) -> Iterator[subprocess.Popen]:
    """Start the viewer and wait until the viewer ends; SIGINT or SIGTERM to this process also ends the viewer.

    Raises:
        UserError: the viewer failed.
    """
    before = signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    # new process group: a signal to `python -m rerun` alone would not reach the child process of rerun
    process = subprocess.Popen([sys.executable, "-m", "rerun", *words], start_new_session=True)
    try:
        yield process
        status = process.wait()
    finally:
        if process.poll() is None:
            _end_group(process)
        signal.signal(signal.SIGTERM, before)
    if status:
        raise UserError(f"look: the rerun viewer failed with exit status {status}")


def _end_group(process: subprocess.Popen) -> None:
    """End a process and its children."""
    os.killpg(process.pid, signal.SIGTERM)
    process.wait()
