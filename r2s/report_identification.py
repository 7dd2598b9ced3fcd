"""The report of an identification: the paper's tables I-IV for this arm, what the data cannot tell, and its figures.

"Old" is the nominal model, "new" what was identified; intervals are 95 %, from the joint distribution of the result.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from r2s.friction import BRISTLE
from r2s.identified import SHARPER, Identified
from r2s.parameters import LINK, WHOLE_ARM
from r2s.recording import Recording
from r2s.report import (
    LEGEND,
    Item,
    Value,
    error_tables,
    named,
    number,
    per_joint,
    values,
)
from r2s.robot import Robot
from r2s.simulator import Dynamics
from r2s.torque_residual import FRICTION_CUTOFF

MOST_LINES = 10  # of null directions in words
FORMULAS = {
    "sigmoid": "phi1 (s(phi2 (v + phi3)) - s(phi2 phi3)) + viscous v, s the logistic function: eq. (5)",
    "coulomb": "coulomb (1 ± asymmetry) sign(v) + viscous v",
    "stribeck": "coulomb (1 ± asymmetry) (1 + rise exp(-(v / stribeck_velocity)²)) sign(v) + viscous v",
    "bristle": "Stribeck's, whose sign turns over the distance `presliding`: it has a memory and holds at rest",
}
LINK_SIDE = "link-side torque, with gravity"
TENSOR = {"Ixx": (0, 0), "Iyy": (1, 1), "Izz": (2, 2), "Ixy": (0, 1), "Ixz": (0, 2), "Iyz": (1, 2)}


# --- tables ---------------------------------------------------------------------------------------------------


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
    if d.family == BRISTLE:
        return _held_by_bristles(robot, found)
    if not commanded:
        return ["Nominal: a link-side sensor does not feel at which torque of the motor a joint lets go."]
    old = nominal.breakaway
    columns: dict[str, list[str]] = {}
    measured = found.break_spread is not None
    for side, word in enumerate(("negative", "positive")):
        columns[f"{word}\nold"] = [number(x) for x in old[:, side]]
        columns[f"{word}\nnew"] = [number(x) for x in d.breakaway[:, side]]
        if measured:
            rows = values(*found.saved, f"breakaway_{word}")
            spread = found.break_spread[:, side]  # type: ignore[index]
            columns[f"{word}\n95 % interval"] = [
                v.interval if np.isfinite(s) else "-" for v, s in zip(rows, spread, strict=True)
            ]
            columns[f"{word}\nrepeatability"] = [number(s, "{:.2g}") for s in spread]
    how = "Not measured: no joint was ramped, and no edge was looked for in the recording. Nominal values."
    if measured:
        how = (
            "Torque at which a resting joint lets go, command and offset together, Nm: measured by ramping each "
            "joint until it moved. Repeatability: standard deviation over ramps; -: fewer than two got there."
        )
    elif not np.array_equal(old, d.breakaway):
        how = (
            "Torque at which a resting joint lets go, command and offset together, Nm: looked for in the recording, "
            "as no joint was ramped. There is no interval."
        )
    return [how, per_joint(robot, columns)] if np.any(old) or np.any(d.breakaway) else [how]


def _held_by_bristles(robot: Robot, found: Identified) -> list[Item]:
    """Return Table II of the family that needs no dead zone: its level at rest."""

    def edges(d: Dynamics) -> np.ndarray:
        level, asymmetry, rise = (d.phi[..., k] for k in (0, 1, 3))
        return np.stack([-level * (1 - asymmetry), level * (1 + asymmetry)], -1) * (1 + rise[..., None])

    space = found.space
    low, high = np.quantile(edges(space.dynamics(found.found.samples)), [0.025, 0.975], axis=0)
    old, new = edges(space.dynamics(space.start)), edges(found.dynamics)
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
        columns = {"mass, kg": cells(lambda x: robot.mass if x.mass is None else x.mass, LINK[:1])}
        for k, axis in enumerate("xyz"):
            get = lambda x, k=k: 1e3 * (robot.com if x.com is None else x.com)[..., k]  # noqa: E731
            columns[f"centre {axis}, mm"] = cells(get, LINK[7 + k :])  # t is seen through an upper triangle
        words = (
            "Mass and centre of mass in the link's frame, old → new. A value is known (no ?) where all of the "
            "parameters behind it are."
        )
        return [words, per_joint(robot, columns, "link"), *items, _physical(d, robot)]
    scales = per_joint(robot, _listed(values(space, found.found, "inertia_scale", found.unseen)), "link")
    return ["Scale of each link's published tensor.", scales, *items, _physical(d, robot)]


def _physical(d: Dynamics, robot: Robot) -> str:
    """Return a sentence: which links are none that mass could have (Wensing, Kim and Slotine, RA-L 3(1), 2018)."""
    second = 0.5 * np.trace(d.inertia, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) - d.inertia
    mass = robot.mass if d.mass is None else d.mass
    wrong = np.flatnonzero((np.linalg.eigvalsh(second).min(-1) < 0) | (mass <= 0)) + 1
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
        f"Family {d.family.name}: {FORMULAS.get(d.family.name, '')}. Its parameters trade off against each other; "
        "the level is what they make together, at the fastest speed of the held-out motion."
    )
    if nominal.family != d.family:
        name = nominal.family.name
        words += f" The nominal model is {name}; old values are of {d.family.name} with its level at 1 rad/s."
    return [words, per_joint(robot, columns)]


def other_terms(robot: Robot, found: Identified) -> list[Item]:
    """Return delay and lag, and what else was searched: load, drag, sensor gain."""
    space = found.space
    items: list[Item] = []
    arm = [b for b in space.blocks if b in WHOLE_ARM]
    if arm:
        rows = [values(space, found.found, b, found.unseen)[0].times(1e3) for b in arm]
        items += [
            "Between a command and the torque at the joint.",
            pd.DataFrame(_listed(rows), index=pd.Index([f"{b}, ms" for b in arm], name="whole arm")),
        ]
    meaning = {
        "load": "load: friction per torque that gravity loads the joint with",
        "drag_sin": "drag: offset that goes with the joint's own sin q and cos q, as a cable's",
        "gain": "gain: relative error of the torque sensor",
    }
    rest = [b for b in ("load", "drag_sin", "drag_cos", "gain") if b in space.blocks]
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


def doubts(found: Identified) -> list[Item]:
    """Return in words what the data cannot tell: unseen values, values at an edge, null directions."""
    space = found.space
    items: list[Item] = []
    known, total = int(found.found.identifiable.sum()), len(space.names)
    items.append(
        f"{total} numbers were searched; the data can tell {known} of them one by one. A number is known (no ?) "
        f"where its 95 % interval is narrower than {2 / SHARPER:g} standard deviations of the belief before."
    )
    if found.unseen:
        items.append(
            "Kept at their nominal values, because the data say hardly more of them than was believed before (or "
            f"their joint's refit did not predict motion left out better): {_grouped(found.unseen, space.n)}."
        )
    u = space.to_unit(found.x)
    edge = np.where(u < 5e-4, space.lower, np.where(u > 1 - 5e-4, space.upper, np.nan))
    names = [n for n, e in zip(space.names, edge, strict=True) if np.isfinite(e) and e != 0 and n not in found.unseen]
    if names:
        items.append(
            "At an edge of what was searched (identify.bounds), so that the best value may lie beyond: "
            f"{_grouped(names, space.n)}."
        )
    if found.null_directions:
        items += _null_directions(found)
    return items


def _null_directions(found: Identified) -> list[Item]:
    """Return the combinations that only the belief decides; those of unseen numbers alone are only counted."""

    def unseen(parts: Mapping[str, float]) -> float:
        square = {name: part**2 for name, part in parts.items()}
        return sum(v for name, v in square.items() if name in found.unseen) / max(sum(square.values()), 1e-12)

    told = [(share, parts) for share, parts in found.null_directions if parts and unseen(parts) < 0.5]
    lines = [f"{100 * share:.0f} %: {_combination(parts)}" for share, parts in told[:MOST_LINES]]
    if more := len(found.null_directions) - len(lines):
        what = (
            "mostly of the numbers kept nominal" if len(told) <= MOST_LINES else "of smaller shares or kept nominal"
        )
        lines.append(f"{'and ' * bool(lines)}{more} {'more, ' * bool(lines)}{what}: see parameters.yaml")
    words = (
        "Combinations that the belief before decides rather than the data: moving along them changes hardly anything "
        "that was recorded. The share is how much of the belief's standard deviation is left; parts are in its units."
    )
    return [words, lines]


def _place(name: str) -> tuple[str, str, str]:
    """Return block, "joint" or "link" and number of a name such as phi1[3]; nothing for the whole arm."""
    block, _, number_ = name.rstrip("]").partition("[")
    kind = "link" if block in LINK or block == "inertia_scale" else "joint"
    return block.removeprefix("link_"), kind if number_ else "", number_


def _grouped(names: Sequence[str], n: int = 0) -> str:
    """Return "phi3 of joints 1, 4; alpha of all links" for names such as phi3[1]; n joints are all."""
    groups: dict[tuple[str, str], list[str]] = {}
    for name in names:
        block, kind, at = _place(name)
        groups.setdefault((block, kind), []).append(at)
    words = []
    for (block, kind), places in groups.items():
        where = f"all {kind}s" if len(places) == n else f"{kind}{'s' * (len(places) > 1)} {', '.join(places)}"
        words.append(f"{block} of {where}" if kind else block)
    return "; ".join(words)


def _combination(parts: Mapping[str, float]) -> str:
    """Return "0.81 d1 of link 3 - 0.57 d2 of link 3"; a direction has no sign, so the first part is positive."""
    flip = -1.0 if next(iter(parts.values())) < 0 else 1.0
    terms = [f"{'-' if flip * part < 0 else '+'} {abs(part):.2f} {_grouped([name])}" for name, part in parts.items()]
    return " ".join(terms).removeprefix("+ ")


# --- the whole ------------------------------------------------------------------------------------------------


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
            "explains everything; a residual that stays correlated for longer than a block of the bootstrap makes "
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
    with_gravity = "commanded torque, without gravity" if validation.torque == "commanded" else LINK_SIDE
    parts = [f"Recording {validation.name or 'without a name'}: {with_gravity}"]
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
