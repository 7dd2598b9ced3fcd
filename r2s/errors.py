"""The one exception that a user's mistake raises: `run.py` prints its message as one line and exits with 2."""

from collections.abc import Iterable
from difflib import get_close_matches


class UserError(ValueError):
    """Says what was wrong, the value seen, what is allowed and the nearest match, in one line."""


def nearest(name: str, allowed: Iterable[str]) -> str:
    """Return "; did you mean 'x'?" for the closest of `allowed`, or "" where nothing is close."""
    match = get_close_matches(name, [str(a) for a in allowed], n=1, cutoff=0.5)
    return f"; did you mean '{match[0]}'?" if match else ""


def choices(allowed: Iterable[str]) -> str:
    """Return the allowed names as "a, b, c" for an error message."""
    return ", ".join(str(a) for a in allowed)
