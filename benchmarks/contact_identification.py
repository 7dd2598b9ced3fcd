"""Identify surfaces that an arm presses on, whose parameters are all known.

    python benchmarks/contact_identification.py [--arms FOLDER] [--seeds 0-19]

arms    simulated arms with contact, train, validation and ramps recordings and the truth, FOLDER/<name>, which are no
        part of this repository: stage=identify with its defaults, then the surface against the truth
seeds   recordings of benchmarks/pressing.py on drawn surfaces: coverage of the intervals

Only this script reads the truth. It writes benchmarks/results/contact_identification.md.
"""

import argparse
import json
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
from common import ROBOT, ROOT, markdown, markdown_rows, write_page
from pressing import drawn_surface, estimated_arm, press_recording

from r2s.identification.contact.contact_file import load_contact
from r2s.identification.contact.estimate import Arm, ContactEstimate, identify_contact
from r2s.identification.contact.exchange import linearized
from r2s.identification.contact.tip import TipMotion
from r2s.identification.parameter_file import load_parameters, load_posterior
from r2s.identification.residuals.modulating_functions import CUTOFF_HZ
from r2s.physics.robot import SIM_DT, Robot
from r2s.physics.surface import Surface, Tool, load_tool
from r2s.recordings.readers import read

NUMBERS = ("slope", "stiffness", "exponent", "damping", "friction")
PLAY = 2e-5  # m, of a Panda's encoders; see `TipMotion`


@dataclass(frozen=True)
class Score:
    """Errors: slope (relative), friction, plane (m, at the contacts), tilt (degrees); covered intervals."""

    slope: float
    friction: float
    plane: float
    tilt_deg: float
    covered: dict[str, bool]


def score(surface: Surface, interval: dict[str, tuple[float, float]], truth: Surface) -> Score:
    """Compare a surface and its 95 % intervals with the truth."""
    values = {name: getattr(truth, name) for name in NUMBERS[1:]} | {"slope": linearized(truth)[0]}
    plane = float((surface.point - truth.point) @ truth.normal)
    tilt = float(np.degrees(np.arcsin(np.linalg.norm(np.cross(surface.normal, truth.normal)))))
    values |= {"height": -plane, "tilt_deg": tilt}
    slack = 1e-9  # a truth at a bound, such as exponent 1
    covered = {n: interval[n][0] - slack <= v <= interval[n][1] + slack for n, v in values.items()}
    slope = linearized(surface)[0] / values["slope"] - 1.0
    return Score(slope, surface.friction - truth.friction, plane, tilt, covered)


def intervals(found: ContactEstimate) -> dict[str, tuple[float, float]]:
    """Return the 95 % intervals of an estimate."""
    own = {name: found.interval(name) for name in NUMBERS}
    return own | {"height": found.height, "tilt_deg": (0.0, found.tilt_deg)}


def identify_arm(folder: Path, words: list[str]) -> Path:
    """Run stage=identify on free motion, ramps and contact of an arm unless it is done; return its run folder."""
    run = ROOT / "runs" / "identify" / f"contact_{folder.name}"
    data = ["data=recording", "data.torque=commanded", f"data.path={folder / 'train.npz'}"]
    data += [f"data.{name}={folder / name}.npz" for name in ("validation", "ramps", "contact")]
    words = [*data, f"robot.tool={folder / 'tool.json'}", f"name={run.name}", "skip_completed=true", *words]
    subprocess.run([sys.executable, "run.py", "stage=identify", *words], cwd=ROOT, check=True)
    return run


