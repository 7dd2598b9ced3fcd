"""Describe the test condition of an arm in words: payload, scaled friction, delayed commands, gear stiffness."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

NOMINAL = "nominal"
IDENTITY = ("_target_", "name", "variant", "seed", "noise", "address")  # keys of conf/arm that identify the arm
SETTINGS: dict[str, tuple[Any, str]] = {  # key of conf/arm -> nominal value, description
    "payload": (0.0, "{} kg"),
    "declared_payload": (0.0, "{} kg declared"),
    "friction_scale": (1.0, "friction x {}"),
    "extra_delay_s": (0.0, "{} s later"),
    "stiffness": (None, "stiffness {}"),
}


def condition(arm: Mapping[str, Any], typed: Iterable[str] = ()) -> dict[str, Any]:
    """Return the settings of conf/arm that differ from their nominal values, such as {"payload": 1.0}.

    Args:
        arm: config of the arm. typed: config keys that the user overrides. An overridden key of the arm, such as
            arm.live, is a setting too, unless the key is in IDENTITY.
    """
    own = [k.removeprefix("arm.").split(".")[0] for k in typed if k.startswith("arm.")]
    keys = dict.fromkeys([*SETTINGS, *own])
    values = {k: _plain(arm[k]) for k in keys if k in arm and k not in IDENTITY}

    def empty(key: str, value: Any) -> bool:
        return "payload" in key and not isinstance(value, str) and not _size(value)  # a string names a run folder

    return {k: v for k, v in values.items() if v != SETTINGS.get(k, (None,))[0] and not empty(k, v)}


def without_common(conditions: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the `conditions` without the settings that are equal in all conditions, such as the surface of a task.

    The keys of SETTINGS remain even if their values are equal, because their nominal values are known.
    """
    first = conditions[0]
    common = {k for k in first.keys() - SETTINGS if all(k in c and c[k] == first[k] for c in conditions)}
    return [{k: v for k, v in c.items() if k not in common} for c in conditions]


def in_words(settings: Mapping[str, Any]) -> str:
    """Describe a `condition` in words, such as "1.0 kg, 0.005 s later", or NOMINAL for an empty condition."""
    return ", ".join(_words(k, v) for k, v in settings.items()) or NOMINAL


def order(settings: Mapping[str, Any]) -> tuple:
    """Return a sort key for a `condition`: the number of its settings (0 if nominal), then their names and values."""
    keys = list(SETTINGS)
    each = [(keys.index(k) if k in keys else len(keys), k, _size(v), str(v)) for k, v in settings.items()]
    return len(each), each


def _plain(value: Any) -> Any:
    """Return a setting in its simplest form; for example, the payloads 1 and {"mass": 1} both become 1.0."""
    if isinstance(value, Mapping) and set(value) == {"mass"}:
        value = value["mass"]
    return float(value) if isinstance(value, int) and not isinstance(value, bool) else value


def _size(value: Any) -> float:
    if isinstance(value, Mapping):
        value = value.get("mass", 0.0)
    return float(value) if isinstance(value, int | float) else 0.0


def _words(key: str, value: Any) -> str:
    if key not in SETTINGS or isinstance(value, str):
        return f"{key}={value}"
    more = ""
    if isinstance(value, Mapping):
        more = "".join(f", {k}={v}" for k, v in value.items() if k != "mass")
        value = _size(value)
    return SETTINGS[key][1].format(value) + more
