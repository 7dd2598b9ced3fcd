"""Trainings side by side: what can be said of groups of a few seeds each, by their last evaluation.

Interquartile mean, stratified bootstrap and probability of improvement as Agarwal et al., Deep Reinforcement Learning
at the Edge of the Statistical Precipice (NeurIPS 2021) propose them; a group is all seeds of one setting.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from r2s.reporting.measures import ALL, Shown, shown
from r2s.reporting.statistics import improvement, interquartile_mean, interval
from r2s.reporting.trainings import Trained


def shown_of(grouped: Mapping[str, Sequence[Trained]]) -> Shown:
    """Return what is shown of these runs, which are of one task."""
    return shown(next(iter(grouped.values()))[0].last)


def scores(group: Sequence[Trained], measure: str) -> np.ndarray:
    """Return (S,): the last evaluation of every seed."""
    return np.array([r.last[measure] for r in group])


def summary_table(grouped: Mapping[str, Sequence[Trained]]) -> pd.DataFrame:
    """Return one row per group and measure: seeds, mean, interquartile mean and its 95 % interval."""
    rows = []
    for label, group in grouped.items():
        for measure in shown_of(grouped).compared:
            x = scores(group, measure)
            low, high = interval([x], lambda d: interquartile_mean(d[0]))
            row = {"group": label, "measure": measure, "seeds": len(x), "mean": x.mean()}
            rows.append(row | {"iqm": float(interquartile_mean(x)), "low": low, "high": high})
    return pd.DataFrame(rows)


def improvement_table(grouped: Mapping[str, Sequence[Trained]]) -> pd.DataFrame:
    """Return, for every pair of groups, the probability that a run of the first is better than one of the second."""
    rows = []
    for first, a in grouped.items():
        for second, b in grouped.items():
            if first == second:
                continue
            for measure in shown_of(grouped).judged:
                sign = -1.0 if ALL[measure].lower else 1.0
                pair = [sign * scores(a, measure), sign * scores(b, measure)]
                low, high = interval(pair, lambda d: improvement(*d))
                row = {"better": first, "than": second, "measure": measure}
                rows.append(row | {"probability": float(improvement(*pair)), "low": low, "high": high})
    return pd.DataFrame(rows)


def sensitivity_table(grouped: Mapping[str, Sequence[Trained]], measure: str | None = None) -> pd.DataFrame:
    """Return, per algorithm, how much its score depends on its settings; empty where none has two settings.

    The measure is the second that trainings are judged by, the return of reaching, where none is given.

    best, median and worst are over settings, each the interquartile mean of its seeds; spread is best minus median,
    with a 95 % interval that draws seeds within each setting: the smaller, the less tuning it needs.
    """
    rows, measure = [], measure or shown_of(grouped).judged[1]
    for algo in dict.fromkeys(group[0].algo for group in grouped.values()):
        strata = [scores(g, measure) for g in grouped.values() if g[0].algo == algo]
        if len(strata) < 2:
            continue
        sign = -1.0 if ALL[measure].lower else 1.0
        each = sign * np.array([interquartile_mean(x) for x in strata])

        def spread(drawn: list[np.ndarray], sign: float = sign) -> np.ndarray:
            means = sign * np.stack([interquartile_mean(x) for x in drawn])
            return means.max(0) - np.median(means, axis=0)

        low, high = interval(strata, spread)
        row = {"algo": algo, "settings": len(strata), "best": sign * each.max(), "median": sign * np.median(each)}
        row |= {"worst": sign * each.min(), "spread": each.max() - np.median(each), "low": low, "high": high}
        rows.append(row)
    return pd.DataFrame(rows)


def improvement_matrix(table: pd.DataFrame, measure: str) -> pd.DataFrame:
    """Return of an `improvement_table` one measure as strings: rows are better than columns, both numbered."""
    rows = table[table["measure"] == measure]
    labels = list(dict.fromkeys(rows["better"]))
    number = {label: str(i + 1) for i, label in enumerate(labels)}
    square = rows.pivot(index="better", columns="than", values="probability").loc[labels, labels]
    cells = square.map(lambda p: "-" if np.isnan(p) else f"{p:.2f}").rename(columns=number)
    return cells.set_axis([f"{number[label]}: {label}" for label in labels]).rename_axis("better \\ than", axis=0)


def band(group: Sequence[Trained], x: str, y: str, points: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """Return (points,) of column x and (3, points) of column y: interquartile mean, lowest and highest seed.

    The curves of the seeds are interpolated, over the stretch that all of them have.
    """
    curves = [r.curve for r in group]
    grid = np.linspace(max(c[x].iloc[0] for c in curves), min(c[x].iloc[-1] for c in curves), points)
    with np.errstate(invalid="ignore"):  # infinite where arms were stopped: no curve there
        values = np.stack([np.interp(grid, c[x], c[y]) for c in curves], -1)
    return grid, np.stack([interquartile_mean(values), values.min(-1), values.max(-1)])
