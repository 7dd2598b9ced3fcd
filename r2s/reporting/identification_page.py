"""The report of an identification: the paper's tables I-IV for this arm, what the data cannot tell, and its figures.

"Old" is the nominal model, "new" what was identified; intervals are 95 %, from the joint distribution of the result.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from r2s.identification.smooth_motion import FRICTION_CUTOFF
from r2s.identification.uncertainty import Identified
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot
from r2s.recordings.recording import Recording
from r2s.reporting.document import Item
from r2s.reporting.doubts import doubts
from r2s.reporting.identification_tables import error_tables
from r2s.reporting.identified_values import LEGEND
from r2s.reporting.paper_tables import (
    breakaway_table,
    family_table,
    friction_table,
    inertia_tables,
    offset_table,
    other_terms,
)
from r2s.reporting.tables import number

TORQUE = {  # what a recording's torque is, in words
    "commanded": "commanded torque, without gravity",
    "measured": "link-side torque, with gravity",
    "motor": "motor torque, with gravity and all friction",
}


def identification_sections(
    robot: Robot,
    nominal: Dynamics,
    found: Identified,
    validation: Recording,
    summary: Mapping,
    *,
    pictures: Mapping[str, Path],
    fastest: np.ndarray,
    whiteness: pd.DataFrame,
    window_s: float,
    cutoff_hz: float,
) -> dict[str, Sequence[Item]]:
    """Return what goes into report.md and report.html: {heading: paragraphs, bullets, tables, figures}.

    Args:
        robot: the arm. nominal: the model before. found: the result.
        validation: motion that the fit has not seen. summary: summary.json.
        pictures: {"torque": PNG, ...}; those that are missing are left out.
        fastest: (n,) rad/s, the fastest speeds of the validation motion.
        whiteness: of its torque residual (`whiteness_table`).
        window_s, cutoff_hz: replayed windows and filter, as they were.
    """
    commanded = validation.torque == "commanded"

    def shown(*names: str) -> list[Item]:
        return [pictures[name] for name in names if name in pictures]

    sections: dict[str, Sequence[Item]] = {
        f"Identification of {robot.name}": [
            _headlines(robot, found, validation, summary),
            f"In the tables: {LEGEND}.",
        ],
        "Prediction, before and after": [
            "Nominal model against identified one, on the motion that was fitted (train) and on motion that was not "
            "(validation). Ratios below 1 are gains.",
            *(
                x
                for title, table in error_tables(robot, summary).items()
                for x in (title[0].upper() + title[1:], table)
            ),
            *shown("torque", "position"),
        ],
        "Table I: torque offsets": offset_table(robot, found),
        "Table II: breakaway": breakaway_table(robot, nominal, found, commanded),
        "Table III: inertia": inertia_tables(robot, found),
        "Table IV: friction": [
            *friction_table(robot, nominal, found, fastest),
            *shown("friction"),
            "Dots: torque of the held-out motion minus everything but friction (with the identified model).",
        ],
        "Delay, lag and other terms": other_terms(robot, found),
        "Friction families": family_table(found),
        "What the data cannot tell": doubts(found),
        "Residual": [
            "What the identified model leaves unexplained of the held-out torque. White is what is left when a model "
            "explains everything; a residual that stays correlated for longer than a block of the intervals makes "
            "intervals too narrow.",
            whiteness,
            *shown("whiteness"),
        ],
        "Convergence": [
            *shown("convergence"),
            "Costs compare only within one search, because residuals are weighed anew between two.",
        ],
        "How the recording was filtered": _filtering(commanded, window_s, cutoff_hz),
    }
    return {heading: items for heading, items in sections.items() if items}


def _headlines(robot: Robot, found: Identified, validation: Recording, summary: Mapping) -> list[str]:
    """Return the first lines of the report."""
    family = found.dynamics.family.name
    parts = [f"Recording {validation.name or 'without a name'}: {TORQUE[validation.torque]}"]
    for side, words in (
        ("train", "fitted to {:.1f} s of motion"),
        ("validation", "judged on {:.1f} s of other motion"),
    ):
        if "seconds" in summary.get(side, {}):
            parts.append(words.format(summary[side]["seconds"]))
    lines = [
        f"{'; '.join(parts)}.",
        f"Friction family {family}; {len(found.x)} numbers searched, {int(found.found.identifiable.sum())} of them "
        f"identifiable, {len(found.unseen)} unseen and left nominal.",
    ]
    errors = summary.get("validation", {})
    if "nominal_torque_rmse_Nm" in errors:
        new, old = (np.asarray(errors[f"{k}torque_rmse_Nm"]) for k in ("", "nominal_"))
        worse = [f"joint {j + 1} ({new[j] / old[j]:.2f})" for j in np.flatnonzero(new > old)]
        lines.append(
            f"Torque RMSE on held-out motion, mean over joints: {new.mean():.3g} Nm, nominal {old.mean():.3g} Nm; "
            f"{'worse than nominal: ' + ', '.join(worse) if worse else 'no joint is worse'}."
        )
    reached, before = errors.get("ee_error_mm", {}), errors.get("nominal_ee_error_mm", {})
    if reached:
        after = [f"{number(reached[h])} mm after {h} s ({number(before.get(h))})" for h in sorted(reached, key=float)]
        lines.append(f"End effector, open loop on held-out motion (nominal in brackets): {', '.join(after)}.")
    return lines


def _filtering(commanded: bool, window_s: float, cutoff_hz: float) -> list[Item]:
    """Return in words what was done to the recording before it was compared."""
    lines = [
        "Resampled on its own logged time to 1 kHz, linearly, each trajectory by itself.",
        f"For torque: angles, velocities and torque low-passed at {cutoff_hz:g} Hz (Butterworth of order 4, forwards "
        "and backwards, so without delay), acceleration differentiated from that, one row per 10 ms kept, the first "
        "and last 50 ms of a trajectory dropped.",
        f"Friction is evaluated at velocities low-passed at {FRICTION_CUTOFF * cutoff_hz:g} Hz ({FRICTION_CUTOFF:g} "
        "times the cutoff), then filtered as the torque was: a filter rounds the step of friction at a reversal.",
    ]
    if commanded:
        lines.append(
            f"For the replay: windows of {window_s:g} s, unfiltered commands; the start state is a cubic "
            "Savitzky-Golay fit over 31 ms of angles. What the figure of open-loop errors shows starts the same way."
        )
    return [lines]
