"""Describe a task's measures: key, unit, whether lower is better, and presentation in tables and figures.

Each task class has a `measure_table`. Training and transfer write this table to measures.json in their run folder.
Code that shows or compares run folders reads that file and needs no task class.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from math import isfinite
from pathlib import Path
from typing import Any

from r2s.errors import UserError, instead_of
from r2s.files import atomic_write

FILE = "measures.json"


@dataclass(frozen=True)
class Measure:
    """One measure of a policy's episodes, a column of evaluations.csv.

    Attributes:
        key: column of evaluations.csv. short: name in table headings. title: name in figures and sentences.
        unit: unit for display, "" if dimensionless. scale: displayed value / stored value.
        digits: number of displayed decimals. lower_is_better: whether lower values are better.
        root_mean_square: whether to average several values as a root mean square instead of a mean.
    """

    key: str
    short: str
    title: str
    unit: str = ""
    scale: float = 1.0
    digits: int = 1
    lower_is_better: bool = False
    root_mean_square: bool = False

    @property
    def column(self) -> str:
        """Heading of the measure's column in a table: short name and unit."""
        return f"{self.short}, {self.unit}" if self.unit else self.short

    @property
    def heading(self) -> str:
        """Label of the measure in a figure: title and unit."""
        return f"{self.title}, {self.unit}" if self.unit else self.title

    @property
    def sign(self) -> float:
        """-1 if lower values of the measure are better, else 1."""
        return -1.0 if self.lower_is_better else 1.0

    def cell(self, value: float | None, digits: int | None = None) -> str:
        """Return the displayed text of a stored value; "-" if the value is missing or not finite."""
        if value is None or not isfinite(value):
            return "-"
        return f"{self.scale * value:.{self.digits if digits is None else digits}f}"

    def in_words(self, value: float | None) -> str:
        """Return title, value and unit, such as "success at 1 cm 98 %"."""
        return f"{self.title} {self.cell(value)} {self.unit}".strip()


# measures of every task: transfer gap (r2s/tasks/rollout.py), safety filter, limits and stops
COMMON = (
    Measure("ee_path_rmse_mm", "path gap", "path gap to the prediction", "mm", 1, 2, True, root_mean_square=True),
    Measure("tau_rmse_Nm", "torque gap", "torque gap to the prediction", "Nm", 1, 2, True, root_mean_square=True),
    Measure("limited", "filter active", "cycles changed by the safety filter", "%", 100, 1, True),
    Measure("q_left_rad", "limit margin", "margin to the position limits", "rad", 1, 2),
    Measure("collision", "collisions", "episodes that end in a collision", "%", 100, 1, True),
    Measure("stops", "stops", "stops of the arm", digits=0, lower_is_better=True),
)
GAP = COMMON[0]


@dataclass(frozen=True)
class MeasureTable:
    """The measures of a task, and the keys of the measures that each table and figure shows.

    Attributes:
        measures: measures of this task only; r2s adds COMMON, the measures of every task.
        selection: keys of the measures that compare trainings. Every row of evaluations.csv must contain the first
            key; the last key ranks the trainings.
        rows: measures to show in the table that has one row per simulator or arm; by default all `measures`.
        comparison: columns of the table that compares trainings. curves: panels of the figure with learning curves.
        scores: panels of the figure that compares the scores of trainings.
        transfer: measures for comparing adapters episode by episode on an arm.
        diagnostics: columns of a transfer's second table; by default COMMON.
        corner: heading of the column of row labels. description: sentence that describes what a policy does.
        error: name, unit and scale of `Episodes.distance`. error_levels: values of the horizontal lines in the plot
            of the error over time.
        reward: name of `Episodes.reward`.

    By default, `comparison`, `curves`, `scores` and `transfer` contain the measures that `selection` lists.
    """

    measures: tuple[Measure, ...]
    selection: tuple[str, ...]
    rows: tuple[str, ...] = ()
    comparison: tuple[str, ...] = ()
    curves: tuple[str, ...] = ()
    scores: tuple[str, ...] = ()
    transfer: tuple[str, ...] = ()
    diagnostics: tuple[str, ...] = ()
    corner: str = ""
    description: str = ""
    error: Measure = Measure("distance", "distance", "distance to the goal", "cm", 100.0, lower_is_better=True)
    error_levels: tuple[float, ...] = (5.0, 2.0, 1.0)
    reward: str = "reward"

    def __post_init__(self) -> None:
        if not self.selection:
            raise UserError("measure_table.selection: expected at least one key, got none")
        own = tuple(m.key for m in self.measures)
        defaults = {"rows": own, "diagnostics": tuple(m.key for m in COMMON)}
        for name in ("selection", "rows", "comparison", "curves", "scores", "transfer", "diagnostics"):
            keys = getattr(self, name) or defaults.get(name, self.selection)
            object.__setattr__(self, name, keys)
            for key in keys:
                if key not in self.known:
                    raise UserError(f"measure_table.{name}: no measure '{key}'; {instead_of(key, self.known)}")

    @property
    def known(self) -> dict[str, Measure]:
        """{key: Measure} for the measures in COMMON and in `measures`."""
        return {m.key: m for m in (*COMMON, *self.measures)}

    def __getitem__(self, key: str) -> Measure:
        return self.known[key]

    def in_words(self, row: Mapping[str, Any]) -> list[str]:
        """Return one text, such as "success at 1 cm 98 %", for each measure in `selection` that `row` contains."""
        return [self[key].in_words(float(row[key])) for key in self.selection if row.get(key) not in (None, "")]


def write_measures(folder: Path, table: MeasureTable) -> None:
    """Write measures.json into a run folder."""
    with atomic_write(folder / FILE) as part:
        part.write_text(json.dumps(asdict(table), indent=1) + "\n")


def read_measures(folder: Path) -> MeasureTable | None:
    """Read measures.json of a run folder; return None if the file is missing.

    Raises:
        UserError: the file is damaged.
    """
    path = folder / FILE
    if not path.is_file():
        return None
    try:
        saved: dict[str, Any] = json.loads(path.read_text())
        fields: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in saved.items()}
        fields["measures"] = tuple(Measure(**m) for m in saved["measures"])
        fields["error"] = Measure(**saved["error"])
        return MeasureTable(**fields)
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise UserError(f"{path} is damaged: {error}") from None
