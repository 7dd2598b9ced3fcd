"""Identify surfaces that an arm presses on, whose parameters are all known.

    python benchmarks/contact_identification.py [--arms FOLDER] [--seeds 0-19] [--twins rigid_100,elastic_200,...]

arms    simulated arms with contact, train, validation and ramps recordings and the truth, FOLDER/<name>, which are no
        part of this repository: stage=identify with its defaults, then the surface against the truth
twins   variant_seed: `stage=identify` from free motion, then with data.presses=6 on the surface of the seed, for
        elastic twins also with stated gears, and with gears identified from slow slides (`data.gears=true`); finished
        identifications in runs/identify are not repeated
seeds   recordings of benchmarks/pressing.py on drawn surfaces: coverage of the intervals

Only this script reads the truth. It writes benchmarks/results/contact_identification.md.
"""

import argparse
import json
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml
from common import JUDGING, ROBOT, ROOT, identify_twins, markdown, markdown_rows, write_page
from press_twins import TOOL, armed, twin_run
from pressing import drawn_surface, estimated_arm, press_recording

from r2s.arm.twins.elastic_joints import STIFF
from r2s.arm.twins.make_twin import make_twin
from r2s.arm.twins.touch import draw_surface
from r2s.identification.contact.contact_file import IdentifiedSurface, load_contact
from r2s.identification.contact.estimate import Arm, ContactEstimate, identify_contact
from r2s.identification.contact.exchange import linearized
from r2s.identification.contact.tip import TipMotion
from r2s.identification.gears.gears_file import load_gears
from r2s.identification.parameter_file import load_parameters, load_posterior
from r2s.identification.residuals.modulating_functions import CUTOFF_HZ
from r2s.physics.robot import SIM_DT, Robot
from r2s.physics.surface import Surface, Tool, load_tool
from r2s.recordings.readers import read

NUMBERS = ("slope", "stiffness", "exponent", "damping", "friction")
TWINS_NOTE = (
    "Identified from free motion, then from presses (`data.presses=6`), with encoders on the motors. slope: error of "
    "the estimate and its 95 % interval; with rigid gears: error if the gears are taken as rigid; gears: mean "
    "deflection by the largest torques. The prior of the gears was chosen on twins 0 to 9. stated gears: the same "
    "presses with `identify.gears.stiffness=`, the twin's own with an error of 10 %, half of "
    "its variance common to all joints. identified gears: the same presses with `identify.gears.stiffness=` a run of "
    "`data.gears=true` on the twin; gears 1 to 4: the largest error of this run's stiffness among the strong joints."
)
GEARS = ("with stated gears, %", "with identified gears, %", "gears 1 to 4, %")  # columns of elastic twins
ACCURACY = 0.1  # relative error of the stated gears
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
    assert before.rigid_gears is not None  # these arms have rigid gears
    smooth = recording.smooth(CUTOFF_HZ)
    tip = TipMotion.of(robot, smooth.q, smooth.derivative(smooth.q), SIM_DT, smooth.t == smooth.t[0], PLAY)
    with np.load(folder / "truth_contact.npz") as file:
        force, rate = file["normal_force"], file["penetration_rate"]
    error, held_out = tip.contact(before.rigid_gears.surface)[1] - force, (recording.t >= last) & (force > 0)
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


def identify_surface(variant: str, seed: int) -> Path:
    """Let a twin record presses and identify its surface, unless it is done; return the run folder."""
    run = ROOT / "runs" / "identify" / f"surface_{variant}_{seed}"
    words = ["arm=twin", f"arm.variant={variant}", f"arm.seed={seed}", "arm.surface=true", "data.presses=6"]
    return identified(run, variant, seed, words)


def identify_with_gears(variant: str, seed: int) -> Path:
    """Identify the surface of a twin's presses again, unless it is done, with stated gears; return the run folder."""
    run = ROOT / "runs" / "identify" / f"stated_{variant}_{seed}"
    rng, half = np.random.default_rng([seed, 11]), ACCURACY / np.sqrt(2.0)
    wrong = rng.normal(0.0, half) + rng.normal(0.0, half, ROBOT.n)
    stated = (make_twin(ROBOT, variant=variant, seed=seed)._hidden[STIFF] * np.exp(wrong)).round().tolist()
    words = ["data=recording", f"data.contact={run.with_name(f'surface_{variant}_{seed}') / 'contact.npz'}"]
    words += [f"identify.gears.stiffness={stated}", f"identify.gears.accuracy={ACCURACY}"]
    return identified(run, variant, seed, words)


def identify_gears(variant: str, seed: int) -> tuple[Path, Path]:
    """Identify a twin's gears, then its surface with these gears, unless it is done; return both run folders."""
    run = ROOT / "runs" / "identify" / f"slides_{variant}_{seed}"
    words = ["arm=twin", f"arm.variant={variant}", f"arm.seed={seed}", "data.gears=true"]
    identified(run, variant, seed, words, "gears.yaml")
    behind = run.with_name(f"behind_{variant}_{seed}")
    words = ["data=recording", f"data.contact={run.with_name(f'surface_{variant}_{seed}') / 'contact.npz'}"]
    return run, identified(behind, variant, seed, [*words, f"identify.gears.stiffness={run}"])


def gear_error(run: Path, variant: str, seed: int) -> str:
    """Return the largest error, %, of the identified stiffness among the strong joints."""
    stiffness = load_gears(run, ROBOT, "slides")["stiffness"]
    true = make_twin(ROBOT, variant=variant, seed=seed)._hidden[STIFF]
    strong = ROBOT.tau_max > 0.5 * ROBOT.tau_max.max()
    error = (100 * (stiffness / true - 1.0))[strong]
    return f"{error[np.abs(error).argmax()]:+.1f}"


