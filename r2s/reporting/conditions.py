"""What was asked of an arm beside which arm it is, in words: a payload, warm friction, late commands."""

from collections.abc import Iterable, Mapping
from typing import Any

AS_IT_IS = "as it is"
WHICH = ("_target_", "name", "make", "seed", "noise")  # arm it is
NOTHING = {"payload": 0.0, "load": None, "friction": 1.0, "late": 0.0, "stiffness": None}  # asked of it
WORDS = {"payload": "{} kg", "load": "told of {} kg", "friction": "friction {}", "stiffness": "stiffness {}"}


def condition(arm: Mapping[str, Any], typed: Iterable[str] = ()) -> dict[str, Any]:
    """Return what is asked of an arm of conf/arm, without what is nothing: {"payload": 1.0}.

    Beside what every twin has (`NOTHING`) it is what was typed of this arm: `typed` are keys such as "arm.live".
    """
    own = [k.removeprefix("arm.").split(".")[0] for k in typed if k.startswith("arm.")]
    keys = [k for k in dict.fromkeys([*NOTHING, *own]) if k in arm and k not in WHICH]
    values = {k: _plain(arm[k]) for k in keys}
    return {k: v for k, v in values.items() if not _is_nothing(k, v)}


def in_words(asked: Mapping[str, Any]) -> str:
    """Return "1.0 kg, 5 ms later" of what `condition` returns; AS_IT_IS of nothing."""
    return ", ".join(_said(k, v) for k, v in asked.items()) or AS_IT_IS


def order(asked: Mapping[str, Any]) -> tuple:
    """Return what conditions are sorted by: nothing first, then by what is asked and how much of it."""
    keys = list(NOTHING)
    each = [(keys.index(k) if k in keys else len(keys), k, _size(v), str(v)) for k, v in asked.items()]
    return len(each), each


def _plain(value: Any) -> Any:
    """Return 1.0 of 1 and of {"mass": 1}, so that what is the same reads the same."""
    if isinstance(value, Mapping) and set(value) == {"mass"}:
        value = value["mass"]
    return float(value) if isinstance(value, int) and not isinstance(value, bool) else value


def _is_nothing(key: str, value: Any) -> bool:
    if key in ("payload", "load") and _size(value) == 0.0:
        return True
    return value == NOTHING.get(key)


def _size(value: Any) -> float:
    if isinstance(value, Mapping):
        value = value.get("mass", 0.0)
    return float(value) if isinstance(value, int | float) else 0.0


def _said(key: str, value: Any) -> str:
    if key == "late":
        return f"{1e3 * value:g} ms later"
    if key not in WORDS:
        return f"{key}={value}"
    more = ""
    if isinstance(value, Mapping):
        more = "".join(f", {k}={v}" for k, v in value.items() if k != "mass")
        value = float(value.get("mass", 0.0))
    return WORDS[key].format(value) + more
