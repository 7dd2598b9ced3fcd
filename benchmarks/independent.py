"""Identification of arms that another simulator made, with everything known of them.

`python benchmarks/independent.py [--five FOLDER] [--arms five|drawn|all|NAME,...] [--drawn FOLDER] [--seeds 0-23]`
runs stage=identify with its defaults on one arm after the other, in run folders runs/identify/independent_<arm>;
those that are finished are not run again. What is known of an arm is in its truth.json: only the judge reads it.

    five    sigmoid, coulomb, stribeck, lugre and paper: FOLDER/<name>, which are not part of this repository
    drawn   arms of benchmarks/independent_arms.py by seed; they are made where FOLDER/<seed> is missing

After a change of the identification give other run folders a name by `--tag WORD`. `--processes 8` takes as many
arms at once, of one thread each; seconds then are those of a busy machine. `--quick` is a toy: search=toy on
the first arm of each kind. Words with = go to run.py as they are. Without either, all arms (20 drawn ones or more)
write docs/independent.md.
"""

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pandas as pd
from common import MACHINE, ROOT, markdown
from independent_arms import make
from independent_judge import judge

FIVE = ("sigmoid", "coulomb", "stribeck", "lugre", "paper")


def identified(arm: Path, name: str, words: list[str]) -> Path | None:
    """Run stage=identify on an arm unless it is done; return its run folder, None where it failed."""
    folder = ROOT / "runs" / "identify" / name
    data = ["data=recording", "data.torque=commanded", f"data.path={arm / 'train.npz'}"]
    data += [f"data.validation={arm / 'validation.npz'}", f"data.ramps={arm / 'ramps.npz'}"]
    command = [sys.executable, "run.py", "stage=identify", *data, f"name={name}", "only_missing=true", *words]
    failed = subprocess.run(command, cwd=ROOT).returncode
    return None if failed else folder


def judged(name: str, arm: Path, label: str, words: list[str]) -> dict | None:
    """Return what the identification of an arm is worth, None where it failed; make a drawn arm that is missing."""
    if name.isdigit() and not (arm / "truth.json").is_file():
        make(arm, int(name))
    run = identified(arm.resolve(), label, words)
    if run is None:
        print(f"{name}: failed", flush=True)
        return None
    result = judge(run, arm, threads=1 if "threads=1" in words else 0)
    (run / "judged.json").write_text(json.dumps(result, indent=1))
    print(", ".join(f"{k} {v}" for k, v in row(name, result).items()), flush=True)
    return result


def both(r: dict, key: str, most=np.nanmax) -> str:
    """Return a figure by itself, and with all that pulls."""
    return f"{most(r[key]):.3g} / {most(r['felt'][key]):.3g}"


def row(name: str, r: dict) -> dict[str, str]:
    """Return the line of an arm in the table."""
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
        "delay + lag, ms": f"{r['late']:.2f} of {r['true late']:.2f}",
        "interval, ms": f"{r['late interval'][0]:.2f}-{r['late interval'][1]:.2f}",
        "0.5 s, mm": f"{r['ee']:.1f} of {r['true ee']:.1f}",
        "friction within, %": f"{100 * np.mean(r['within']):.0f} / {100 * np.mean(r['felt']['within']):.0f}",
        "seconds": f"{r['seconds']:.0f}",
    }


