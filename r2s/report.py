"""What a person reads: figures (PNG), tables for the terminal, and the same tables in a report.md.

A table is a DataFrame of strings first, so that the terminal and the report say the same.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from r2s.friction import friction_torque
from r2s.identify import Identified
from r2s.parameters import UNITS
from r2s.robot import SIM_DT, Robot
from r2s.simulator import Dynamics
from r2s.viewer import Episode, colours

DPI = 120
MOST_POINTS = 4000  # of a line or a cloud in a figure
SUCCESS = {
    "success_5cm": "5 cm, %",
    "success_2cm": "2 cm, %",
    "success_1cm": "1 cm, %",
    "success_5mm": "5 mm, %",
}
LEGEND = "in brackets: 95 % interval; ?: the data cannot tell this value"


@contextmanager
def _panels(path: Path, count: int, columns: int, title: str, height: float = 2.3) -> Iterator[list[Axes]]:
    """Give `count` axes in a grid, with one legend for all, and save the figure to `path`."""
    rows = -(-count // columns)
    figure = Figure(figsize=(12, 0.9 + height * rows), dpi=DPI, layout="constrained")
    axes = [figure.add_subplot(rows, columns, i + 1) for i in range(count)]
    yield axes
    for axis in axes:
        axis.grid(alpha=0.3, linewidth=0.6)
        axis.spines[["top", "right"]].set_visible(False)
        axis.title.set_fontsize(10)
    figure.suptitle(title, fontsize=13, fontweight="bold")
    named = {name: line for axis in axes for line, name in zip(*axis.get_legend_handles_labels(), strict=True)}
    if named:
        figure.legend(
            named.values(), named.keys(), loc="outside lower center", ncols=min(len(named), 6), frameon=False
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def _joint_panels(path: Path, n: int, title: str):
    return _panels(path, n, 2 if n > 3 else 1, title)


def _log_axis(axis: Axes, ticks: Sequence[float] = (1.0, 2.0, 5.0)) -> None:
    """Make y logarithmic, with numbers that people read at these `ticks` of every decade."""
    axis.set_yscale("log")
    axis.yaxis.set_major_locator(LogLocator(subs=ticks))
    axis.yaxis.set_major_formatter("{x:g}")
    axis.yaxis.set_minor_formatter(NullFormatter())


def _thin(count: int, most: int = MOST_POINTS) -> slice:
    return slice(None, None, max(1, -(-count // most)))


def torque_figure(
    path: Path, t: np.ndarray, measured: np.ndarray, predicted: Mapping[str, np.ndarray], title: str
) -> Path:
    """Draw measured (T, n) and predicted {label: (T, n)} torque, Nm, over t (T,) s: the paper's fig. 4."""
    colour, some = colours(["measured", *predicted]), _thin(len(t))
    with _joint_panels(path, measured.shape[1], title) as axes:
        for j, axis in enumerate(axes):
            axis.plot(
                t[some],
                measured[some, j],
                color=colour["measured"],
                linewidth=2.2,
                alpha=0.7,
                label="measured",
            )
            scores = []
            for label, tau in predicted.items():
                axis.plot(t[some], tau[some, j], color=colour[label], linewidth=0.9, label=label)
                scores.append(f"{label} {np.sqrt(np.mean((tau[:, j] - measured[:, j]) ** 2)):.3g}")
            axis.set_title(f"joint {j + 1}: RMSE {', '.join(scores)} Nm", loc="left")
            axis.set(xlabel="time, s", ylabel="torque, Nm", xlim=(t[0], t[-1]))
    return path


