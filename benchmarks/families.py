"""Test whether friction.family=auto selects the family that generated the data.

`python benchmarks/families.py [SEEDS]` draws arms with sigmoid, Coulomb + viscous, Stribeck and presliding friction
around the paper's level, records 15 s of each (sensor noise, delay and breakaway as in known_truth.py), and compares
the families same as stage=identify. Writes benchmarks/results/families.md.
"""

import sys
import time

import numpy as np
from common import (
    NEW,
    OLD,
    ROBOT,
    fourier,
    identify_settings,
    markdown_rows,
    record,
    replace,
    simulated_arm,
    write_page,
)

from r2s.identification.identify import STANDSTILL
from r2s.identification.structure.cross_validation import CrossValidation
from r2s.identification.structure.family_selection import compare_families
from r2s.physics.friction import BRISTLE, FAMILIES, SIGMOID, STRIBECK


def draw(family, rng):
    """Return an arm with friction of this family, at the paper's level times U(0.7, 1.3)."""
    n = ROBOT.n
    level = SIGMOID.level(NEW.phi, np.full(n, 1.0)) * rng.uniform(0.7, 1.3, n)
    if family == SIGMOID:
        phi = NEW.phi * rng.uniform(0.7, 1.3, NEW.phi.shape)
    else:
        viscous = level * rng.uniform(0.2, 0.6, n)
        phi = np.stack([level - 0.5 * viscous, rng.uniform(-0.1, 0.1, n), viscous], -1)
    if family in (STRIBECK, BRISTLE):
        phi = np.concatenate([phi, rng.uniform(0.2, 0.6, (n, 1)), rng.uniform(0.05, 0.15, (n, 1))], -1)
    if family == BRISTLE:
        phi = np.concatenate([phi, rng.uniform(5e-4, 2e-3, (n, 1))], -1)
    return replace(NEW, family=family, phi=phi, delay=3e-3)


def main() -> None:
    """Run every family and seed and write the table."""
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 10
    settings = identify_settings()
    given = settings.bounds, settings.prior, settings.folds, 10.0  # Hz, low-pass
    terms = ["offset", "inertia_scale", "delay"]
    names, picks, began = [f.name for f in FAMILIES], {}, time.perf_counter()
    for family in FAMILIES:
        picks[family.name] = []
        for seed in range(seeds):
            truth = draw(family, np.random.default_rng([FAMILIES.index(family), seed]))
            motion = record(simulated_arm(truth, seed), fourier(ROBOT, duration=15.0, seed=seed))
            cv = CrossValidation(ROBOT, OLD, motion, *given, report=lambda row: None)
            chosen = compare_families(cv, terms, STANDSTILL)
            picks[family.name].append(names[chosen["best"]])
            errors = ", ".join(f"{n} {e:.3f}" for n, e in zip(names, chosen["error"], strict=True))
            print(f"{family.name}, seed {seed}: {picks[family.name][-1]} ({errors})", flush=True)
    seconds = (time.perf_counter() - began) / (len(FAMILIES) * seeds)
    table = {truth: {f"picked {n}": picked.count(n) for n in names} for truth, picked in picks.items()}
    parts = [
        f"{seeds} seeds per family, {seconds:.0f} s each with the recording. Target: 9 of 10.",
        markdown_rows(table, "data made with"),
    ]
    title = "Friction family selected by `friction.family=auto`"
    write_page("families", title, "python benchmarks/families.py", parts)


if __name__ == "__main__":
    main()
