"""Build the tables of an identification for the terminal: parameters with intervals, links, prediction errors."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from rich.console import Console

from r2s.identification.friction.breakaway import SIDES
from r2s.identification.link_inertia import LINK, inertia_scale
from r2s.identification.parameters import WHOLE_ARM, units
from r2s.identification.result import IdentificationResult
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot
from r2s.reporting.identification.values import SHORT, Value, of_whole_arm, per_joint, values
from r2s.reporting.tables import number, print_table

MOST = 7  # largest number of joints side by side in a terminal of 100 columns


def identification_tables(robot: Robot, found: IdentificationResult, summary: Mapping) -> dict[str, pd.DataFrame]:
    """Return {title: table}: parameters, breakaway torques, and the prediction errors in `summary` (summary.json)."""
    space, estimate, tables = found.space, found.found, {}
    own = [b for b in space.blocks if b not in WHOLE_ARM and b not in LINK]
    rows = dict(_parameter(b, values(space, estimate, b, found.unseen)) for b in own)
    parameters = pd.DataFrame.from_dict(rows, orient="index", columns=[str(j + 1) for j in range(robot.n)])
    for i in range(0, robot.n if rows else 0, MOST):
        some = f" of joints {i + 1} to {min(i + MOST, robot.n)}" if robot.n > MOST else ""
        tables[f"identified parameters{some}"] = parameters.iloc[:, i : i + MOST].rename_axis("joint")
    if arm := of_whole_arm(space, estimate, found.unseen):
        cells = {name: [number(v.old), v.found, v.interval] for name, v in arm.items()}
        whole = pd.DataFrame.from_dict(cells, orient="index", columns=["nominal", "identified", "95 %"])
        tables["parameters of the whole arm"] = whole.rename_axis("parameter")
    if set(LINK) & set(space.blocks):
        tables["links, nominal → identified"] = _links(robot, found)
    dynamics = found.dynamics
    if np.any(dynamics.breakaway) and not dynamics.family.has_memory:  # presliding itself models stiction
        rule = "of the net torque at the joint" if dynamics.stiction_model == "net" else "of command and offset"
        tables[f"breakaway, Nm {rule}"] = _breakaway(robot, found)
    return tables | error_tables(robot, summary)


def _parameter(block: str, found: Sequence[Value]) -> tuple[str, list[str]]:
    """Return a parameter's row heading and a cell per joint: value, ± half the interval's width, and nominal value.

    A nominal value that all joints share is in the heading, not in the cells.
    """
    unit = units()[block]
    if unit == "rad":
        unit, found = "mrad", [v.times(1e3) for v in found]
    nominal = list(dict.fromkeys(number(v.old) for v in found))
    shared = len(nominal) == 1
    words = [unit] * (unit != "1") + [f"nominal {nominal[0]}"] * shared
    cells = [v.short + f"\n{number(v.old)}" * (not shared) for v in found]
    return "\n".join([block, ", ".join(words), *["nominal"] * (not shared)]), cells


def _breakaway(robot: Robot, identified: IdentificationResult) -> pd.DataFrame:
    """Return the breakaway torque per joint and direction; if the ramps did not measure a torque, add the reason."""
    reasons = identified.edges.unknown if identified.edges is not None else {}
    columns = {}
    for side, edges in zip(SIDES, identified.dynamics.breakaway.T, strict=True):
        why = [reasons.get(f"joint {j + 1}, {side}", "") for j in range(robot.n)]
        columns[side] = [f"{number(x)}{f', {w}' if w else ''}" for x, w in zip(edges, why, strict=True)]
    return per_joint(robot, columns)


def _links(robot: Robot, identified: IdentificationResult) -> pd.DataFrame:
    """Return a row per link: mass, shift of the center of mass, and inertia trace divided by its nominal value."""
    space = identified.space
    before, after, draws = (space.dynamics(x) for x in (space.start, identified.x, identified.found.samples))

    def each(d: Dynamics) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        shift = 1e3 * np.linalg.norm(d.com - before.com, axis=-1)
        return d.mass, shift, inertia_scale(d.inertia, before.inertia)

    (mass, _, _), found = each(before), each(after)
    spans = [np.quantile(part, [0.025, 0.975], axis=0) for part in each(draws)]
    intervals = [[f"[{number(low)}, {number(high)}]" for low, high in span.T] for span in spans]
    known = dict(zip(space.names, identified.found.identifiable, strict=True))
    doubt = ["" if known.get(f"link_alpha[{j + 1}]", True) else " ?" for j in range(robot.n)]  # alpha sets the mass
    columns = {
        "mass, kg": [f"{number(a)} → {number(b)}{k}" for a, b, k in zip(mass, found[0], doubt, strict=True)],
        "95 %": intervals[0],
        "shift of the\ncentre, mm": [number(x, "{:.2f}") for x in found[1]],
        "trace of inertia\nover nominal": [number(x) for x in found[2]],
        "95 % ": intervals[2],
    }
    return per_joint(robot, columns, "link")


def error_tables(robot: Robot, summary: Mapping) -> dict[str, pd.DataFrame]:
    """Return {title: table} of the prediction errors in `summary` (summary.json): nominal, identified, ratio."""
    joints, tables = [str(j + 1) for j in range(robot.n)], {}
    sides = {side: summary[side] for side in ("train", "validation") if side in summary}
    titles = {"torque_rmse_Nm": "torque RMSE, Nm", "position_rmse_mrad": "open-loop position RMSE, mrad"}
    for key, title in titles.items():
        columns = {side: _pair(errors, key) for side, errors in sides.items() if key in errors}
        if columns:
            tables[title] = _before_after(columns, pd.Index([*joints, "mean"], name="joint"))
    reached = {side: e["ee_error_mm"] for side, e in sides.items() if e.get("ee_error_mm")}
    if reached:
        horizons = sorted({h for errors in reached.values() for h in errors}, key=float)
        parts = {side: (sides[side].get("nominal_ee_error_mm", {}), errors) for side, errors in reached.items()}
        columns = {side: tuple([p.get(h, np.nan) for h in horizons] for p in both) for side, both in parts.items()}
        index = pd.Index([f"{h} s" for h in horizons], name="open loop for")
        tables["end-effector error, mm"] = _before_after(columns, index)
    return tables


def _pair(errors: Mapping, key: str) -> tuple[list[float], ...]:
    """Return the errors of the nominal and of the identified model as two lists, each with its mean appended."""
    before, after = errors.get(f"nominal_{key}", [np.nan] * len(errors[key])), errors[key]
    return [*before, float(np.mean(before))], [*after, float(np.mean(after))]


def _before_after(columns: Mapping[str, Sequence[Sequence[float]]], index: pd.Index) -> pd.DataFrame:
    """Return a table with the columns nominal, identified and ratio, both for training and for validation motion."""
    table = {}
    for side, (before, after) in columns.items():
        ratios = [a / b if b else np.nan for b, a in zip(before, after, strict=True)]
        table[f"{side}\nnominal"] = [number(b) for b in before]
        table[f"{side}\nidentified"] = [number(a) for a in after]
        table[f"{side}\nratio"] = [number(r, "{:.2f}") for r in ratios]
    return pd.DataFrame(table, index=index)


def identification_table(console: Console, robot: Robot, identified: IdentificationResult, summary: Mapping) -> None:
    """Print the tables of `identification_tables`."""
    for title, table in identification_tables(robot, identified, summary).items():
        print_table(console, table, title, SHORT if title.startswith("identified") else None)
    if identified.refused:
        console.print("replays rejected: they contradict the torque of moving joints; the fit is of torque alone")
