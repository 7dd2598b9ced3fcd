"""Report an identified payload: tables, and a figure of the loaded arm's torque, measured and predicted."""

from pathlib import Path

import numpy as np
import pandas as pd

from r2s.identification.payload.estimate import ELEMENTS, PayloadEstimate
from r2s.reporting.identification.figures import torque_figure
from r2s.reporting.tables import number

FINE = "{:.4g}"


def payload_table(found: PayloadEstimate) -> pd.DataFrame:
    """Return a row per payload parameter: value, 95 % interval, and whether the data determine the parameter."""
    cells = {}
    names = {"mass": ["mass, kg"], "centre": [f"centre {k}, m" for k in "xyz"]}
    names["inertia"] = [f"inertia {k}, kg m²" for k in ELEMENTS]
    for name, value in found.values.items():
        low, high = (np.atleast_1d(end) for end in found.interval(name))
        known, values = np.atleast_1d(found.identifiable[name]), np.atleast_1d(value)
        for k, label in enumerate(names[name]):
            interval = f"[{number(low[k], FINE)}, {number(high[k], FINE)}]"
            cells[label] = [number(values[k], FINE), interval, "yes" if known[k] else "no"]
    columns = ["value", "95 % interval", "determined"]
    return pd.DataFrame.from_dict(cells, orient="index", columns=columns).rename_axis("payload")


def load_error_table(found: PayloadEstimate) -> pd.DataFrame:
    """Return, per joint, the RMSE of the loaded arm's predicted torque, without and with the identified payload."""
    rows = {"without": found.rmse(found.without), "with": found.rmse(found.predicted)}
    cells = {f"{name} payload": [number(x) for x in values] for name, values in rows.items()}
    joints = [f"joint {j + 1}" for j in range(found.measured.shape[1])]
    return pd.DataFrame.from_dict(cells, orient="index", columns=joints).rename_axis("torque RMSE, Nm")


def payload_figure(path: Path, found: PayloadEstimate) -> Path:
    """Draw the torque of the loaded arm: recorded, and predicted without and with the payload."""
    rows = found.seen.any(1)
    shown = [np.where(found.seen, x, np.nan)[rows] for x in (found.measured, found.without, found.predicted)]
    lines = {"without payload": shown[1], "with payload": shown[2]}
    return torque_figure(path, found.t[rows], shown[0], lines, "torque of the loaded arm")
