"""Read finished trainings from their run folders, and select comparable trainings."""

import json
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from r2s.errors import UserError
from r2s.reporting.measures import measures_of
from r2s.reporting.trackers.tracker import flat
from r2s.runs import parts_of
from r2s.tasks.measures import MeasureTable

# config groups that affect a training; runs of one algorithm that agree in all of them differ only in their seeds
READ = (
    *("algo", "budget", "calibration", "control", "costs", "dr", "friction", "inertia", "matmul", "reward", "safety"),
)
ALIKE = ("robot", "task")  # config groups that must have equal values in comparable runs
# {key of `origin`: reason if two runs differ in this key}; the commit affects results, the machine affects speed
ORIGIN = {"commit": "another commit", "cpu": "another machine", "cores": "another machine", "gpus": "another machine"}
ORIGIN |= {"threads": "other threads", "device": "another device"}
FILES = ("config.yaml", "overrides.yaml", "evaluations.csv", "summary.json")
MOST_BUDGETS = 2.0  # largest ratio of comparable budgets; at larger ratios, the longer training wins by its length
UNFINISHED = {"running": "unfinished"}


@dataclass(frozen=True)
class Trained:
    """One finished run of stage=train.

    Attributes:
        folder, seed, algo: run folder, random seed, name of the algorithm.
        settings: config values that the training used, such as {"algo.lr": 5e-4, "dr.phi_relative": 0.1}.
        alike: config values that agree in comparable runs, such as {"task.ctrl_hz": 50, "evaluation.episodes": 200}.
        origin: {key of ORIGIN: value in meta.json, None if unknown}; a model-based controller has only the commit.
        typed: the user's overrides of `settings`, from overrides.yaml: {"dr": "paper", "algo.lr": "5e-4"}.
        toy: whether the run used +experiment=toy, a training too short for the policy to learn.
        minutes: budget of the run in minutes; None if the run has a budget in env_steps.
        measures: measures of the task. curve: evaluations.csv, measured on the goals that select the best policy.
        last: measures of the last policy, from summary.json, on goals that were not used for selection.
    """

    folder: Path
    seed: int
    algo: str
    settings: dict[str, Any]
    alike: dict[str, Any]
    origin: dict[str, Any]
    typed: dict[str, str]
    toy: bool
    minutes: float | None
    measures: MeasureTable
    curve: pd.DataFrame
    last: dict[str, float]

    @property
    def learned(self) -> bool:
        """Whether the run trained a policy; False for a model-based controller."""
        return self.last["env_steps"] > 0


def read_trainings(folders: Sequence[str | Path]) -> tuple[list[Trained], dict[str, str]]:
    """Read the finished trainings in run folders; return them, and {folder: reason} for all other folders.

    Raises:
        UserError: there is no finished training.
    """
    trained, others = trainings_among(folders)
    if not trained:
        seen = f"; got {'; '.join(by_reason(others))}" if others else ""
        raise UserError(f"runs: expected finished runs of stage=train (runs='runs/train/*'){seen}")
    return trained, others


def trainings_among(folders: Sequence[str | Path]) -> tuple[list[Trained], dict[str, str]]:
    """Read trainings like `read_trainings`, but return an empty list if there is no finished training."""
    trained, others = [], {}
    for folder in map(Path, folders):
        if why := why_not(folder, "train", FILES):
            others[folder.name] = why
            continue
        try:
            trained.append(_read(folder))
        except (KeyError, TypeError, ValueError, AttributeError, UserError, yaml.YAMLError):  # a file edited by hand
            others[folder.name] = "unreadable"
    return trained, others


def why_not(folder: Path, stage: str, files: Iterable[str]) -> str:
    """Return why a folder is not that of a finished run of `stage` with all `files`, or "" if it is."""
    try:
        meta = json.loads((folder / "meta.json").read_text())
        seen, status = meta.get("stage", "train"), meta["status"]
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return "no run folder"
    if seen != stage:
        return f"stage={seen}"
    if status != "done":
        return UNFINISHED.get(status, status)
    missing = [name for name in files if not (folder / name).is_file()]
    return f"no {missing[0]}" if missing else ""


def typed_in(folder: Path) -> dict[str, str]:
    """Return the overrides of a run, from overrides.yaml: {"dr": "paper", "algo.lr": "5e-4"}."""
    words = yaml.safe_load((folder / "overrides.yaml").read_text()) or []
    pairs = (word.lstrip("+~").partition("=") for word in words)
    return {key: value for key, _, value in pairs}


def _read(folder: Path) -> Trained:
    config = yaml.safe_load((folder / "config.yaml").read_text())
    algo, budget = config["algo"], config.get("budget", {})
    name = algo.get("name") or algo["_target_"].rpartition(".")[2].lower()
    measures = measures_of(folder)
    curve, last = _evaluations(folder, measures)
    learned, read = last["env_steps"] > 0, set(READ)
    if config.get("calibration"):
        read -= {"friction", "inertia"}  # groups that the calibration replaces
    if not learned:
        read -= {"budget", "costs", "matmul", "reward"}
    typed = {k: v for k, v in typed_in(folder).items() if k.split(".")[0] in read | {"experiment"}}
    alike = settings_in(config, ALIKE)
    origin = _origin(folder)
    return Trained(
        folder,
        int(config["seed"]),
        name,
        settings_in(config, read),
        alike | {"evaluation.episodes": config.get("evaluation", {}).get("episodes")},
        origin if learned else {"commit": origin["commit"]},
        typed,
        typed.get("experiment") == "toy",
        None if budget.get("env_steps") else budget.get("minutes"),
        measures,
        curve,
        last,
    )


