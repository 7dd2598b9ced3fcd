"""Report identified gear stiffness: a table, and a figure of the motors' frequency response."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from r2s.excitation.multisine import LINES_HZ
from r2s.identification.gears.estimate import GearEstimate
from r2s.identification.gears.gears_file import COVERED
from r2s.reporting.figures.colours import colours
from r2s.reporting.figures.panels import joint_panels, log_axis
from r2s.reporting.tables import number

TICKS_HZ = (6, 10, 20, 50, 100)


def gears_table(found: GearEstimate) -> pd.DataFrame:
    """Return a row per joint: stiffness, 95 % interval, deflection, misfit, "yes" if stiffness is determined."""
    low, high = np.percentile(found.draws, COVERED, axis=0)
    stiffness, rows = found.drives.stiffness, {}
    for i, value in enumerate(stiffness):
        rows[f"joint {i + 1}"] = [
            number(value, "{:.0f}"),
            f"[{number(low[i], '{:.0f}')}, {number(high[i], '{:.0f}')}]",
            number(1e3 * found.tau_max[i] / value, "{:.2f}"),
            number(found.misfit[i], "{:.2f}"),
            "yes" if found.identifiable[i] else "no",
        ]
    columns = ["stiffness, Nm/rad", "95 % interval", "deflection at tau_max, mrad", "misfit, sd", "determined"]
    return pd.DataFrame.from_dict(rows, orient="index", columns=columns).rename_axis("gear")


def gears_figure(path: Path, found: GearEstimate) -> Path:
    """Draw each motor's frequency response (angle per torque), measured and fitted, relative to the rotor alone."""
    colour = colours(["measured", "identified"])
    inverse = (2 * np.pi * LINES_HZ) ** 2 * found.drives.rotor[:, None]  # scales the response of the rotor alone to 1
    measured: dict[str, Any] = {"linestyle": "", "marker": ".", "markersize": 4, "color": colour["measured"]}
    with joint_panels(path, len(found.tau_max), "motor angle per torque, relative to the rotor alone") as axes:
        for i, axis in enumerate(axes):
            for k, row in enumerate(np.flatnonzero(found.slides.joint == i)):
                own = np.abs(found.slides.response[row]) * inverse[i]
                axis.plot(LINES_HZ, own, label=None if k else "measured", **measured)
                fit = np.abs(found.response[row]) * inverse[i]
                axis.plot(LINES_HZ, fit, color=colour["identified"], lw=1.0, label=None if k else "identified")
            axis.set(xscale="log", xlabel="frequency, Hz")
            axis.set_xticks(TICKS_HZ, [f"{tick}" for tick in TICKS_HZ])
            log_axis(axis, (1.0,))
            axis.set_title(f"joint {i + 1}: {found.drives.stiffness[i]:.0f} Nm/rad", loc="left")
    return path
