"""Build Tables I to IV of the paper for the identified arm, and tables of other parameters and friction families."""

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import pandas as pd

from r2s.identification.link_inertia import LINK
from r2s.identification.result import IdentificationResult
from r2s.identification.structure.family_selection import CLOSE
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot
from r2s.reporting.document import Item
from r2s.reporting.identification.values import Value, named, of_whole_arm, per_joint, values
from r2s.reporting.tables import number

TENSOR = {"Ixx": (0, 0), "Iyy": (1, 1), "Izz": (2, 2), "Ixy": (0, 1), "Ixz": (0, 2), "Iyz": (1, 2)}
OTHERS = {
    "armature": "armature: rotor inertia, reflected to the joint",
    "load": "load: friction per Nm of gravity torque",
    "drag_sin": "drag: offset proportional to sin q and cos q of the joint, as of a cable",
    "drag_cos": "",
    "gain": "gain: relative error of the torque sensor or of the motor's torque constant",
}
BREAKAWAY = "Torque (command plus offset, Nm) at which a resting joint starts to move"


def _listed(rows: Sequence[Value]) -> dict[str, list[str]]:
    """Return the table columns "old" (nominal), "new" (identified) and "95 % interval" of the values in `rows`."""
    return {
        "old": [number(v.old) for v in rows],
        "new": [number(v.old) if v.kept else v.found for v in rows],
        "95 % interval": [v.interval for v in rows],
    }


def offset_table(robot: Robot, found: IdentificationResult) -> list[Item]:
    """Return Table I of the paper for this arm: torque offsets."""
    if "offset" not in found.space.blocks:
        return ["Offsets were not identified; they keep their nominal values."]
    rows = values(found.space, found.found, "offset", found.unseen)
    return ["Torque added to every command, Nm.", per_joint(robot, _listed(rows))]


def breakaway_table(robot: Robot, nominal: Dynamics, found: IdentificationResult, commanded: bool) -> list[Item]:
    """Return Table II: breakaway torques, and whether ramps or a search in the recording determined them."""
    d = found.dynamics
    if d.family.held is not None:
        return _presliding(robot, found, d.family.held)
    if not commanded:
        return ["Nominal: without commanded torque the recording does not show the command that moves a joint."]
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
            why = [ramped.unknown.get(f"joint {j + 1}, {word}", "").split(":")[0] for j in range(robot.n)]
            columns[f"{word}\nrepeatability"] = [w or s for w, s in zip(why, spread, strict=True)]
    how = "Not measured: there are no ramps, and the recording was not searched. Values are nominal."
    if ramped is not None:
        how = (
            f"{BREAKAWAY}, measured with torque ramps. Repeatability: standard deviation over ramps; -: fewer than "
            "two ramps moved the joint. Intervals are Student's, with the scatter of the joint's own ramps and of "
            "joints of its size. Not reached: the joint held until the end of the ramp; its breakaway lies beyond."
        )
    elif not np.array_equal(old, d.breakaway):
        how = f"{BREAKAWAY}, found by search in the recording because there are no ramps; without interval."
    return [how, per_joint(robot, columns)] if np.any(old) or np.any(d.breakaway) else [how]


def _presliding(robot: Robot, found: IdentificationResult, held: Callable[[np.ndarray], np.ndarray]) -> list[Item]:
    """Return Table II for a presliding friction family: the largest torque at which bristles hold a resting joint."""
    space = found.space
    low, high = np.quantile(held(space.dynamics(found.found.samples).phi), [0.025, 0.975], axis=0)
    old, new = held(space.dynamics(space.start).phi), held(found.dynamics.phi)
    columns: dict[str, list[str]] = {}
    for side, word in enumerate(("negative", "positive")):
        rows = [Value(*v) for v in zip(old[:, side], new[:, side], low[:, side], high[:, side], strict=True)]
        columns |= {f"{word}\n{k}": cells for k, cells in _listed(rows).items()}
    words = "This family models presliding: its bristles hold a resting joint up to this torque, Nm."
    return [words, per_joint(robot, columns)]


def base_items(robot: Robot, base: pd.DataFrame) -> list[Item]:
    """Tabulate the base parameters; link and name of a combination's first parameter determine its row and column."""
    columns: dict[str, list[str]] = {}
    rows = base[["nominal", "value", "interval95_low", "interval95_high"]].to_numpy()
    for first, row in zip(base["parameter"], rows.tolist(), strict=True):
        name, _, link = first.rstrip("]").partition("[")
        columns.setdefault(name, [""] * robot.n)[int(link) - 1] = Value(*row).cell
    words = (
        f"The {len(base)} combinations of inertial parameters on which torque depends, old → new, SI units, about "
        "each link's origin. base_parameters.csv lists the parameters that each one combines."
    )
    return [words, per_joint(robot, columns, "link")]


