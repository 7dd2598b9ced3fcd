"""Identify arms of an independent simulator, whose parameters are all known.

    python benchmarks/independent.py [--five FOLDER] [--arms five|drawn|all|NAME,...] [--drawn FOLDER] [--seeds 0-9]

runs stage=identify with its defaults on each arm, in run folders runs/identify/independent_<arm>, and skips finished
ones. Only the judge reads truth.json, the parameters of an arm.

    five    sigmoid, coulomb, stribeck, lugre and paper: FOLDER/<name>, not part of this repository
    drawn   arms of benchmarks/independent_arms.py by seed; the script creates missing ones in FOLDER/<seed>. Seeds 0
            to 31 chose constants of r2s; 100 to 149, ten of each friction, are for judging

After a change of the identification, `--tag WORD` names other run folders. `--processes 8` identifies as many arms at
once with one thread each; seconds are then those of a busy machine. `--quick` is a toy: search=toy on the first arm
of each kind. Arguments with = go to run.py. Without them, all arms (20 drawn ones or more) write
benchmarks/results/independent.md.
"""

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from datetime import date
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pandas as pd
from common import MACHINE, RESULTS, ROOT, markdown
from independent_arms import write_arm
from independent_judge import judge

FIVE = ("sigmoid", "coulomb", "stribeck", "lugre", "paper")


def identify_arm(arm: Path, name: str, words: list[str]) -> Path | None:
    """Run stage=identify on an arm unless finished; return its run folder, None if it failed."""
    folder = ROOT / "runs" / "identify" / name
    data = ["data=recording", "data.torque=commanded", f"data.path={arm / 'train.npz'}"]
    data += [f"data.validation={arm / 'validation.npz'}", f"data.ramps={arm / 'ramps.npz'}"]
    command = [sys.executable, "run.py", "stage=identify", *data, f"name={name}", "skip_completed=true", *words]
    failed = subprocess.run(command, cwd=ROOT).returncode
    return None if failed else folder


def evaluate(name: str, arm: Path, label: str, words: list[str]) -> dict | None:
    """Create a missing drawn arm, identify it and return its scores, None if identification failed."""
    if name.isdigit() and not (arm / "truth.json").is_file():
        write_arm(arm, int(name))
    run = identify_arm(arm.resolve(), label, words)
    if run is None:
        print(f"{name}: failed", flush=True)
        return None
    result = judge(run, arm, threads=1 if "threads=1" in words else 0)
    (run / "judged.json").write_text(json.dumps(result, indent=1))
    print(", ".join(f"{k} {v}" for k, v in row(name, result).items()), flush=True)
    return result


def both(r: dict, key: str, most=np.nanmax) -> str:
    """Return a measure of the parameters, and including all torques of the identified model."""
    return f"{most(r[key]):.3g} / {most(r['total'][key]):.3g}"


def row(name: str, r: dict) -> dict[str, str]:
    """Return the row of an arm."""
    truth = f"{r['true family']}{', paper' if r['paper'] else ''}"
    return {
        "arm": name,
        "family": f"{truth} → {r['family']}",
        "friction - offset, worst joint, %": both(r, "friction"),
        "median joint, %": both(r, "friction", np.median),
        "plain regression, %": f"{np.max(r['plain']):.3g}, median {np.median(r['plain']):.3g}",
        "offset, mNm": both(r, "offset"),
        "edges, mNm": both(r, "edges"),
        "median edge, mNm": both(r, "edges", np.nanmedian),
        "delay + lag, ms": f"{r['latency']:.2f} of {r['true latency']:.2f}",
        "interval, ms": f"{r['latency interval'][0]:.2f}-{r['latency interval'][1]:.2f}",
        "0.5 s, mm": f"{r['ee']:.1f} of {r['true ee']:.1f}",
        "friction within, %": f"{100 * np.mean(r['within']):.0f} / {100 * np.mean(r['total']['within']):.0f}",
        "seconds": f"{r['seconds']:.0f}",
    }


