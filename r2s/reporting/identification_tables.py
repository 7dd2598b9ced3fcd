"""Tables of an identification for the terminal: parameters old and new with intervals, links, prediction errors."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from rich.console import Console

from r2s.identification.breakaway import SIDES
from r2s.identification.link_inertia import LINK, inertia_scale
from r2s.identification.parameters import WHOLE_ARM
from r2s.identification.uncertainty import Identified
from r2s.physics.robot import Robot
from r2s.reporting.identified_values import LEGEND, named, of_whole_arm, per_joint, values
from r2s.reporting.tables import number, print_table


def identification_tables(robot: Robot, identified: Identified, summary: Mapping) -> dict[str, pd.DataFrame]:
    """Return {title: table} for the terminal: parameters and, where `summary` (summary.json) has them, errors."""
    space, found, tables = identified.space, identified.found, {}
    own = [b for b in space.blocks if b not in WHOLE_ARM and b not in LINK]
    cells = {named(b): [v.cell for v in values(space, found, b, identified.unseen)] for b in own}
    blocks = per_joint(robot, cells)
    for i in range(0, blocks.shape[1], 5):
        tables[f"parameters, nominal → identified{' (continued)' * (i > 0)}"] = blocks.iloc[:, i : i + 5]
    if arm := of_whole_arm(space, found, identified.unseen):
        cells = {"nominal → identified": [v.cell for v in arm.values()]}
        tables["whole arm"] = pd.DataFrame(cells, index=pd.Index(list(arm), name="whole arm"))
    if set(LINK) & set(space.blocks):
        tables["links, nominal → identified"] = _links(robot, identified)
    edges = identified.dynamics.breakaway
    if np.any(edges) and not identified.dynamics.family.has_memory:  # bristles hold without a dead zone
        why = identified.edges.open if identified.edges is not None else {}
        shown = {
            f"joint {j + 1}": [
                "\n".join([number(edge), *why.get(f"joint {j + 1}, {side}", "").split(": ")]).strip()
                for side, edge in zip(SIDES, edges[j], strict=True)
            ]
            for j in range(robot.n)
        }
        rule = "of all that acts on the joint" if identified.dynamics.hold == "net" else "of command and offset"
        tables[f"breakaway, Nm {rule}"] = pd.DataFrame(shown, index=pd.Index(SIDES, name="edge"))
    return tables | error_tables(robot, summary)


def _links(robot: Robot, identified: Identified) -> pd.DataFrame:
    """Return one line per link: mass, how far its centre moved, and the scale of its tensor's trace."""
    space = identified.space
    before, after, draws = (space.dynamics(x) for x in (space.start, identified.x, identified.found.samples))

    def each(d):
        shift = 1e3 * np.linalg.norm(d.com - before.com, axis=-1)
        return d.mass, shift, inertia_scale(d.inertia, before.inertia)

    (mass, _, _), found = each(before), each(after)
    spans = [np.quantile(part, [0.025, 0.975], axis=0) for part in each(draws)]
    intervals = [[f"[{number(low)}, {number(high)}]" for low, high in span.T] for span in spans]
    known = dict(zip(space.names, identified.found.identifiable, strict=True))
    doubt = ["" if known.get(f"link_alpha[{j + 1}]", True) else " ?" for j in range(robot.n)]  # mass: alpha alone
    columns = {
        "mass, kg": [f"{number(a)} → {number(b)}{k}" for a, b, k in zip(mass, found[0], doubt, strict=True)],
        "95 %": intervals[0],
        "centre moved\nmm": [number(x, "{:.2f}") for x in found[1]],
        "tensor's trace\nof nominal": [number(x) for x in found[2]],
        "95 % ": intervals[2],
    }
    return per_joint(robot, columns, "link")


def error_tables(robot: Robot, summary: Mapping) -> dict[str, pd.DataFrame]:
    """Return {title: table} of the prediction errors in `summary` (summary.json): nominal, identified, ratio."""
    joints, tables = [str(j + 1) for j in range(robot.n)], {}
    sides = {side: summary[side] for side in ("train", "validation") if side in summary}
    for key, title in (
        ("torque_rmse_Nm", "torque RMSE, Nm"),
        ("position_rmse_mrad", "replayed position RMSE, mrad"),
    ):
        columns = {side: _pair(errors, key) for side, errors in sides.items() if key in errors}
        if columns:
            tables[title] = _before_after(columns, pd.Index([*joints, "mean"], name="joint"))
    reached = {side: e["ee_error_mm"] for side, e in sides.items() if e.get("ee_error_mm")}
    if reached:
        horizons = sorted({h for errors in reached.values() for h in errors}, key=float)
        columns = {}
        for side, errors in reached.items():
            before = sides[side].get("nominal_ee_error_mm", {})
            columns[side] = (
                [before.get(h, np.nan) for h in horizons],
                [errors.get(h, np.nan) for h in horizons],
            )
        index = pd.Index([f"{h} s" for h in horizons], name="open loop for")
        tables["end-effector error, mm"] = _before_after(columns, index)
    return tables


def _pair(errors: Mapping, key: str) -> tuple[list[float], list[float]]:
    """Return (nominal, identified), their means appended."""
    before, after = errors.get(f"nominal_{key}", [np.nan] * len(errors[key])), errors[key]
    return [*before, float(np.mean(before))], [*after, float(np.mean(after))]


def _before_after(columns: Mapping[str, tuple[Sequence[float], Sequence[float]]], index: pd.Index) -> pd.DataFrame:
    """Return nominal, identified and their ratio, for each side of the split."""
    table = {}
    for side, (before, after) in columns.items():
        table[f"{side}\nnominal"] = [number(b) for b in before]
        table[f"{side}\nidentified"] = [number(a) for a in after]
        table[f"{side}\nratio"] = [
            number(a / b if b else np.nan, "{:.2f}") for b, a in zip(before, after, strict=True)
        ]
    return pd.DataFrame(table, index=index)


def identification_table(console: Console, robot: Robot, identified: Identified, summary: Mapping) -> None:
    """Print what `identification_tables` returns."""
    for title, table in identification_tables(robot, identified, summary).items():
        print_table(console, table, title, LEGEND if title.startswith("parameters") else None)
    if identified.refused:
        console.print("replays disagreed with the torque of joints that move: refused, the numbers are torque's")
