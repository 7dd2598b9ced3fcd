"""Report the limits of an identification: parameters and their combinations that the data hardly constrain."""

from collections.abc import Mapping, Sequence

from r2s.identification.link_inertia import LINK
from r2s.identification.result import SHARPER, IdentificationResult
from r2s.reporting.document import Item

MOST_LINES = 10  # largest number of listed combinations of parameters


def identifiability(found: IdentificationResult) -> list[Item]:
    """Return sentences on the limits of an identification.

    The sentences name parameters that remained nominal, parameters that reached a bound, and combinations of
    parameters that only the prior determines.
    """
    space = found.space
    count, total = int(found.found.identifiable.sum()), len(space.names)
    items: list[Item] = [
        f"The search has {total} parameters; the data identify {count} of them individually. A parameter is "
        f"identifiable (no ?) if its 95 % interval is narrower than {2 / SHARPER:g} standard deviations of its prior."
    ]
    if found.refused:
        items.append(
            "The replays contradict the torque of moving joints by more than the errors of both allow. They were "
            "rejected: the parameters come from the torque."
        )
    if found.unseen:
        items.append(
            "Kept at their nominal values, because the data hardly constrain them beyond the prior (or because the "
            f"joint's refit did not predict held-out motion better): {_grouped(found.unseen, space.n)}."
        )
    items += [f"{line[0].upper()}{line[1:]}." for line in found.at_bounds]
    return items + (_null_directions(found) if found.null_directions else [])


def _null_directions(found: IdentificationResult) -> list[Item]:
    """List up to MOST_LINES parameter combinations that only the prior determines; state the number of the others."""

    def kept(parts: Mapping[str, float]) -> float:
        square = {name: part**2 for name, part in parts.items()}
        return sum(v for name, v in square.items() if name in found.unseen) / max(sum(square.values()), 1e-12)

    listed = [(share, parts) for share, parts in found.null_directions if parts and kept(parts) < 0.5]
    lines = [f"{100 * share:.0f} %: {_combination(parts)}" for share, parts in listed[:MOST_LINES]]
    if more := len(found.null_directions) - len(lines):
        few = len(listed) <= MOST_LINES
        what = "mostly of parameters kept nominal" if few else "of smaller shares or of parameters kept nominal"
        lines.append(f"{'and ' * bool(lines)}{more} {'more, ' * bool(lines)}{what}: see parameters.yaml")
    words = (
        "Combinations that the prior decides instead of the data: a change along them hardly changes the predicted "
        "recording. The percentage is the remaining share of the prior's standard deviation, which is also the unit "
        "of the coefficients."
    )
    return [words, lines]


def _place(name: str) -> tuple[str, str, str]:
    """Split a name such as phi1[3] into block, kind ("joint" or "link", "" for the whole arm) and number (or "")."""
    block, _, number = name.rstrip("]").partition("[")
    kind = "link" if block in LINK or block == "inertia_scale" else "joint"
    return block.removeprefix("link_"), kind if number else "", number


def _grouped(names: Sequence[str], n: int = 0) -> str:
    """Join names such as phi3[1] to text for an arm with n joints: "phi3 of joints 1, 4; alpha of all links"."""
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
    """Return a combination as "0.81 d1 of link 3 - 0.57 d2 of link 3"; flip all signs if the first is negative."""
    flip = -1.0 if next(iter(parts.values())) < 0 else 1.0
    terms = [f"{'-' if flip * part < 0 else '+'} {abs(part):.2f} {_grouped([name])}" for name, part in parts.items()]
    return " ".join(terms).removeprefix("+ ")
