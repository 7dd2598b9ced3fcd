"""Assign colors to labels; figures and the Rerun viewer use the same colors."""

from collections.abc import Iterable

KNOWN = {"measured": "#9aa0a6", "nominal": "#f28e2b", "identified": "#3b8fe0"}
# twelve colors far apart in OKLab; their WCAG contrast to black and to white is at least 2.4
OTHERS = (
    "#3daa6d", "#d65f9e", "#9b7ede", "#c9a227", "#784800", "#005484",
    "#cc0018", "#5400f0", "#007800", "#d800fc", "#607878", "#900c90",
)  # fmt: skip


def colours(labels: Iterable[str]) -> dict[str, str]:
    """Return {label: "#rrggbb"}, legible on white and on black.

    KNOWN has a color for each of the words "measured", "nominal" and "identified". The first label that contains such
    a word has the word's color. All other labels cycle through the twelve colors in OTHERS.
    """
    found: dict[str, str] = {}
    others = 0
    for label in dict.fromkeys(labels):
        meant = next((colour for word, colour in KNOWN.items() if word in label), None)
        if meant is None or meant in found.values():
            meant = OTHERS[others % len(OTHERS)]
            others += 1
        found[label] = meant
    return found
