"""Draw figures and write the Rerun recording of stage=estimate: each estimate over time, with its 95 % interval."""

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import rerun as rr
import rerun.blueprint as rrb

from r2s.files import atomic_write
from r2s.physics.robot import Robot
from r2s.recordings.recording import Recording
from r2s.reporting.figures.colours import colours
from r2s.reporting.figures.log_rows import at_rate
from r2s.reporting.figures.panels import panels
from r2s.reporting.viewer.layout import log_series
from r2s.reporting.wrench_page import DRAWN_HZ, FORCES, log_wrench

LINE_WIDTH, EDGE_WIDTH = 1.6, 0.6  # line widths in the Rerun viewer: estimate, and limits of its 95 % interval


def draw_estimate(payload: Path, friction: Path, rows: pd.DataFrame, changes: Sequence[float]) -> list[Path]:
    """Draw the estimates of payload and friction in `rows` over time; mark payload changes (times `changes`, s)."""
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


def write_estimate_recording(
    path: Path, robot: Robot, recording: Recording, rows: pd.DataFrame, wrench: pd.DataFrame
) -> Path:
    """Write a Rerun recording: the arm, the force on the arm, and each estimate with its 95 % interval.

    Args:
        rows: table of the estimates, with a row per time `t`. wrench: table of the external force from
            `observe_recording`.
    """
    stream = rr.RecordingStream(f"r2s {path.absolute().parent.name.replace('.', '-')}")
    shown = [n for n in rows.columns if n not in wrench.columns and not n.endswith("_half")]
    with atomic_write(path) as part:
        stream.save(part, default_blueprint=_layout(shown))
        log_wrench(stream, robot, recording, wrench)
        _log_columns(stream, wrench.iloc[at_rate(wrench["t"].to_numpy(), DRAWN_HZ)], [*FORCES, "in_contact"])
        _log_columns(stream, rows, shown)
        stream.flush()
        stream.disconnect()
    return path


def _log_columns(stream: rr.RecordingStream, table: pd.DataFrame, names: Sequence[str]) -> None:
    """Log the columns `names` of a table, with the limits of their 95 % intervals, over the column `t`."""
    index = [rr.TimeColumn("time", duration=table["t"].to_numpy())]
    colour = colours(["estimate"])["estimate"]
    for name in names:
        x = table[name].to_numpy(dtype=float)
        lines = {"estimate": (x, LINE_WIDTH)}
        if f"{name}_half" in table:
            half = table[f"{name}_half"].to_numpy()
            lines |= {"low": (x - half, EDGE_WIDTH), "high": (x + half, EDGE_WIDTH)}
        for label, (values, width) in lines.items():
            log_series(stream, f"{name}/{label}", index, values, label, colour, width)


def _layout(names: Sequence[str]) -> rrb.Blueprint:
    """Return a layout of two tabs: the arm with plots of the external force, and one plot per estimate in `names`."""
    eye = rrb.EyeControls3D(position=[1.5, -1.1, 0.9], look_target=[0.35, 0.0, 0.4])
    legend = rrb.PlotLegend(visible=False)
    force = [rrb.TimeSeriesView(origin=f, name=f"force along {f[6]}, N", plot_legend=legend) for f in FORCES]
    touch = rrb.TimeSeriesView(origin="in_contact", name="contact", plot_legend=legend)
    scene = rrb.Spatial3DView(origin="arm", name="force on the arm, 1 cm per N", eye_controls=eye)
    first = rrb.Horizontal(scene, rrb.Vertical(*force, touch, row_shares=[3, 3, 3, 2]), name="force")
    rest = rrb.Grid(*[rrb.TimeSeriesView(origin=n, name=n) for n in names], name="estimates")
    sides = rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed")
    time = rrb.TimePanel(state="collapsed", timeline="time", play_state="playing")
    return rrb.Blueprint(rrb.Tabs(first, rest, active_tab=0), *sides, time)
