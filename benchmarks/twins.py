"""Identify judging twins: open-loop prediction against that of the nominal model.

`python benchmarks/twins.py [variant=elastic] [SEED ...]`, by default the judging seeds, 100-109 (rigid) or 200-209
(elastic); development seeds are 0-9. Each twin is recorded for 20 s, ramped at two postures, identified with the
settings of stage=identify, and scored on held-out motion. The judging seeds write benchmarks/results/twins.md.
"""

import sys
import time

import numpy as np
from common import (
    JUDGING,
    OLD,
    RESULTS,
    ROBOT,
    fourier,
    identify_settings,
    markdown_rows,
    poses_about,
    put_section,
    ramp,
    record,
    searches,
    stamp,
)
from twin_judge import WatchedTwin, covered

from r2s.arm.twins.make_twin import make_twin
from r2s.identification.identify import identify
from r2s.identification.prediction import prediction_errors


def evaluate(variant: str, seed: int) -> dict:
    """Return the results of one twin."""
    arms = [make_twin(ROBOT, variant=variant, seed=seed, noise=s) for s in range(3)]
    watched = WatchedTwin(arms[0])
    train, validation = (
        record(arm, fourier(ROBOT, duration=20.0, seed=s)) for s, arm in enumerate((watched, arms[1]))
    )
    ramps = ramp(arms[2], poses_about(ROBOT, 2))
    began = time.perf_counter()
    found = identify(ROBOT, OLD, train, searches("staged"), identify_settings(family="auto"), ramps=ramps)
    seconds = time.perf_counter() - began
    e = prediction_errors(ROBOT, OLD, found.dynamics, validation, window_s=0.2, cutoff_hz=10.0)
    joints, torque = (np.array(e[k]) / np.array(e[f"nominal_{k}"]) for k in ("position_rmse_mrad", "torque_rmse_Nm"))
    return {
        "family": found.dynamics.family.name,
        "ee": e["ee_error_mm"],
        "nominal": e["nominal_ee_error_mm"],
        "ratio": e["nominal_ee_error_mm"]["0.5"] / e["ee_error_mm"]["0.5"],
        "joints": joints,
        "torque": torque,
        "delay": 1e3 * float(found.dynamics.delay),
        "lag": 1e3 * float(found.dynamics.lag),
        "within": covered(watched, train.q, found),
        "seconds": seconds,
    }


def cells(r: dict) -> dict[str, str]:
    """Return the row of a twin."""
    pairs = {h: f"{r['nominal'][h]:.1f} → {r['ee'][h]:.1f}" for h in ("0.1", "0.5", "2")}
    row = {"family": r["family"], "0.1 s, mm": pairs["0.1"], "0.5 s, mm": pairs["0.5"]}
    row |= {"ratio": f"1/{r['ratio']:.1f}", "2 s, mm": pairs["2"], "worst joint": f"{r['joints'].max():.2f}"}
    row |= {"friction within, %": f"{100 * r['within']:.0f}"}
    return row | {"delay + lag, ms": f"{r['delay']:.1f} + {r['lag']:.1f}", "seconds": f"{r['seconds']:.0f}"}


def main() -> None:
    """Run every seed and write the table."""
    words = sys.argv[1:]
    variant = next((word.removeprefix("variant=") for word in words if word.startswith("variant=")), "rigid")
    seeds = [int(word) for word in words if "=" not in word]
    rows = {}
    for seed in seeds or JUDGING[variant]:
        rows[seed] = evaluate(variant, seed)
        line = ", ".join(f"{k} {v}" for k, v in cells(rows[seed]).items())
        print(f"twin {seed}: {line}, torque {rows[seed]['torque'].max():.2f}", flush=True)
    ratio = np.array([r["ratio"] for r in rows.values()])
    worst = max(r["joints"].max() for r in rows.values())
    summary = f"median 1/{np.median(ratio):.1f}, worst 1/{ratio.min():.1f}; worst joint of any twin {worst:.2f}"
    print(summary)
    if seeds:
        return
    command = f"python benchmarks/twins.py{f' variant={variant}' * (variant != 'rigid')}"
    parts = [
        f"{stamp(command)} Ratio after 0.5 s: {summary} (target: median 1/10, worst 1/6, no joint worse).",
        markdown_rows({seed: cells(r) for seed, r in rows.items()}, "twin"),
    ]
    put_section(RESULTS / "twins.md", f"{variant.capitalize()} variant", parts)


if __name__ == "__main__":
    main()
