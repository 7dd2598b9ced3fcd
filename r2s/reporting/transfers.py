"""Finished transfers to an arm, read from their run folders; and which of them can be compared at all."""

import json
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from r2s.files import DAMAGED
from r2s.reporting.conditions import condition
from r2s.reporting.trainings import flat, typed_in, why_not
from r2s.tasks.episode import HOLD_S

FILES = ("config.yaml", "policy.yaml", "overrides.yaml", "summary.json")
OF_ONE_ARM = ("calibration", "network", "training", "told", "latent")  # of conf/adapt: no setting of the adapter
WITHIN_M = {"path": 5e-3, "goal": 1e-2}  # success: of the steps of a path; of the end of a motion to a goal


@dataclass(frozen=True)
class Transferred:
    """One finished run of stage=transfer with an arm."""

    folder: Path
    start: str
    """When it began, as meta.json says it."""
    policy: str
    """The absolute path of its policy's run folder."""
    told: str
    """The adapter that its policy was trained with; "none" where it is told nothing."""
    adapter: str
    """Of conf/adapt."""
    settings: dict[str, Any]
    """Of the adapter, but what belongs to one arm: {"filter_s": 0.087}."""
    arm: str
    """Which arm: "twin, make 1, seed 0"."""
    asked: dict[str, Any]
    """What was asked of the arm beside, as of `condition`."""
    robot: dict[str, Any]
    """Of the policy's training: {"q_max": [...], ...}."""
    what: str
    """"path" where what is asked moves, "goal" where it stays."""
    length: str
    """Of an episode, and the policy's rate: "4 s at 100 Hz"."""
    goals: int
    """How many were asked for."""
    us: float
    """The adapter's own time a cycle, microseconds, median; 0 without one, nan where it was not kept."""
    minutes: float
    """Training that the adapter took; 0 where none, nan where it is not known."""
    episodes: pd.DataFrame
    """A row per episode, its index says which goal: `figures`."""


def read_transfers(folders: Sequence[str | Path]) -> tuple[list[Transferred], dict[str, str]]:
    """Return the finished transfers to an arm among run folders, and {name: why not} of everything else."""
    found, others = [], {}
    for folder in map(Path, folders):
        why = why_not(folder, "transfer", FILES)
        if not why:
            try:
                found.append(_read(folder))
                continue
            except FileNotFoundError:
                why = "no episode on an arm"
            except (KeyError, TypeError, AttributeError, yaml.YAMLError, *DAMAGED):  # somebody wrote into it
                why = "unreadable"
        others[folder.name] = why
    return found, others


def _read(folder: Path) -> Transferred:
    config = yaml.safe_load((folder / "config.yaml").read_text())
    policy = yaml.safe_load((folder / "policy.yaml").read_text())
    meta = json.loads((folder / "meta.json").read_text())
    arm, adapt, told = config["arm"], config["adapt"], policy.get("adapt") or {}
    with np.load(folder / f"episodes_{arm['name']}.npz", allow_pickle=False) as saved:
        ran = {k: saved[k] for k in ("t", "distance", "goal", "ee")}
    predicted = folder / "episodes_predicted.npz"
    model = None
    if predicted.is_file():
        with np.load(predicted, allow_pickle=False) as saved:
            model = {k: saved[k] for k in ("goal", "ee")}
    row = json.loads((folder / "summary.json").read_text())[arm["name"]]
    silent, step = adapt["name"] == "none", float(ran["t"][0])
    minutes = 0.0 if silent else row["adapter_minutes"]
    return Transferred(
        folder,
        str(meta["start"]),
        os.path.abspath(config["policy"]),
        told["name"] if told.get("told") else "none",
        adapt["name"],
        dict(flat({k: v for k, v in adapt.items() if k != "name" and k not in OF_ONE_ARM})),
        ", ".join([arm["name"], *(f"{k} {arm[k]}" for k in ("make", "seed") if k in arm)]),
        condition(arm, typed_in(folder)),
        dict(flat(policy["robot"])),
        "path" if ran["goal"].ndim == 3 else "goal",
        f"{step * len(ran['t']):g} s at {1 / step:g} Hz",
        int(row["asked"]),
        0.0 if silent else _cost(folder / "timing.csv"),
        np.nan if minutes is None else float(minutes),
        figures(ran, model),
    )


