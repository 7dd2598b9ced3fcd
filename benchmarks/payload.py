"""Identification at work: mass, centre, detection and coverage, on twins with their identified models.

`python benchmarks/payload.py [make=2] [root=RUNS] [motions=N] [SEED ...]`, by default development seeds 0-5 of both
makes; the judging seeds are 100-109 and 200-209. A twin that was not identified yet is (stage=identify, a minute or
two). Each motion lasts 12 s, with pauses; a payload of U(0.05, 1.5) kg, its centre uniform within 7.5 cm, is put on
at U(2, 4) s and taken off at U(7, 9) s. Its mass is asked for when the arm has moved for 2 s since it was put on,
pauses not counted, or just before it is taken off. The table goes to docs/payload.md.
"""

import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
from common import MACHINE, ROBOT, ROOT, fourier, markdown, record, replace, side_by_side

from r2s.adaptation.kalman import T
from r2s.adaptation.listen import estimator, listen
from r2s.arm.twins import twin
from r2s.identification.parameter_file import load_parameters, load_posterior
from r2s.physics.payload import FARTHEST_M, payload_of
from r2s.recordings.readers import read

DOCS = ROOT / "docs" / "payload.md"
SECONDS, LEARN, SOON_S = 12.0, round(2.0 / T), 0.2


def motion(seed: int):
    """Return a calm motion."""
    calm = replace(ROBOT, dq_max=0.6 * ROBOT.dq_max, ddq_max=0.6 * ROBOT.ddq_max)
    return fourier(calm, duration=SECONDS, seed=1000 + seed)


def drawn(rng: np.random.Generator) -> dict:
    """Return a payload."""
    way = rng.normal(size=3)
    centre = way / np.linalg.norm(way) * FARTHEST_M * rng.uniform() ** (1 / 3)
    on, off = rng.uniform(2, 4), rng.uniform(7, 9)
    return {"mass": float(rng.uniform(0.05, 1.5)), "centre": centre.tolist(), "on_s": float(on), "off_s": float(off)}


def one(make: int, seed: int, root: Path, motions: int) -> dict:
    """Return what came out for one twin: a row per motion, and of unloaded motion."""
    folder = root / "identify" / f"m{make}_{seed}"
    space, x = load_parameters(folder, ROBOT)
    posterior = space, load_posterior(folder, space)
    unloaded = tuple(read(folder / f"{name}.npz", torque="commanded") for name in ("train", "validation"))
    rng, rows = np.random.default_rng([make, seed]), []
    for k in range(motions + 1):
        ear = estimator(ROBOT, space.dynamics(x), posterior, unloaded)
        given = drawn(rng) if k else 0.0
        arm = twin(ROBOT, make=make, seed=seed, payload=given, noise=100 + k)
        heard = record(arm, motion(k), laden=True)
        began = time.process_time()
        known = listen(ROBOT, ear, heard)
        row = {"us": 1e6 * (time.process_time() - began) / len(heard.t), "alarms": len(ear.changes), "motion": k}
        if not k:
            rows.append(row)
            continue
        thing = payload_of(given)
        carries = [e for e in known if thing.on_s <= e.t < thing.off_s]
        moves = [e for e in carries if not e.rests]
        at = moves[LEARN] if len(moves) > LEARN else carries[-1]
        true = [float(thing.mass) * (thing.on_s <= e.t < thing.off_s) for e in known]
        hit = [abs(e.mass - m) <= e.mass_half for e, m in zip(known, true, strict=True)]
        settled = [not any(0 <= e.t - s < 0.5 for s in (0.0, thing.on_s, thing.off_s)) for e in known]
        seen = [any(0 < c - s <= SOON_S for c in ear.changes) for s in (thing.on_s, thing.off_s)]
        real = sum(any(0 < c - s <= 0.5 for s in (thing.on_s, thing.off_s)) for c in ear.changes)
        rests = np.array([e.rests for e in known])
        rows.append(
            row
            | {
                "mass": float(thing.mass),
                "mass_error": abs(at.mass - float(thing.mass)),
                "centre_error": float(np.linalg.norm(at.centre - thing.centre)),
                "seen": sum(seen),
                "false": len(ear.changes) - real,
                "moving": np.mean(np.array(hit)[~rests & settled]),
                "resting": np.mean(np.array(hit)[rests & settled]) if (rests & settled).any() else np.nan,
            }
        )
    return {"make": make, "seed": seed, "rows": pd.DataFrame(rows)}


def told(found: list[dict]) -> pd.DataFrame:
    """Return a row per twin, and one of all of a make."""
    lines = {}

    def line(rows: pd.DataFrame) -> dict:
        loaded, free = rows[rows["motion"] > 0], rows[rows["motion"] == 0]
        heavy = loaded[loaded["mass"] > 0.3]
        allowed = np.maximum(0.02, 0.02 * loaded["mass"])
        hour = 3600 / SECONDS
        return {
            "mass, median error, g": f"{1e3 * loaded['mass_error'].median():.0f}",
            "within 2 % or 20 g": f"{100 * (loaded['mass_error'] <= allowed).mean():.0f} %",
            "centre above 0.3 kg, cm": f"{100 * heavy['centre_error'].median():.1f}",
            "seen in 0.2 s": f"{int(loaded['seen'].sum())} of {2 * len(loaded)}",
            "false in an hour, unloaded": f"{hour * free['alarms'].mean():.0f}",
            "false in an hour, loaded": f"{hour * loaded['false'].mean():.0f}",
            "covered in motion": f"{100 * loaded['moving'].mean():.0f} %",
            "covered at rest": f"{100 * loaded['resting'].mean():.0f} %",
            "µs": f"{rows['us'].median():.0f}",
        }

    for make in sorted({f["make"] for f in found}):
        own = [f for f in found if f["make"] == make]
        for f in own:
            lines[f"make {make}, twin {f['seed']}"] = line(f["rows"])
        lines[f"make {make}, all"] = line(pd.concat([f["rows"] for f in own]))
    return pd.DataFrame(lines).T.rename_axis("twin")


def main() -> None:
    """Identify what is missing, listen to every twin, write the table."""
    words = dict(w.split("=", 1) for w in sys.argv[1:] if "=" in w)
    root, motions = Path(words.get("root", ROOT / "runs")), int(words.get("motions", 4))
    makes = [int(words["make"])] if "make" in words else [1, 2]
    seeds = [int(w) for w in sys.argv[1:] if "=" not in w] or list(range(6))
    jobs = [
        ["stage=identify", "arm=twin", f"arm.make={m}", f"arm.seed={s}", f"root={root}", f"name=m{m}_{s}"]
        for m in makes
        for s in seeds
        if not (root / "identify" / f"m{m}_{s}" / "posterior.npz").is_file()
    ]
    side_by_side(jobs)
    found = []
    for make in makes:
        for seed in seeds:
            found.append(one(make, seed, root, motions))
            print(told(found[-1:]).iloc[0].to_string(), flush=True)
            print(found[-1]["rows"].round(4).to_string(), flush=True)
    text = markdown(told(found))
    print(text)
    begin, end = "<!-- table -->\n", "<!-- end of the table -->\n"
    before, _, after = DOCS.read_text().partition(begin)
    command = f"`python benchmarks/payload.py {' '.join(sys.argv[1:])}`".replace(f"root={root} ", "")
    table = (
        f"{command} on {MACHINE}; {motions} motions of {SECONDS:g} s with a payload and one without, each twin.\n\n"
    )
    DOCS.write_text(before + begin + table + text + "\n" + end + after.partition(end)[2])


if __name__ == "__main__":
    main()
