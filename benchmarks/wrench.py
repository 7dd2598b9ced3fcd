"""Force without a sensor: independent arms and hidden twins that press and slide, with the truth.

    python benchmarks/wrench.py [--arms FOLDER] [--twins rigid_0,elastic_0,...] [NAME=VALUE ...]

arms    FOLDER/<name> with train, validation, ramps and contact recordings and the truth, no part of this repository;
        identified with the defaults of stage=identify and data.contact (benchmarks/contact_identification.py)
twins   variant_seed: recordings of benchmarks/press_twins.py on the surface of the seed, identified from free motion

Finished identifications in runs/identify are not repeated. The contact thresholds come from free motion; false alarms
are counted in ramps.npz and wherever a press recording touches nothing. Writes benchmarks/results/wrench.md; with
other values of constants of r2s/adaptation (NAME=VALUE), only prints the rows.

moving, rest: RMSE of the normal force in contact without the first 50 ms of a touch (`impact`); at rest every joint
has been below 3 mrad/s for 30 ms. inside: share of force components within their 95 % interval.
"""

import argparse
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from common import CONSTANT, JUDGING, ROBOT, ROOT, identify_twins, markdown_rows, set_constants, write_page
from contact_identification import identify_arm
from press_twins import armed, press_twin, twin_run

from r2s.adaptation.wrench import WrenchObserver, observe_recording
from r2s.adaptation.wrench_fusion import FusedWrench
from r2s.identification.contact.contact_file import load_contact
from r2s.physics.surface import load_tool
from r2s.recordings.readers import read
from r2s.stages.adapter_factory import calibrated, free_recordings

ARMS = {  # N: momentum observer with the true parameters, moving and at rest, from the README of the data
    "sigmoid": (0.56, 0.71),
    "coulomb": (0.55, 1.14),
    "stribeck": (0.87, 1.94),
}
NOTE = (
    "Normal force in contact, RMSE. The constants of the filter were chosen on these three arms, rigid twins 0 to 6 "
    f"and elastic twins 0 to 14. Those from {JUDGING['rigid'].start} (rigid) and {JUDGING['elastic'].start} "
    "(elastic) are for judging. fused: with the identified surface, and with the same surface moved by 0.3 mm along "
    "its normal. seen: share of time in motion with more than 5 N in which a contact is reported. A touch includes "
    "its bounces, if the tip touches again within 0.2 s; an alarm within a touch is not false."
)
EARLY, STILL, SLOW = 50, 30, 3e-3  # cycles, cycles, rad/s
BOUNCE = 200  # cycles within which a touch belongs to the one before
DETECTED, OFF = 5.0, 3e-4  # N; m


def scores(found: pd.DataFrame, recording, true: np.ndarray, normal: np.ndarray) -> dict:
    """Compare a table of `observe_recording` with the true force (T, 3) N."""
    force = found[[f"force_{c}_N" for c in "xyz"]].to_numpy()
    half = found[[f"force_{c}_N_half" for c in "xyz"]].to_numpy()
    touches, fn = found["in_contact"].to_numpy(), true @ normal
    on = fn > 0
    recent = pd.Series(on.astype(float)).rolling(BOUNCE, min_periods=1).max().shift(fill_value=0.0).to_numpy() > 0
    soon = pd.Series(on[::-1].astype(float)).rolling(BOUNCE, min_periods=1).max().to_numpy()[::-1] > 0
    off = ~on & ~(recent & soon)  # not in a bounce
    begins = np.flatnonzero(on & ~recent)
    early = np.zeros(len(fn), dtype=bool)
    for k in begins:
        early[k : k + EARLY] = True
    smooth = np.apply_along_axis(lambda x: np.convolve(x, np.ones(15) / 15, "same"), 0, recording.dq)
    still = pd.Series((np.abs(smooth) < SLOW).all(1)).rolling(STILL).min().fillna(0.0).to_numpy() > 0
    error, out = force @ normal - fn, {}
    parts = {"moving": on & ~early & ~still, "rest": on & ~early & still, "impact": on & early}
    for name, mask in parts.items():
        out[name] = float(np.sqrt((error[mask] ** 2).mean())) if mask.any() else float("nan")
        out[f"{name} inside"] = (
            100 * float((np.abs(force - true) < half)[mask].mean()) if mask.any() else float("nan")
        )
        out[f"{name} cycles"] = int(mask.sum())
    delays = []
    for a, b in zip(begins, [*begins[1:], len(fn)], strict=True):
        above = np.flatnonzero(fn[a:b] > DETECTED)
        if len(above):
            after = np.flatnonzero(touches[a:b])
            delays.append(int(after[0] - above[0]) if len(after) else None)
    seen = 100 * float(touches[(fn > DETECTED) & ~still].mean())
    false = (np.diff(touches) > 0) & off[1:]
    return out | {"delays": delays, "seen": seen, "false": int(false.sum()), "free": float(off.sum() * 1e-3)}