def asked(arms: dict[str, dict]) -> pd.DataFrame:
    """Return what is asked, what was seen by itself and with all that pulls, and whether the first is enough."""
    rows, lines = list(arms.values()), []

    def add(what: str, bar: str, seen: str, enough: bool, felt: str = "") -> None:
        lines.append(
            {"what": what, "asked": bar, "seen": seen, "with all that pulls": felt, "met": "yes" if enough else "no"}
        )

    def largest(what: str, bar: float, unit: str, of, arms: list[dict]) -> None:
        seen, felt = (max((of(r) for r in some), default=np.nan) for some in (arms, [r["felt"] for r in arms]))
        add(what, f"<= {bar:g} {unit}", f"{seen:.3g} {unit}", seen <= bar, f"{felt:.3g} {unit}")

    largest("friction minus offset, worst joint", 3, "%", lambda r: np.max(r["friction"]), rows)
    largest("friction minus offset, median joint", 1, "%", lambda r: np.median(r["friction"]), rows)
    worse = [n for n, r in arms.items() if np.max(r["friction"]) > np.max(r["plain"])]
    felt = [n for n, r in arms.items() if np.max(r["felt"]["friction"]) > np.max(r["plain"])]
    add("worse than plain regression", "none", ", ".join(worse) or "none", not worse, ", ".join(felt) or "none")
    told = [r for r in rows if r["true family"] == "sigmoid"]
    largest("offset of eq. (5)", 20, "mNm", lambda r: np.max(r["offset"]), told)
    largest("edges as commands", 30, "mNm", lambda r: np.nanmax(r["edges"]), rows)
    late = max(abs(r["late"] - r["true late"]) for r in rows)
    add("delay + lag", "<= 0.3 ms", f"{late:.2f} ms", late <= 0.3)
    ratio = max(r["ee"] / r["true ee"] for r in rows)
    add("end effector after 0.5 s", "<= 1.25 of the truth's", f"{ratio:.2f}", ratio <= 1.25)
    wrong = [n for n, r in arms.items() if not r["right"]]
    add("wrong family", "none", ", ".join(wrong) or "none", not wrong)
    inside, felt_inside = (100 * np.mean([r["within"] for r in some]) for some in (rows, [r["felt"] for r in rows]))
    what = "95 % interval of friction minus offset has the truth"
    add(what, "90-98 %", f"{inside:.1f} %", 90 <= inside <= 98, f"{felt_inside:.1f} %")
    inside = 100 * np.mean([r["late within"] for r in rows])
    add("95 % interval of delay + lag has the truth", "90-98 %", f"{inside:.1f} %", 90 <= inside <= 98)
    return pd.DataFrame(lines).set_index("what")


def report(results: dict[str, dict], words: list[str], processes: int = 1) -> str:
    """Return docs/independent.md."""
    five = {n: r for n, r in results.items() if n in FIVE}
    table = pd.DataFrame([row(n, r) for n, r in results.items()]).set_index("arm")
    groups = {"The arms that are not ours": five, "All arms": results if len(results) > len(five) else {}}
    bars = "\n\n".join(f"## {name}\n\n{markdown(asked(some))}" for name, some in groups.items() if some)
    seconds = np.array([r["seconds"] for r in results.values()])
    words = ["--five FOLDER", *words, *([f"--processes {processes}"] if processes > 1 else [])]
    order = "one after the other" if processes == 1 else f"{processes} at once, of one thread each"
    commit = ", ".join(sorted({str(r["commit"])[:12] for r in results.values()}))
    said = " ".join(["python benchmarks/independent.py", *words])
    took = f"{np.median(seconds):.0f} s in the median, {seconds.max():.0f} s at most"
    return f"""# Arms of another simulator: what identification finds of them

`{said}` on {MACHINE}: {len(results)} simulated Pandas,
each recorded for 20 s and ramped 14 times, and identified with the defaults of stage=identify, {order}:
{took} (commit {commit}). The arms share no code with r2s: rigid bodies of their own, Runge-Kutta at
0.1 ms, stick and slip located in time (benchmarks/independent_dynamics.py). Friction, offsets, breakaway, delay, lag
and inertia are drawn; nothing is set for any of them.

{bars}

## Each arm

{markdown(table)}

- a / b: a is of the parameters themselves, as the arms have nothing else of the kind; b is with all that an
  identified arm has beside them (load, drag, gravity that is not compensated), at the mean over the postures of the
  training motion, or of edges at the posture of the ramps: what it feels in the simulator.
- friction - offset: the largest error from 0.05 rad/s to the 95 % quantile of the speeds visited in a direction, in %
  of the mean magnitude of the true friction there. plain regression: the same of least squares with a delay, tensor
  scales, and Coulomb and viscous friction of each direction.
- offset: worst joint. Where friction has a free level in either direction the two cannot be told apart, so it is
  asked of eq. (5) only.
- edges: commands at which a resting joint lets go: the worst, and the median, of those that a ramp reached. Onset of
  motion is read late by up to 6 mNm (eq. 5) or 60 mNm (Coulomb, Stribeck), and bristles yield before they let go (-20
  to 44 mNm).
- 0.5 s: mean error of the end effector in open-loop replays of motion that was not fitted, of the identified arm and
  of the truth in the same simulator, as far as its families express it.
- within: the truth within the 95 % interval; of friction minus offset at five speeds in both directions.
"""