def judged_arm(folder: Path, words: list[str]) -> dict[str, str]:
    """Return a row of the table for an arm: errors, and normal force of a press that was not fitted."""
    folder = folder.resolve()
    run, robot = identify_arm(folder, words), replace(ROBOT, tool=load_tool(folder / "tool.json"))
    true = json.loads((folder / "truth.json").read_text())["contact"]
    numbers = (true["k_N_per_m"], true["exponent"], true["c_s_per_m"], true["mu"])
    truth = Surface(np.array(true["point"]), np.array(true["normal"]), *numbers)
    found = load_contact(run)
    s = score(found.surface, found.interval, truth)
    last = max(part["t0"] for part in true["segments"] if part["kind"] == "travel")
    space, x = load_parameters(run, robot)
    recording = read(folder / "contact.npz", torque="commanded")
    before = identify_contact(Arm(space, x, load_posterior(run, space)), recording.select(recording.t < last))
    smooth = recording.smooth(CUTOFF_HZ)
    tip = TipMotion.of(robot, smooth.q, smooth.derivative(smooth.q), SIM_DT, smooth.t == smooth.t[0], PLAY)
    with np.load(folder / "truth_contact.npz") as file:
        force, rate = file["normal_force"], file["penetration_rate"]
    error, held_out = tip.contact(before.surface)[1] - force, (recording.t >= last) & (force > 0)
    sides = {"loading": rate > 0, "unloading": rate < 0}
    rmse = {name: float(np.sqrt(np.mean(error[held_out & side] ** 2))) for name, side in sides.items()}
    missed = [name for name, inside in s.covered.items() if not inside]
    return {
        "slope at 10 N, %": f"{100 * s.slope:+.2f}",
        "exponent": f"{found.surface.exponent:.3f} ({truth.exponent:g})",
        "friction": f"{s.friction:+.4f}",
        "plane, mm": f"{1e3 * s.plane:+.4f}",
        "normal, °": f"{s.tilt_deg:.4f}",
        "outside 95 %": ", ".join(missed) or "none",
        "held-out force, N RMS, loading / unloading": f"{rmse['loading']:.2f} / {rmse['unloading']:.2f}",
    }


def drawn_scores(robot: Robot, seeds: list[int]) -> list[Score]:
    """Identify the drawn surface of each seed with an arm known up to its posterior."""
    scores = []
    for seed in seeds:
        arm, truth = estimated_arm(robot, seed), drawn_surface(seed)
        found = identify_contact(arm, press_recording(arm, truth, seed), seed=seed)
        scores.append(score(found.surface, intervals(found), truth))
        print(f"seed {seed}: {scores[-1]}", flush=True)
    return scores


def coverage(scores: list[Score]) -> pd.DataFrame:
    """Return the share of 95 % intervals that contain the truth, per number and in all, and the largest errors."""
    names = list(scores[0].covered)
    inside = np.array([[s.covered[n] for n in names] for s in scores])
    row = {n: f"{100 * share:.0f} %" for n, share in zip(names, inside.mean(0), strict=True)}
    row |= {"all": f"{100 * inside.mean():.1f} %"}
    worst = {"slope": 100 * max(abs(s.slope) for s in scores), "friction": max(abs(s.friction) for s in scores)}
    worst |= {"height": 1e3 * max(abs(s.plane) for s in scores), "tilt_deg": max(s.tilt_deg for s in scores)}
    units = {"slope": "{:.2f} %", "friction": "{:.4f}", "height": "{:.3f} mm", "tilt_deg": "{:.4f}°"}
    most = {n: units[n].format(worst[n]) if n in worst else "" for n in row}
    return pd.DataFrame.from_dict({"covered": row, "largest error": most}, orient="index").rename_axis(
        "95 % intervals"
    )


def main() -> None:
    """Judge the arms and draw the seeds; write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arms", type=Path, help="folder of the simulated arms")
    parser.add_argument("--seeds", default="0-19", help="first and last seed")
    options, words = parser.parse_known_args()
    first, last = map(int, options.seeds.split("-"))
    parts = []
    if options.arms:
        rows = {
            path.parent.name: judged_arm(path.parent, words) for path in sorted(options.arms.glob("*/contact.npz"))
        }
        parts += ["## Simulated arms that stick and slip", markdown_rows(rows, "arm")]
    robot = replace(ROBOT, tool=Tool(np.zeros(3), 0.01))
    parts += [f"## {last - first + 1} drawn surfaces"]
    parts += [markdown(coverage(drawn_scores(robot, list(range(first, last + 1)))))]
    command = "contact_identification.py" + (" --arms FOLDER" if options.arms else "") + f" --seeds {options.seeds}"
    write_page("contact_identification", "Surfaces identified from joint torques", command, parts)
    print("\n\n".join(parts))


if __name__ == "__main__":
    main()
