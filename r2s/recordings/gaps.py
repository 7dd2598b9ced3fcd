"""Find pauses in a log: a pause is a time step longer than `longest_step`."""

import numpy as np

from r2s.errors import UserError

LEAST_GAP_S, GAP_STEPS = 0.05, 5.0  # s and median steps; a pause exceeds both limits; lost frames cause shorter gaps
SLOWEST_S = 0.2  # s; a longer median step means that t is not in seconds; unit_checks.py needs at least 5 Hz
SLACK = 1e-6  # relative tolerance for round-off: steps of a 20 Hz clock are not exactly 0.05 s


def longest_step(steps: np.ndarray, max_gap_s: float | None = None) -> float:
    """Return the longest time step (s) that is not a pause, including the relative tolerance SLACK.

    Args:
        steps: (T,) s, time steps. max_gap_s: s, the user's limit; if None, the limit is five median steps, but at
            least 0.05 s.

    Raises:
        UserError: the median step exceeds `max_gap_s` (0.2 s if None), so t is probably not in seconds.
    """
    median = float(np.median(steps)) if len(steps) else 0.0
    allowed = SLOWEST_S if max_gap_s is None else max_gap_s
    if median > allowed * (1 + SLACK):
        limit = f"{allowed:g} s" if max_gap_s is None else f"max_gap_s={max_gap_s:g}"
        raise UserError(
            f"most steps in time are longer than {limit} (median {median:g}): t must be in seconds; if it is, raise "
            "max_gap_s"
        )
    longest = max(LEAST_GAP_S, GAP_STEPS * median) if max_gap_s is None else max_gap_s
    return longest * (1 + SLACK)
