"""What stage=watch leaves to look at: the estimate with its band over time, as a figure and in rerun."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import rerun as rr

from r2s.files import whole
from r2s.reporting.colours import colours
from r2s.reporting.figures import panels

WIDE = 1.6


def watch_figures(carried: Path, friction: Path, known: pd.DataFrame, changes: Sequence[float]) -> list[Path]:
    """Draw what `listen`'s table says over time: payload to `carried`, friction per joint to `friction`."""
    t, colour = known["t"].to_numpy(), colours(["estimate"])["estimate"]

    def band(axis, name: str, title: str, label: str, scale: float = 1.0) -> None:
        x, half = scale * known[name].to_numpy(), scale * known[f"{name}_half"].to_numpy()
        axis.fill_between(t, x - half, x + half, color=colour, alpha=0.25, linewidth=0, label="95 %")
        axis.plot(t, x, color=colour, linewidth=1.2, label="estimate")
        for at in changes:
            axis.axvline(at, color="#cc0018", linewidth=0.8, label="payload changed")
        axis.set_title(title, loc="left")
        axis.set(xlabel="time, s", ylabel=label, xlim=(0, t[-1]))

    with panels(carried, 4, 2, "what the arm carries") as axes:
        band(axes[0], "mass_kg", "mass", "kg")
        axes[0].set_ylim(-0.1, max(0.2, 1.2 * known["mass_kg"].max()))
        for axis, way in zip(axes[1:], "xyz", strict=True):
            band(axis, f"centre_{way}_m", f"centre, {way} from the hand", "cm", 100.0)
            axis.set_ylim(-10, 10)
    joints = sum(name.startswith("friction_") and not name.endswith("_half") for name in map(str, known))
    with panels(friction, joints, 2 if joints > 3 else 1, "friction, share of what was believed") as axes:
        for j, axis in enumerate(axes):
            band(axis, f"friction_{j + 1}", f"joint {j + 1}", "%", 100.0)
            axis.set_ylim(40, 160)
    return [carried, friction]


def watch_recording(path: Path, known: pd.DataFrame) -> Path:
    """Write the same as a rerun recording: every number of the table over `time`, with the edges of its band."""
    stream = rr.RecordingStream(f"r2s {path.absolute().parent.name.replace('.', '-')}")
    index = [rr.TimeColumn("time", duration=known["t"].to_numpy())]
    colour = colours(["estimate"])["estimate"]
    rgb = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])
    with whole(path) as part:
        stream.save(part)
        for name in known.columns:
            if name == "t" or name.endswith("_half"):
                continue
            x = known[name].to_numpy(dtype=float)
            lines = {"estimate": (x, WIDE)}
            if f"{name}_half" in known:
                half = known[f"{name}_half"].to_numpy()
                lines |= {"low": (x - half, 0.6), "high": (x + half, 0.6)}
            for label, (values, width) in lines.items():
                at = f"{name}/{label}"
                stream.log(at, rr.SeriesLines(names=label, colors=rgb, widths=width), static=True)
                stream.send_columns(at, indexes=index, columns=rr.Scalars.columns(scalars=values))
        stream.flush()
        stream.disconnect()
    return path
