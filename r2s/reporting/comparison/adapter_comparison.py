"""Compare adapters by their transfers, in tables with a row per adapter and a column per test condition.

Each mean is taken over arms and episodes. The bootstrap is paired. Each draw resamples the arms, then the episodes of
each arm; all rows of a condition use the same sample.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from r2s.reporting.comparison.arm_conditions import NOMINAL, in_words, order, without_common
from r2s.reporting.comparison.grouping import differing
from r2s.reporting.comparison.statistics import paired
from r2s.reporting.comparison.transfers import Transferred
from r2s.tasks.measures import GAP, Measure

COLUMNS = ["row", "reference", "measure", "condition", "mean", "low", "high", "difference", "worse_low", "worse_high"]
COUNTS = ["stopped", "asked", "episodes", "arms"]


@dataclass(frozen=True)
class AdapterComparison:
    """Scores of adapters; each row describes one adapter, or one adapter with one policy (see `rows_of`).

    Attributes:
        measures: {key: compared measure}. headline: the measure that summarizes a row.
        scores: table with a line per measure, condition and row. `low` to `high` is the 95 % interval of `mean`.
            `difference` is the row's mean minus the mean of the row `reference` (None: no reference). `worse_low` to
            `worse_high` is the 95 % interval of this difference, positive if the row is worse.
            `asked` is the number of episodes common to all rows, `episodes` the number of these in the mean,
            `stopped` the number of stopped episodes, `arms` the number of arms.
        losses: table with a line per condition and row. The column `value` is the mean of the headline measure; the
            column `nominal` is this mean over the same arms and episodes in the nominal condition.
        costs: table with a line per row. The column `us` is the adapter's computing time per cycle in microseconds.
        runs: {row: its transfers}. key: lines that explain policy names. left_out: lines about omitted episodes.
    """

    measures: Mapping[str, Measure]
    headline: Measure
    scores: pd.DataFrame
    losses: pd.DataFrame
    costs: pd.DataFrame
    runs: Mapping[str, Sequence[Transferred]]
    key: Sequence[str]
    left_out: Sequence[str]


def compare_adapters(found: Sequence[Transferred]) -> AdapterComparison:
    """Compare the adapters of the transfers `found`, which `comparable` selected."""
    conditions = without_common([r.condition for r in found])
    found = [replace(r, condition=own) for r, own in zip(found, conditions, strict=True)]
    runs, key = rows_of(found)
    reference = {name: _reference(name, runs) for name in runs}
    frame = pd.concat(
        [
            r.episodes.rename_axis("goal").reset_index().assign(row=name, arm=r.arm, condition=in_words(r.condition))
            for name, members in runs.items()
            for r in members
        ],
        ignore_index=True,
    )
    own = found[0].measures
    measures = {key: own[key] for key in own.transfer}
    headline = next((measures[key] for key in own.selection if key in measures), own[own.transfer[0]])
    if GAP.key in frame and frame[GAP.key].notna().any():
        measures[GAP.key] = GAP
    places = {in_words(r.condition): order(r.condition) for r in found}
    parts, left_out, counted, arms = [], [], [], frame["arm"].unique()
    for condition in sorted(places, key=lambda c: places[c]):
        shared, words = in_common(frame[frame["condition"] == condition])
        left_out += [f"{condition}: {w}" for w in words]
        if len(missing := [a for a in arms if a not in set(frame.loc[frame["condition"] == condition, "arm"])]):
            left_out.append(f"{condition}: no transfer to {'; '.join(missing)}")
        counted.append(shared)
        for measure in measures.values() if len(shared) else ():
            parts.append(score(shared, measure, reference).assign(condition=condition))
    costs = pd.DataFrame({"us": {name: np.mean([r.us for r in members]) for name, members in runs.items()}})
    table = pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=[*COLUMNS, *COUNTS])
    losses = against_nominal(pd.concat(counted), headline.key)
    return AdapterComparison(measures, headline, table, losses, costs, runs, key, left_out)


def in_common(part: pd.DataFrame) -> tuple[pd.DataFrame, list[str]]:
    """Return the episodes that all rows of a condition have in common, and lines about omitted arms and episodes."""
    count = part["row"].nunique()
    of_all = part.groupby(["arm", "goal"], sort=False)["row"].transform("nunique") == count
    shared, words = part[of_all], []
    for arm, own in part.groupby("arm", sort=False):
        kept, total = shared.loc[shared["arm"] == arm, "goal"].nunique(), own["goal"].nunique()
        missing = [name for name in part["row"].unique() if name not in set(own["row"])]
        if missing:
            words.append(f"{arm} left out, no transfer with {', '.join(missing)}")
        elif kept < total:
            words.append(f"{total - kept} of {total} episodes of {arm} left out, not all rows have them")
    return shared, words


def against_nominal(shared: pd.DataFrame, measure: str) -> pd.DataFrame:
    """Return the table `AdapterComparison.losses`. shared: outputs of `in_common` for all conditions, joined."""
    key = ["row", "arm", "goal"]
    values = shared.rename(columns={measure: "value"})
    nominal = values.loc[values["condition"] == NOMINAL, [*key, "value"]].rename(columns={"value": "nominal"})
    both = values.merge(nominal, on=key)
    return both.groupby(["condition", "row"], sort=False)[["value", "nominal"]].mean().reset_index()


def score(shared: pd.DataFrame, measure: Measure, reference: Mapping[str, str | None], seed: int = 0) -> pd.DataFrame:
    """Return the lines of the table `AdapterComparison.scores` for one measure and one condition.

    If one row has no finite value for an episode, such as no RMSE after a stop, all rows omit this episode. A row
    without any finite value does not affect the other rows. The mean of a single episode has no interval.

    Args:
        shared: output of `in_common`. measure: the compared measure. reference: {row: its reference row or None}.
        seed: seed of the bootstrap.
    """
    wide = shared.pivot(index=["arm", "goal"], columns="row", values=measure.key)[list(shared["row"].unique())]
    wide = wide.replace([np.inf, -np.inf], np.nan)  # for a stopped episode, some tasks report inf
    stopped = shared.groupby("row", sort=False)["arm_stopped"].sum()
    power = 2 if measure.root_mean_square else 1
    kept = wide.dropna(axis=1, how="all").dropna()
    names = list(kept.columns)
    each = [w.to_numpy(dtype=float) ** power for _, w in kept.groupby(level="arm", sort=False)]
    rows: dict[str, dict] = {n: {} for n in wide.columns}
    if len(kept):
        draws = paired(each, np.random.default_rng(seed)) ** (1 / power)
        middle = np.concatenate(each).mean(0) ** (1 / power)
        for k, name in enumerate(names):
            low, high = _interval(draws[:, k], len(kept))
            rows[name] = {"mean": middle[k], "low": low, "high": high}
            if (other := reference[name]) in names:
                j = names.index(other)
                low, high = _interval(-measure.sign * (draws[:, k] - draws[:, j]), len(kept))
                rows[name] |= {"difference": middle[k] - middle[j], "worse_low": low, "worse_high": high}
    counts = {"episodes": len(kept), "asked": len(wide), "arms": len(each), "measure": measure.key}
    table = [{"row": n, "reference": reference[n], "stopped": int(stopped[n])} | counts | r for n, r in rows.items()]
    return pd.DataFrame(table).reindex(columns=[*COLUMNS, *COUNTS])


def _interval(draws: np.ndarray, count: int) -> tuple[float, float]:
    low, high = np.quantile(draws, [0.025, 0.975]) if count > 1 else (np.nan, np.nan)
    return float(low), float(high)


def rows_of(found: Sequence[Transferred]) -> tuple[dict[str, list[Transferred]], list[str]]:
    """Return {row name: transfers}, and lines that explain the names of policies.

    If any arm ran several policies, a row is an adapter with one policy. Otherwise, a row combines all policies of an
    adapter.
    """
    of_arm: dict[str, set[str]] = {}
    for r in found:
        of_arm.setdefault(r.arm, set()).add(r.policy)
    apart = any(len(policies) > 1 for policies in of_arm.values())
    short = _short({r.policy for r in found})
    varied = {a: sorted(differing([r.settings for r in found if r.adapter == a])) for a in {r.adapter for r in found}}
    sets: dict[tuple, list[Transferred]] = {}
    for r in found:
        own = ", ".join([r.adapter, *(f"{k}={r.settings.get(k)}" for k in varied[r.adapter])])
        sets.setdefault((own, short[r.policy] if apart else ""), []).append(r)
    adapters = [own for own, _ in sets]
    rows = {}
    for own, policy in sorted(sets, key=lambda s: (sets[s][0].adapter != "none", s[1])):
        name = f"{own} ({policy})" if policy and adapters.count(own) > 1 else own
        rows[name] = sets[own, policy]
    key = []
    for policy, name in short.items() if len(short) > 1 and not apart else ():
        arms = sorted({r.arm for r in found if r.policy == policy})
        under = [row for row, members in rows.items() if any(r.policy == policy for r in members)]
        key.append(f"{name} is the policy of {', '.join(under)} on {'; '.join(arms)}")
    return rows, key


def _short(paths: set[str]) -> dict[str, str]:
    """Return {path: its last k components}, with the smallest k for which all these short paths differ."""
    for count in range(1, max(len(Path(p).parts) for p in paths) + 1):
        names = {p: os.path.join(*Path(p).parts[-count:]) for p in sorted(paths)}
        if len(set(names.values())) == len(paths):
            break
    return names


def _reference(name: str, rows: Mapping[str, Sequence[Transferred]]) -> str | None:
    """Return the adapt=none row that shares a policy with the row `name`; else the only adapt=none row, or None."""
    policies = {r.policy for r in rows[name]}
    none = {n: {r.policy for r in members} for n, members in rows.items() if members[0].adapter == "none"}
    same = [n for n, own in none.items() if policies & own]
    return same[0] if same else next(iter(none)) if len(none) == 1 else None


def verdict(found: AdapterComparison, row: str) -> str:
    """Describe a row: headline measure in its worst condition, and measures significantly worse than adapt=none."""
    m, table = found.headline, found.losses
    own = table[(table["row"] == row) & (table["condition"] != NOMINAL)].to_dict("records")
    if own:
        worst = min(own, key=lambda r: m.sign * (r["value"] - r["nominal"]))
        before, now = m.in_words(worst["nominal"]), f"{m.cell(worst['value'])} {m.unit}".rstrip()
        words = f"{row}: {before} on the nominal arm, {now} in its worst condition, {worst['condition']}"
    else:
        words = f"{row}: a loss against the nominal arm needs transfers to the nominal arm and in another condition"
    if found.runs[row][0].adapter == "none":
        return f"{words}."
    compared = found.scores[(found.scores["row"] == row) & found.scores["worse_low"].notna()]
    if not len(compared):
        return f"{words}. A comparison with adapt=none needs the same arms and more than one episode."
    reference, worse = compared["reference"].iloc[0], compared[compared["worse_low"] > 0]
    if not len(worse):
        return f"{words}. Nowhere significantly worse than {reference}."
    places = "; ".join(_place(found, part) for _, part in worse.groupby("condition", sort=False))
    return f"{words}. Significantly worse than {reference}: {places}."


def _place(found: AdapterComparison, worse: pd.DataFrame) -> str:
    """Name a condition and the measures that are worse there: "1.0 kg (RMSE of the path 1.38 mm instead of 1.06)"."""
    parts = []
    for r in worse.to_dict("records"):
        m = found.measures[r["measure"]]
        parts.append(f"{m.in_words(r['mean'])} instead of {m.cell(r['mean'] - r['difference'])}")
    return f"{worse['condition'].iloc[0]} ({'; '.join(parts)})"
