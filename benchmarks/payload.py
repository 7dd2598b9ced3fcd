"""Identification at work on twins with their identified models: payloads, false alarms, friction that warms, setLoad.

`python benchmarks/payload.py [part=PART,...] [make=2] [root=RUNS] [motions=N] [minutes=N] [keep=FOLDER]
[CONSTANT=X ...] [SEED ...]`, by default all parts and development seeds 0-5 of both makes; the judging seeds are
100-109, of make 1, and 200-209, of make 2. A twin that was not identified yet is, as m1_0 beneath ROOT/identify, a
minute or two; judge_100 is found there too.

- `events`: motions=4 of 12 s, with pauses, each with a payload of U(0.05, 1.5) kg, its centre uniform within 7.5 cm,
  put on at U(2, 4) s and taken off at U(7, 9) s. Its mass is asked for when the arm has moved for 2 s since it was
  put on, pauses not counted, or just before it is taken off.
- `quiet`: minutes=5 of unloaded motion, a multiple of 5, and its alarms. minutes=60 does what is missing of an hour:
  a minute of a core for 5 minutes of a twin, and another for their motions, which all twins share.
- `warming`: friction falls to 0.75 of what it was, 1 - 0.25 (1 - exp(-t / 60 s)), over 4 minutes after 36 s.
- `load`: motions=4 with a payload all along, of which the arm itself was told right, half, nothing, or half too much.

Rows go to ROOT/bench/payload_PART.csv, each only once: what is missing is done, by several of these beside each
other too, if they have other twins. Tables of the twins that were asked for go to docs/payload.md.

To tune: keep=FOLDER keeps recordings (2 MB for a motion; none of `load`), so that listening to them again takes a
sixth of the time. A word in capitals is a constant of r2s/adaptation, as TAME=9 SHARPER=1; rows then go to files with
these words in their names, and tables are only printed.
"""

import os
import subprocess
import sys
import tempfile
import time
from difflib import get_close_matches
from pathlib import Path

import numpy as np
import pandas as pd
from common import MACHINE, ROOT, markdown, put_table, side_by_side
from payload_parts import (
    FALL,
    JUDGING,
    PIECE,
    SECONDS,
    TAU_S,
    WARMS,
    events,
    folder,
    known,
    load,
    quiet,
    warming,
)

DOCS = ROOT / "docs" / "payload.md"
PARTS = {"events": events, "quiet": quiet, "warming": warming, "load": load}
KEY = ["make", "seed", "piece"]
PIECE_MIN = round(PIECE * SECONDS / 60)


def within(rows: pd.DataFrame) -> dict[str, str]:
    """Return how well masses and centres are told."""
    heavy, allowed = rows[rows["mass"] > 0.3], np.maximum(0.02, 0.02 * rows["mass"])
    return {
        "mass, median error, g": f"{1e3 * rows['mass_error'].median():.0f}",
        "within 2 % or 20 g": f"{100 * (rows['mass_error'] <= allowed).mean():.0f} %",
        "centre above 0.3 kg, cm": f"{100 * heavy['centre_error'].median():.1f}",
        "covered in motion": f"{100 * rows['moving'].mean():.0f} %",
        "covered at rest": f"{100 * rows['resting'].mean():.0f} %",
    }


def of_events(rows: pd.DataFrame) -> dict[str, str]:
    """Return a line of what was put on and taken off."""
    rest, seen = rows["at_rest"].sum(), rows["seen_at_rest"].sum()
    return within(rows) | {
        "seen in 0.2 s in motion": f"{rows['seen'].sum() - seen} of {2 * len(rows) - rest}",
        "at rest": f"{seen} of {rest}",
        "all, in 0.2 s of motion": f"{rows['seen_moving'].sum()} of {2 * len(rows)}",
        "other alarms in an hour": f"{rows['false'].mean() * 3600 / SECONDS:.0f}",
        "µs": f"{rows['us'].median():.0f}",
    }


