"""The league of adapters: transfers of one policy side by side, a row per adapter and a column per condition.

Arms are what is averaged over. The bootstrap is paired: arms are drawn, and of each arm its episodes, the same for
all rows of a condition.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from r2s.reporting.conditions import AS_IT_IS, in_words, order
from r2s.reporting.measures import Measure
from r2s.reporting.statistics import paired
from r2s.reporting.transfers import Transferred

MEASURES = {  # of transfers that follow a path, and of those that reach a goal
    "path": {
        "rmse": Measure("RMSE, mm", "RMSE of the path, mm", 1, 2, lower=True),
        "success": Measure("within 5 mm, %", "time within 5 mm, %", 100, 0),
        "gap": Measure("path gap, mm", "gap to the predicted path, mm", 1, 2, lower=True),
    },
    "goal": {
        "success": Measure("within 1 cm, %", "success within 1 cm, %", 100, 0),
        "gap": Measure("path gap, mm", "gap to the predicted path, mm", 1, 2, lower=True),
    },
}
SQUARES = ("rmse", "gap")  # whose mean is the root of the mean of squares


@dataclass(frozen=True)
class League:
    """What several transfers say of adapters.

    Attributes:
        measures: {column of scores' `measure`: how it is shown}.
        scores: a row per measure, condition and row: mean, low, high; less those of the `reference` row (None: there
            is none) difference, and its interval worse_low, worse_high, of which above 0 is worse; stopped, of asked
            episodes; episodes, arms: how many the mean is of.
        success: a row per condition and row: success there, and `unloaded`, that of the same arms and episodes with
            nothing asked of the arm.
        costs: a row per row: us a cycle, minutes of training.
        runs: {row: its transfers}. key: what a person needs to read the names. left_out: what does not count.
    """

    measures: Mapping[str, Measure]
    scores: pd.DataFrame
    success: pd.DataFrame
    costs: pd.DataFrame
    runs: Mapping[str, Sequence[Transferred]]
    key: Sequence[str]
    left_out: Sequence[str]


def league(found: Sequence[Transferred]) -> League:
    """Return the league of transfers that can be compared (`comparable`)."""
    runs, key = rows_of(found)
    reference = {name: _reference(name, runs) for name in runs}
    frame = pd.concat(
        [
            r.episodes.rename_axis("goal").reset_index().assign(row=name, arm=r.arm, condition=in_words(r.asked))
            for name, members in runs.items()
            for r in members
        ],
        ignore_index=True,
    )
    measures = dict(MEASURES[found[0].what])
    if frame["gap"].isna().all():
        del measures["gap"]
    asked = {in_words(r.asked): order(r.asked) for r in found}
    parts, left_out, counted, arms = [], [], [], frame["arm"].unique()
    for condition in sorted(asked, key=lambda c: asked[c]):
        shared, words = in_common(frame[frame["condition"] == condition])
        left_out += [f"{condition}: {w}" for w in words]
        if len(missing := [a for a in arms if a not in set(frame.loc[frame["condition"] == condition, "arm"])]):
            left_out.append(f"{condition}: no transfer to {'; '.join(missing)}")
        counted.append(shared)
        for measure in measures if len(shared) else ():
            table = scores(shared, measure, reference, measures[measure].lower)
            parts.append(table.assign(measure=measure, condition=condition))
    costs = pd.DataFrame(
        {
            "us": {name: np.mean([r.us for r in members]) for name, members in runs.items()},
            "minutes": {name: np.mean([r.minutes for r in members]) for name, members in runs.items()},
        }
    )
    table = (
        pd.concat(parts, ignore_index=True)
        if parts
        else pd.DataFrame(columns=["row", "measure", "condition", "worse_low", "stopped"])
    )
    return League(measures, table, against_unloaded(pd.concat(counted)), costs, runs, key, left_out)


def in_common(part: pd.DataFrame) -> tuple[pd.DataFrame, list[str]]:
    """Return of one condition the arms and episodes that all of its rows have, and in words what that leaves out."""
    count = part["row"].nunique()
    of_all = part.groupby(["arm", "goal"], sort=False)["row"].transform("nunique") == count
    shared, words = part[of_all], []
    for arm, own in part.groupby("arm", sort=False):
        kept, all_of_it = shared.loc[shared["arm"] == arm, "goal"].nunique(), own["goal"].nunique()
        missing = [name for name in part["row"].unique() if name not in set(own["row"])]
        if missing:
            words.append(f"{arm} is left out, {', '.join(missing)} was not there")
        elif kept < all_of_it:
            words.append(f"{all_of_it - kept} of {all_of_it} episodes of {arm} are left out, not all rows have them")
    return shared, words


def against_unloaded(shared: pd.DataFrame) -> pd.DataFrame:
    """Return `League.success` of what is in common in all conditions: of arms and episodes that AS_IT_IS has, too."""
    key = ["row", "arm", "goal"]
    unloaded = shared.loc[shared["condition"] == AS_IT_IS, [*key, "success"]]
    both = shared.merge(unloaded.rename(columns={"success": "unloaded"}), on=key)
    return both.groupby(["condition", "row"], sort=False)[["success", "unloaded"]].mean().reset_index()


def scores(
    shared: pd.DataFrame, measure: str, reference: Mapping[str, str | None], lower: bool, seed: int = 0
) -> pd.DataFrame:
    """Return a row per row of one condition and measure, as of `League.scores`.

    An episode that was stopped has no RMSE and no gap: it is left out of these for all rows, but for one that was
    stopped in all of them. One episode has no interval.

    Args:
        shared: of `in_common`. measure: its column. reference: {row: the row that it is compared with}.
        lower: whether less is better. seed: of the bootstrap.
    """
    wide = shared.pivot(index=["arm", "goal"], columns="row", values=measure)[list(shared["row"].unique())]
    ended = shared.groupby("row", sort=False)["stopped"].sum()
    power = 2 if measure in SQUARES else 1
    kept = wide.dropna(axis=1, how="all").dropna()
    names = list(kept.columns)
    each = [w.to_numpy(dtype=float) ** power for _, w in kept.groupby(level="arm", sort=False)]
    rows = {n: {"mean": np.nan, "low": np.nan, "high": np.nan} for n in wide.columns}
    if len(kept):
        draws = paired(each, np.random.default_rng(seed)) ** (1 / power)
        middle = np.concatenate(each).mean(0) ** (1 / power)
        for k, name in enumerate(names):
            rows[name] = {"mean": middle[k]} | _interval(draws[:, k], len(kept))
            if (other := reference[name]) in names:
                j, sign = names.index(other), 1 if lower else -1
                worse = _interval(sign * (draws[:, k] - draws[:, j]), len(kept))
                rows[name] |= {"difference": middle[k] - middle[j]}
                rows[name] |= {f"worse_{end}": x for end, x in worse.items()}
    counts = {"episodes": len(kept), "asked": len(wide), "arms": len(each)}
    table = [{"row": n, "reference": reference[n], "stopped": int(ended[n])} | counts | r for n, r in rows.items()]
    columns = ["difference", "worse_low", "worse_high"]
    return pd.DataFrame(table).reindex(columns=[*dict.fromkeys([*table[0], *columns])])


def _interval(draws: np.ndarray, count: int) -> dict[str, float]:
    low, high = np.quantile(draws, [0.025, 0.975]) if count > 1 else (np.nan, np.nan)
    return {"low": float(low), "high": float(high)}


def rows_of(found: Sequence[Transferred]) -> tuple[dict[str, list[Transferred]], list[str]]:
    """Return the transfers by row, named as shortly as tells them apart, and lines that say what a name hides.

    A row is an adapter. Where an arm met several policies of one kind it is an adapter and a policy; where each arm
    has a policy of its own, the policies count as one.
    """
    of_arm: dict[tuple[str, str], set[str]] = {}
    for r in found:
        of_arm.setdefault((r.arm, r.told), set()).add(r.policy)
    apart = any(len(policies) > 1 for policies in of_arm.values())
    short = _short({r.policy for r in found})
    varied = _varied(found)
    sets: dict[tuple, list[Transferred]] = {}
    for r in found:
        own = ", ".join([r.adapter, *(f"{k}={r.settings.get(k)}" for k in varied[r.adapter])])
        kind = short[r.policy] if apart else "" if r.told in ("none", r.adapter) else f"policy for {r.told}"
        sets.setdefault((own, kind), []).append(r)
    adapters = [own for own, _ in sets]
    rows = {}
    for own, kind in sorted(sets, key=lambda s: (sets[s][0].adapter != "none", s[1])):
        name = f"{own} ({kind})" if kind and (not apart or adapters.count(own) > 1) else own
        rows[name] = sets[own, kind]
    key = []
    for policy, name in short.items() if len(short) > 1 and not apart else ():
        arms = sorted({r.arm for r in found if r.policy == policy})
        under = [row for row, members in rows.items() if any(r.policy == policy for r in members)]
        key.append(f"{name} is the policy of {', '.join(under)} on {'; '.join(arms)}")
    return rows, key


def _varied(found: Sequence[Transferred]) -> dict[str, list[str]]:
    """Return the settings of each adapter that its transfers differ in."""
    out = {}
    for adapter in {r.adapter for r in found}:
        own = [r.settings for r in found if r.adapter == adapter]
        keys = sorted({k for s in own for k in s})
        out[adapter] = [k for k in keys if len({repr(s.get(k)) for s in own}) > 1]
    return out


def _short(paths: set[str]) -> dict[str, str]:
    """Return the last parts of each path, as few as tell them apart."""
    for count in range(1, max(len(Path(p).parts) for p in paths) + 1):
        names = {p: os.path.join(*Path(p).parts[-count:]) for p in sorted(paths)}
        if len(set(names.values())) == len(paths):
            break
    return names


def _reference(name: str, rows: Mapping[str, Sequence[Transferred]]) -> str | None:
    """Return the row without an adapter of the same policies; of others where there is but one; else None."""
    policies = {r.policy for r in rows[name]}
    none = {n: {r.policy for r in members} for n, members in rows.items() if members[0].adapter == "none"}
    same = [n for n, own in none.items() if policies & own]
    return same[0] if same else next(iter(none)) if len(none) == 1 else None


def verdict(table: League, row: str) -> str:
    """Return a line: how much of its success a row keeps, and where it does harm."""
    s, own = table.scores, table.success[(table.success["row"] == row) & (table.success["condition"] != AS_IT_IS)]
    if not len(own):
        words = f"{row}: what it keeps is not known, that takes the arm {AS_IT_IS} and another condition"
    elif not own["unloaded"].all():
        words = f"{row} has no success with the arm {AS_IT_IS}, and so none to keep"
    else:
        worst = min(own.to_dict("records"), key=lambda r: r["success"] / r["unloaded"])
        now, unloaded = 100 * worst["success"], 100 * worst["unloaded"]
        words = f"{row} keeps {100 * now / unloaded:.0f} % of its success with the arm {AS_IT_IS}; its worst "
        words += f"condition is {worst['condition']} ({now:.0f} instead of {unloaded:.0f} %)"
    if table.runs[row][0].adapter == "none":
        return f"{words}."
    own = s[(s["row"] == row) & s["worse_low"].notna()]
    if not len(own):
        return f"{words}. Harm: not known, that takes adapt=none on the same arms, and more than one episode."
    worse = own[own["worse_low"] > 0]
    if not len(worse):
        return f"{words}. No harm is seen."
    harm = "; ".join(_harm(table, part) for _, part in worse.groupby("condition", sort=False))
    return f"{words}. Harm against {own['reference'].iloc[0]}: {harm}."


def _harm(table: League, worse: pd.DataFrame) -> str:
    """Return "1.0 kg (RMSE, mm: 1.38 instead of 1.06)" of the rows of one condition."""
    parts = []
    for r in worse.to_dict("records"):
        m = table.measures[r["measure"]]
        parts.append(f"{m.short}: {m.cell(r['mean'])} instead of {m.cell(r['mean'] - r['difference'])}")
    return f"{worse['condition'].iloc[0]} ({'; '.join(parts)})"