def position_figure(
    path: Path, windows_q: np.ndarray, predicted: Mapping[str, np.ndarray], dt: float = SIM_DT
) -> Path:
    """Draw the open-loop joint error of predicted {label: (W, S, n)} rad against windows_q (W, S, n).

    Lines are medians over the W windows, bands hold 90 % of them; one of the S rows per `dt` s.
    """
    colour, t = colours(predicted), dt * np.arange(1, windows_q.shape[1] + 1)
    title = f"open-loop error over {len(windows_q)} windows: median and 90 % band"
    early = windows_q.shape[1] // 20  # before that the error is still the noise of the start
    with _joint_panels(path, windows_q.shape[2], title) as axes:
        for j, axis in enumerate(axes):
            bottom = np.inf
            for label, q in predicted.items():
                error = 1e3 * np.abs(q[..., j] - windows_q[..., j])
                low, median, high = np.quantile(error, [0.05, 0.5, 0.95], axis=0)
                axis.fill_between(t, low, high, color=colour[label], alpha=0.2, linewidth=0)
                axis.plot(t, median, color=colour[label], label=label)
                bottom = min(bottom, max(median[early], 1e-3) / 5)
            _log_axis(axis, ticks=(1.0,))
            axis.set_ylim(bottom=bottom)
            axis.set_title(f"joint {j + 1}", loc="left")
            axis.set(xlabel="time since the measured start, s", ylabel="error, mrad", xlim=(0, t[-1]))
    return path


def friction_figure(
    path: Path,
    dynamics: Mapping[str, Dynamics],
    dq_max: np.ndarray,
    data: tuple[np.ndarray, np.ndarray] | None = None,
) -> Path:
    """Draw friction over speed up to dq_max (n,) rad/s, and bars at rest for the breakaway edges.

    `data` is (dq (T, n) rad/s, friction torque (T, n) Nm) from a recording.
    """
    colour = colours(dynamics)
    with _joint_panels(path, len(dq_max), "friction over speed") as axes:
        for j, axis in enumerate(axes):
            if data is not None:
                some = _thin(len(data[0]))
                cloud = {"marker": ".", "linestyle": "", "color": "#9aa0a6", "alpha": 0.35}
                axis.plot(data[0][some, j], data[1][some, j], markersize=2.5, markeredgewidth=0, **cloud)
                axis.plot([], [], markersize=9, label="recording", **cloud)
            speed = np.linspace(-dq_max[j], dq_max[j], 801)
            for label, d in dynamics.items():
                axis.plot(speed, friction_torque(speed, d.phi[j]), color=colour[label], label=label)
                if np.any(d.breakaway[j]):
                    edges = {
                        "marker": "_",
                        "markersize": 14,
                        "markeredgewidth": 2,
                        "linewidth": 1,
                        "linestyle": ":",
                    }
                    axis.plot([0, 0], d.breakaway[j], color=colour[label], label=f"breakaway, {label}", **edges)
            axis.set_title(f"joint {j + 1}", loc="left")
            axis.set(xlabel="speed, rad/s", ylabel="friction, Nm", xlim=(-dq_max[j], dq_max[j]))
    return path


def convergence_figure(path: Path, history: pd.DataFrame) -> Path:
    """Draw the cost over seconds, a colour per search; what has no cost (the breakaway scan) is shaded."""
    stages = (history["search"] != history["search"].shift()).cumsum()
    colour = colours(history["search"])
    with _panels(path, 1, 1, "convergence of the identification", height=4.2) as (axis,):
        began = 0.0
        for _, rows in history.groupby(stages):
            label, ended = rows["search"].iloc[0], rows["seconds"].iloc[-1]
            cost = rows.get("cost", pd.Series(dtype=float)).dropna()
            if len(cost):
                name = f"{label}: {rows['evaluations'].iloc[-1]:.0f} evaluations"
                seconds = rows.loc[cost.index, "seconds"]
                axis.plot(seconds, cost, label=name, color=colour[label], marker="o", markersize=3.5)
            else:
                axis.axvspan(began, ended, color=colour[label], alpha=0.2, label=label)
            began = ended
        axis.set_yscale("log")
        axis.set(xlabel="seconds", ylabel="cost (sum of squared, weighted residuals)")
    return path


def learning_figure(path: Path, runs: Mapping[str, pd.DataFrame]) -> Path:
    """Draw success at 5, 2 and 1 cm and the paper's return over minutes; runs are {name: evaluations.csv}."""
    shown = {
        "success_5cm": "success at 5 cm, %",
        "success_2cm": "success at 2 cm, %",
        "success_1cm": "success at 1 cm, %",
        "return_paper": "return, eq. (2) over 4 s",
    }
    colour = colours(runs)
    with _panels(path, len(shown), 2, "learning", height=3.0) as axes:
        for axis, (column, title) in zip(axes, shown.items(), strict=True):
            scale = 100 if column in SUCCESS else 1
            for label, table in runs.items():
                if column in table:
                    minutes = table["wall_clock_s"] / 60
                    axis.plot(minutes, scale * table[column], color=colour[label], marker=".", label=label)
            if column in SUCCESS:
                axis.set_ylim(-3, 103)
            axis.set_title(title, loc="left")
            axis.set_xlabel("wall clock, minutes")
    return path


