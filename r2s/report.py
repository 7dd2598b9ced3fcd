"""What a person reads: tables for the terminal, and the same in report.md and report.html.

A table is a DataFrame of strings first, so that the terminal and the reports say the same. What only the report of an
identification has is in r2s/report_identification.py, figures are in r2s/report_figures.py.
"""

import os
from base64 import b64encode
from collections.abc import Mapping, Sequence
from html import escape as escape_html
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from r2s.friction import BRISTLE
from r2s.identified import SHARPER, Identified
from r2s.parameters import LINK, UNITS, WHOLE_ARM, Estimate, ParameterSpace, inertia_scale
from r2s.robot import Robot

SUCCESS = {
    "success_5cm": "5 cm, %",
    "success_2cm": "2 cm, %",
    "success_1cm": "1 cm, %",
    "success_5mm": "5 mm, %",
}
UNSEEN = "nominal, unseen"
LEGEND = (
    f"[ ]: 95 % interval; ?: it is wider than {2 / SHARPER:g} standard deviations of the belief before; "
    f"{UNSEEN}: kept, the data hardly speak of it"
)
Item = str | list[str] | pd.DataFrame | Path  # of a report: paragraph, bullets, table, picture


def scores_rows(table: pd.DataFrame) -> pd.DataFrame:
    """Return one row of strings per group: interquartile mean [95 % interval] of each measure."""
    names = {m: title for m, title in SUCCESS.items() if m in set(table["measure"])}
    names |= {"distance_median_m": "median distance, mm", "return_paper": "return"}
    out: dict[str, dict[str, str]] = {}
    for r in table.to_dict("records"):
        scale = 100 if r["measure"] in SUCCESS else 1e3 if r["measure"] == "distance_median_m" else 1
        cells = out.setdefault(r["group"], {"seeds": str(r["seeds"])})
        middle, low, high = (scale * r[k] for k in ("iqm", "low", "high"))
        cells[names[r["measure"]]] = f"{middle:.1f} [{low:.1f}, {high:.1f}]"
    return pd.DataFrame.from_dict(out, orient="index").rename_axis("success within")


class Value(NamedTuple):
    """One number of a table: nominal, identified, 95 % interval, whether the data could tell or were silent."""

    old: float
    new: float
    low: float
    high: float
    known: bool = True
    unseen: bool = False

    def times(self, factor: float) -> "Value":
        """Return the value in another unit."""
        old, new, low, high = (factor * x for x in self[:4])
        return Value(old, new, low, high, self.known, self.unseen)

    @property
    def cell(self) -> str:
        """Return "old → new" over "[low, high]"; "?" where it is not identifiable."""
        if self.unseen:
            return f"{number(self.old)}\n{UNSEEN}"
        return f"{number(self.old)} → {self.found}\n{self.interval}"

    @property
    def found(self) -> str:
        """Return the new value, with "?" where it is not identifiable."""
        return number(self.new) + ("" if self.known else " ?")

    @property
    def interval(self) -> str:
        """Return "[low, high]"."""
        return UNSEEN if self.unseen else f"[{number(self.low)}, {number(self.high)}]"


def values(space: ParameterSpace, found: Estimate, block: str, unseen: Sequence[str] = ()) -> list[Value]:
    """Return what is known of a block: a `Value` per joint or link, or one of the whole arm."""
    silent = np.isin(space.names, list(unseen))
    parts = (space.start, found.x, found.low, found.high, found.identifiable, silent)
    return [Value(*row) for row in zip(*(space.block(part, block).tolist() for part in parts), strict=True)]


def named(block: str) -> str:
    """Return the title of a block's column, with its unit."""
    return block if UNITS[block] == "1" else f"{block}\n{UNITS[block]}"


def per_joint(robot: Robot, columns: Mapping[str, Sequence[str]], index: str = "joint") -> pd.DataFrame:
    """Return a table of n cells a column, a row per joint or link."""
    return pd.DataFrame(dict(columns), index=pd.Index([str(j + 1) for j in range(robot.n)], name=index))


def identification_tables(robot: Robot, identified: Identified, summary: Mapping) -> dict[str, pd.DataFrame]:
    """Return {title: table} for the terminal: parameters and, where `summary` (summary.json) has them, errors."""
    space, found, tables = identified.space, identified.found, {}
    own = [b for b in space.blocks if b not in WHOLE_ARM and b not in LINK]
    cells = {named(b): [v.cell for v in values(space, found, b, identified.unseen)] for b in own}
    blocks = per_joint(robot, cells)
    for i in range(0, blocks.shape[1], 5):
        tables[f"parameters, nominal → identified{' (continued)' * (i > 0)}"] = blocks.iloc[:, i : i + 5]
    arm = {b: values(space, found, b, identified.unseen)[0].times(1e3).cell for b in space.blocks if b in WHOLE_ARM}
    if arm:
        index = pd.Index([f"{b}, ms" for b in arm], name="whole arm")
        tables["actuation"] = pd.DataFrame({"nominal → identified": list(arm.values())}, index=index)
    if set(LINK) & set(space.blocks):
        tables["links, nominal → identified"] = _links(robot, identified)
    edges = identified.dynamics.breakaway
    if np.any(edges) and identified.dynamics.family != BRISTLE:  # bristles hold without a dead zone
        shown = {f"joint {j + 1}": [number(edge) for edge in edges[j]] for j in range(robot.n)}
        tables["breakaway, Nm"] = pd.DataFrame(shown, index=pd.Index(["negative", "positive"], name="edge"))
    return tables | error_tables(robot, summary)


