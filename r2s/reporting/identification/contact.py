"""Report an identified surface: tables, and a figure of the normal force over the penetration depth."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from r2s.identification.contact.contact_file import UNITS
from r2s.identification.contact.estimate import COVERED, ContactEstimate
from r2s.identification.contact.surface_space import LOAD
from r2s.reporting.figures.colours import colours
from r2s.reporting.figures.log_rows import thin
from r2s.reporting.figures.panels import panels
from r2s.reporting.tables import number

WORDS = {"stiffness": "stiffness at 1 mm", "damping": "damping", "friction": "friction mu", "bristle": "presliding"}
FINE = "{:.4g}"


def contact_table(found: ContactEstimate) -> pd.DataFrame:
    """Return a row per surface parameter: value, 95 % interval, and whether the data determine the parameter."""
    rows = {f"slope at {LOAD:g} N, N/m": (found.slope, found.interval("slope"), found.identifiable["slope"])}
    for name, unit in UNITS.items():
        value, known = getattr(found.surface, name), found.identifiable[name]
        rows[f"{WORDS.get(name, name)}{'' if unit == '1' else f', {unit}'}"] = value, found.interval(name), known
    if (rigid := found.rigid_gears) is not None:
        rows["slope with rigid gears, N/m"] = rigid.slope, rigid.interval("slope"), rigid.identifiable["slope"]
        low, high = (1e3 * np.percentile(found.deflection(found.draws["gears"]), COVERED)).tolist()
        mean = 1e3 * float(found.deflection(found.gears))
        rows["gears at tau_max, mrad"] = mean, (low, high), found.identifiable["gears"]
    cells = {
        name: [number(value, FINE), f"[{number(low, FINE)}, {number(high, FINE)}]", "yes" if known else "no"]
        for name, (value, (low, high), known) in rows.items()
    }
    plane = "yes" if found.identifiable["plane"] else "no"
    low, high = (1e3 * end for end in found.height)
    point, normal = (", ".join(f"{v:.5f}" for v in x) for x in (found.surface.point, found.surface.normal))
    cells["point, m"] = [point, f"along the normal\n[{number(low)}, {number(high)}] mm", plane]
    cells["normal"] = [normal, f"tilt below {number(found.tilt_deg, '{:.2g}')}°", plane]
    columns = ["value", "95 % interval", "determined"]
    return pd.DataFrame.from_dict(cells, orient="index", columns=columns).rename_axis("surface")


def press_table(found: ContactEstimate) -> pd.DataFrame:
    """Tabulate the RMSE of the modeled normal force against joint torques, for fitted and for held-out presses."""
    parts = {"fitted presses": found.training, "held-out press": found.validation}
    cells = {
        name: [f"{part.summary()['seconds']:.1f}", *(number(part.rmse(side), "{:.2f}") for side in (0.0, 1.0, -1.0))]
        for name, part in parts.items()
        if part is not None
    }
    columns = ["s of force", "all", "loading", "unloading"]
    return pd.DataFrame.from_dict(cells, orient="index", columns=columns).rename_axis("normal force, N RMS")


def contact_figure(path: Path, found: ContactEstimate) -> Path:
    """Draw the normal force over penetration depth with a 95 % band, and over time in the held-out press."""
    colour = colours(["measured", "identified"]) | {"measured": "#30363d"}
    validation = found.validation
    with panels(path, 1 + (validation is not None), 2, "normal force of the surface", height=3.6) as axes:
        depth = np.linspace(0.0, found.penetration[1], 200)
        low, high = np.percentile(_curves(found, depth), [2.5, 97.5], axis=0)
        part, axis = found.training, axes[0]
        some = thin(len(part.t))
        still = part.seen / (1.0 + found.surface.damping * part.rate)
        dots: dict[str, Any] = {"marker": ".", "linestyle": "", "markersize": 2.5, "zorder": 3}
        axis.plot(1e3 * part.depth[some], still[some], color=colour["measured"], label="joint torques", **dots)
        axis.fill_between(1e3 * depth, low, high, color=colour["identified"], alpha=0.35, label="95 % interval")
        force = found.surface.coefficient * depth**found.surface.exponent
        axis.plot(1e3 * depth, force, color=colour["identified"], label="surface")
        axis.set(xlabel="penetration, mm", ylabel="force without damping, N")
        axis.set_title("fitted presses", loc="left")
        if validation is not None:
            axis, clock = axes[1], validation.t - validation.t[:1].sum()
            wide: dict[str, Any] = {"linestyle": "", "marker": "o", "markeredgewidth": 0.0, "alpha": 0.5}
            axis.plot(clock, validation.force, color=colour["identified"], markersize=5.0, **wide)
            axis.plot(clock, validation.seen, color=colour["measured"], label="joint torques", **dots)
            axis.set(xlabel="time, s", ylabel="normal force, N")
            axis.set_title(f"held-out press: RMSE {validation.rmse():.2g} N", loc="left")
    return path


def _curves(found: ContactEstimate, depth: np.ndarray) -> np.ndarray:
    """Return the normal force (S, D) N of S posterior draws, at depths (D,) m below the plane of each draw."""
    draws = found.draws
    return 1e-3 * draws["stiffness"][:, None] * (1e3 * depth) ** draws["exponent"][:, None]  # N/m at a depth of 1 mm
