"""Draw figures of several panels with one shared legend; set up logarithmic axes."""

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from r2s.tasks.measures import Measure

DPI = 120
WIDTH = 12.0  # inches
LEGEND_WIDTH = 160  # number of letters that fit into WIDTH, in one line of the legend
# inches around and between panels, fixed because matplotlib's layout engines are slow: they measure every text
LEFT, RIGHT, TOP, BOTTOM, ACROSS, DOWN, LINE = 0.8, 0.15, 0.75, 0.5, 0.85, 0.75, 0.22
LETTER = 0.085  # inches of left margin per letter of the first panel's tick labels
TITLE, AGAIN = 0.9, 0.2  # inches of height added to the rows of panels: per figure, and per row after the first


@contextmanager
def panels(
    path: Path, count: int, columns: int, title: str, height: float = 2.3, key: str | None = None
) -> Iterator[list[Axes]]:
    """Yield `count` axes in a grid, then save the figure to `path` with one legend; `key` is the legend's title.

    Each row of panels is `height` inches high.
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
        below += LINE * (-(-len(named) // wide) + (key is not None)) + 0.1
        figure.legend(list(named.values()), list(named), loc="lower center", ncols=wide, frameon=False, title=key)
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


def joint_panels(path: Path, n: int, title: str) -> AbstractContextManager[list[Axes]]:
    """Return the context manager `panels` for a figure with one panel per joint."""
    return panels(path, n, 2 if n > 3 else 1, title)


def label_axis(axis: Axes, m: Measure) -> None:
    """Set the title of a measure's panel; if the measure is a percentage, let the y axis show about 0 to 100 %."""
    axis.set_title(m.heading, loc="left")
    if m.unit == "%":
        axis.set_ylim(-3, 103)


def log_axis(axis: Axes, ticks: Sequence[float] = (1.0, 2.0, 5.0)) -> None:
    """Make the y axis logarithmic, with labels such as 0.1, 0.2 and 0.5: the multiples `ticks` of powers of ten."""
    axis.set_yscale("log")
    axis.yaxis.set_major_locator(LogLocator(subs=ticks))
    axis.yaxis.set_major_formatter("{x:g}")
    axis.yaxis.set_minor_formatter(NullFormatter())
