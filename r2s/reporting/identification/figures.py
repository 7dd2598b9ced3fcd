"""Draw the figures of an identification: torque, open-loop position, friction, convergence."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import SIM_DT
from r2s.reporting.figures.colours import colours
from r2s.reporting.figures.log_rows import thin, without_pauses
from r2s.reporting.figures.panels import joint_panels, log_axis, panels

LONGEST = 30.0  # s of torque in a figure; more would look like a solid band
SCANS = {  # search without comparable costs -> title and color of its shaded area
    "family": ("comparison of friction families", "#9aa0a6"),
    "terms": ("choice of terms", "#57ab5a"),
    "breakaway": ("search for breakaway", "#c9a227"),
}
BARS: dict[str, Any] = {"marker": "_", "markersize": 14, "markeredgewidth": 2, "linewidth": 1, "linestyle": ":"}
CLOUD: dict[str, Any] = {"marker": "o", "linestyle": "", "color": "#6e7781", "markeredgewidth": 0}


def torque_figure(
    path: Path, t: np.ndarray, measured: np.ndarray, predicted: Mapping[str, np.ndarray], title: str
) -> Path:
    """Draw measured torque (T, n) Nm and predicted torque {label: (T, n) Nm} over times t (T,) s (paper, figure 4).

    The figure shows the first `LONGEST` seconds, with shortened pauses. The RMSE in the titles covers all rows.
    """
    colour, (clock, pauses) = colours(["measured", *predicted]), without_pauses(t)
    rows = np.flatnonzero(clock <= LONGEST)
    title += f" (the first {LONGEST:g} s of {clock[-1]:.0f} s)" if len(rows) < len(t) else ""
    rows = rows[thin(len(rows))]
    breaks = np.searchsorted(rows, pauses[pauses <= rows[-1]])  # nan at a pause interrupts the line

    def line(values: np.ndarray) -> np.ndarray:
        return np.insert(values[rows], breaks, np.nan)

    with joint_panels(path, measured.shape[1], title) as axes:
        for j, axis in enumerate(axes):
            x = line(clock)
            axis.plot(x, line(measured[:, j]), color=colour["measured"], linewidth=2.2, alpha=0.7, label="measured")
            scores = []
            for label, tau in predicted.items():
                axis.plot(x, line(tau[:, j]), color=colour[label], linewidth=0.9, label=label)
                scores.append(f"{label} {np.sqrt(np.nanmean((tau[:, j] - measured[:, j]) ** 2)):.3g}")
            axis.set_title(f"joint {j + 1}: RMSE {', '.join(scores)} Nm", loc="left")
            seconds = "time, s, pauses cut short" if len(pauses) else "time, s"
            axis.set(xlabel=seconds, ylabel="torque, Nm", xlim=(0, clock[rows[-1]]))
    return path


def position_figure(
    path: Path, windows_q: np.ndarray, predicted: Mapping[str, np.ndarray], dt: float = SIM_DT
) -> Path:
    """Draw the open-loop error |q - windows_q| in mrad of predicted joint angles {label: q (W, S, n) rad}.

    `windows_q` (W, S, n) rad contains the measured joint angles of W windows of S rows; rows are `dt` s apart. Lines
    are medians over the windows; bands contain 90 % of the windows.
    """
    colour, t = colours(predicted), dt * np.arange(1, windows_q.shape[1] + 1)
    title = f"open-loop error over {len(windows_q)} windows: median and 90 % band"
    early = windows_q.shape[1] // 20  # before this row, the error is mainly noise of the start state
    with joint_panels(path, windows_q.shape[2], title) as axes:
        for j, axis in enumerate(axes):
            bottom = np.inf
            for label, q in predicted.items():
                error = 1e3 * np.abs(q[..., j] - windows_q[..., j])
                low, median, high = np.quantile(error, [0.05, 0.5, 0.95], axis=0)
                axis.fill_between(t, low, high, color=colour[label], alpha=0.2, linewidth=0)
                axis.plot(t, median, color=colour[label], label=label)
                bottom = min(bottom, max(median[early], 1e-3) / 5)
            log_axis(axis, ticks=(1.0,))
            axis.set_ylim(bottom=bottom)
            axis.set_title(f"joint {j + 1}", loc="left")
            axis.set(xlabel="time since the measured start, s", ylabel="error, mrad", xlim=(0, t[-1]))
    return path


def friction_figure(
    path: Path,
    dynamics: Mapping[str, Dynamics],
    dq_max: np.ndarray,
    data: tuple[np.ndarray, np.ndarray] | None = None,
    draws: np.ndarray | None = None,
) -> Path:
    """Draw friction over speed up to dq_max (n,) rad/s, and breakaway torques as bars at zero speed.

    Args:
        path: file of the figure (PNG). dynamics: {label: model}. dq_max: (n,) rad/s, largest speeds on the axes.
        data: speed (T, n) rad/s and friction torque (T, n) Nm of a recording.
        draws: (S, n, K), S posterior draws of the K friction parameters of the last model, for the 95 % band.
    """
    colour = colours(dynamics)
    grid = np.linspace(-1, 1, 401)
    speed = (np.sign(grid) * np.abs(grid) ** 1.5)[:, None] * dq_max  # denser near rest, where friction reverses
    with joint_panels(path, len(dq_max), "friction over speed") as axes:
        for j, axis in enumerate(axes):
            seen = []
            if data is not None:
                some = thin(len(data[0]))
                axis.plot(data[0][some, j], data[1][some, j], markersize=1.8, alpha=0.45, zorder=3, **CLOUD)
                axis.plot([], [], markersize=6, label="recording", **CLOUD)
                seen.append(np.quantile(data[1][:, j], [0.005, 0.995]))
            for label, d in dynamics.items():
                curve = d.friction(speed)[:, j]
                axis.plot(speed[:, j], curve, color=colour[label], label=label)
                seen.append(curve)
                if np.any(d.breakaway[j]) and not d.family.has_memory:
                    axis.plot([0, 0], d.breakaway[j], color=colour[label], label=f"breakaway, {label}", **BARS)
                    seen.append(d.breakaway[j])
            low, high = min(x.min() for x in seen), max(x.max() for x in seen)
            if draws is not None:
                label, d = list(dynamics.items())[-1]
                torque = d.family.torque(speed[:, None, [j]], draws[:, [j]])[..., 0]
                low, high = _band(axis, speed[:, j], torque, (low, high), colour[label], label)
            margin = 0.05 * (high - low) + 1e-6
            axis.set_title(f"joint {j + 1}", loc="left")
            axis.set(xlabel="speed, rad/s", ylabel="friction, Nm", xlim=(-dq_max[j], dq_max[j]))
            axis.set_ylim(low - margin, high + margin)
    return path


def _band(
    axis: Axes, speed: np.ndarray, torque: np.ndarray, limits: tuple[float, float], colour: str, label: str
) -> tuple[float, float]:
    """Draw the 95 % band of S torque draws (T, S) Nm; return y limits that show all curves but cut a wide band."""
    low, high = limits
    bottom, top = np.quantile(torque, [0.025, 0.975], axis=1)
    axis.fill_between(speed, bottom, top, label=f"95 % band, {label}", color=colour, alpha=0.25, linewidth=0)
    most = 0.4 * (high - low)
    return min(low, max(bottom.min(), low - most)), max(high, min(top.max(), high + most))


def convergence_figure(path: Path, history: pd.DataFrame) -> Path:
    """Draw the cost of each search over time, relative to its first cost; for searches in SCANS, shade the duration.

    Costs are comparable only within one search, because each search uses new weights of the residuals.
    """
    history = history.assign(seconds=_running(history["seconds"].to_numpy(float)))
    name = history["search"].astype(str)
    search = (name != name.shift()) | (history["done"] <= history["done"].shift())
    colour = colours(name.where(~name.str.startswith("family"), "family"))
    with panels(path, 1, 1, "convergence of the identification", height=4.2) as (axis,):
        began, evaluations, lowest = 0.0, dict.fromkeys(colour, 0.0), 1.0
        for _, rows in history.groupby(search.cumsum()):
            label = str(rows["search"].iloc[0])
            kind, ended = label.split(" ")[0].rstrip(","), rows["seconds"].iloc[-1]
            if kind in SCANS:
                title, shade = SCANS[kind]
                axis.axvspan(began, ended, color=shade, alpha=0.2, linewidth=0, label=title)
            else:
                evaluations[label] += rows["evaluations"].iloc[-1]
                cost = rows["cost"].dropna()
                relative = cost / cost.iloc[0]
                lowest = min(lowest, relative.min())
                axis.plot(rows.loc[cost.index, "seconds"], relative, color=colour[label], marker="o", markersize=3.5)
            began = ended
        for label, count in evaluations.items():
            if count:
                title = f"{label}: {count:.0f} evaluations"
                axis.plot([], [], color=colour[label], marker="o", markersize=3.5, label=title)
        log_axis(axis)
        axis.set_ylim(min(lowest / 1.3, 0.45), 1.3)  # at least two ticks
        axis.set_xlim(left=0)
        axis.set(xlabel="seconds", ylabel="cost relative to the start of the search")
    return path


def _running(seconds: np.ndarray) -> np.ndarray:
    """Convert `seconds` (K,), which restart at 0 when a run is resumed, to one increasing clock (K,) s."""
    steps = np.diff(seconds, prepend=0.0)
    return np.cumsum(np.where(steps < 0, seconds, steps))