def _cost(path: Path) -> float:
    if not path.is_file():
        return np.nan
    table = pd.read_csv(path).set_index("what")["median_ms"]
    return 1e3 * float(table.get("adapter", np.nan))


def figures(ran: Mapping[str, np.ndarray], model: Mapping[str, np.ndarray] | None) -> pd.DataFrame:
    """Return a row per episode, its index says which goal: rmse, success, gap and stopped.

    rmse: mm, of the distance over all steps; gap: the same of the hand's distance to what was predicted. Both are nan
    of an episode that was stopped. success: of a path the share of its steps within 5 mm, of a goal whether the hand
    was within 1 cm for the whole last 0.5 s; 0 of an episode that was stopped.

    Args:
        ran: t (T,) s, distance (E, T) m, goal (E, ...), ee (E, T, 3) m of the episodes on an arm, as of `Episodes`.
        model: goal, ee of those that were predicted, in any order; None: none were.
    """
    distance, stopped = ran["distance"], ~np.isfinite(ran["distance"]).all(1)
    hold = max(1, round(HOLD_S / float(ran["t"][0])))
    if ran["goal"].ndim == 3:
        success = (distance < WITHIN_M["path"]).mean(1)
    else:
        success = (distance[:, -hold:] < WITHIN_M["goal"]).all(1).astype(float)
    names, gap = list(_names(ran["goal"])), np.full(len(distance), np.nan)
    if model is not None:
        expected = dict(zip(_names(model["goal"]), model["ee"], strict=True))
        for i, name in enumerate(names):
            if name in expected:
                gap[i] = _rms_mm(np.linalg.norm(ran["ee"][i] - expected[name], axis=-1))
    gap[stopped], success[stopped] = np.nan, 0.0
    rmse = np.array([np.nan if end else _rms_mm(d) for d, end in zip(distance, stopped, strict=True)])
    columns = {"rmse": rmse, "success": success, "gap": gap, "stopped": stopped.astype(float)}
    return pd.DataFrame(columns, index=names)


def _rms_mm(x: np.ndarray) -> float:
    return float(1e3 * np.sqrt((x**2).mean()))


def _names(goals: np.ndarray) -> Iterator[str]:
    """Give a name for each goal, the same wherever it is asked for; of equal ones the k-th has its own.

    Goals of two machines may differ in their last digits: a micrometre is not looked at.
    """
    seen: Counter[bytes] = Counter()
    for goal in goals:
        key = np.rint(1e5 * np.asarray(goal, dtype=float)).astype(np.int64).tobytes()
        seen[key] += 1
        yield f"{sha256(key).hexdigest()[:16]}.{seen[key]}"


def comparable(found: Sequence[Transferred]) -> tuple[list[Transferred], dict[str, str]]:
    """Return the largest set of transfers that can be compared, and {name: why} of those that are set apart.

    They can be compared where robot, task and goals are the same. Of one policy, adapter, arm and condition the last
    run counts.
    """
    first = max(found, key=lambda run: sum(not _apart(other, run) for other in found))
    apart = {r.folder.name: why for r in found if (why := _apart(r, first))}
    last: dict[str, Transferred] = {}
    for run in sorted((r for r in found if r.folder.name not in apart), key=lambda r: r.start):
        key = repr((run.policy, run.adapter, sorted(run.settings.items()), run.arm, run.asked))
        if key in last:
            apart[last[key].folder.name] = "done again"
        last[key] = run
    return [r for r in found if r.folder.name not in apart], apart


def _apart(run: Transferred, first: Transferred) -> str:
    """Return why a transfer cannot be compared with `first`; "" where it can."""
    if keys := [k for k in first.robot | run.robot if run.robot.get(k) != first.robot.get(k)]:
        return f"another robot: robot.{keys[0]} differs"
    if run.what != first.what:
        return f"another task: to follow a {run.what}" if run.what == "path" else "another task: to reach a goal"
    if run.length != first.length:
        return f"another task: {run.length}, not {first.length}"
    if run.goals != first.goals:
        return f"another evaluation: evaluation.episodes is {run.goals}, not {first.goals}"
    return "" if set(run.episodes.index) & set(first.episodes.index) else "other goals"
