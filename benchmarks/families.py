"""Does friction.family=auto pick the family that data were made with?

`python benchmarks/families.py [SEEDS]` draws arms with sigmoid, Coulomb + viscous, Stribeck and bristle friction
about the paper's level, records 15 s of each (sensor noise, delay and breakaway as in benchmarks/known_truth.py), and
compares the families as stage=identify does. Writes docs/families.md.
"""

import sys
import time

import numpy as np
from common import MACHINE, NEW, OLD, ROBOT, ROOT, fourier, how, record, replace

from r2s.arm.simulated import SimulatedArm
from r2s.identification.family_selection import compare_families
from r2s.identification.identify import STANDSTILL
from r2s.physics.friction import BRISTLE, FAMILIES, SIGMOID, STRIBECK

NOISE = {"position_noise": 2e-5, "velocity_noise": 3e-3}


def draw(family, rng):
    """Return an arm whose friction is of this family, with the paper's level times U(0.7, 1.3)."""
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
    """Run every truth and seed and write the table."""
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 10
    settings = how()
    given = [settings.bounds, settings.prior, ["offset", "inertia_scale", "delay"], settings.folds]
    names = [f.name for f in FAMILIES]
    picks = {}
    began = time.perf_counter()
    for family in FAMILIES:
        picks[family.name] = []
        for seed in range(seeds):
            truth = draw(family, np.random.default_rng([FAMILIES.index(family), seed]))
            arm = SimulatedArm(ROBOT, truth, **NOISE, seed=seed)
            motion = record(arm, fourier(ROBOT, duration=15.0, seed=seed))
            chosen = compare_families(ROBOT, OLD, motion, *given, {"cutoff_hz": 10.0}, lambda row: None, STANDSTILL)
            picks[family.name].append(names[chosen["best"]])
            told = ", ".join(f"{n} {e:.3f}" for n, e in zip(names, chosen["error"], strict=True))
            print(f"{family.name}, seed {seed}: {picks[family.name][-1]} ({told})", flush=True)
    seconds = (time.perf_counter() - began) / (len(FAMILIES) * seeds)
    lines = [
        "# Right family: what friction.family=auto picks",
        "",
        f"`python benchmarks/families.py` on {MACHINE}, {seeds} seeds each, {seconds:.0f} s each with its recording.",
        "Asked: the right one in at least 9 of 10.",
        "",
        "| data made with | " + " | ".join(f"picked {n}" for n in names) + " |",
        "|---|" + "---|" * len(names),
    ]
    lines += [f"| {t} | " + " | ".join(str(p.count(n)) for n in names) + " |" for t, p in picks.items()]
    (ROOT / "docs" / "families.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines[5:]))


if __name__ == "__main__":
    main()
