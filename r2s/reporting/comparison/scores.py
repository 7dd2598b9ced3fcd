"""Score groups of trainings by their last evaluation; the trainings of a group differ only in their seeds."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from r2s.reporting.comparison.statistics import improvement, interquartile_mean, interval
from r2s.reporting.comparison.trainings import Trained
from r2s.tasks.measures import MeasureTable

Grouped = Mapping[str, Sequence[Trained]]


def measures_in(grouped: Grouped) -> MeasureTable:
    """Return the measure table of the task; all runs have the same task."""
    return next(iter(grouped.values()))[0].measures


def scores(group: Sequence[Trained], measure: str) -> np.ndarray:
    """Return the values (S,) of a measure in the last evaluations of S seeds."""
    return np.array([r.last[measure] for r in group])


def summary_table(grouped: Grouped) -> pd.DataFrame:
    """Return a row per group and measure: number of seeds, mean, interquartile mean with a 95 % interval."""
    rows, table = [], measures_in(grouped)
    for label, group in grouped.items():
        for measure in dict.fromkeys((*table.comparison, *table.scores)):
            x = scores(group, measure)
            low, high = interval([x], lambda d: interquartile_mean(d[0]))
            row = {"group": label, "measure": measure, "seeds": len(x), "mean": x.mean()}
            rows.append(row | {"iqm": float(interquartile_mean(x)), "low": low, "high": high})
    return pd.DataFrame(rows)


def improvement_table(grouped: Grouped) -> pd.DataFrame:
    """Return a row per measure and ordered pair of groups: probability that a run of the first group is better."""
    rows, table = [], measures_in(grouped)
    pairs = [(first, second) for first in grouped for second in grouped if first != second]
    for first, second in pairs:
        for measure in table.selection:
            sign = table[measure].sign
            pair = [sign * scores(grouped[label], measure) for label in (first, second)]
            low, high = interval(pair, lambda d: improvement(*d))
            row = {"better": first, "than": second, "measure": measure}
            rows.append(row | {"probability": float(improvement(*pair)), "low": low, "high": high})
    return pd.DataFrame(rows)


def sensitivity_table(grouped: Grouped, measure: str | None = None) -> pd.DataFrame:
    """Return, for each algorithm with several groups, how much a measure depends on the settings of the groups.

    `best`, `median` and `worst` are the best, median and worst interquartile mean of the algorithm's groups. `best`
    is optimistic, because the same seeds select and score the group. `held_out` avoids this: for each seed, the other
    seeds select the best group, and this seed scores the group; `held_out` is the mean score. `spread` is the mean
    over seeds of this score minus the median score of all groups (positive: better); `low` to `high` is its 95 %
    interval. An algorithm with a small `spread` needs little tuning. With fewer than two seeds common to all groups,
    `held_out` and `spread` are nan.

    Args:
        grouped: groups of trainings. measure: key of the measure; if None, the last of `MeasureTable.selection`.
    """
    table = measures_in(grouped)
    rows, measure = [], measure or table.selection[-1]
    sign = table[measure].sign
    for algo in dict.fromkeys(group[0].algo for group in grouped.values()):
        settings = [g for g in grouped.values() if g[0].algo == algo]
        if len(settings) < 2:
            continue
        each = sign * np.array([interquartile_mean(scores(g, measure)) for g in settings])
        row = {"algo": algo, "settings": len(settings), "best": sign * each.max(), "median": sign * np.median(each)}
        row |= {"worst": sign * each.min()} | dict.fromkeys(("held_out", "spread", "low", "high"), np.nan)
        seeds = held_out([{r.seed: sign * r.last[measure] for r in g} for g in settings])
        if seeds is not None:
            row |= {"held_out": sign * seeds[0].mean(), "spread": (seeds[0] - seeds[1]).mean()}
            row["low"], row["high"] = interval([seeds[0] - seeds[1]], lambda d: d[0].mean(-1))
        rows.append(row)
    return pd.DataFrame(rows)


def held_out(settings: Sequence[Mapping[int, float]]) -> tuple[np.ndarray, np.ndarray] | None:
    """Return, at S seeds, the score (S,) of the group best at the other seeds, and the median (S,) over all groups.

    Args:
        settings: {seed: score} of each group; a larger score is better. Only seeds common to all groups are used; the
            result is None for fewer than two common seeds.
    """
    seeds = sorted(set.intersection(*(set(s) for s in settings)))
    if len(seeds) < 2:
        return None
    x = np.array([[s[seed] for seed in seeds] for s in settings])
    chosen = [interquartile_mean(np.delete(x, k, axis=1)).argmax() for k in range(len(seeds))]
    return x[chosen, range(len(seeds))], np.median(x, axis=0)


def at_edges(grouped: Grouped) -> list[str]:
    """For each algo or reward setting with three or more values, return a line if the best value is an extreme."""
    table, lines = measures_in(grouped), []
    by = table[table.selection[-1]]
    for algo in dict.fromkeys(group[0].algo for group in grouped.values()):
        settings = [g for g in grouped.values() if g[0].algo == algo]
        best = max(settings, key=lambda g: by.sign * float(interquartile_mean(scores(g, by.key))))[0].settings
        for key, value in ((k, v) for k, v in best.items() if k.startswith(("algo.", "reward."))):
            tried: set[Any] = {g[0].settings.get(key) for g in settings if is_number(g[0].settings.get(key))}
            if len(tried) > 2 and value in (min(tried), max(tried)):
                lines.append(edge(f"best setting of {algo}", key, value, value == max(tried)))
    return lines


def edge(what: str, key: str, value: float, largest: bool) -> str:
    """Return a line which states that the best value of a setting is the largest or the smallest tried value."""
    return f"{what}: {key}={value:g} is the {'largest' if largest else 'smallest'} tried; a better one may lie beyond"


def is_number(value: object) -> bool:
    """Return whether a setting is a number, and not a boolean."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def improvement_matrix(table: pd.DataFrame, measure: str) -> pd.DataFrame:
    """Tabulate an `improvement_table` as strings: the probability that the row's group beats the column's group."""
    rows = table[table["measure"] == measure]
    labels = list(dict.fromkeys(rows["better"]))
    number = {label: str(i + 1) for i, label in enumerate(labels)}
    square = rows.pivot(index="better", columns="than", values="probability").loc[labels, labels]
    cells = square.map(lambda p: "-" if np.isnan(p) else f"{p:.2f}").rename(columns=number)
    return cells.set_axis([f"{number[label]}: {label}" for label in labels]).rename_axis("better \\ than", axis=0)


def band(group: Sequence[Trained], x: str, y: str, points: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """Return a grid of x (points,), and interquartile mean, minimum and maximum of y over seeds as (3, points).

    The curves of all seeds are interpolated to the grid. The grid covers the range of x that all curves share.
    """
    curves = [r.curve for r in group]
    grid = np.linspace(max(c[x].iloc[0] for c in curves), min(c[x].iloc[-1] for c in curves), points)
    with np.errstate(invalid="ignore"):  # values are inf where arms were stopped; the curve has a gap there
        values = np.stack([np.interp(grid, c[x], c[y]) for c in curves], -1)
    return grid, np.stack([interquartile_mean(values), values.min(-1), values.max(-1)])
