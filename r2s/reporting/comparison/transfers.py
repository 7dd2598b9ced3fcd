"""Read the run folders of finished transfers to an arm, and select transfers that are comparable."""

import json
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from r2s.files import DAMAGED
from r2s.reporting.comparison.arm_conditions import condition
from r2s.reporting.comparison.trainings import settings_in, typed_in, why_not
from r2s.reporting.measures import measures_of
from r2s.tasks.measures import MeasureTable

FILES = ("config.yaml", "policy.yaml", "overrides.yaml", "summary.json")
ARM_SPECIFIC = ("calibration",)  # keys of conf/adapt that describe the arm, not the adapter


@dataclass(frozen=True)
class Transferred:
    """One finished run of stage=transfer with an arm.

    Attributes:
        folder: run folder. start: start time, from meta.json. policy: absolute path of the policy's run folder.
        adapter: name in conf/adapt. settings: the adapter's settings, such as {"filter_s": 0.087}.
        arm: name such as "twin, rigid, seed 0" or "panda, 172.16.0.2". condition: output of `condition`.
        robot: robot config in training.
        measures: measures of the task. length: episode length and rate, as "4 s at 100 Hz". goals: number of goals.
        us: median computing time of the adapter per cycle in microseconds; 0 without an adapter, nan if not measured.
        episodes: table with a row per episode, indexed by goal, and columns for `MeasureTable.transfer`, path gap and
            arm_stopped (0 or 1).
    """

    folder: Path
    start: str
    policy: str
    adapter: str
    settings: dict[str, Any]
    arm: str
    condition: dict[str, Any]
    robot: dict[str, Any]
    measures: MeasureTable
    length: str
    goals: int
    us: float
    episodes: pd.DataFrame


def read_transfers(folders: Sequence[str | Path]) -> tuple[list[Transferred], dict[str, str]]:
    """Return the finished transfers to an arm in `folders`, and {folder: reason} for the other folders."""
    found, others = [], {}
    for folder in map(Path, folders):
        why = why_not(folder, "transfer", FILES)
        if not why:
            try:
                found.append(_read(folder))
                continue
            except FileNotFoundError:
                why = "no episode on an arm"
            except (KeyError, TypeError, AttributeError, yaml.YAMLError, *DAMAGED):  # a file edited by hand
                why = "unreadable"
        others[folder.name] = why
    return found, others


def _read(folder: Path) -> Transferred:
    config = yaml.safe_load((folder / "config.yaml").read_text())
    policy = yaml.safe_load((folder / "policy.yaml").read_text())
    meta = json.loads((folder / "meta.json").read_text())
    arm, adapt, measures = config["arm"], config["adapt"], measures_of(folder)
    with np.load(folder / f"episodes_{arm['name']}.npz", allow_pickle=False) as saved:
        t, goals = saved["t"], saved["goal"]
    row = json.loads((folder / "summary.json").read_text())[arm["name"]]
    step = float(t[0])
    words = {"name": "{}", "variant": "{}", "seed": "seed {}", "address": "{}"}
    return Transferred(
        folder,
        str(meta["start"]),
        os.path.abspath(config["policy"]),
        adapt["name"],
        settings_in(adapt, adapt.keys() - {"name", *ARM_SPECIFIC}),
        ", ".join(word.format(arm[k]) for k, word in words.items() if k in arm),
        condition(arm, typed_in(folder)),
        settings_in(policy["robot"], policy["robot"]),
        measures,
        f"{step * len(t):g} s at {1 / step:g} Hz",
        int(row["asked"]),
        0.0 if adapt["name"] == "none" else _cost(folder / "timing.csv"),
        pd.read_csv(folder / f"episodes_{arm['name']}.csv").set_axis(list(_names(goals))),
    )


def _cost(path: Path) -> float:
    if not path.is_file():
        return np.nan
    table = pd.read_csv(path).set_index("what")["median_ms"]
    return 1e3 * float(table.get("adapter", np.nan))


def _names(goals: np.ndarray) -> Iterator[str]:
    """Yield a name for each goal, the same in all transfers; a number distinguishes equal goals of one transfer.

    Goals are rounded to 10 micrometers, because two machines may compute them with different last digits.
    """
    seen: Counter[bytes] = Counter()
    for goal in goals:
        key = np.rint(1e5 * np.asarray(goal, dtype=float)).astype(np.int64).tobytes()
        seen[key] += 1
        yield f"{sha256(key).hexdigest()[:16]}.{seen[key]}"


def comparable(found: Sequence[Transferred]) -> tuple[list[Transferred], dict[str, str]]:
    """Return the largest set of comparable transfers, and {run: reason} for all other transfers.

    Transfers are comparable if robot, task and number of goals agree, and if at least one goal is common to both. Of
    several runs that agree in policy, adapter, settings, arm and condition, only the latest is used.
    """
    first = max(found, key=lambda run: sum(not _difference(other, run) for other in found))
    apart = {r.folder.name: why for r in found if (why := _difference(r, first))}
    last: dict[str, Transferred] = {}
    for run in sorted((r for r in found if r.folder.name not in apart), key=lambda r: r.start):
        key = repr((run.policy, run.adapter, sorted(run.settings.items()), run.arm, run.condition))
        if key in last:
            apart[last[key].folder.name] = "repeated later"
        last[key] = run
    return [r for r in found if r.folder.name not in apart], apart


def _difference(run: Transferred, first: Transferred) -> str:
    """Return why a transfer is not comparable with `first`; "" for a comparable transfer."""
    if keys := [k for k in first.robot | run.robot if run.robot.get(k) != first.robot.get(k)]:
        return f"another robot: robot.{keys[0]} differs"
    one, other = (r.measures[r.measures.selection[0]].title for r in (run, first))
    if one != other:
        return f"another task: selected by {one}, not {other}"
    if run.length != first.length:
        return f"another task: {run.length}, not {first.length}"
    if run.goals != first.goals:
        return f"another evaluation: evaluation.episodes is {run.goals}, not {first.goals}"
    return "" if set(run.episodes.index) & set(first.episodes.index) else "other goals"