def of_quiet(rows: pd.DataFrame) -> dict[str, str]:
    """Return a line of unloaded motion."""
    hours = rows["minutes"].sum() / 60
    return {
        "minutes": f"{60 * hours:.0f}",
        "alarms": f"{rows['alarms'].sum()}",
        "in an hour": f"{rows['alarms'].sum() / hours:.1f}",
        "largest log odds": f"{rows['odds'].max():.0f}",
    }


def of_warming(rows: pd.DataFrame) -> dict[str, str]:
    """Return a line of friction that warmed up; errors in shares of its change."""

    def percent(values) -> str:
        return f"{100 * values.median():.0f} % ({100 * values.max():.0f} %)"

    near = rows.loc[~rows["never"], "near_after_s"]
    return {
        "cold, of what is believed": f"{100 * rows['cold'].median():.0f} %",
        "change": f"{100 * rows['change'].median():.0f} %",
        "error of the change (worst)": percent(rows["error"]),
        "error itself (worst)": percent(rows["absolute"]),
        "behind, s (worst)": f"{rows['behind_s'].median():.0f} ({rows['behind_s'].max():.0f})",
        "within 10 % from, s": f"{near.median():.0f}" if len(near) else "-",
        "never within 10 %": f"{rows['never'].sum()} of {len(rows)}",
        "covered (worst)": f"{100 * rows['covered'].mean():.0f} % ({100 * rows['covered'].min():.0f} %)",
    }


def of_load(rows: pd.DataFrame) -> dict[str, str]:
    """Return a line of what the arm itself was told of."""
    return within(rows) | {"alarms": f"{rows['changes'].sum()}"}


def told(part: str, rows: pd.DataFrame) -> pd.DataFrame:
    """Return the table of a part: a line per twin and one of each make; of `load` one per make and what was told."""
    line = {"events": of_events, "quiet": of_quiet, "warming": of_warming, "load": of_load}[part]
    lines = {}
    for make, own in rows.groupby("make"):
        if part == "load":
            for share, of in own.groupby("told", sort=False):
                lines[f"make {make}, told {share}"] = line(of)
            continue
        for seed, of in own.groupby("seed"):
            lines[f"make {make}, twin {seed}"] = line(of)
        lines[f"make {make}, all"] = line(own)
    return pd.DataFrame(lines).T.rename_axis("twin" if part != "load" else "the arm was")


def said(part: str, rows: pd.DataFrame) -> str:
    """Return what a table is of."""
    count = rows.groupby(KEY[:2])["piece"].nunique()
    each = f"{count.min()}" if count.min() == count.max() else f"{count.min()} to {count.max()}"
    return {
        "events": f"{each} motions of {SECONDS:g} s with a payload, each twin.",
        "quiet": f"Unloaded motion; an estimator hears {PIECE_MIN} minutes.",
        "warming": f"Friction falls by {100 * FALL:g} % with {TAU_S:g} s in {WARMS * SECONDS / 60:g} minutes; "
        "median and worst of the joints, errors in shares of the change.",
        "load": f"{each} motions of {SECONDS:g} s of {len(count)} twins, each with all four.",
    }[part]


def write(part: str, rows: pd.DataFrame, command: str, page: Path | None) -> None:
    """Print the table of a part and put it between its markers on the page."""
    text = f"`{command}` on {MACHINE}. {said(part, rows)}\n\n{markdown(told(part, rows))}\n"
    print(f"\n{text}")
    if page is not None:
        put_table(page, part, text)


def tuned(constants: dict[str, str]) -> None:
    """Set constants of r2s/adaptation wherever they are, in a process of its own: what was compiled holds others."""
    rooms = [module for name, module in sys.modules.items() if name.startswith("r2s.adaptation.")]
    names = {name for module in rooms for name, x in vars(module).items() if isinstance(x, float) and name.isupper()}
    for name in constants:
        if name not in names:
            near = get_close_matches(name, names, 1)
            sys.exit(f"error: no number {name} in r2s/adaptation" + (f"; did you mean {near[0]}?" if near else ""))
    if constants and "R2S_TUNED" not in os.environ:
        with tempfile.TemporaryDirectory() as folder:
            own = {"R2S_TUNED": "1", "NUMBA_CACHE_DIR": folder}
            sys.exit(subprocess.run([sys.executable, *sys.argv], env=os.environ | own).returncode)
    for module in rooms:
        for name in constants.keys() & vars(module).keys():
            setattr(module, name, float(constants[name]))


