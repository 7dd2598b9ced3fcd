"""report.md and report.html from the same sections: paragraphs, bullets, tables and pictures."""

import os
from base64 import b64encode
from collections.abc import Mapping, Sequence
from html import escape as escape_html
from pathlib import Path

import pandas as pd

UNSEEN = "nominal, unseen"
Item = str | list[str] | pd.DataFrame | Path  # of a report: paragraph, bullets, table, picture


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
