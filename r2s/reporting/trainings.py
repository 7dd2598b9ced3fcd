"""Finished trainings, read from their run folders; and which of them can be compared at all."""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from r2s.errors import UserError
from r2s.reporting.measures import ALL, shown

# parts of a config that a training reads, beside its seed: runs that agree in them are seeds of one group
READ = ("algo", "budget", "calibration", "dr", "friction", "inertia", "reward")
ALIKE = ("robot", "task")  # parts without whose agreement nothing can be compared
FILES = ("config.yaml", "overrides.yaml", "evaluations.csv", "summary.json")
BUDGETS_APART = 2.0  # how many times the smaller budget the larger one may be
CONTROLLERS = ("oracle", "computed_torque")  # which are not trained
UNFINISHED = {"running": "unfinished", "stopped": "stopped", "failed": "failed"}


@dataclass(frozen=True)
class Trained:
    """One finished run of stage=train."""

    folder: Path
    seed: int
    algo: str
    settings: dict[str, Any]
    """What it read: {"algo.lr": 5e-4, "dr.phi_relative": 0.1, ...}."""
    alike: dict[str, Any]
    """What must be the same in two runs that are compared: {"task.ctrl_hz": 50, ..., "evaluation.episodes": 200}."""
    typed: dict[str, str]
    """What the user typed of the settings: {"dr": "paper", "algo.lr": "5e-4"}."""
    toy: bool
    """Whether it ran with +experiment=toy, which learns nothing."""
    minutes: float | None
    """Its budget, None where env_steps were the budget."""
    curve: pd.DataFrame
    """Its evaluations.csv, on the goals that its best policy was chosen on."""
    last: dict[str, float]
    """What its last policy does on goals that nothing was chosen on: of its summary.json."""

    @property
    def learned(self) -> bool:
        """Whether there was anything to learn; the oracle is a controller."""
        return self.last["env_steps"] > 0


def read_trainings(folders: Sequence[str | Path]) -> tuple[list[Trained], dict[str, str]]:
    """Return the finished trainings among run folders, and {name: why not} of everything else.

    Raises:
        UserError: there is no finished training.
    """
    trained, others = trainings_among(folders)
    if not trained:
        seen = f"; seen: {'; '.join(in_words(others))}" if others else ""
        raise UserError(f"runs: no finished run of stage=train among them, such as runs='runs/train/*' has{seen}")
    return trained, others


def trainings_among(folders: Sequence[str | Path]) -> tuple[list[Trained], dict[str, str]]:
    """Return what `read_trainings` does, also where there is none."""
    trained, others = [], {}
    for folder in map(Path, folders):
        if why := why_not(folder, "train", FILES):
            others[folder.name] = why
            continue
        try:
            trained.append(_read(folder))
        except (KeyError, TypeError, ValueError, yaml.YAMLError):  # somebody wrote into it
            others[folder.name] = "unreadable"
    return trained, others


def why_not(folder: Path, of: str, files: Iterable[str]) -> str:
    """Return why a folder is no finished run of the stage `of`, with these files; "" where it is one."""
    try:
        meta = json.loads((folder / "meta.json").read_text())
        stage, status = meta.get("stage", "train"), meta["status"]
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return "no run folder"
    if stage != of:
        return f"stage={stage}"
    if status != "done":
        return UNFINISHED.get(status, status)
    missing = [name for name in files if not (folder / name).is_file()]
    return f"it has no {missing[0]}" if missing else ""


def typed_in(folder: Path) -> dict[str, str]:
    """Return what was typed for a run: {"dr": "paper", "algo.lr": "5e-4"}."""
    words = yaml.safe_load((folder / "overrides.yaml").read_text()) or []
    pairs = (word.lstrip("+~").partition("=") for word in words)
    return {key: value for key, _, value in pairs}