def arm(folder: Path) -> dict[str, str]:
    """Return the row of an independent arm."""
    run, robot = identify_arm(folder, []), replace(ROBOT, tool=load_tool(folder / "tool.json"))
    dynamics, surface = calibrated(run, robot)[0], load_contact(run).simulated
    observer = WrenchObserver(robot, dynamics)
    observer.calibrate(robot, free_recordings(run))
    recording, truth = read(folder / "contact.npz", torque="commanded"), np.load(folder / "truth_contact.npz")
    true = truth["wrench"][:, :3], np.array(json.loads((folder / "truth.json").read_text())["contact"]["normal"])
    own = scores(observe_recording(robot, observer, recording), recording, *true)
    ramps = observe_recording(robot, observer, read(folder / "ramps.npz", torque="commanded"))
    own["false"] += int((np.diff(ramps["in_contact"]) > 0).sum())
    own["free"] += len(ramps) * 1e-3
    fused = []
    for off in (0.0, OFF):
        moved = [replace(s, point=s.point + off * s.normal) for s in (surface.surface, *surface.draws)]
        together = FusedWrench(robot, dynamics, moved[0], moved[1:], observer.thresholds, observer.sensors)
        fused.append(scores(observe_recording(robot, together, recording), recording, *true)["moving"])
    plain = "{:.2f} / {:.2f}".format(*ARMS[folder.name])
    return row(own) | {"fused, right / moved, N": "{:.2f} / {:.2f}".format(*fused), "true parameters, N": plain}


def twin(variant: str, seed: int) -> dict:
    """Return the scores of a twin."""
    run, robot = twin_run(variant, seed), armed(ROBOT)
    observer = WrenchObserver(robot, calibrated(run, robot)[0])
    observer.calibrate(robot, free_recordings(run))
    recording, *true = press_twin(robot, variant, seed)
    found = scores(observe_recording(robot, observer, recording), recording, *true)
    return found | {"thresholds": observer.thresholds}


def pooled(found: list[dict]) -> str:
    """Return a sentence with the share of all twins' time inside the intervals."""
    shares = []
    for name in ("moving", "rest"):
        cycles = [r[f"{name} cycles"] for r in found]
        shares.append(np.average(np.nan_to_num([r[f"{name} inside"] for r in found]), weights=cycles))
    return "All judging twins together: {:.1f} % inside in motion, {:.1f} % at rest.".format(*shares)


def row(r: dict) -> dict[str, str]:
    """Return the cells of measures."""
    return {
        "moving, N": f"{r['moving']:.2f}",
        "at rest, N": f"{r['rest']:.2f}",
        "impact, N": f"{r['impact']:.2f}",
        "inside 95 %, moving / rest": f"{r['moving inside']:.0f} / {r['rest inside']:.0f} %",
        "detected after 5 N, ms": ", ".join("none" if d is None else str(d) for d in r["delays"]),
        "seen, %": f"{r['seen']:.0f}",
        "false alarms": f"{r['false']} in {r['free']:.0f} s",
    }


def main() -> None:
    """Write the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--arms", default=str(ROOT.parent / "shared/data/contact_arms"), help="'' leaves them out")
    parser.add_argument("--twins", default="rigid_0,rigid_1,rigid_2,elastic_0,elastic_1,elastic_2")
    parser.add_argument("constants", nargs="*", metavar="NAME=VALUE", help="of r2s/adaptation; writes no page")
    options = parser.parse_args()
    if wrong := [word for word in options.constants if not re.fullmatch(CONSTANT, word)]:
        parser.error(f"'{wrong[0]}': expected NAME=VALUE, such as EDGE_ERROR=0.2")
    set_constants(dict(word.split("=") for word in options.constants))
    if options.arms and not Path(options.arms).is_dir():
        parser.error(f"--arms: no folder {options.arms}; --arms '' leaves the independent arms out")
    words = [word for word in options.twins.split(",") if word]
    if wrong := [word for word in words if not re.fullmatch(r"(rigid|elastic)_\d+", word)]:
        parser.error(f"--twins: '{wrong[0]}' is no twin; rigid_SEED and elastic_SEED are allowed")
    twins = [(v, int(s)) for v, _, s in (word.partition("_") for word in words)]
    rows, judging = {}, []
    for name in ARMS if options.arms else ():
        rows[name] = arm((Path(options.arms) / name).resolve())
        print(name, rows[name], flush=True)
    identify_twins([(v, s, twin_run(v, s)) for v, s in twins], ROOT / "runs")
    for variant, seed in twins:
        found, judged = twin(variant, seed), seed in JUDGING[variant]
        judging += [found] * judged
        cells = row(found) | {"fused, right / moved, N": "", "true parameters, N": ""}
        rows[f"{variant} twin {seed}" + " (judging)" * judged] = cells
        print(variant, seed, cells, "contact thresholds:", found["thresholds"].round(1), flush=True)
    if options.constants:
        return
    command = "python benchmarks/wrench.py" + f" --twins {options.twins}" * (
        options.twins != parser.get_default("twins")
    )
    summary = [pooled(judging)] if judging else []
    write_page("wrench", "Force without a sensor", command, [NOTE, markdown_rows(rows, "arm"), *summary])


if __name__ == "__main__":
    main()