def _links(robot: Robot, identified: Identified) -> pd.DataFrame:
    """Return one line per link: mass, how far its centre moved, and the scale of its tensor's trace."""
    space = identified.space
    before, after, draws = (space.dynamics(x) for x in (space.start, identified.x, identified.found.samples))

    def each(d):
        mass = robot.mass if d.mass is None else d.mass
        com = robot.com if d.com is None else d.com
        shift = 1e3 * np.linalg.norm(com - (robot.com if before.com is None else before.com), axis=-1)
        return mass, shift, inertia_scale(d.inertia, before.inertia)

    (mass, _, _), found = each(before), each(after)
    spans = [np.quantile(part, [0.025, 0.975], axis=0) for part in each(draws)]
    intervals = [[f"[{number(low)}, {number(high)}]" for low, high in span.T] for span in spans]
    known = dict(zip(space.names, identified.found.identifiable, strict=True))
    doubt = ["" if known.get(f"link_alpha[{j + 1}]", True) else " ?" for j in range(robot.n)]  # mass: alpha alone
    columns = {
        "mass, kg": [f"{number(a)} → {number(b)}{k}" for a, b, k in zip(mass, found[0], doubt, strict=True)],
        "95 %": intervals[0],
        "centre moved\nmm": [number(x, "{:.2f}") for x in found[1]],
        "tensor's trace\nof nominal": [number(x) for x in found[2]],
        "95 % ": intervals[2],
    }
    return per_joint(robot, columns, "link")


def error_tables(robot: Robot, summary: Mapping) -> dict[str, pd.DataFrame]:
    """Return {title: table} of the prediction errors in `summary` (summary.json): nominal, identified, ratio."""
    joints, tables = [str(j + 1) for j in range(robot.n)], {}
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


def _pair(errors: Mapping, key: str) -> tuple[list[float], list[float]]:
    """Return (nominal, identified), their means appended."""
    before, after = errors.get(f"nominal_{key}", [np.nan] * len(errors[key])), errors[key]
    return [*before, float(np.mean(before))], [*after, float(np.mean(after))]


def _before_after(columns: Mapping[str, tuple[Sequence[float], Sequence[float]]], index: pd.Index) -> pd.DataFrame:
    """Return nominal, identified and their ratio, for each side of the split."""
    table = {}
    for side, (before, after) in columns.items():
        table[f"{side}\nnominal"] = [number(b) for b in before]
        table[f"{side}\nidentified"] = [number(a) for a in after]
        table[f"{side}\nratio"] = [
            number(a / b if b else np.nan, "{:.2f}") for b, a in zip(before, after, strict=True)
        ]
    return pd.DataFrame(table, index=index)


def number(value: float | None, form: str = "{:.3g}") -> str:
    """Return a number as tables show it; "-" where there is none."""
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
            title: number(100 * row[key] if row.get(key) is not None else None, "{:.1f}")
            for key, title in SUCCESS.items()
        }
        distance = row.get("distance_median_m")
        cells["median distance, mm"] = number(None if distance is None else 1e3 * distance, "{:.1f}")
        cells["return"] = number(row.get("return_paper"), "{:.1f}")
        table[label] = cells
    return pd.DataFrame.from_dict(table, orient="index").rename_axis("success within")


def gap_rows(rows: Mapping[str, Mapping]) -> pd.DataFrame:
    """Return one row per label: how far from the simulation that the policy was trained in, and how it moved."""
    columns = {
        "path from simulation, mm": ("ee_path_rmse_mm", 1, "{:.2g}"),
        "torque from simulation, Nm": ("tau_rmse_Nm", 1, "{:.2g}"),
        "time to reach, s": ("time_to_reach_s", 1, "{:.2f}"),
        "overshoot, mm": ("overshoot_m", 1e3, "{:.1f}"),
        "stops": ("stops", 1, "{:.0f}"),
    }
    table = {
        label: {
            title: number(None if row.get(key) is None else scale * row[key], form)
            for title, (key, scale, form) in columns.items()
        }
        for label, row in rows.items()
    }
    return pd.DataFrame.from_dict(table, orient="index").rename_axis("")


def reach_table(console: Console, rows: Mapping[str, Mapping], title: str) -> None:
    """Print what `reach_rows` returns."""
    print_table(console, reach_rows(rows), title)


def print_table(console: Console, frame: pd.DataFrame, title: str, caption: str | None = None) -> None:
    """Print a table of strings; what is uncertain is dimmed."""
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
        table.add_row(escape(str(label)), *(f"[dim]{c}[/dim]" if _doubtful(c) else c for c in cells))
    console.print(table)