def inertia_tables(robot: Robot, found: IdentificationResult) -> list[Item]:
    """Return Table III: inertia tensors of links; with the full parametrization, also masses and centers of mass."""
    space, d = found.space, found.dynamics
    full = bool(set(LINK) & set(space.blocks))
    if not full and "inertia_scale" not in space.blocks:
        return ["Inertia was not identified; it keeps its nominal values."]
    before, draws = space.dynamics(space.start), space.dynamics(found.found.samples)
    kept = dict(zip(space.names, np.isin(space.names, found.unseen), strict=True))
    known = dict(zip(space.names, found.found.identifiable, strict=True))

    def cells(get: Callable[[Dynamics], np.ndarray], blocks: Sequence[str]) -> list[str]:
        """Return a cell per link: the value of `get`, with a ? unless the link is identifiable in all `blocks`."""
        low, high = np.quantile(get(draws), [0.025, 0.975], axis=0)
        rows = zip(get(before), get(d), low, high, strict=True)
        behind = [[f"{b}[{j + 1}]" for b in blocks if b in space.blocks] for j in range(robot.n)]
        return [
            Value(*v, all(known[k] for k in names), bool(names) and all(kept[k] for k in names)).cell
            for v, names in zip(rows, behind, strict=True)
        ]

    everything = LINK if full else ("inertia_scale",)
    tensors = {k: cells(partial(_moment, at), everything) for k, at in TENSOR.items()}
    words = "Tensor about each link's centre of mass, link axes, 10⁻³ kg m², old → new."
    items: list[Item] = [words, per_joint(robot, tensors, "link")]
    if full:
        columns = {"mass, kg": cells(lambda x: x.mass, LINK[:1])}
        for k, axis in enumerate("xyz"):
            # the log-Cholesky factor is upper triangular: coordinate k of the center depends on elements t_k to t_3
            columns[f"centre {axis}, mm"] = cells(partial(_centre, k), LINK[7 + k :])
        words = (
            "Mass and centre of mass in the link's frame, old → new. A value is identifiable (no ?) if all its "
            "parameters are."
        )
        return [words, per_joint(robot, columns, "link"), *items, _consistency(d)]
    scales = per_joint(robot, _listed(values(space, found.found, "inertia_scale", found.unseen)), "link")
    return ["Scale of each link's published tensor.", scales, *items, _consistency(d)]


def _moment(at: tuple[int, int], d: Dynamics) -> np.ndarray:
    return 1e3 * d.inertia[..., *at]


def _centre(axis: int, d: Dynamics) -> np.ndarray:
    return 1e3 * d.com[..., axis]


def _consistency(d: Dynamics) -> str:
    """Return a sentence on the physical consistency of all links (Wensing, Kim and Slotine, RA-L 3(1), 2018)."""
    second = 0.5 * np.trace(d.inertia, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) - d.inertia
    wrong = np.flatnonzero((np.linalg.eigvalsh(second).min(-1) < 0) | (d.mass <= 0)) + 1
    if not len(wrong):
        return "Every link is physically consistent: positive mass, positive moments within the triangle inequality."
    links = ", ".join(map(str, wrong))
    return f"The tensor of link {links} violates the triangle inequality, as the published one does."


def friction_table(robot: Robot, nominal: Dynamics, found: IdentificationResult, fastest: np.ndarray) -> list[Item]:
    """Return Table IV for the identified friction family, and the friction level at speeds `fastest` (n,) rad/s."""
    space, d = found.space, found.dynamics
    own = [b for b in d.family.names if b in space.blocks]
    columns = {named(b): [v.cell for v in values(space, found.found, b, found.unseen)] for b in own}
    levels = d.family.level(space.dynamics(found.found.samples).phi, fastest)
    low, high = np.quantile(levels, [0.025, 0.975], axis=0)
    old, new = nominal.family.level(nominal.phi, fastest), d.family.level(d.phi, fastest)
    columns["level at the\nfastest, Nm"] = [Value(*v).cell for v in zip(old, new, low, high, strict=True)]
    columns["fastest\nrad/s"] = [number(v) for v in fastest]
    words = (
        f"Family {d.family.name}: {d.family.formula}. Its parameters trade off against each other; the level is the "
        "friction at the fastest speed of the validation motion."
    )
    if nominal.family != d.family:
        words += (
            f" The nominal family is {nominal.family.name}; old values are those of {d.family.name} with the same "
            "level at 1 rad/s."
        )
    return [words, per_joint(robot, columns)]


def other_terms(robot: Robot, found: IdentificationResult) -> list[Item]:
    """Return up to two tables: one of parameters of the whole arm, one of armature, load, drag and gain per joint."""
    space = found.space
    items: list[Item] = []
    if arm := of_whole_arm(space, found.found, found.unseen):
        items += [
            "Delay and lag lie between a command and the torque at the joint. A payload is rigidly attached to the "
            "last link, its centre is in that link's frame.",
            pd.DataFrame(_listed([*arm.values()]), index=pd.Index(list(arm), name="whole arm")),
        ]
    if rest := [b for b in OTHERS if b in space.blocks]:
        columns = {named(b): [v.cell for v in values(space, found.found, b, found.unseen)] for b in rest}
        items += ["; ".join(OTHERS[b] for b in rest if OTHERS[b]) + ".", per_joint(robot, columns)]
    return items


def family_table(found: IdentificationResult) -> list[Item]:
    """Return the comparison of friction families on held-out motion."""
    chosen = found.dynamics.family.name
    if not found.families:
        return []
    rows = {name: [number(e, "{:.3f}"), "chosen" if name == chosen else ""] for name, e in found.families.items()}
    table = pd.DataFrame.from_dict(rows, orient="index", columns=["error / best error", ""]).rename_axis("family")
    words = (
        "Each family was fitted to a part of the recording and scored by its torque error on the rest. A family with "
        "more parameters is chosen only if it is better by more than one standard error. In windows of sliding, "
        f"Stribeck friction is chosen only if the error of Coulomb friction is more than {CLOSE} times its own."
    )
    return [words, table]
