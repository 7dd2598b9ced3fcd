"""Runs of stage=train side by side: groups of seeds, and what can be said of them with few seeds.

Interquartile mean, stratified bootstrap and probability of improvement as Agarwal et al., Deep Reinforcement Learning
at the Edge of the Statistical Precipice (NeurIPS 2021) propose them; a group is all seeds of one setting.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from r2s.errors import UserError
from r2s.reporting.statistics import improvement, interquartile_mean, interval

MEASURES = ("success_2cm", "success_1cm", "success_5mm", "distance_median_m", "return_paper")
LOWER_IS_BETTER = ("distance_median_m",)
# of a config: no setting of a training
BESIDE = ("seed", "name", "root", "resume", "threads", "runs", "policy", "only_missing", "grid")


@dataclass(frozen=True)
class Trained:
    """One finished training.

    Attributes:
        folder: its run folder. seed: its seed. algo: its algorithm.
        settings: {"algo.lr": 5e-4, ...}, everything else of its config, flat.
        curve: its evaluations.csv.
    """

    folder: Path
    seed: int
    algo: str
    settings: dict[str, Any]
    curve: pd.DataFrame

    @property
    def last(self) -> dict[str, float]:
        """The last evaluation."""
        return {str(k): float(v) for k, v in self.curve.iloc[-1].items()}


def read_runs(folders: Sequence[str | Path]) -> list[Trained]:
    """Return the finished trainings among the folders; raises UserError if there is none."""
    out = []
    for folder in map(Path, folders):
        if not all((folder / name).is_file() for name in ("summary.json", "evaluations.csv", "config.yaml")):
            continue
        if json.loads((folder / "meta.json").read_text())["status"] != "done":
            continue
        config = yaml.safe_load((folder / "config.yaml").read_text())
        settings = {k: v for k, v in _flat(config).items() if k.split(".")[0] not in BESIDE}
        algo = str(settings.get("algo.name", "?"))
        out.append(Trained(folder, int(config["seed"]), algo, settings, pd.read_csv(folder / "evaluations.csv")))
    if not out:
        raise UserError("runs: no finished run of stage=train among them; such as runs='runs/train/*'")
    return out


def groups(runs: Sequence[Trained]) -> dict[str, list[Trained]]:
    """Return the runs by what they differ in: {"tqc, lr 0.0005": [seeds ...]}, in the order they came.

    What one algorithm has and another has not tells them apart no better than their names.
    """
    varied: list[str] = []
    for algo in dict.fromkeys(r.algo for r in runs):
        own = [r.settings for r in runs if r.algo == algo]
        varied += [k for k in own[0] if any(s.get(k) != own[0][k] for s in own)]
    common = [k for k in runs[0].settings if not k.startswith("algo.") and all(k in r.settings for r in runs)]
    varied += [k for k in common if len({repr(r.settings[k]) for r in runs}) > 1]
    varied = [k for k in dict.fromkeys(varied) if k != "algo.name"]
    out: dict[str, list[Trained]] = {}
    for r in runs:
        parts = [f"{k.removeprefix('algo.')} {r.settings[k]}" for k in varied if k in r.settings]
        out.setdefault(", ".join([r.algo, *parts]), []).append(r)
    return out


def scores(group: Sequence[Trained], measure: str) -> np.ndarray:
    """Return (S,): the last evaluation of every seed."""
    return np.array([r.last[measure] for r in group])


def summary_table(grouped: Mapping[str, Sequence[Trained]]) -> pd.DataFrame:
    """Return one row per group and measure: seeds, mean, interquartile mean and its 95 % interval."""
    rows = []
    for label, group in grouped.items():
        for measure in MEASURES:
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
            for measure in ("success_1cm", "return_paper"):
                pair = [scores(a, measure), scores(b, measure)]
                low, high = interval(pair, lambda d: improvement(*d))
                row = {"better": first, "than": second, "measure": measure}
                rows.append(row | {"probability": float(improvement(*pair)), "low": low, "high": high})
    return pd.DataFrame(rows)


def sensitivity_table(grouped: Mapping[str, Sequence[Trained]], measure: str = "return_paper") -> pd.DataFrame:
    """Return, per algorithm, how much its score depends on its settings; empty where none has two settings.

    best, median and worst are over settings, each the interquartile mean of its seeds; spread is best minus median,
    with a 95 % interval that draws seeds within each setting: the smaller, the less tuning it needs.
    """
    rows = []
    for algo in dict.fromkeys(group[0].algo for group in grouped.values()):
        strata = [scores(g, measure) for g in grouped.values() if g[0].algo == algo]
        if len(strata) < 2:
            continue
        sign = -1.0 if measure in LOWER_IS_BETTER else 1.0
        each = sign * np.array([interquartile_mean(x) for x in strata])

        def spread(drawn: list[np.ndarray], sign: float = sign) -> np.ndarray:
            means = sign * np.stack([interquartile_mean(x) for x in drawn])
            return means.max(0) - np.median(means, axis=0)

        low, high = interval(strata, spread)
        row = {"algo": algo, "settings": len(strata), "best": sign * each.max(), "median": sign * np.median(each)}
        row |= {"worst": sign * each.min(), "spread": each.max() - np.median(each), "low": low, "high": high}
        rows.append(row)
    return pd.DataFrame(rows)


def band(group: Sequence[Trained], x: str, y: str, points: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """Return (points,) of column x and (3, points) of column y: interquartile mean, lowest and highest seed.

    The curves of the seeds are interpolated, over the stretch that all of them have.
    """
    curves = [r.curve for r in group]
    grid = np.linspace(max(c[x].iloc[0] for c in curves), min(c[x].iloc[-1] for c in curves), points)
    values = np.stack([np.interp(grid, c[x], c[y]) for c in curves], -1)
    return grid, np.stack([interquartile_mean(values), values.min(-1), values.max(-1)])


def _flat(node: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return {"a.b": value} of nested dicts."""
    out: dict[str, Any] = {}
    for key, value in node.items():
        out |= _flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return out
