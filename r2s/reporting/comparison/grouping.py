"""Group trainings that differ only in their seeds, and name the groups by their overrides."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from r2s.reporting.comparison.trainings import Trained

LONGEST = 40  # largest number of letters in a label; longer labels would leave too little space for the figure


@dataclass(frozen=True)
class Groups:
    """Runs grouped by their settings.

    Attributes:
        members: {label: runs, one per seed}; a label such as "tqc, dr=paper" has at most `LONGEST` letters.
        key: {numbered label: full name}, such as {"tqc #1": "tqc, calibration=..., dr=identified"}.
    """

    members: dict[str, list[Trained]]
    key: dict[str, str]


def group(runs: Sequence[Trained]) -> Groups:
    """Group the runs by their settings, so that the runs of a group differ only in their seeds.

    A group's label consists of the algorithm and the overrides that differ among groups. A setting that the label
    omits has its default value, or the same value in all groups. A label longer than LONGEST letters becomes the
    algorithm and a number, such as "tqc #1" (see `Groups.key`).
    """
    sets: dict[str, list[Trained]] = {}
    for run in runs:
        same = repr((run.algo, sorted(run.settings.items(), key=lambda item: item[0])))
        sets.setdefault(same, []).append(run)
    members: dict[str, list[Trained]] = {}
    key: dict[str, str] = {}
    for name, seeds in zip(_names(list(sets.values())), sets.values(), strict=True):
        label = name
        if len(name) > LONGEST:
            label = f"{seeds[0].algo[: LONGEST - 5]} #{len(key) + 1}"
            key[label] = name
        members.setdefault(label, []).extend(seeds)
    return Groups(members, key)


def _names(sets: Sequence[Sequence[Trained]]) -> list[str]:
    """Return a name, as described in `group`, for each set of runs that differ only in their seeds."""
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
        if len(twins) > 1:  # these sets differ in settings that no override names, such as those of +experiment=
            changed = differing([sets[k][0].settings for k in twins])
            for k in twins:
                more = {_short(s): sets[k][0].settings[s] for s in changed if s in sets[k][0].settings}
                names[k] = _joined(sets[k][0].algo, parts[k] | more)
    return names


def _varied(sets: Sequence[Sequence[Trained]]) -> dict[str, list[str]]:
    """Return {algorithm: keys that differ}: keys algo.* among sets of this algorithm, other keys among all sets."""
    settings = [seeds[0].settings for seeds in sets]
    common = [k for k in differing(settings) if not k.startswith("algo.")]
    out = {}
    for algo in dict.fromkeys(seeds[0].algo for seeds in sets):
        own = differing([seeds[0].settings for seeds in sets if seeds[0].algo == algo])
        out[algo] = [k for k in own if k.startswith("algo.")] + common
    return out


def differing(settings: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the keys whose values differ among the mappings `settings`; a missing key has the value None."""
    keys = dict.fromkeys(k for s in settings for k in s)
    return [k for k in keys if len({repr(s.get(k)) for s in settings}) > 1]


def _short(key: str) -> str:
    return key.removeprefix("algo.").removeprefix("budget.")


def _joined(algo: str, parts: Mapping[str, Any]) -> str:
    return ", ".join([algo, *(f"{k}={v}" for k, v in parts.items())])
