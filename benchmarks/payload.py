"""Measure payload and friction estimation on identified twins: payloads, false alarms, warming, declared payloads.

    python benchmarks/payload.py [part=PART,...] [variant=elastic] [root=RUNS] [motions=N] [minutes=N] [keep=FOLDER]
        [CONSTANT=X ...] [SEED ...]

The default is all parts and the development seeds 0-5 of both variants; the judging seeds are 100-109 (rigid) and
200-209 (elastic). A missing identification (run folder identify/VARIANT_SEED below root; judge_SEED counts too) takes
a minute or two.

- `events`: motions=4 of 12 s, with pauses, each with a payload of U(0.05, 1.5) kg, its centre uniform within 7.5 cm,
  attached at U(2, 4) s and removed at U(7, 9) s. The mass counts after 2 s of motion with the payload, without
  pauses, or just before its removal.
- `quiet`: alarms in minutes=5 of unloaded motion, a multiple of 5. minutes=60 runs what is missing of an hour: a
  minute of a core per 5 minutes and twin, and another for their motions, which all twins share.
- `warming`: friction falls to 0.75, 1 - 0.25 (1 - exp(-t / 60 s)), over 4 minutes after 36 s.
- `load`: motions=4 with a constant payload; the declared payload is right, half, nothing, or half too much.

Rows go to ROOT/bench/payload_PART.csv, each only once; runs on different twins can write to it at the same time.
Tables of the requested twins go to benchmarks/results/payload.md.

For tuning, keep=FOLDER keeps recordings (2 MB per motion; none of `load`), so that repeated estimation takes a sixth
of the time. A word in capitals sets a constant of r2s/adaptation: HUBER=1.0 OUTLIER=2; rows then go to files with
these words in their names, and the script only prints the tables.
"""

import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
from common import JUDGING, MACHINE, RESULTS, ROOT, identify_twins, markdown_rows, put_table, set_constants
from payload_parts import FALL, PIECE, SECONDS, TAU_S, WARMS, events, folder, identified, load, quiet, warming

PARTS = {"events": events, "quiet": quiet, "warming": warming, "load": load}
KEY = ["variant", "seed", "piece"]
PIECE_MIN = round(PIECE * SECONDS / 60)


def accuracy(rows: pd.DataFrame) -> dict[str, str]:
    """Return errors and interval coverage of masses and centres."""
    heavy, allowed = rows[rows["mass"] > 0.3], np.maximum(0.02, 0.02 * rows["mass"])
    return {
        "mass, median error, g": f"{1e3 * rows['mass_error'].median():.0f}",
        "within 2 % or 20 g": f"{100 * (rows['mass_error'] <= allowed).mean():.0f} %",
        "centre above 0.3 kg, cm": f"{100 * heavy['centre_error'].median():.1f}",
        "covered in motion": f"{100 * rows['moving'].mean():.0f} %",
        "covered at rest": f"{100 * rows['resting'].mean():.0f} %",
    }


