"""Tables of an identification's report: the paper's Tables I to IV for this arm, what else was searched, families."""

from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd

from r2s.identification.link_inertia import LINK
from r2s.identification.uncertainty import Identified
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot
from r2s.reporting.document import Item
from r2s.reporting.identified_values import Value, named, of_whole_arm, per_joint, values
from r2s.reporting.tables import number

TENSOR = {"Ixx": (0, 0), "Iyy": (1, 1), "Izz": (2, 2), "Ixy": (0, 1), "Ixz": (0, 2), "Iyz": (1, 2)}


def _listed(rows: Sequence[Value]) -> dict[str, list[str]]:
    """Return the columns old, new and interval of a table."""
    return {
        "old": [number(v.old) for v in rows],
        "new": [number(v.old) if v.unseen else v.found for v in rows],
        "95 % interval": [v.interval for v in rows],
    }


def offset_table(robot: Robot, found: Identified) -> list[Item]:
    """Return the paper's Table I."""
    if "offset" not in found.space.blocks:
        return ["Offsets were not searched: they keep their nominal values."]
    rows = values(found.space, found.found, "offset", found.unseen)
    return ["Torque that is added to every command, Nm.", per_joint(robot, _listed(rows))]


def breakaway_table(robot: Robot, nominal: Dynamics, found: Identified, commanded: bool) -> list[Item]:
    """Return the paper's Table II: edges of the dead zone, of command and offset together."""
    d = found.dynamics
    if d.family.held is not None:
        return _held_by_bristles(robot, found, d.family.held)
    if not commanded:
        return ["Nominal: what is fitted on the level of torque does not say at which command a joint lets go."]
    old = nominal.breakaway
    columns: dict[str, list[str]] = {}
    ramped = found.edges
    for side, word in enumerate(("negative", "positive")):
        columns[f"{word}\nold"] = [number(x) for x in old[:, side]]
        columns[f"{word}\nnew"] = [number(x) for x in d.breakaway[:, side]]
        if ramped is not None:
            rows = values(*found.saved, f"breakaway_{word}")
            columns[f"{word}\nnew"] = [v.found for v in rows]
            columns[f"{word}\n95 % interval"] = [v.interval for v in rows]
            spread = [number(s, "{:.2g}") for s in ramped.spread[:, side]]
            why = [ramped.open.get(f"joint {j + 1}, {word}", "").split(":")[0] for j in range(robot.n)]
            columns[f"{word}\nrepeatability"] = [w or s for w, s in zip(why, spread, strict=True)]
    how = "Not measured: no joint was ramped, and no edge was looked for in the recording. Nominal values."
    if ramped is not None:
        how = (
            "Torque at which a resting joint lets go, command and offset together, Nm: measured by ramping each "
            "joint until it moved. Repeatability: standard deviation over ramps; -: fewer than two got there. "
            "Intervals are Student's, with the scatter of the joint's own ramps and of joints of its size. Not "
            "reached: the joint was held until the ramp ended, so that the edge lies beyond."
        )
    elif not np.array_equal(old, d.breakaway):
        how = (
            "Torque at which a resting joint lets go, command and offset together, Nm: looked for in the recording, "
            "as no joint was ramped. There is no interval."
        )
    return [how, per_joint(robot, columns)] if np.any(old) or np.any(d.breakaway) else [how]


def _held_by_bristles(robot: Robot, found: Identified, held: Callable[[np.ndarray], np.ndarray]) -> list[Item]:
    """Return Table II of a family that needs no dead zone: what it `held` at rest."""
    space = found.space
    low, high = np.quantile(held(space.dynamics(found.found.samples).phi), [0.025, 0.975], axis=0)
    old, new = held(space.dynamics(space.start).phi), held(found.dynamics.phi)
    columns: dict[str, list[str]] = {}
    for side, word in enumerate(("negative", "positive")):
        rows = [Value(*v) for v in zip(old[:, side], new[:, side], low[:, side], high[:, side], strict=True)]
        columns |= {f"{word}\n{k}": cells for k, cells in _listed(rows).items()}
    words = "This family has no dead zone: bristles hold a resting joint up to its level at rest, Nm."
    return [words, per_joint(robot, columns)]


