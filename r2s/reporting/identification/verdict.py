"""Build tables that judge a recording before the fit: checks, and expected widths of the parameters' intervals."""

from typing import Protocol

import numpy as np
import pandas as pd
from rich.console import Console

from r2s.identification.parameters import WHOLE_ARM, ParameterSpace, units
from r2s.identification.result import SHARPER, UNSEEN
from r2s.identification.verdict import Verdict
from r2s.physics.robot import Robot
from r2s.reporting.tables import number, print_table

WIDTHS = "expected width of the 95 % intervals"
LEGEND = f"?: wider than {2 / SHARPER:g} standard deviations of the prior; prior: the data hardly narrow it"


class Widths(Protocol):
    """Interface of `ExpectedWidths` and `PlannedWidths`: the expected interval widths of P parameters."""

    @property
    def space(self) -> ParameterSpace: ...  # noqa: D102
    @property
    def width(self) -> np.ndarray: ...  # noqa: D102
    @property
    def share(self) -> np.ndarray: ...  # noqa: D102
    @property
    def identifiable(self) -> np.ndarray: ...  # noqa: D102


def verdict_table(verdict: Verdict) -> pd.DataFrame:
    """Return a table with a row per check, and the columns verdict, finding and advice."""
    rows = {x.check: {"": x.verdict, "found": x.found, "advice": x.advice} for x in verdict.lines}
    return pd.DataFrame.from_dict(rows, orient="index").rename_axis("check")


def width_table(expected: Widths, n: int) -> pd.DataFrame:
    """Return a row per parameter and a column per joint or link; parameters of the whole arm use the first column."""
    space, unit, rows = expected.space, units(), {}
    for block in space.blocks:
        parts = (space.block(x, block) for x in (expected.width, expected.share, expected.identifiable))
        cells = [
            "prior" if share > UNSEEN else f"{number(width)}{'' if seen else ' ?'}"
            for width, share, seen in zip(*parts, strict=True)
        ]
        name = block if unit[block] == "1" else f"{block}, {unit[block]}"
        rows[f"{name} (arm)" if block in WHOLE_ARM else name] = cells + [""] * (n - len(cells))
    columns = [str(j + 1) for j in range(n)]
    return pd.DataFrame.from_dict(rows, orient="index", columns=columns).rename_axis("joint or link")


def print_verdict(console: Console, robot: Robot, verdict: Verdict, title: str) -> None:
    """Print the table of a verdict's checks and, if there are expected interval widths, their table."""
    print_table(console, verdict_table(verdict), title, sentences=True)
    if verdict.expected is not None:
        print_table(console, width_table(verdict.expected, robot.n), WIDTHS, LEGEND)