def of_events(rows: pd.DataFrame) -> dict[str, str]:
    """Return a line of payloads that were attached and removed."""
    rest, seen = rows["at_rest"].sum(), rows["seen_at_rest"].sum()
    return accuracy(rows) | {
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
    """Return a line of warming friction; errors relative to its change."""

    def percent(values) -> str:
        return f"{100 * values.median():.0f} % ({100 * values.max():.0f} %)"

    near = rows.loc[~rows["never"], "near_after_s"]
    return {
        "cold, of the model": f"{100 * rows['cold'].median():.0f} %",
        "change": f"{100 * rows['change'].median():.0f} %",
        "error of the change (worst)": percent(rows["error"]),
        "error itself (worst)": percent(rows["absolute"]),
        "behind, s (worst)": f"{rows['behind_s'].median():.0f} ({rows['behind_s'].max():.0f})",
        "within 10 % from, s": f"{near.median():.0f}" if len(near) else "-",
        "never within 10 %": f"{rows['never'].sum()} of {len(rows)}",
        "covered (worst)": f"{100 * rows['covered'].mean():.0f} % ({100 * rows['covered'].min():.0f} %)",
    }


def of_load(rows: pd.DataFrame) -> dict[str, str]:
    """Return a line of one declared payload."""
    return accuracy(rows) | {"alarms": f"{rows['changes'].sum()}"}


def table(part: str, rows: pd.DataFrame) -> str:
    """Return the table of a part: a line per twin and per variant; for `load` per variant and declared payload."""
    line = {"events": of_events, "quiet": of_quiet, "warming": of_warming, "load": of_load}[part]
    lines = {}
    for variant, own in rows.groupby("variant", sort=False):
        if part == "load":
            for name, some in own.groupby("declared", sort=False):
                lines[f"{variant}, {name}"] = line(some)
            continue
        for seed, some in own.groupby("seed"):
            lines[f"{variant} {seed}"] = line(some)
        lines[f"{variant}, all"] = line(own)
    return markdown_rows(lines, "twin" if part != "load" else "declared payload")


def caption(part: str, rows: pd.DataFrame) -> str:
    """Return the data behind a table."""
    count = rows.groupby(KEY[:2])["piece"].nunique()
    each = f"{count.min()}" if count.min() == count.max() else f"{count.min()} to {count.max()}"
    return {
        "events": f"{each} motions of {SECONDS:g} s with a payload, each twin.",
        "quiet": f"Unloaded motion; one estimator per {PIECE_MIN} minutes.",
        "warming": f"Friction falls by {100 * FALL:g} % with {TAU_S:g} s in {WARMS * SECONDS / 60:g} minutes; "
        "median and worst of the joints, errors relative to the change.",
        "load": f"{each} motions of {SECONDS:g} s of {len(count)} twins, each with all four declarations.",
    }[part]


def requested_twins(words: dict[str, str], seeds: list[int]) -> list[tuple[str, int]]:
    """Return variant and seed of the requested twins.

    A judging seed belongs to one variant; other seeds exist in both, and `variant=` selects one.
    """
    variants, twins = [words["variant"]] if "variant" in words else list(JUDGING), []
    if wrong := [v for v in variants if v not in JUDGING]:
        sys.exit(f"error: variant={wrong[0]}; allowed: {', '.join(JUDGING)}")
    for seed in seeds:
        own = [v for v, judging in JUDGING.items() if judging[0] <= seed < judging[0] + 100]
        if seed > 9 and not own:
            sys.exit(f"error: twin {seed}; allowed: 0 to 9, 100 to 199 (rigid), 200 to 299 (elastic)")
        if own and "variant" in words and own != variants:
            sys.exit(f"error: twin {seed} is {own[0]}, got variant={variants[0]}")
        twins += [(v, seed) for v in own or variants]
    return sorted(set(twins), key=lambda t: (list(JUDGING).index(t[0]), t[1]))


def main() -> None:
    """Identify missing twins, run missing pieces, write the tables."""
    words = dict(w.split("=", 1) for w in sys.argv[1:] if "=" in w)
    set_constants(constants := {k: v for k, v in words.items() if k.isupper()})
    keep = Path(words["keep"]) if "keep" in words else None
    root, motions = Path(words.get("root", ROOT / "runs")), int(words.get("motions", 4))
    minutes = int(words.get("minutes", PIECE_MIN))
    if minutes % PIECE_MIN:
        sys.exit(f"error: minutes: expected a multiple of {PIECE_MIN}, got {minutes}")
    pieces = {"events": motions, "quiet": minutes // PIECE_MIN, "warming": 1, "load": motions}
    twins = requested_twins(words, [int(w) for w in sys.argv[1:] if "=" not in w] or list(range(6)))
    identify_twins([(v, s, folder(root, v, s)) for v, s in twins], root)
    typed = [w for w in sys.argv[1:] if not w.startswith(("root=", "keep="))]
    command = " ".join(["python benchmarks/payload.py", *typed])
    for part in words.get("part", ",".join(PARTS)).split(","):
        path = root / "bench" / f"{'_'.join(['payload', part, *('='.join(c) for c in constants.items())])}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        done = set(pd.read_csv(path)[KEY].itertuples(index=False, name=None)) if path.is_file() else set()
        # outer loop over pieces: twins share the motions of a piece, and planning takes longer than recording
        requested = [(*t, k) for k in range(pieces[part]) for t in twins]
        jobs = [job for job in requested if job not in done]
        for i, (variant, seed, k) in enumerate(jobs, 1):
            began = time.process_time()
            rows = pd.DataFrame(PARTS[part](identified(root, variant, seed, keep), k))
            for at, value in enumerate((variant, seed, k)):
                rows.insert(at, KEY[at], value)
            rows.to_csv(path, mode="a", header=not path.is_file(), index=False)
            seconds = time.process_time() - began
            shown = rows.drop(columns=KEY).mean(numeric_only=True).round(3).to_dict()
            print(
                f"{part} {i} of {len(jobs)}: {variant} {seed}, {k}: {shown} ({seconds:.0f} s of a core)", flush=True
            )
        rows = pd.read_csv(path)
        rows = rows[[job in set(requested) for job in rows[KEY].itertuples(index=False, name=None)]]
        text = f"`{command}` on {MACHINE}. {caption(part, rows)}\n\n{table(part, rows)}\n"
        print(f"\n{text}")
        if not constants:
            put_table(RESULTS / "payload.md", part, text)


if __name__ == "__main__":
    main()
