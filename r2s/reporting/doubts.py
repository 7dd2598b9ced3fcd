"""What the data of an identification cannot tell, in words."""

from collections.abc import Mapping, Sequence

import numpy as np

from r2s.identification.link_inertia import LINK
from r2s.identification.uncertainty import SHARPER, Identified
from r2s.reporting.document import Item

MOST_LINES = 10  # of null directions in words


def doubts(found: Identified) -> list[Item]:
    """Return in words what the data cannot tell: unseen values, values at an edge, null directions."""
    space = found.space
    items: list[Item] = []
    known, total = int(found.found.identifiable.sum()), len(space.names)
    items.append(
        f"{total} numbers were searched; the data can tell {known} of them one by one. A number is known (no ?) "
        f"where its 95 % interval is narrower than {2 / SHARPER:g} standard deviations of the belief before."
    )
    if found.refused:
        items.append(
            "Replays of the motion disagreed with the torque of joints that move, by more than the errors of both "
            "allow: they were refused, and the numbers are those of the torque."
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