def reach_figure(path: Path, episodes: Mapping[str, Sequence[Episode]]) -> Path:
    """Draw the distance to up to four goals over time, one line per label: MuJoCo against the arm."""
    colour = colours(episodes)
    count = max(1, min(4, max((len(e) for e in episodes.values()), default=0)))
    with _panels(path, count, min(count, 2), "distance to the goal", height=3.0) as axes:
        for k, axis in enumerate(axes):
            shown = {label: sequence[k] for label, sequence in episodes.items() if k < len(sequence)}
            for label, episode in shown.items():
                distance = 100 * np.maximum(episode.distance, 1e-5)
                axis.plot(episode.t - episode.t[0], distance, color=colour[label], label=label)
            for level in (5, 2, 1):
                axis.axhline(level, color="#555555", linewidth=0.7, linestyle=":")
            _log_axis(axis)
            goal = next((f" at ({', '.join(f'{x:.2f}' for x in e.goal)}) m" for e in shown.values()), "")
            axis.set_title(f"goal {k + 1}{goal}", loc="left")
            axis.set(xlabel="time, s", ylabel="distance, cm")
    return path


def identification_tables(robot: Robot, identified: Identified, summary: Mapping) -> dict[str, pd.DataFrame]:
    """Return {title: table}: parameters and, where `summary` (summary.json) has them, prediction errors."""
    joints = [str(j + 1) for j in range(robot.n)]
    parameters = pd.DataFrame(_parameter_cells(identified), index=pd.Index(joints, name="joint"))
    blocks = [parameters.iloc[:, i : i + 5] for i in range(0, parameters.shape[1], 5)]
    tables = {f"parameters, nominal → identified{' (continued)' * (i > 0)}": b for i, b in enumerate(blocks)}
    edges = identified.dynamics.breakaway
    if np.any(edges):
        shown = {f"joint {j}": [f"{edge:.3g}" for edge in edges[i]] for i, j in enumerate(joints)}
        tables["breakaway, Nm"] = pd.DataFrame(shown, index=pd.Index(["negative", "positive"], name="edge"))
    sides = {side: summary[side] for side in ("train", "validation") if side in summary}
    for key, title in (
        ("torque_rmse_Nm", "torque RMSE, Nm"),
        ("position_rmse_mrad", "replayed position RMSE, mrad"),
    ):
        columns = {side: _pair(errors, key) for side, errors in sides.items() if key in errors}
        if columns:
            tables[title] = _before_after(columns, pd.Index([*joints, "mean"], name="joint"))
    reached = {side: e["ee_error_mm"] for side, e in sides.items() if e.get("ee_error_mm")}
    if reached:
        horizons = sorted({h for errors in reached.values() for h in errors}, key=float)
        columns = {}
        for side, errors in reached.items():
            before = sides[side].get("nominal_ee_error_mm", {})
            columns[side] = (
                [before.get(h, np.nan) for h in horizons],
                [errors.get(h, np.nan) for h in horizons],
            )
        index = pd.Index([f"{h} s" for h in horizons], name="open loop for")
        tables["end-effector error, mm"] = _before_after(columns, index)
    return tables


def _parameter_cells(identified: Identified) -> dict[str, list[str]]:
    """Return {block with unit: n cells "old → new, interval, ? where the data could not tell"}."""
    space, cells = identified.space, {}
    for block in space.blocks:
        parts = (space.start, identified.x, *identified.interval, identified.identifiable)
        rows = zip(*(space.block(part, block) for part in parts), strict=True)
        unit = "" if UNITS[block] == "1" else f", {UNITS[block]}"
        cells[f"{block}{unit}"] = [
            f"{old:.3g} → {new:.3g}{'' if known else ' ?'}\n[{low:.3g}, {high:.3g}]"
            for old, new, low, high, known in rows
        ]
    return cells


