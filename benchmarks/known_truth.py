"""Identify a simulated arm of known truth: the paper's NEW values from its OLD ones.

`python benchmarks/known_truth.py [SEEDS]` records 20 s at 1 kHz of a simulated Panda per seed (encoder noise 2e-5
rad, velocity noise 3e-3 rad/s, delay 3 ms), ramps every joint in both directions at two postures, identifies with
search=staged, and predicts another excitation. Writes benchmarks/results/known_truth.md.
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
    poses_about,
    ramp,
    record,
    replace,
    searches,
    simulated_arm,
    write_page,
)

from r2s.arm.interface import ArmStopped
from r2s.identification.identify import identify
from r2s.identification.link_inertia import inertia_scale
from r2s.identification.prediction import prediction_errors

TRUTH = replace(NEW, delay=3e-3)
TERMS = ["offset", "inertia_scale", "delay", "lag"]
TARGETS = {
    "friction curve, worst joint, % of its level": "<= 1",
    "offset, worst joint, Nm": "<= 0.005",
    "delay, ms": "<= 0.2",
    "breakaway, worst edge over what is allowed": "<= 1 (2 % or 0.01 Nm)",
    "inertia scale, worst identifiable link, %": "<= 3",
    "identifiable scales": "",
    "truth within the 95 % interval, %": "90-98 on average",
    "end effector after 0.5 s, mm": "<= 0.5",
    "after 2 s, mm": "<= 2",
    "seconds": "<= 45",
}


def record_excitation(seed: int, excitation: int, seconds: float = 20.0):
    """Return a recording of the true arm; if the arm stops itself, of another excitation."""
    try:
        return record(simulated_arm(TRUTH, seed), fourier(ROBOT, duration=seconds, seed=excitation))
    except ArmStopped as stop:
        print(f"excitation {excitation}: {stop}; taking {excitation + 1000}", flush=True)
        return record_excitation(seed, excitation + 1000, seconds)


def friction_error(d, recording) -> float:
    """Return the largest error of the friction curves over the visited speeds, % of the friction level."""
    fastest = np.quantile(np.abs(recording.dq), 0.98, axis=0)
    speeds = np.linspace(-1, 1, 201)[:, None] * fastest
    curve = np.abs(d.friction(speeds) - TRUTH.friction(speeds)).max(0) / TRUTH.family.level(TRUTH.phi, fastest)
    return 100 * curve.max()


def evaluate(seed: int) -> list[float]:
    """Return the values of one seed, in the order of TARGETS."""
    motions = [record_excitation(seed, s) for s in (2 * seed, 2 * seed + 1)]
    ramps = ramp(simulated_arm(TRUTH, seed), poses_about(ROBOT, 2))
    began = time.perf_counter()
    settings = identify_settings(family="sigmoid", terms=TERMS, candidate_terms=[])
    found = identify(ROBOT, OLD, motions[0], searches("staged"), settings, ramps=ramps)
    seconds = time.perf_counter() - began
    d, space = found.dynamics, found.space
    edges = np.abs(d.breakaway - TRUTH.breakaway) / np.maximum(0.02 * np.abs(TRUTH.breakaway), 0.01)
    scale = 100 * np.abs(inertia_scale(d.inertia, TRUTH.inertia) - 1)
    identifiable = space.block(found.found.identifiable, "inertia_scale")
    truth = replace(space, nominal=TRUTH).start
    inside = (truth >= found.found.low - 1e-12) & (truth <= found.found.high + 1e-12)
    ahead = prediction_errors(ROBOT, OLD, d, motions[1], window_s=0.2, cutoff_hz=10.0)["ee_error_mm"]
    row = [friction_error(d, motions[0]), np.abs(d.offset - TRUTH.offset).max()]
    row += [
        1e3 * abs(float(d.delay) - 3e-3),
        edges.max(),
        scale[identifiable].max() if identifiable.any() else np.nan,
    ]
    row += [float(identifiable.sum()), 100 * inside.mean(), ahead["0.5"], ahead["2"], seconds]
    missed = [name for name, ok in zip(space.names, inside, strict=True) if not ok]
    print(f"seed {seed}: outside their interval: {', '.join(missed) or 'none'}", flush=True)
    return row


def main() -> None:
    """Run every seed and write the table."""
    seeds, rows = range(int(sys.argv[1]) if len(sys.argv) > 1 else 10), []
    for seed in seeds:
        rows.append(evaluate(seed))
        print(seed, " ".join(f"{v:.3g}" for v in rows[-1]), flush=True)
    table = {}
    for (name, target), column in zip(TARGETS.items(), np.array(rows).T, strict=True):
        worst = column.min() if name.startswith(("identifiable", "truth")) else column.max()
        middle = f"mean {column.mean():.1f}" if name.startswith("truth") else f"{np.median(column):.3g}"
        table[name] = {"target": target, "median": middle, "worst": f"{worst:.3g}"}
        table[name] |= {f"seed {s}": f"{v:.3g}" for s, v in zip(seeds, column, strict=True)}
    text = (
        "20 s at 1 kHz, encoder noise 2e-5 rad, velocity noise 3e-3 rad/s, delay 3 ms; about 11 s of ramps. "
        f"{len(rows)} motions; search=staged, friction.family=sigmoid. End-effector errors on held-out motion."
    )
    title = "Known truth: the paper's NEW values from its OLD ones"
    write_page("known_truth", title, "python benchmarks/known_truth.py", [text, markdown_rows(table)])


if __name__ == "__main__":
    main()