def targets(arms: dict[str, dict]) -> pd.DataFrame:
    """Return target and measured value, of the parameters and including all torques, and whether the first is met."""
    rows, lines = list(arms.values()), []

    def add(what: str, target: str, measured: str, met: bool, total: str = "") -> None:
        line = {"what": what, "target": target, "measured": measured, "with all torques": total}
        lines.append(line | {"met": "yes" if met else "no"})

    def add_maximum(what: str, target: float, unit: str, measure, arms: list[dict]) -> None:
        measured, total = (max((measure(r) for r in some), default=np.nan) for some in (arms, totals(arms)))
        add(what, f"<= {target:g} {unit}", f"{measured:.3g} {unit}", measured <= target, f"{total:.3g} {unit}")

    def totals(arms: list[dict]) -> list[dict]:
        return [r["total"] for r in arms]

    add_maximum("friction minus offset, worst joint", 3, "%", lambda r: np.max(r["friction"]), rows)
    add_maximum("friction minus offset, median joint", 1, "%", lambda r: np.median(r["friction"]), rows)
    worse = [n for n, r in arms.items() if np.max(r["friction"]) > np.max(r["plain"])]
    total = [n for n, r in arms.items() if np.max(r["total"]["friction"]) > np.max(r["plain"])]
    add("worse than plain regression", "none", ", ".join(worse) or "none", not worse, ", ".join(total) or "none")
    sigmoid = [r for r in rows if r["true family"] == "sigmoid"]
    add_maximum("offset of eq. (5)", 20, "mNm", lambda r: np.max(r["offset"]), sigmoid)
    add_maximum("edges as commands", 30, "mNm", lambda r: np.nanmax(r["edges"]), rows)
    error = max(abs(r["latency"] - r["true latency"]) for r in rows)
    add("delay + lag", "<= 0.3 ms", f"{error:.2f} ms", error <= 0.3)
    ratio = max(r["ee"] / r["true ee"] for r in rows)
    add("end effector after 0.5 s", "<= 1.25 of the truth's", f"{ratio:.2f}", ratio <= 1.25)
    wrong = [n for n, r in arms.items() if not r["right"]]
    add("wrong family", "none", ", ".join(wrong) or "none", not wrong)
    inside, total_inside = (100 * np.mean([r["within"] for r in some]) for some in (rows, totals(rows)))
    what = "95 % interval of friction minus offset has the truth"
    add(what, "90-98 %", f"{inside:.1f} %", 90 <= inside <= 98, f"{total_inside:.1f} %")
    inside = 100 * np.mean([r["latency within"] for r in rows])
    add("95 % interval of delay + lag has the truth", "90-98 %", f"{inside:.1f} %", 90 <= inside <= 98)
    return pd.DataFrame(lines).set_index("what")


def by_family(arms: dict[str, dict]) -> pd.DataFrame:
    """Return a line per true friction: how drawn arms fare."""
    lines = {}
    for family in dict.fromkeys(r["true family"] for r in arms.values()):
        own = [r for r in arms.values() if r["true family"] == family]
        picked = pd.Series([r["family"] for r in own]).value_counts()
        worst = np.array([np.max(r["friction"]) for r in own])
        lines[family] = {
            "arms": str(len(own)),
            "selected": ", ".join(f"{name} {count}" for name, count in picked.items()),
            "friction - offset, median joint, %": f"{np.median([r['friction'] for r in own]):.2g}",
            "worst joint, median arm, %": f"{np.median(worst):.2g}",
            "worst joint, worst arm, %": f"{worst.max():.2g}",
            "edges, worst, mNm": f"{max(np.nanmax(r['edges']) for r in own):.0f}",
            "0.5 s, mm": f"{np.mean([r['ee'] for r in own]):.1f} of {np.mean([r['true ee'] for r in own]):.1f}",
            "0.5 s over the truth's, median": f"{np.median([r['ee'] / r['true ee'] for r in own]):.2f}",
            "friction within, %": f"{100 * np.mean([r['within'] for r in own]):.0f}",
        }
    return pd.DataFrame.from_dict(lines, orient="index").rename_axis("true friction")


