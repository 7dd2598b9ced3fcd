"""Identification against a known truth: the paper's NEW values, found from its OLD ones.

`python benchmarks/known_truth.py [SEEDS]` records 20 s at 1 kHz of a simulated Panda (encoder noise 2e-5 rad,
velocity noise 3e-3 rad/s, delay 3 ms) and ramps every joint both ways at two postures, per seed; identifies with
search=replays; and writes docs/known_truth.md. Motion that is predicted is another excitation.
"""

import sys
import time

import numpy as np
from common import MACHINE, NEW, OLD, ROBOT, ROOT, fourier, how, poses_about, ramp, record, replace, searches

from r2s.arm.interface import ArmStopped
from r2s.arm.simulated import SimulatedArm
from r2s.identification.identify import identify
from r2s.identification.link_inertia import inertia_scale
from r2s.identification.prediction import prediction_errors

TRUTH = replace(NEW, delay=3e-3)
NOISE = {"position_noise": 2e-5, "velocity_noise": 3e-3}
TERMS = ["offset", "inertia_scale", "delay", "lag"]
ASKED = {
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


def recorded(seed: int, excitation: int):
    """Return a recording; where the arm stops itself, of another excitation."""
    try:
        return record(SimulatedArm(ROBOT, TRUTH, **NOISE, seed=seed), fourier(ROBOT, duration=20.0, seed=excitation))
    except ArmStopped as stop:
        print(f"excitation {excitation}: {stop}; taking {excitation + 1000}", flush=True)
        return recorded(seed, excitation + 1000)


def one(seed: int) -> list[float]:
    """Return a row of the table."""
    motions = [recorded(seed, s) for s in (2 * seed, 2 * seed + 1)]
    ramps = ramp(SimulatedArm(ROBOT, TRUTH, **NOISE, seed=seed), poses_about(ROBOT, 2))
    began = time.perf_counter()
    settings = how(family="sigmoid", terms=TERMS, extra=[])
    found = identify(ROBOT, OLD, motions[0], searches("replays"), settings, ramps=ramps)
    seconds = time.perf_counter() - began
    d, space = found.dynamics, found.space
    fastest = np.quantile(np.abs(motions[0].dq), 0.98, axis=0)
    speeds = np.linspace(-1, 1, 201)[:, None] * fastest
    curve = np.abs(d.friction(speeds) - TRUTH.friction(speeds)).max(0) / TRUTH.family.level(TRUTH.phi, fastest)
    edges = np.abs(d.breakaway - TRUTH.breakaway) / np.maximum(0.02 * np.abs(TRUTH.breakaway), 0.01)
    scale = 100 * np.abs(inertia_scale(d.inertia, TRUTH.inertia) - 1)
    told = space.block(found.found.identifiable, "inertia_scale")
    right = replace(space, nominal=TRUTH).start
    inside = (right >= found.found.low - 1e-12) & (right <= found.found.high + 1e-12)
    ahead = prediction_errors(ROBOT, OLD, d, motions[1], window_s=0.2, cutoff_hz=10.0)["ee_error_mm"]
    row = [100 * curve.max(), np.abs(d.offset - TRUTH.offset).max(), 1e3 * abs(float(d.delay) - 3e-3), edges.max()]
    row += [scale[told].max() if told.any() else np.nan, float(told.sum()), 100 * inside.mean()]
    missed = [name for name, ok in zip(space.names, inside, strict=True) if not ok]
    print(f"seed {seed}: outside their interval: {', '.join(missed) or 'none'}", flush=True)
    return [*row, ahead["0.5"], ahead["2"], seconds]


def main() -> None:
    """Run every seed and write the table."""
    seeds = range(int(sys.argv[1]) if len(sys.argv) > 1 else 10)
    rows = []
    for seed in seeds:
        rows.append(one(seed))
        print(seed, " ".join(f"{v:.3g}" for v in rows[-1]), flush=True)
    table = np.array(rows)
    lines = [
        "# Known truth: the paper's NEW values, from its OLD ones",
        "",
        f"`python benchmarks/known_truth.py` on {MACHINE}: 20 s at 1 kHz, encoder noise 2e-5 rad, velocity noise",
        "3e-3 rad/s, delay 3 ms; beside it about 11 s in which every joint is ramped both ways at two postures.",
        f"{len(rows)} seeds, each with another motion; search=replays, friction.family=sigmoid,",
        f"identify.terms.commanded=[{', '.join(TERMS)}]. End-effector errors on motion that was not fitted.",
        "",
        "| | asked | median | worst | " + " | ".join(f"seed {s}" for s in seeds) + " |",
        "|---|---|---|---|" + "---|" * len(rows),
    ]
    for name, asked, column in zip(ASKED, ASKED.values(), table.T, strict=True):
        worst = column.min() if name.startswith("identifiable") else column.max()
        cells = [name, asked, f"{np.median(column):.3g}", f"{worst:.3g}", *(f"{v:.3g}" for v in column)]
        if name.startswith("truth"):
            cells[2:4] = [f"mean {column.mean():.1f}", f"{column.min():.3g}"]
        lines.append("| " + " | ".join(cells) + " |")
    (ROOT / "docs" / "known_truth.md").write_text("\n".join(lines) + "\n")
    print("written: docs/known_truth.md")


if __name__ == "__main__":
    main()