def _origin(folder: Path) -> dict[str, Any]:
    """Return commit, machine, threads and device of a run; a value that changed on resuming becomes "A and B"."""
    found: dict[str, set[str]] = {key: set() for key in ORIGIN}
    for part in parts_of(json.loads((folder / "meta.json").read_text())):
        git, machine = part["git"] or {}, part["machine"] or {}
        commit = f"{git['commit'][:8]}{' with changes' * bool(git.get('dirty'))}" if git.get("commit") else None
        seen = {"commit": commit, **{k: machine.get(k) for k in ("cpu", "cores", "gpus")}}
        for key, value in (seen | {k: part[k] for k in ("threads", "device")}).items():
            found[key] |= {str(value)} if value else set()
    return {key: " and ".join(sorted(values)) or None for key, values in found.items()}


def settings_in(config: Mapping[str, Any], groups: Container[str]) -> dict[str, Any]:
    """Return the settings of the config groups `groups` as {"dr.phi_relative": 0.1, ...}, without `_target_` keys."""
    own = flat({group: node for group, node in config.items() if group in groups})
    return {key: value for key, value in own if not key.endswith("_target_")}


def _evaluations(folder: Path, measures: MeasureTable) -> tuple[pd.DataFrame, dict[str, float]]:
    """Return evaluations.csv and the last policy's measures; a missing value becomes inf if lower values are better.

    A measure has no value (null in summary.json) if the arm was stopped in all episodes.

    Raises:
        ValueError: there is no evaluation, or a measure for which higher is better has no value.
    """
    curve = pd.read_csv(folder / "evaluations.csv")
    if curve.empty:
        raise ValueError("no evaluation")
    last = json.loads((folder / "summary.json").read_text())["last"]
    last = {k: np.nan if v is None else float(v) for k, v in last.items()}
    keys = list(dict.fromkeys((*measures.comparison, *measures.selection, *measures.scores)))
    for key in (k for k in keys if measures[k].lower_is_better):
        curve[key] = curve[key].astype(float).fillna(np.inf)
        last[key] = np.inf if np.isnan(last[key]) else last[key]
    rows = curve[["env_steps", "wall_clock_s", *keys]].astype(float).to_numpy()
    if np.isnan([*rows.ravel(), *(last[k] for k in keys)]).any():
        raise ValueError("a measure without a value")
    return curve, last


def comparable(trained: Sequence[Trained]) -> tuple[list[Trained], dict[str, str]]:
    """Return the largest set of comparable runs, and {run: reason} for all other runs.

    Runs are comparable if robot, task, number of evaluation episodes, use of +experiment=toy and all keys of ORIGIN
    agree. The ratio of their budgets must be at most `MOST_BUDGETS`. Of sets of equal size, sets without
    +experiment=toy have priority, then sets with more env steps. Of runs with equal settings and seed, only the
    first remains, because a repetition adds no evidence.
    """
    learned = [r for r in trained if r.learned] or list(trained)

    def size(first: Trained) -> tuple[int, bool, float]:
        members = sum(not _difference(r, first) for r in learned)
        return members, not first.toy, first.last["env_steps"]

    first = max(learned, key=size)
    apart = {r.folder.name: why for r in trained if (why := _difference(r, first))}
    seeds: dict[str, str] = {}
    for run in (r for r in trained if r.folder.name not in apart):
        key = repr((run.algo, run.seed, sorted(run.settings.items(), key=lambda item: item[0])))
        if seeds.setdefault(key, run.folder.name) != run.folder.name:
            apart[run.folder.name] = f"seed {run.seed} again, as {seeds[key]}"
    return [r for r in trained if r.folder.name not in apart], apart


def _difference(run: Trained, first: Trained) -> str:
    """Return why `run` is not comparable with `first`, the run with the least budget in a set; "" if comparable."""
    if run.toy != first.toy:
        return "+experiment=toy" if run.toy else "not +experiment=toy"
    keys = [k for k in first.alike | run.alike if run.alike.get(k) != first.alike.get(k)]
    if keys:
        part = {"robot": "another robot", "task": "another task"}.get(keys[0].split(".")[0], "another evaluation")
        values = f"{run.alike.get(keys[0])}, not {first.alike.get(keys[0])}"
        return f"{part}: {keys[0]}" + (f" is {values}" if len(values) <= 40 else " differs")
    for key in (key for key in first.origin if key in run.origin):
        if run.origin[key] != first.origin[key]:
            return f"{ORIGIN[key]}: {run.origin[key] or 'unknown'}, not {first.origin[key] or 'unknown'}"
    if not run.learned:
        return ""
    if run.minutes and first.minutes:
        ratio, words = run.minutes / first.minutes, f"{run.minutes:g} min, not {first.minutes:g}"
    else:
        mine, others = (r.last["env_steps"] for r in (run, first))
        ratio, words = mine / others, f"{mine:.0f} env steps, not {others:.0f}"
    return "" if 1 <= ratio <= MOST_BUDGETS else f"another budget: {words}"


def by_reason(why: Mapping[str, str], most: int = 4, width: int = 24) -> list[str]:
    """Return texts such as "a, b (failed)": up to `most` names per reason, each name cut to `width` letters."""
    reasons: dict[str, list[str]] = {}
    for name, reason in why.items():
        reasons.setdefault(reason, []).append(name if len(name) <= width else f"{name[: width - 1]}…")
    more = {reason: f" and {len(names) - most} more" * (len(names) > most) for reason, names in reasons.items()}
    return [f"{', '.join(names[:most])}{more[reason]} ({reason})" for reason, names in reasons.items()]