def seeds_of(text: str) -> list[int]:
    """Return the seeds of 0-23 or 1,4,7."""
    ranges = [[int(end) for end in part.split("-")] for part in text.split(",")]
    return [seed for r in ranges for seed in range(r[0], r[-1] + 1)]


def main() -> None:
    """Identify and judge every arm, and write the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--arms", default="all", help="five, drawn, all, or names such as sigmoid,paper,3")
    parser.add_argument("--five", type=Path, help="folder of the five arms")
    parser.add_argument("--drawn", type=Path, default=ROOT / "runs" / "independent_arms")
    parser.add_argument("--seeds", type=seeds_of, default="0-23", help="of drawn arms: 0-23, or 1,4,7")
    parser.add_argument("--quick", action="store_true", help="a toy, of the first arms")
    parser.add_argument("--processes", type=int, default=1, help="arms at once, of one thread each")
    parser.add_argument("--tag", default="", help="of the run folders")
    own, words = parser.parse_known_args()
    if wrong := [w for w in words if "=" not in w or w.startswith("-")]:
        parser.error(f"what is {wrong[0]}?")
    drawn = [str(seed) for seed in own.seeds]
    names = {"five": [*FIVE], "drawn": drawn, "all": [*FIVE, *drawn]}.get(own.arms, own.arms.split(","))
    if wrong := [n for n in names if n not in FIVE and not n.isdigit()]:
        parser.error(f"no arm {wrong[0]}; there are {', '.join(FIVE)} and seeds")
    if own.quick:
        names = [n for n in names if n in FIVE][:1] + [n for n in names if n.isdigit()][:1]
        own.tag, words = own.tag or "toy", [*words, "search=toy"]
    if own.five is None and any(n in FIVE for n in names):
        parser.error("--five FOLDER is where the five arms are")
    arms = {n: (own.five if n in FIVE else own.drawn) / n for n in names}
    labels = ["_".join(w for w in ("independent", own.tag, name) if w) for name in arms]
    if own.processes > 1:
        alone = [*words, "threads=1"]
        os.environ["OMP_NUM_THREADS"] = "1"  # of the processes to come
        with ProcessPoolExecutor(own.processes, get_context("spawn")) as pool:
            found: Iterable = list(pool.map(judged, arms, arms.values(), labels, [alone] * len(arms)))
    else:
        found = map(judged, arms, arms.values(), labels, [words] * len(arms))
    results = {name: r for name, r in zip(arms, found, strict=True) if r is not None}
    if not results:
        sys.exit("no arm was identified")
    if len(commits := {r["commit"] for r in results.values()}) > 1:
        print(f"these runs are of {len(commits)} commits: give all of them one --tag")
    page = report(results, words, own.processes)
    print(page)
    if len(results) < len(arms):
        sys.exit(f"failed: {', '.join(n for n in arms if n not in results)}")
    if own.arms == "all" and not words and len(drawn) >= 20:
        (ROOT / "docs" / "independent.md").write_text(page)
        print("written: docs/independent.md")


if __name__ == "__main__":
    main()