def inertia_tables(robot: Robot, found: Identified) -> list[Item]:
    """Return the paper's Table III; with the full parametrisation also mass and centre of mass."""
    space, d = found.space, found.dynamics
    full = bool(set(LINK) & set(space.blocks))
    if not full and "inertia_scale" not in space.blocks:
        return ["Inertia was not searched: it keeps its nominal values."]
    before, draws = space.dynamics(space.start), space.dynamics(found.found.samples)
    silent = dict(zip(space.names, np.isin(space.names, found.unseen), strict=True))
    told = dict(zip(space.names, found.found.identifiable, strict=True))

    def cells(get, blocks: Sequence[str]) -> list[str]:
        """Return a column of what `get` takes from dynamics; it can be told where all the `blocks` behind it can."""
        low, high = np.quantile(get(draws), [0.025, 0.975], axis=0)
        rows = zip(get(before), get(d), low, high, strict=True)
        behind = [[f"{b}[{j + 1}]" for b in blocks if b in space.blocks] for j in range(robot.n)]
        return [
            Value(*v, known=all(told[k] for k in names), unseen=bool(names) and all(silent[k] for k in names)).cell
            for v, names in zip(rows, behind, strict=True)
        ]

    everything = LINK if full else ("inertia_scale",)
    tensors = {k: cells(lambda x, at=at: 1e3 * x.inertia[..., *at], everything) for k, at in TENSOR.items()}
    words = "Tensor about each link's centre of mass, link axes, 10⁻³ kg m², old → new."
    items: list[Item] = [words, per_joint(robot, tensors, "link")]
    if full:
        columns = {"mass, kg": cells(lambda x: x.mass, LINK[:1])}
        for k, axis in enumerate("xyz"):
            # t is seen through an upper triangle
            columns[f"centre {axis}, mm"] = cells(lambda x, k=k: 1e3 * x.com[..., k], LINK[7 + k :])
        words = (
            "Mass and centre of mass in the link's frame, old → new. A value is known (no ?) where all of the "
            "parameters behind it are."
        )
        return [words, per_joint(robot, columns, "link"), *items, _physical(d)]
    scales = per_joint(robot, _listed(values(space, found.found, "inertia_scale", found.unseen)), "link")
    return ["Scale of each link's published tensor.", scales, *items, _physical(d)]


def _physical(d: Dynamics) -> str:
    """Return a sentence: which links are none that mass could have (Wensing, Kim and Slotine, RA-L 3(1), 2018)."""
    second = 0.5 * np.trace(d.inertia, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) - d.inertia
    wrong = np.flatnonzero((np.linalg.eigvalsh(second).min(-1) < 0) | (d.mass <= 0)) + 1
    if not len(wrong):
        return (
            "Every link is physical: positive mass, and a tensor of positive moments within the triangle inequality."
        )
    links = ", ".join(map(str, wrong))
    return f"No mass can have the tensor of link {links} (triangle inequality): the published figures are like that."


def friction_table(robot: Robot, nominal: Dynamics, found: Identified, fastest: np.ndarray) -> list[Item]:
    """Return the paper's Table IV for the family found, and the curve's level at `fastest` (n,) rad/s."""
    space, d = found.space, found.dynamics
    own = [b for b in d.family.names if b in space.blocks]
    columns = {named(b): [v.cell for v in values(space, found.found, b, found.unseen)] for b in own}
    levels = d.family.level(space.dynamics(found.found.samples).phi, fastest)
    low, high = np.quantile(levels, [0.025, 0.975], axis=0)
    old, new = nominal.family.level(nominal.phi, fastest), d.family.level(d.phi, fastest)
    rows = zip(old, new, low, high, strict=True)
    columns["level at the\nfastest, Nm"] = [Value(*v).cell for v in rows]
    columns["fastest\nrad/s"] = [number(v) for v in fastest]
    words = (
        f"Family {d.family.name}: {d.family.formula}. Its parameters trade off against each other; "
        "the level is what they make together, at the fastest speed of the held-out motion."
    )
    if nominal.family != d.family:
        name = nominal.family.name
        words += f" The nominal model is {name}; old values are of {d.family.name} with its level at 1 rad/s."
    return [words, per_joint(robot, columns)]


def other_terms(robot: Robot, found: Identified) -> list[Item]:
    """Return delay and lag, payload, and what else was searched: rotors, load, drag, sensor gain."""
    space = found.space
    items: list[Item] = []
    if arm := of_whole_arm(space, found.found, found.unseen):
        items += [
            "Delay and lag are between a command and the torque at the joint; a payload is what the last link "
            "carries, its centre in that link's frame.",
            pd.DataFrame(_listed([*arm.values()]), index=pd.Index(list(arm), name="whole arm")),
        ]
    meaning = {
        "armature": "armature: inertia of the joint's rotor, as the joint feels it through the gear",
        "load": "load: friction per torque that gravity loads the joint with",
        "drag_sin": "drag: offset that goes with the joint's own sin q and cos q, as a cable's",
        "gain": "gain: relative error of the torque sensor, or of the motor's torque constant",
    }
    rest = [b for b in ("armature", "load", "drag_sin", "drag_cos", "gain") if b in space.blocks]
    if rest:
        columns = {named(b): [v.cell for v in values(space, found.found, b, found.unseen)] for b in rest}
        items += ["; ".join(meaning[b] for b in rest if b in meaning) + ".", per_joint(robot, columns)]
    return items


def family_table(found: Identified) -> list[Item]:
    """Return the comparison of friction families on motion left out."""
    chosen = found.dynamics.family.name
    if not found.families:
        return []
    rows = {
        name: [number(error, "{:.3f}"), "chosen" if name == chosen else ""] for name, error in found.families.items()
    }
    table = pd.DataFrame.from_dict(rows, orient="index", columns=["error, of the best", ""]).rename_axis("family")
    words = (
        "Each family was fitted to a part of the recording and judged by the torque it predicts on the rest. One "
        "with more parameters is chosen only where it is better by more than one standard error."
    )
    return [words, table]