def identified(run: Path, variant: str, seed: int, words: list[str], result: str = "contact.yaml") -> Path:
    """Run stage=identify with a twin's identification as calibration, unless it is done; return the run folder."""
    tool = run.with_name("press_tool.json")
    tool.write_text(json.dumps({"tip_in_flange_m": TOOL.tip.tolist(), "radius_m": TOOL.radius}))
    words = [*words, f"calibration={twin_run(variant, seed)}", f"robot.tool={tool}", f"root={ROOT / 'runs'}"]
    if not (run / result).is_file():
        command = [sys.executable, "run.py", "stage=identify", *words, f"name={run.name}"]
        subprocess.run(command, cwd=ROOT, check=True)
    return run


def slope_error(found: IdentifiedSurface, document: dict[str, Any], truth: Surface) -> str:
    """Return the error of a surface's slope and its 95 % interval, in % of the truth."""
    slope = linearized(truth)[0]
    ends = document["parameters"]["slope_at_10N"]["value"], *found.interval["slope"]
    own, low, high = (100 * (end / slope - 1.0) for end in ends)
    return f"{own:+.1f} [{low:+.1f}, {high:+.1f}]"


def judged_twin(variant: str, seed: int) -> tuple[dict[str, Score], dict[str, str]]:
    """Return {coverage group: errors} and row of the table for a twin."""
    run, robot = identify_surface(variant, seed), armed(ROBOT)
    found, document = load_contact(run), yaml.safe_load((run / "contact.yaml").read_text())
    truth = draw_surface(robot, True, np.random.default_rng([seed, 4]))
    assert isinstance(truth, Surface)
    s = score(found.surface, found.interval, truth)
    scores, known_gears = (
        {"": s},
        dict.fromkeys(("with stated gears, %", "with identified gears, %", "gears 1 to 4, %"), ""),
    )
    if variant == "elastic":
        slides, behind = identify_gears(variant, seed)
        known_gears[GEARS[2]] = gear_error(slides, variant, seed)
        pairs = zip(GEARS, (identify_with_gears(variant, seed), behind), strict=False)
        for column, again in pairs:
            known, its = load_contact(again), yaml.safe_load((again / "contact.yaml").read_text())
            scores[f" {column.removesuffix(', %')}"] = score(known.surface, known.interval, truth)
            known_gears[column] = slope_error(known, its, truth)
    rigid = document["rigid_gears"]["parameters"]["slope_at_10N"]["value"]
    held_out = json.loads((run / "summary.json").read_text())["contact"]["validation"]["force_rmse_N"]
    return scores, {
        "true slope, N/mm": f"{1e-3 * linearized(truth)[0]:.1f}",
        "slope at 10 N, %": slope_error(found, document, truth),
        **known_gears,
        "with rigid gears, %": f"{100 * (rigid / linearized(truth)[0] - 1.0):+.1f}",
        "friction": f"{s.friction:+.4f}",
        "plane, mm": f"{1e3 * s.plane:+.3f}",
        "normal, °": f"{s.tilt_deg:.3f}",
        "gears, mrad": f"{1e3 * (document['gears']['value'] * robot.tau_max).mean():.1f}",
        "outside 95 %": ", ".join(name for name, inside in s.covered.items() if not inside) or "none",
        "held-out force, N RMS": "-" if held_out is None else f"{held_out:.2f}",
    }


def twin_parts(twins: list[tuple[str, int]]) -> list[str]:
    """Return the section of the twins: a table, and the coverage for each variant."""
    identify_twins([(v, s, twin_run(v, s)) for v, s in twins], ROOT / "runs")
    rows, scores = {}, {}
    for variant, seed in twins:
        judged = " (judging)" if seed in JUDGING[variant] else ""
        name = f"{variant} twin {seed}{judged}"
        one, rows[name] = judged_twin(variant, seed)
        for how, own in one.items():
            scores.setdefault(f"{variant}{how}{judged}", []).append(own)
        print(name, rows[name], flush=True)
    inside = {k: np.mean([list(s.covered.values()) for s in own]) for k, own in scores.items()}
    shares = ", ".join(f"{name} {100 * share:.0f} %" for name, share in inside.items())
    return ["## Twins", TWINS_NOTE, markdown_rows(rows, "twin"), f"95 % intervals that contain the truth: {shares}."]


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
    parser.add_argument("--twins", default="", help="variant_seed, separated by commas")
    parser.add_argument("--seeds", default="0-19", help="first and last seed")
    options, words = parser.parse_known_args()
    first, last = map(int, options.seeds.split("-"))
    parts = []
    if options.arms:
        rows = {
            path.parent.name: judged_arm(path.parent, words) for path in sorted(options.arms.glob("*/contact.npz"))
        }
        parts += ["## Simulated arms that stick and slip", markdown_rows(rows, "arm")]
    if options.twins:
        parts += twin_parts([(v, int(s)) for v, s in (word.split("_") for word in options.twins.split(","))])
    robot = replace(ROBOT, tool=Tool(np.zeros(3), 0.01))
    parts += [f"## {last - first + 1} drawn surfaces"]
    parts += [markdown(coverage(drawn_scores(robot, list(range(first, last + 1)))))]
    command = "contact_identification.py" + (" --arms FOLDER" if options.arms else "") + f" --seeds {options.seeds}"
    command += f" --twins {options.twins}" * bool(options.twins)
    write_page("contact_identification", "Surfaces identified from joint torques", command, parts)
    print("\n\n".join(parts))


if __name__ == "__main__":
    main()
