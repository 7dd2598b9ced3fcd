"""Compare the table cells in two versions of a page of benchmarks/results, and test whether intervals overlap.

Cells are matched by section, row and column, so added rows and changed paragraphs do not affect the comparison.
"""

import re
from collections import Counter
from collections.abc import Iterator

import pandas as pd

NUMBER = r"[-+]?\d[\d,]*(?:\.\d+)?(?:e[-+]?\d+)?"
INTERVAL = re.compile(rf"\[({NUMBER}),\s*({NUMBER})\]")
MISSING = "not made again"
VERDICTS = ("equal", "last digit", "within intervals", "beyond intervals", "without interval", MISSING, "new")
Cell = tuple[str, str, str]  # section, row, column


def table_cells(page: str) -> dict[Cell, str]:
    """Return {(section, row, column): cell} of all tables in a page; repeated row and column names get a number."""
    cells: dict[Cell, str] = {}
    for section, head, rows in _tables(page):
        columns, names = _numbered(head), _numbered([row[0] for row in rows])
        for name, row in zip(names, rows, strict=True):
            cells |= {(section, name, c): x for c, x in zip(columns[1:], row[1:], strict=False)}
    return cells


def without_rows(page: str) -> str:
    """Remove the rows of all tables in a page; a table that is not computed again then shows only its header."""
    kept, in_table = [], False
    for line in page.splitlines():
        rule = re.fullmatch(r"\|(?: *:?-+:? *\|)+", line) is not None
        if rule or not (in_table and line.startswith("|")):
            kept.append(line)
        in_table = rule or (in_table and line.startswith("|"))
    return "\n".join(kept) + "\n"


def compare_pages(before: str, now: str) -> pd.DataFrame:
    """Compare all cells of two pages; return a row per cell: section, row, column, committed, now, verdict, change.

    `verdict` is one of VERDICTS. The verdict "last digit" means that numbers differ by at most one unit of their last
    digits. The verdict "beyond intervals" means that an interval in the old cell and its counterpart in the new cell
    do not overlap. `change` is the largest relative change of a number in the cell; NaN if the cell has no numbers,
    or a different count of numbers in the two versions.
    """
    old, new = table_cells(before), table_cells(now)
    rows = []
    for key in [*old, *(key for key in new if key not in old)]:
        a, b = old.get(key), new.get(key)
        verdict = "new" if a is None else MISSING if b is None else _verdict(a, b)
        rows.append((*key, a or "", b or "", verdict, _change(a or "", b or "")))
    return pd.DataFrame(rows, columns=["section", "row", "column", "committed", "now", "verdict", "change"])


def compare_all(before: dict[str, str], now: dict[str, str]) -> pd.DataFrame:
    """Compare each page in {page: text}; return one table. With several pages, sections begin with the page name."""
    parts = []
    for page, text in before.items():
        cells = compare_pages(text, now[page])
        parts.append(cells if len(before) == 1 else cells.assign(section=f"{page}: " + cells["section"]))
    return pd.concat(parts, ignore_index=True)


def _tables(page: str) -> Iterator[tuple[str, list[str], list[list[str]]]]:
    """Yield (section heading, column names, rows of cells) for each table of a page."""
    section, block = "", []
    for line in [*page.splitlines(), ""]:
        if line.startswith("|"):
            block.append([cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]])
            continue
        if len(block) > 1:
            yield section, block[0], block[2:]
        block = []
        if line.startswith("#"):
            section = line.lstrip("# ")


def _numbered(names: list[str]) -> list[str]:
    """Return the names, with repeated names numbered: the second of two equal names ends with (2)."""
    seen: Counter[str] = Counter()
    numbered = []
    for name in names:
        seen[name] += 1
        numbered.append(name if seen[name] == 1 else f"{name} ({seen[name]})")
    return numbered


def _numbers(text: str) -> list[float]:
    return [float(x.replace(",", "")) for x in re.findall(NUMBER, text)]


def _last_digits(text: str) -> list[float]:
    """Return the resolution of each number in a text: one unit of the number's last digit."""
    parts = [x.lower().partition("e") for x in re.findall(NUMBER, text)]
    return [10.0 ** (int(power or 0) - len(number.partition(".")[2])) for number, _, power in parts]


def _verdict(before: str, now: str) -> str:
    if before == now:
        return "equal"
    (a, b), units = (_numbers(before), _numbers(now)), _last_digits(before)
    words = [re.sub(NUMBER, "", text) for text in (before, now)]
    if words[0] == words[1] and all(abs(x - y) <= 1.001 * u for x, y, u in zip(a, b, units, strict=True)):
        return "last digit"
    pairs = [[_numbers(m[0]) for m in INTERVAL.finditer(text)] for text in (before, now)]
    if not pairs[0] or len(pairs[0]) != len(pairs[1]):
        return "without interval"
    overlap = all(a[0] <= b[1] and b[0] <= a[1] for a, b in zip(*pairs, strict=True))
    return "within intervals" if overlap else "beyond intervals"


def _change(before: str, now: str) -> float:
    a, b = _numbers(before), _numbers(now)
    if not a or len(a) != len(b):
        return float("nan")
    return max(abs(y - x) / max(abs(x), abs(y), 1e-300) for x, y in zip(a, b, strict=True))
