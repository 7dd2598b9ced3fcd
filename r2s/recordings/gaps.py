"""The longest step in time within a trajectory: a longer one is a pause in the log."""

import numpy as np

from r2s.errors import UserError

LEAST_GAP_S, GAP_STEPS = 0.05, 5.0  # s; median steps: no shorter pause separates trajectories, so frames may be lost
SLOWEST_S = 0.2  # s, longest median step taken for seconds: below 5 Hz unit_checks.py judges nothing
SLACK = 1e-6  # relative, of a rounded clock: 20 Hz have steps of 0.05 s plus or minus round-off


def longest_step(steps: np.ndarray, max_gap_s: float | None = None) -> float:
    """Return the longest step that is no pause, s, with SLACK.

    Args:
        steps: (T,) s, of a log. max_gap_s: the user's; None: five times the median step, and at least 0.05 s.

    Raises:
        UserError: most steps are longer, so t is not in seconds.
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