def wanted(words: dict[str, str], seeds: list[int]) -> list[tuple[int, int]]:
    """Return make and seed of the twins that are asked for.

    A judging seed is of its own make; others are of both, or of make=.
    """
    makes = [int(words["make"])] if "make" in words else sorted(JUDGING)
    twins = []
    for seed in seeds:
        own = [m for m, first in JUDGING.items() if first <= seed < first + 100]
        if seed > 9 and not own:
            sys.exit(f"error: twin {seed} is not allowed; 0 to 9, 100 to 199 of make 1 and 200 to 299 of make 2 are")
        if own and "make" in words and own != makes:
            sys.exit(f"error: twin {seed} is of make {own[0]}; make={makes[0]} is not allowed with it")
        twins += [(m, seed) for m in own or makes]
    return sorted(set(twins))


def main() -> None:
    """Identify what is missing, do what is missing, write the tables."""
    words = dict(w.split("=", 1) for w in sys.argv[1:] if "=" in w)
    tuned(constants := {k: v for k, v in words.items() if k.isupper()})
    keep = Path(words["keep"]) if "keep" in words else None
    parts = words.get("part", ",".join(PARTS)).split(",")
    root, motions, minutes = (
        Path(words.get("root", ROOT / "runs")),
        int(words.get("motions", 4)),
        int(words.get("minutes", PIECE_MIN)),
    )
    if minutes % PIECE_MIN:
        sys.exit(f"error: minutes={minutes} is not allowed; a multiple of {PIECE_MIN} is")
    pieces = {"events": motions, "quiet": minutes // PIECE_MIN, "warming": 1, "load": motions}
    twins = wanted(words, [int(w) for w in sys.argv[1:] if "=" not in w] or list(range(6)))
    side_by_side(
        ["stage=identify", "arm=twin", f"arm.make={m}", f"arm.seed={s}", f"root={root}", f"name=m{m}_{s}"]
        for m, s in twins
        if not (folder(root, m, s) / "posterior.npz").is_file()
    )
    said_words = [w for w in sys.argv[1:] if not w.startswith(("root=", "keep="))]
    command = " ".join(["python benchmarks/payload.py", *said_words])
    for part in parts:
        path = root / "bench" / f"{'_'.join(['payload', part, *('='.join(c) for c in constants.items())])}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        there = set(map(tuple, pd.read_csv(path)[KEY].to_numpy())) if path.is_file() else set()
        # the twins of a piece share its motions, which take longer to plan than to record
        jobs = [(*t, k) for k in range(pieces[part]) for t in twins if (*t, k) not in there]
        for i, (make, seed, k) in enumerate(jobs, 1):
            began = time.process_time()
            rows = pd.DataFrame(PARTS[part](known(root, make, seed, keep), k))
            for at, value in enumerate((make, seed, k)):
                rows.insert(at, KEY[at], value)
            rows.to_csv(path, mode="a", header=not path.is_file(), index=False)
            seconds = time.process_time() - began
            shown = rows.drop(columns=KEY).mean(numeric_only=True).round(3).to_dict()
            print(
                f"{part} {i} of {len(jobs)}: make {make}, twin {seed}, {k}: {shown} ({seconds:.0f} s of a core)",
                flush=True,
            )
        rows = pd.read_csv(path)
        asked = [
            (m, s, k) in {(*t, k) for t in twins for k in range(pieces[part])} for m, s, k in rows[KEY].to_numpy()
        ]
        write(part, rows[asked], command, None if constants else DOCS)


if __name__ == "__main__":
    main()