def _doubtful(cell: str) -> bool:
    """Whether a cell is of a value that the data tell little of."""
    return cell.split("\n")[0].endswith("?") or cell.endswith(UNSEEN)


def report_markdown(path: Path, sections: Mapping[str, Sequence[Item]]) -> Path:
    """Write report.md: {heading: paragraphs, bullets, tables and figures}; the first heading is the title.

    Figures are linked relative to the report, so that the run folder can be moved.
    """
    lines: list[str] = []
    for i, (heading, items) in enumerate(sections.items()):
        lines += [f"{'#' if i == 0 else '##'} {heading}", ""]
        for item in items:
            lines += [_markdown(item, path.parent), ""]
    path.write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")
    return path


def _markdown(item: Item, folder: Path) -> str:
    if isinstance(item, Path):
        return f"![{item.stem}]({Path(os.path.relpath(item, folder)).as_posix().replace(' ', '%20')})"
    if isinstance(item, str):
        return item
    if isinstance(item, list):
        return "\n".join(f"- {line}" for line in item)
    head, *body = _rows(item)
    rows = [head, ["---", *["---:"] * len(item.columns)], *body]
    return "\n".join("| " + " | ".join(c.replace("|", "\\|").replace("\n", "<br>") for c in r) + " |" for r in rows)


def _rows(table: pd.DataFrame) -> list[list[str]]:
    """Return a table's cells, the header first, the index in front."""
    head = [str(table.index.name or ""), *map(str, table.columns)]
    return [head, *([str(k), *map(str, row)] for k, row in zip(table.index, table.to_numpy(), strict=True))]


STYLE = """
body { margin: 2rem auto; max-width: 80rem; padding: 0 1.5rem; color: #1f2328; background: #fff;
  font: 15px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
h1 { font-size: 1.7rem; margin: 0 0 1rem; }
h2 { font-size: 1.2rem; margin: 2.6rem 0 .6rem; padding-top: .8rem; border-top: 1px solid #d8dee4; }
nav { margin: 1.2rem 0; padding: .7rem 1rem; background: #f6f8fa; border-radius: 6px; }
nav a { margin-right: 1.2rem; white-space: nowrap; color: #0969da; text-decoration: none; }
p, ul { max-width: 56rem; }
.wide { overflow-x: auto; margin: .8rem 0 1.4rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .3rem .8rem; text-align: right; white-space: nowrap; border-bottom: 1px solid #e4e8ec; }
th { vertical-align: bottom; border-bottom: 2px solid #afb8c1; }
th:first-child, td:first-child { text-align: left; }
small { color: #59636e; }
td.doubtful, td.doubtful small { color: #8c959f; }
figure { margin: 1rem 0 1.6rem; }
img { max-width: 100%; height: auto; }
"""


def report_html(path: Path, sections: Mapping[str, Sequence[Item]]) -> Path:
    """Write report.html: what `report_markdown` takes as one file, pictures inside; no script, nothing is loaded."""
    title, *rest = sections
    names = {heading: f"s{i}" for i, heading in enumerate(rest, 1)}
    parts = [
        f"<!DOCTYPE html>\n<html lang='en'>\n<head>\n<meta charset='utf-8'>\n<title>{escape_html(title)}</title>",
        "<meta name='viewport' content='width=device-width, initial-scale=1'>",
        f"<style>{STYLE}</style>\n</head>\n<body>",
    ]
    links = "\n".join(f"<a href='#{name}'>{escape_html(heading)}</a>" for heading, name in names.items())
    for heading, items in sections.items():
        tag = f"h2 id='{names[heading]}'" if heading in names else "h1"
        parts.append(f"<{tag}>{escape_html(heading)}</{tag[:2]}>")
        parts += [_html(item) for item in items]
        if heading == title and rest:
            parts.append(f"<nav>\n{links}\n</nav>")
    path.write_text("\n".join([*parts, "</body>", "</html>"]) + "\n", encoding="utf-8")
    return path


def _html(item: Item) -> str:
    if isinstance(item, Path):
        picture = b64encode(item.read_bytes()).decode()
        return f"<figure><img alt='{escape_html(item.stem)}' src='data:image/png;base64,{picture}'></figure>"
    if isinstance(item, str):
        return f"<p>{escape_html(item)}</p>"
    if isinstance(item, list):
        return "<ul>\n" + "\n".join(f"<li>{escape_html(line)}</li>" for line in item) + "\n</ul>"
    head, *body = _rows(item)
    lines = ["<div class='wide'><table>", "<tr>" + "".join(f"<th>{_broken(c)}</th>" for c in head) + "</tr>"]
    for row in body:
        kinds = [" class='doubtful'" if _doubtful(c) else "" for c in row]
        cells = (f"<td{kind}>{_broken(c, small=True)}</td>" for kind, c in zip(kinds, row, strict=True))
        lines.append("<tr>" + "".join(cells) + "</tr>")
    return "\n".join([*lines, "</table></div>"])


def _broken(cell: str, small: bool = False) -> str:
    """Return a cell's lines one below the other, those after the first in small print."""
    first, *rest = map(escape_html, cell.split("\n"))
    return "<br>".join([first, *(f"<small>{line}</small>" if small else line for line in rest)])
