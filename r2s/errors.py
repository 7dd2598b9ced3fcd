"""How a run ends that cannot go on: a user's mistake is one line and exit status 2, a stopped arm one and 3."""

from collections.abc import Iterable
from difflib import get_close_matches
from numbers import Integral, Real


class UserError(ValueError):
    """Says what was wrong, the value seen, what is allowed and the nearest match, in one line."""


class Stopped(Exception):  # noqa: N818 (an arm that stops is not a bug)
    """An arm was stopped, and nobody said that it may move again: the run keeps what it has, and ends as stopped."""


def nearest(name: str, allowed: Iterable[str]) -> str:
    """Return "; did you mean 'x'?" for the closest of `allowed`, or "" where nothing is close."""
    match = get_close_matches(name, [str(a) for a in allowed], n=1, cutoff=0.5)
    return f"; did you mean '{match[0]}'?" if match else ""


def choices(allowed: Iterable[str]) -> str:
    """Return the allowed names as "a, b, c" for an error message."""
    return ", ".join(str(a) for a in allowed)


def check_number(name: str, value: object, interval: str, whole: bool = False) -> None:
    """Check one setting.

    Args:
        name, value: of the setting.
        interval: where it may lie, written as in "(0, 1]".
        whole: it must be an integer.

    Raises:
        UserError: it is no such number.
    """
    low, high = (float(end) for end in interval[1:-1].split(","))
    if isinstance(value, Integral if whole else Real) and not isinstance(value, bool):
        x = float(value)  # type: ignore[arg-type]
        if (low < x or (x == low and interval[0] == "[")) and (x < high or (x == high and interval[-1] == "]")):
            return
    kind = "whole number" if whole else "number"
    raise UserError(f"{name}: {value!r} is not allowed; a {kind} in {interval} is")
