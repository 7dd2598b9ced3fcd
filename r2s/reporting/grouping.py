"""Groups of trainings: the seeds of one setting, named by what was typed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from r2s.reporting.trainings import Trained

LONGEST = 40  # letters of a label


@dataclass(frozen=True)
class Groups:
    """Runs by what they differ in."""

    members: dict[str, list[Trained]]
    """{"tqc, dr=paper": [seeds ...]}, in the order they came; no label is longer than `LONGEST` letters."""
    key: dict[str, str]
    """What a numbered label stands for: {"tqc #1": "tqc, calibration=..., dr=identified"}."""


def group(runs: Sequence[Trained]) -> Groups:
    """Return the runs by what they read, seeds together.

    A label is the algorithm and what was typed of the settings that differ; what it leaves out is the default. A
    label that is too long for figures gets a number instead, and the key says what it stands for.
    """
    sets: dict[str, list[Trained]] = {}
    for run in runs:
        same = repr((run.algo, sorted(run.settings.items(), key=lambda item: item[0])))
        sets.setdefault(same, []).append(run)
    names = _names(list(sets.values()))
    members: dict[str, list[Trained]] = {}
    key: dict[str, str] = {}
    for name, seeds in zip(names, sets.values(), strict=True):
        label = name
        if len(name) > LONGEST:
            label = f"{seeds[0].algo[: LONGEST - 5]} #{len(key) + 1}"
            key[label] = name
        members.setdefault(label, []).extend(seeds)
    return Groups(members, key)


def _names(sets: Sequence[Sequence[Trained]]) -> list[str]:
    """Return one name per set."""
    varied = _varied(sets)
    typed = [{k: v for run in seeds for k, v in run.typed.items()} for seeds in sets]
    parts = []
    for seeds, words in zip(sets, typed, strict=True):
        own = varied[seeds[0].algo]
        shown = {k: v for k, v in sorted(words.items()) if any(s == k or s.startswith(f"{k}.") for s in own)}
        if "experiment" in words and any(w.get("experiment") != words["experiment"] for w in typed):
            shown["experiment"] = words["experiment"]
        shown.pop("algo", None)
        if "calibration" in shown:
            shown["calibration"] = Path(shown["calibration"]).name
        parts.append({_short(k): v for k, v in shown.items()})
    names = [_joined(seeds[0].algo, p) for seeds, p in zip(sets, parts, strict=True)]
    for name in list(names):
        twins = [k for k, other in enumerate(names) if other == name]
        if len(twins) > 1:  # what differs between them was not typed, as in an experiment's file
            differing = _differing([sets[k][0].settings for k in twins])
            for k in twins:
                more = {_short(s): sets[k][0].settings[s] for s in differing if s in sets[k][0].settings}
                names[k] = _joined(sets[k][0].algo, parts[k] | more)
    return names


def _varied(sets: Sequence[Sequence[Trained]]) -> dict[str, list[str]]:
    """Return, per algorithm, the settings that differ: its own between its runs, all others between all runs."""
    settings = [seeds[0].settings for seeds in sets]
    common = [k for k in _differing(settings) if not k.startswith("algo.")]
    out = {}
    for algo in dict.fromkeys(seeds[0].algo for seeds in sets):
        own = _differing([seeds[0].settings for seeds in sets if seeds[0].algo == algo])
        out[algo] = [k for k in own if k.startswith("algo.")] + common
    return out


def _differing(settings: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the keys that not all of the settings have with the same value."""
    keys = dict.fromkeys(k for s in settings for k in s)
    return [k for k in keys if len({repr(s.get(k)) for s in settings}) > 1]


def _short(key: str) -> str:
    return key.removeprefix("algo.").removeprefix("budget.")


def _joined(algo: str, parts: Mapping[str, Any]) -> str:
    return ", ".join([algo, *(f"{k}={v}" for k, v in parts.items())])
