"""What all figures (PNG) share: panels with one legend, and logarithmic axes."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

DPI = 120
LEGEND_WIDTH = 160  # letters, of a figure


@contextmanager
def panels(
    path: Path, count: int, columns: int, title: str, height: float = 2.3, key: str | None = None
) -> Iterator[list[Axes]]:
    """Give `count` axes in a grid, with one legend for all, headed by `key`, and save the figure to `path`."""
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
        fit = max(1, LEGEND_WIDTH // (max(map(len, named)) + 6))
        columns = min(len(named), 6, fit)
        lines, labels = list(named.values()), list(named)
        figure.legend(lines, labels, loc="outside lower center", ncols=columns, frameon=False, title=key)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def joint_panels(path: Path, n: int, title: str):
    """Give `panels` for n joints."""
    return panels(path, n, 2 if n > 3 else 1, title)


def log_axis(axis: Axes, ticks: Sequence[float] = (1.0, 2.0, 5.0)) -> None:
    """Make y logarithmic, with numbers that people read at these `ticks` of every decade."""
    axis.set_yscale("log")
    axis.yaxis.set_major_locator(LogLocator(subs=ticks))
    axis.yaxis.set_major_formatter("{x:g}")
    axis.yaxis.set_minor_formatter(NullFormatter())
