"""Write report.md and report.html from the same sections: paragraphs, bullets, tables and pictures."""

import os
from base64 import b64encode
from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd
from jinja2 import Environment

KEPT = "kept nominal"  # cell of a parameter that the data hardly constrain
Item = str | list[str] | pd.DataFrame | Path  # paragraph, bullets, table, picture


def doubtful(cell: str) -> bool:
    """Return whether a table cell marks its value as poorly identifiable ("?") or as kept nominal."""
    return any(line.endswith(("?", "kept", KEPT)) for line in cell.split("\n"))


def report_markdown(path: Path, sections: Mapping[str, Sequence[Item]]) -> Path:
    """Write report.md from {heading: items}; the first heading is the title, and links to figures are relative."""
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
    """Return the cells of a table, including its header and its index."""
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
th, td { padding: .3rem .8rem; text-align: right; white-space: pre; border-bottom: 1px solid #e4e8ec; }
td { font-size: 12px; color: #59636e; }
td::first-line { font-size: 15px; color: #1f2328; }
th { vertical-align: bottom; border-bottom: 2px solid #afb8c1; }
th:first-child, td:first-child { text-align: left; }
td.doubtful, td.doubtful::first-line { color: #8c959f; }
figure { margin: 1rem 0 1.6rem; }
img { max-width: 100%; height: auto; }
"""
PAGE = """\
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<title>{{ sections[0][0] }}</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>{{ style }}</style>
</head>
<body>
{% for heading, items in sections %}
{% if loop.first %}<h1>{{ heading }}</h1>{% else %}<h2 id="s{{ loop.index0 }}">{{ heading }}</h2>{% endif %}
{% for item in items %}
{% if item is string %}<p>{{ item }}</p>
{% elif item.picture %}<figure><img alt="{{ item.name }}" src="data:image/png;base64,{{ item.picture }}"></figure>
{% elif item.head %}
<div class="wide"><table>
<tr>{% for cell in item.head %}<th>{{ cell }}</th>{% endfor %}</tr>
{% for row in item.body %}
<tr>{% for cell in row %}<td{% if doubtful(cell) %} class="doubtful"{% endif %}>{{ cell }}</td>{% endfor %}</tr>
{% endfor %}
</table></div>
{% else %}<ul>{% for line in item %}<li>{{ line }}</li>{% endfor %}</ul>
{% endif %}
{% endfor %}
{% if loop.first %}
<nav>{% for heading, _ in sections[1:] %}<a href="#s{{ loop.index }}">{{ heading }}</a> {% endfor %}</nav>
{% endif %}
{% endfor %}
</body>
</html>
"""


def report_html(path: Path, sections: Mapping[str, Sequence[Item]]) -> Path:
    """Write report.html as one file with embedded pictures, without scripts or external resources."""
    page = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True).from_string(PAGE)
    parts = [(heading, [_for_template(item) for item in items]) for heading, items in sections.items()]
    path.write_text(page.render(sections=parts, style=STYLE, doubtful=doubtful), encoding="utf-8")
    return path


def _for_template(item: Item) -> str | list[str] | dict:
    if isinstance(item, Path):
        return {"name": item.stem, "picture": b64encode(item.read_bytes()).decode()}
    if isinstance(item, pd.DataFrame):
        head, *body = _rows(item)
        return {"head": head, "body": body}
    return item
