"""Format identified parameters as table cells: nominal → identified, 95 % interval, identifiability."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from r2s.identification.parameters import TIMING, WHOLE_ARM, ParameterEstimate, ParameterSpace, units
from r2s.identification.result import SHARPER
from r2s.physics.robot import Robot
from r2s.reporting.document import KEPT
from r2s.reporting.tables import number

FIXED = "fixed"  # cell of a parameter fixed by identify.prior.PARAMETER.fixed=
WIDE = f"?: the interval is wider than {2 / SHARPER:g} standard deviations of the prior"
LEGEND = f"[ ]: 95 % interval; {WIDE}; {KEPT}: the data hardly constrain the value"
SHORT = f"±: half of the 95 % interval; {WIDE}; kept: nominal, as the data hardly constrain it"


class Value(NamedTuple):
    """Nominal and identified value of a parameter, 95 % interval, and flags: identifiable, kept nominal, fixed."""

    old: float
    new: float
    low: float
    high: float
    identifiable: bool = True
    kept: bool = False
    fixed: bool = False

    def times(self, factor: float) -> "Value":
        """Return the value in another unit, with all numbers multiplied by `factor`."""
        old, new, low, high = (factor * x for x in self[:4])
        return Value(old, new, low, high, self.identifiable, self.kept, self.fixed)

    @property
    def cell(self) -> str:
        """Table cell with two lines: "old → new" and "[low, high]"."""
        if self.kept or self.fixed:
            return f"{number(self.old)}\n{KEPT if self.kept else FIXED}"
        return f"{number(self.old)} → {self.found}\n{self.interval}"

    @property
    def found(self) -> str:
        """Text of the identified value, followed by "?" if the parameter is not identifiable."""
        return number(self.new) + ("" if self.identifiable or self.fixed else " ?")

    @property
    def short(self) -> str:
        """Table cell with two lines: the identified value, and "±" with half the width of the 95 % interval."""
        half = 0.5 * (self.high - self.low)
        if self.kept or self.fixed:
            return f"{number(self.old)}\n{'kept' if self.kept else FIXED}"
        new = number(self.new, "{:.3g}" if abs(self.new) >= 1e-3 else "{:.2g}")
        return f"{new}{'' if self.identifiable else '?'}\n±{number(half, '{:.0f}' if half >= 100 else '{:.2g}')}"

    @property
    def interval(self) -> str:
        """Table cell with the 95 % interval: "[low, high]"."""
        return KEPT if self.kept else FIXED if self.fixed else f"[{number(self.low)}, {number(self.high)}]"


def values(space: ParameterSpace, found: ParameterEstimate, block: str, kept: Sequence[str] = ()) -> list[Value]:
    """Return a `Value` per parameter of `block`: per joint, per link or for the arm. kept: names kept nominal."""
    marks = (np.isin(space.names, list(names)) for names in (kept, space.fixed))
    parts = (space.start, found.x, found.low, found.high, found.identifiable, *marks)
    return [Value(*row) for row in zip(*(space.block(part, block).tolist() for part in parts), strict=True)]


def of_whole_arm(space: ParameterSpace, found: ParameterEstimate, kept: Sequence[str] = ()) -> dict[str, Value]:
    """Return {"delay, ms": Value, "payload_mass, kg": Value, ...} for the parameters of the whole arm."""
    out = {}
    for block in (b for b in space.blocks if b in WHOLE_ARM):
        value = values(space, found, block, kept)[0]
        milliseconds = block in TIMING
        out[f"{block}, {'ms' if milliseconds else units()[block]}"] = value.times(1e3) if milliseconds else value
    return out


def named(block: str) -> str:
    """Return the column heading of a parameter block, with the unit."""
    unit = units()[block]
    return block if unit == "1" else f"{block}\n{unit}"


def per_joint(robot: Robot, columns: Mapping[str, Sequence[str]], index: str = "joint") -> pd.DataFrame:
    """Return `columns` as a table whose rows are joints or links, numbered from 1."""
    return pd.DataFrame(dict(columns), index=pd.Index([str(j + 1) for j in range(robot.n)], name=index))