def _read(folder: Path) -> Trained:
    config = yaml.safe_load((folder / "config.yaml").read_text())
    algo = config["algo"]
    name = algo.get("name") or algo["_target_"].rpartition(".")[2].lower()
    read = set(READ)
    if config.get("calibration"):
        read -= {"friction", "inertia"}  # identified values stand over them
    if (config.get("adapt") or {}).get("told"):
        read.add("adapt")
    if name in CONTROLLERS:
        read -= {"budget", "reward"}
    typed = {k: v for k, v in typed_in(folder).items() if k.split(".")[0] in read | {"experiment"}}
    budget = config.get("budget", {})
    curve = pd.read_csv(folder / "evaluations.csv")
    if curve.empty:
        raise ValueError("no evaluation")
    measures = shown(curve.columns).compared
    last = json.loads((folder / "summary.json").read_text())["last"]
    last = {k: np.nan if v is None else float(v) for k, v in last.items()}  # null: no episode had one
    for measure in (m for m in measures if ALL[m].lower):  # of arms that were all stopped
        curve[measure] = curve[measure].astype(float).fillna(np.inf)
        last[measure] = np.inf if np.isnan(last[measure]) else last[measure]
    rows = curve[["env_steps", "wall_clock_s", *measures]].astype(float).to_numpy()
    if np.isnan([*rows.ravel(), *(last[m] for m in measures)]).any():
        raise ValueError("an evaluation that is no number")
    return Trained(
        folder,
        int(config["seed"]),
        name,
        dict(flat({k: v for k, v in config.items() if k in read})),
        dict(flat({k: v for k, v in config.items() if k in ALIKE}))
        | {"evaluation.episodes": config.get("evaluation", {}).get("episodes")},
        typed,
        typed.get("experiment") == "toy",
        None if budget.get("env_steps") else budget.get("minutes"),
        curve,
        last,
    )


def comparable(trained: Sequence[Trained]) -> tuple[list[Trained], dict[str, str]]:
    """Return the largest set of runs that can be compared, and {name: why} of those that are set apart.

    Runs can be compared where robot, task and evaluation are the same and no budget is more than `BUDGETS_APART`
    times another. Of two sets as large, the one that is no toy and had more to learn from is taken.
    """
    learned = [r for r in trained if r.learned] or list(trained)

    def size(first: Trained) -> tuple[int, bool, float]:
        members = sum(not _apart(r, first) for r in learned)
        return members, not first.toy, first.last["env_steps"]

    first = max(learned, key=size)
    apart = {r.folder.name: why for r in trained if (why := _apart(r, first))}
    return [r for r in trained if r.folder.name not in apart], apart


def _apart(run: Trained, first: Trained) -> str:
    """Return why a run cannot be compared with `first`, whose budget is the smallest of its set; "" where it can."""
    if run.toy != first.toy:
        return "+experiment=toy" if run.toy else "no toy, as the others are"
    keys = [k for k in first.alike | run.alike if run.alike.get(k) != first.alike.get(k)]
    if keys:
        part = {"robot": "another robot", "task": "another task"}.get(keys[0].split(".")[0], "another evaluation")
        values = f"{run.alike.get(keys[0])}, not {first.alike.get(keys[0])}"
        return f"{part}: {keys[0]}" + (f" is {values}" if len(values) <= 40 else " differs")
    if not run.learned:
        return ""
    if run.minutes and first.minutes:
        ratio, words = run.minutes / first.minutes, f"{run.minutes:g} min, not {first.minutes:g}"
    else:
        mine, others = (r.last["env_steps"] for r in (run, first))
        ratio, words = mine / others, f"{mine:.0f} env steps, not {others:.0f}"
    return "" if 1 <= ratio <= BUDGETS_APART else f"another budget: {words}"


def in_words(why: Mapping[str, str], most: int = 4, width: int = 24) -> list[str]:
    """Return {name: reason} as ["a, b (failed)", "c (unfinished)"]: so many names a reason, each cut to `width`."""
    reasons: dict[str, list[str]] = {}
    for name, reason in why.items():
        reasons.setdefault(reason, []).append(name if len(name) <= width else f"{name[: width - 1]}…")
    more = {reason: f" and {len(names) - most} more" * (len(names) > most) for reason, names in reasons.items()}
    return [f"{', '.join(names[:most])}{more[reason]} ({reason})" for reason, names in reasons.items()]


def flat(node: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Give ("a.b", value) of nested dicts; classes (`_target_`) are no settings."""
    for key, value in node.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{prefix}{key}.")
        elif key != "_target_":
            yield f"{prefix}{key}", value
