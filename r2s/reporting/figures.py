"""What all figures (PNG) share: panels with one legend, and logarithmic axes."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

DPI = 120
WIDTH = 12.0  # inches
LEGEND_WIDTH = 160  # letters, of a figure
# Inches around the panels and between them. A layout that measures every text would take most of a figure's time.
LEFT, RIGHT, TOP, BOTTOM, ACROSS, DOWN, LINE = 0.8, 0.15, 0.75, 0.5, 0.85, 0.75, 0.22
LETTER = 0.085  # inches, of a label beside the first panel
TITLE, AGAIN = 0.9, 0.2  # inches that a figure has beyond the `height` of its rows: once, and for each further row


@contextmanager
def panels(
    path: Path, count: int, columns: int, title: str, height: float = 2.3, key: str | None = None
) -> Iterator[list[Axes]]:
    """Give `count` axes in a grid, with one legend for all, headed by `key`, and save the figure to `path`.

    height: inches of a row of panels.
    """
    rows = -(-count // columns)
    figure = Figure(dpi=DPI)
    axes = [figure.add_subplot(rows, columns, i + 1) for i in range(count)]
    yield axes
    for axis in axes:
        axis.grid(alpha=0.3, linewidth=0.6)
        axis.spines[["top", "right"]].set_visible(False)
        axis.title.set_fontsize(10)
    named = {name: line for axis in axes for line, name in zip(*axis.get_legend_handles_labels(), strict=True)}
    below = BOTTOM
    if named:
        fit = max(1, LEGEND_WIDTH // (max(map(len, named)) + 6))
        wide = min(len(named), 6, fit)
        lines, labels = list(named.values()), list(named)
        below += LINE * (-(-len(named) // wide) + (key is not None)) + 0.1
        figure.legend(lines, labels, loc="lower center", ncols=wide, frameon=False, title=key)
    tall = TITLE + height * rows + AGAIN * (rows - 1) + below - BOTTOM
    figure.suptitle(title, fontsize=13, fontweight="bold", y=1 - 0.12 / tall, va="top")
    figure.set_size_inches(WIDTH, tall)
    left = LEFT + LETTER * max(0, max(len(text.get_text()) for text in axes[0].get_yticklabels()) - 6)
    panel = (WIDTH - left - RIGHT - (columns - 1) * ACROSS) / columns, (tall - TOP - below - (rows - 1) * DOWN) / rows
    figure.subplots_adjust(
        left / WIDTH, below / tall, 1 - RIGHT / WIDTH, 1 - TOP / tall, ACROSS / panel[0], DOWN / panel[1]
    )
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
