"""How the measures of tasks are shown: titles, units and digits, and which of them tables and figures are about.

A run folder does not name its task's class; the keys of its rows say what it was about.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import isinf


@dataclass(frozen=True)
class Measure:
    """One column of evaluations.csv.

    Attributes:
        short, title: in tables, and in figures and headings. scale, digits: as they are shown.
        lower: whether less is better.
    """

    short: str
    title: str
    scale: float = 1.0
    digits: int = 1
    lower: bool = False

    def cell(self, value: float, digits: int | None = None) -> str:
        """Return a value as tables show it; "-" where arms were stopped, so that it is infinite."""
        return "-" if isinf(value) else f"{self.scale * value:.{self.digits if digits is None else digits}f}"


@dataclass(frozen=True)
class Shown:
    """What is shown of runs of one kind of task.

    Attributes:
        known: {key: Measure}. corner: what stands above the labels of a table, and is short for the columns.
        row: columns of a table, a row each simulator or arm. compared: those of trainings side by side.
        curves: of learning figures. judged: the two that trainings are compared by, of which the first selects.
        scored: those of the figure of scores. error: of the figure of episodes, what a distance is called.
        does: what a policy of it does, in a sentence.
    """

    known: Mapping[str, Measure]
    corner: str
    row: tuple[str, ...]
    compared: tuple[str, ...]
    curves: tuple[str, ...]
    judged: tuple[str, str]
    scored: tuple[str, ...]
    error: str
    does: str


RETURN = "return, eq. (2) over 4 s"
REACH = Shown(
    known={
        "success_5cm": Measure("5 cm, %", "success at 5 cm, %", 100, 0),
        "success_2cm": Measure("2 cm, %", "success at 2 cm, %", 100, 0),
        "success_1cm": Measure("1 cm, %", "success at 1 cm, %", 100, 0),
        "success_5mm": Measure("5 mm, %", "success at 5 mm, %", 100, 0),
        "distance_median_m": Measure("median\ndistance, mm", "median distance, mm", 1e3, 1, lower=True),
        "return_paper": Measure("return", RETURN),
        "rest": Measure("at rest, %", "at rest, %", 100, 0),
    },
    corner="success within",
    row=("success_5cm", "success_2cm", "success_1cm", "success_5mm", "distance_median_m", "return_paper", "rest"),
    compared=("success_2cm", "success_1cm", "success_5mm", "distance_median_m", "return_paper"),
    curves=("success_5cm", "success_2cm", "success_1cm", "return_paper"),
    judged=("success_1cm", "return_paper"),
    scored=("success_1cm", "success_5mm", "distance_median_m", "return_paper"),
    error="distance to the goal",
    does="It reaches points with its hand and stays there.",
)
TRACK = Shown(
    known={
        "path_rmse_mm": Measure("RMSE, mm", "RMSE of the path, mm", 1, 2, lower=True),
        "path_max_mm": Measure("largest,\nmm", "largest error of a path, mm", 1, 1, lower=True),
        "within_2mm": Measure("2 mm, %", "time within 2 mm, %", 100, 0),
        "within_5mm": Measure("5 mm, %", "time within 5 mm, %", 100, 0),
        "within_10mm": Measure("10 mm, %", "time within 10 mm, %", 100, 0),
        "torque_rms_Nm": Measure("torque,\nNm", "torque, RMS, Nm", 1, 2, lower=True),
        "jerk": Measure("jerk,\nm/s^3", "jerk of the hand, RMS, m/s^3", 1, 0, lower=True),
        "return_track": Measure("return", "return"),
        "stopped": Measure("stopped, %", "paths that were stopped, %", 100, 0, lower=True),
    },
    corner="time within",
    row=("path_rmse_mm", "path_max_mm", "within_2mm", "within_5mm", "within_10mm", "torque_rms_Nm", "jerk"),
    compared=("path_rmse_mm", "path_max_mm", "within_2mm", "within_5mm", "return_track"),
    curves=("path_rmse_mm", "path_max_mm", "within_5mm", "return_track"),
    judged=("within_5mm", "path_rmse_mm"),
    scored=("path_rmse_mm", "path_max_mm", "within_5mm", "return_track"),
    error="error of the path",
    does="It follows timed paths with its hand; an error is how far that is from where it is to be.",
)
ALL = {**REACH.known, **TRACK.known}


def shown(keys: Iterable[str]) -> Shown:
    """Return what is shown of rows with these keys."""
    return TRACK if TRACK.known.keys() & set(keys) else REACH


def in_short(row: Mapping[str, float]) -> list[str]:
    """Return the two judged measures of a row in words, nothing where it has none."""
    if "path_rmse_mm" in row:
        return [f"RMSE {float(row['path_rmse_mm']):.2f} mm", f"{100 * float(row['within_5mm']):.0f} % < 5 mm"]
    if "success_1cm" in row:
        return [f"{100 * float(row['success_1cm']):.0f} % < 1 cm", f"return {float(row['return_paper']):.0f}"]
    return []