def _pair(errors: Mapping, key: str) -> tuple[list[float], list[float]]:
    """Return (nominal, identified), their means appended."""
    before, after = errors.get(f"nominal_{key}", [np.nan] * len(errors[key])), errors[key]
    return [*before, float(np.mean(before))], [*after, float(np.mean(after))]


def _before_after(columns: Mapping[str, tuple[Sequence[float], Sequence[float]]], index: pd.Index) -> pd.DataFrame:
    """Return nominal, identified and their ratio, for each side of the split."""
    table = {}
    for side, (before, after) in columns.items():
        table[f"{side}\nnominal"] = [_number(b) for b in before]
        table[f"{side}\nidentified"] = [_number(a) for a in after]
        table[f"{side}\nratio"] = [
            _number(a / b if b else np.nan, "{:.2f}") for b, a in zip(before, after, strict=True)
        ]
    return pd.DataFrame(table, index=index)


def _number(value: float | None, form: str = "{:.3g}") -> str:
    return "-" if value is None or not np.isfinite(value) else form.format(value)


def identification_table(console: Console, robot: Robot, identified: Identified, summary: Mapping) -> None:
    """Print what `identification_tables` returns."""
    for title, table in identification_tables(robot, identified, summary).items():
        print_table(console, table, title, LEGEND if title.startswith("parameters") else None)


def reach_rows(rows: Mapping[str, Mapping]) -> pd.DataFrame:
    """Return one row per label from dicts with the keys of evaluations.csv (success from 0 to 1)."""
    table = {}
    for label, row in rows.items():
        cells = {
            title: _number(100 * row[key] if row.get(key) is not None else None, "{:.1f}")
            for key, title in SUCCESS.items()
        }
        distance = row.get("distance_median_m")
        cells["median distance, mm"] = _number(None if distance is None else 1e3 * distance, "{:.1f}")
        cells["return"] = _number(row.get("return_paper"), "{:.1f}")
        table[label] = cells
    return pd.DataFrame.from_dict(table, orient="index").rename_axis("success within")


def reach_table(console: Console, rows: Mapping[str, Mapping], title: str) -> None:
    """Print what `reach_rows` returns."""
    print_table(console, reach_rows(rows), title)


def print_table(console: Console, frame: pd.DataFrame, title: str, caption: str | None = None) -> None:
    """Print a table of strings; cells that end in "?" on their first line are dimmed."""
    table = Table(
        title=title,
        caption=caption,
        title_justify="left",
        caption_justify="left",
        title_style="bold",
        box=SIMPLE_HEAD,
    )
    table.add_column(str(frame.index.name or ""))
    for column in frame.columns:
        table.add_column(str(column), justify="right")
    for label, row in frame.iterrows():
        cells = [escape(str(cell)) for cell in row]
        table.add_row(
            escape(str(label)), *(f"[dim]{c}[/dim]" if c.split("\n")[0].endswith("?") else c for c in cells)
        )
    console.print(table)


def report_markdown(path: Path, sections: Mapping[str, Sequence[str | pd.DataFrame | Path]]) -> Path:
    """Write report.md: {heading: paragraphs, tables and figures}; the first heading is the title.

    Figures are linked relative to the report, so that the run folder can be moved.
    """
    lines: list[str] = []
    for i, (heading, items) in enumerate(sections.items()):
        lines += [f"{'#' if i == 0 else '##'} {heading}", ""]
        for item in items:
            lines += [_markdown(item, path.parent), ""]
    path.write_text("\n".join(lines).rstrip() + "\n")
    return path


def _markdown(item: str | pd.DataFrame | Path, folder: Path) -> str:
    if isinstance(item, Path):
        return f"![{item.stem}]({Path(os.path.relpath(item, folder)).as_posix().replace(' ', '%20')})"
    if isinstance(item, str):
        return item
    head = [str(item.index.name or ""), *map(str, item.columns)]
    body = [[str(label), *map(str, row)] for label, row in zip(item.index, item.to_numpy(), strict=True)]
    rows = [head, ["---", *["---:"] * len(item.columns)], *body]
    return "\n".join("| " + " | ".join(c.replace("|", "\\|").replace("\n", "<br>") for c in r) + " |" for r in rows)
