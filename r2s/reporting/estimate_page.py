"""Figures and rerun recording of stage=estimate: each value over time, with its 95 % interval."""

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import rerun as rr

from r2s.files import atomic_write
from r2s.reporting.figures.colours import colours
from r2s.reporting.figures.panels import panels
from r2s.reporting.viewer.layout import log_series

LINE_WIDTH, EDGE_WIDTH = 1.6, 0.6  # of the estimate and of the edges of its interval, in rerun


def draw_estimate(payload: Path, friction: Path, rows: pd.DataFrame, changes: Sequence[float]) -> list[Path]:
    """Draw the table of `offline_estimation.table` over time: payload, and friction per joint, to these two files."""
    t, colour = rows["t"].to_numpy(), colours(["estimate"])["estimate"]

    def band(axis, name: str, title: str, label: str, scale: float = 1.0) -> None:
        x, half = scale * rows[name].to_numpy(), scale * rows[f"{name}_half"].to_numpy()
        axis.fill_between(t, x - half, x + half, color=colour, alpha=0.25, linewidth=0, label="95 %")
        axis.plot(t, x, color=colour, linewidth=1.2, label="estimate")
        for at in changes:
            axis.axvline(at, color="#cc0018", linewidth=0.8, label="payload changed")
        axis.set_title(title, loc="left")
        axis.set(xlabel="time, s", ylabel=label, xlim=(0, t[-1]))

    with panels(payload, 4, 2, "payload") as axes:
        band(axes[0], "mass_kg", "mass", "kg")
        axes[0].set_ylim(-0.1, max(0.2, 1.2 * rows["mass_kg"].max()))
        for axis, way in zip(axes[1:], "xyz", strict=True):
            band(axis, f"centre_{way}_m", f"centre, {way} in the payload frame", "cm", 100.0)
            axis.set_ylim(-10, 10)
    joints = sum(name.startswith("friction_") and not name.endswith("_half") for name in map(str, rows))
    with panels(friction, joints, 2 if joints > 3 else 1, "friction relative to the identified model") as axes:
        for j, axis in enumerate(axes):
            band(axis, f"friction_{j + 1}", f"joint {j + 1}", "%", 100.0)
            axis.set_ylim(40, 160)
    return [payload, friction]


def write_estimate_recording(path: Path, rows: pd.DataFrame) -> Path:
    """Write a rerun recording: each column of the table over `time`, with the edges of its interval."""
    stream = rr.RecordingStream(f"r2s {path.absolute().parent.name.replace('.', '-')}")
    index = [rr.TimeColumn("time", duration=rows["t"].to_numpy())]
    colour = colours(["estimate"])["estimate"]
    with atomic_write(path) as part:
        stream.save(part)
        for name in rows.columns:
            if name == "t" or name.endswith("_half"):
                continue
            x = rows[name].to_numpy(dtype=float)
            lines = {"estimate": (x, LINE_WIDTH)}
            if f"{name}_half" in rows:
                half = rows[f"{name}_half"].to_numpy()
                lines |= {"low": (x - half, EDGE_WIDTH), "high": (x + half, EDGE_WIDTH)}
            for label, (values, width) in lines.items():
                log_series(stream, f"{name}/{label}", index, values, label, colour, width)
        stream.flush()
        stream.disconnect()
    return path