def report(results: dict[str, dict], words: list[str], processes: int = 1) -> str:
    """Return the page."""
    five = {n: r for n, r in results.items() if n in FIVE}
    table = pd.DataFrame([row(n, r) for n, r in results.items()]).set_index("arm")
    groups = {"The first five arms": five, "All arms": results if len(results) > len(five) else {}}
    bars = "\n\n".join(f"## {name}\n\n{markdown(targets(some))}" for name, some in groups.items() if some)
    drawn = {n: r for n, r in results.items() if n not in FIVE}
    bars += f"\n\n## Drawn arms by friction\n\n{markdown(by_family(drawn))}" if drawn else ""
    seconds = np.array([r["seconds"] for r in results.values()])
    words = ["--five FOLDER", *words, *([f"--processes {processes}"] if processes > 1 else [])]
    order = "one at a time" if processes == 1 else f"{processes} at a time on one thread each"
    commit = ", ".join(sorted({str(r["commit"])[:12] for r in results.values()}))
    command = " ".join(["python benchmarks/independent.py", *words])
    took = f"{np.median(seconds):.0f} s in the median, {seconds.max():.0f} s at most"
    return f"""# Identification of arms of an independent simulator

Written by `benchmarks/independent.py`. {MACHINE}; {date.today()}; commit {commit}; `{command}`.

{len(results)} simulated Pandas, each recorded for 20 s and ramped 14 times, then identified with the defaults of
`stage=identify`, {order}: {took}. The arms share no code with r2s
(`benchmarks/independent_dynamics.py`): other rigid-body equations, Runge-Kutta at 0.1 ms, stick-slip events located
in time. Friction, offsets, breakaway, delay, lag and inertia are drawn.

{bars}

## Each arm

{markdown(table)}

- a / b: a compares the parameters; b includes all torques of the identified model (load, drag, uncompensated gravity)
  at the mean over the postures of the training motion, or at the ramp posture.
- friction - offset: largest error from 0.05 rad/s to the 95 % quantile of the visited speeds, in % of the mean true
  friction there. plain regression: least squares with a delay, tensor scales, and Coulomb and viscous friction per
  direction.
- offset: worst joint. Families with a free friction level per direction do not separate it from friction.
- edges: command at which a resting joint breaks away, over the ramps that reached it.
- 0.5 s: mean end-effector error in open-loop replays of held-out motion, identified arm and truth in the same
  simulator.
- within: truth inside the 95 % interval of friction minus offset, at five speeds in both directions.
"""


def seeds_of(text: str) -> list[int]:
    """Return the seeds of 100-149 or 1,4,7."""
    ranges = [[int(end) for end in part.split("-")] for part in text.split(",")]
    return [seed for r in ranges for seed in range(r[0], r[-1] + 1)]


def main() -> None:
    """Identify and judge every arm, and write the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--arms", default="all", help="five, drawn, all, or names such as sigmoid,paper,3")
    parser.add_argument("--five", type=Path, help="folder of the five arms")
    parser.add_argument("--drawn", type=Path, default=ROOT / "runs" / "independent_arms")
    parser.add_argument("--seeds", type=seeds_of, default="100-149", help="of drawn arms: 100-149, or 1,4,7")
    parser.add_argument("--quick", action="store_true", help="a toy on the first arms")
    parser.add_argument("--processes", type=int, default=1, help="arms at once, one thread each")
    parser.add_argument("--tag", default="", help="name of the run folders")
    own, words = parser.parse_known_args()
    if wrong := [w for w in words if "=" not in w or w.startswith("-")]:
        parser.error(f"unknown argument {wrong[0]}")
    drawn = [str(seed) for seed in own.seeds]
    names = {"five": [*FIVE], "drawn": drawn, "all": [*FIVE, *drawn]}.get(own.arms, own.arms.split(","))
    if wrong := [n for n in names if n not in FIVE and not n.isdigit()]:
        parser.error(f"--arms: unknown arm {wrong[0]}; allowed: {', '.join(FIVE)} and seeds")
    if own.quick:
        names = [n for n in names if n in FIVE][:1] + [n for n in names if n.isdigit()][:1]
        own.tag, words = own.tag or "toy", [*words, "search=toy"]
    if own.five is None and any(n in FIVE for n in names):
        parser.error("--five FOLDER is required: it contains the five arms")
    arms = {n: (own.five if n in FIVE else own.drawn) / n for n in names}
    labels = ["_".join(w for w in ("independent", own.tag, name) if w) for name in arms]
    if own.processes > 1:
        alone = [*words, "threads=1"]
        os.environ["OMP_NUM_THREADS"] = "1"  # inherited by the processes
        with ProcessPoolExecutor(own.processes, get_context("spawn")) as pool:
            found: Iterable = list(pool.map(evaluate, arms, arms.values(), labels, [alone] * len(arms)))
    else:
        found = map(evaluate, arms, arms.values(), labels, [words] * len(arms))
    results = {name: r for name, r in zip(arms, found, strict=True) if r is not None}
    if not results:
        sys.exit("no arm was identified")
    if len(commits := {r["commit"] for r in results.values()}) > 1:
        print(f"these runs have {len(commits)} different commits: repeat them with one new --tag")
    page = report(results, words, own.processes)
    print(page)
    if len(results) < len(arms):
        sys.exit(f"failed: {', '.join(n for n in arms if n not in results)}")
    if own.arms == "all" and not words and len(drawn) >= 20:
        (RESULTS / "independent.md").write_text(page)
        print("written: benchmarks/results/independent.md")


if __name__ == "__main__":
    main()
