"""Write a recording (.rrd) for the Rerun viewer: arms side by side, torques, learning curves and figures.

One file contains everything, because two Rerun recordings cannot share a timeline. Episodes and torque overlays use
the timeline `time`; learning curves use the timelines `env_steps` and `wall_clock`. The command `rerun FILE` plays
the episodes.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import rerun as rr

from r2s.files import atomic_write
from r2s.physics.robot import Robot
from r2s.reporting.figures.colours import colours
from r2s.reporting.figures.log_rows import at_rate, without_pauses
from r2s.reporting.viewer.arms import GOAL, log_arms
from r2s.reporting.viewer.data import Content, Overlay
from r2s.reporting.viewer.layout import LEARNING, blueprint, entity, log_series, starts_of
from r2s.tasks.measures import Measure

OVERLAY_HZ = 100.0  # Hz, rate at which torque overlays are drawn: ten times the cutoff of the torque's low-pass


def write_recording(path: str | os.PathLike, robot: Robot, content: Content) -> Path:
    """Write the content to `path` (.rrd), and return the path."""
    path = Path(path)
    episodes = {label: sequence for label, sequence in content.episodes.items() if sequence}
    content = replace(content, episodes=episodes)
    name = path.absolute().parent.name.replace(".", "-")  # name of the viewer's stored layout, without dots
    stream = rr.RecordingStream(f"r2s {name}")
    with atomic_write(path) as part:
        stream.save(part, default_blueprint=blueprint(robot, content))
        if episodes and content.measures:
            log_arms(stream, robot, episodes, content.measures.error)
            if content.torque is not None:
                _limits(stream, content.torque, float(starts_of(episodes)[-1]))
        for label, overlay in content.overlays.items():
            _overlay(stream, label, overlay)
        _learning(stream, content.curves, content.learning)
        for name, picture in content.figures.items():
            stream.log(entity("figures", name), rr.EncodedImage(path=picture), static=True)
        stream.flush()
        stream.disconnect()
    return path


def _limits(stream: rr.RecordingStream, torque: np.ndarray, seconds: float) -> None:
    index = [rr.TimeColumn("time", duration=np.array([0.0, seconds]))]
    for j, limit in enumerate(torque):
        for side, sign in (("upper", 1.0), ("lower", -1.0)):
            path = entity("command", f"joint {j + 1}", f"{side} limit")
            log_series(stream, path, index, np.full(2, sign * limit), f"{side} limit", GOAL, 0.8)


def _overlay(stream: rr.RecordingStream, label: str, overlay: Overlay) -> None:
    """Log one torque plot per joint; numbered entity paths put the broad measured line behind the predicted lines."""
    clock, _ = without_pauses(overlay.t)
    rows = at_rate(clock, OVERLAY_HZ)
    index = [rr.TimeColumn("time", duration=clock[rows])]
    lines = {"measured": overlay.measured, **overlay.predicted}
    palette = colours(lines)
    for i, (name, torque) in enumerate(lines.items()):
        for j in range(torque.shape[1]):
            path = entity("torque", label, f"joint {j + 1}", f"{i + 1} {name}")
            width = {"width": 4.0} if name == "measured" else {}
            log_series(stream, path, index, torque[rows, j], name, palette[name], **width)


def _learning(stream: rr.RecordingStream, curves: Mapping[str, pd.DataFrame], measures: Sequence[Measure]) -> None:
    palette = colours(curves)
    for run, table in curves.items():
        index = [
            rr.TimeColumn("env_steps", sequence=table["env_steps"].to_numpy(int)),
            rr.TimeColumn("wall_clock", duration=table["wall_clock_s"].to_numpy(float)),
        ]
        for m in measures:
            if m.key in table:
                values = m.scale * table[m.key].to_numpy(float)
                log_series(stream, entity(LEARNING, m.title, run), index, values, run, palette[run])
