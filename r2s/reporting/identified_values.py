"""Identified values as cells of a table: nominal, identified, 95 % interval, and whether the data could tell."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from r2s.identification.parameters import TIMING, WHOLE_ARM, Estimate, ParameterSpace, units
from r2s.identification.uncertainty import SHARPER
from r2s.physics.robot import Robot
from r2s.reporting.document import UNSEEN
from r2s.reporting.tables import number

LEGEND = (
    f"[ ]: 95 % interval; ?: it is wider than {2 / SHARPER:g} standard deviations of the belief before; "
    f"{UNSEEN}: kept, the data hardly speak of it"
)


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


def of_whole_arm(space: ParameterSpace, found: Estimate, unseen: Sequence[str] = ()) -> dict[str, Value]:
    """Return {"delay, ms": Value, "payload_mass, kg": Value, ...} of the searched values that are of no one joint."""
    out = {}
    for block in (b for b in space.blocks if b in WHOLE_ARM):
        value = values(space, found, block, unseen)[0]
        out[f"{block}, {'ms' if block in TIMING else units()[block]}"] = (
            value.times(1e3) if block in TIMING else value
        )
    return out


def named(block: str) -> str:
    """Return the title of a block's column, with its unit."""
    unit = units()[block]
    return block if unit == "1" else f"{block}\n{unit}"


def per_joint(robot: Robot, columns: Mapping[str, Sequence[str]], index: str = "joint") -> pd.DataFrame:
    """Return a table of n cells a column, a row per joint or link."""
    return pd.DataFrame(dict(columns), index=pd.Index([str(j + 1) for j in range(robot.n)], name=index))
