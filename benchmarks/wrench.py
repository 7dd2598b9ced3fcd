"""Force without a sensor on independent arms that press and slide: beside the momentum observer of their README.

    python benchmarks/wrench.py [FOLDER] [NAME,...]

FOLDER holds one folder per arm with train.npz, validation.npz, ramps.npz, contact.npz, tool.json, and for the judge
truth.json and truth_contact.npz; it is not part of this repository. The script identifies each arm with the defaults
of stage=identify in runs/identify/wrench_<arm>, and skips finished ones. The contact threshold comes from train.npz
and validation.npz; false alarms are counted in ramps.npz and wherever contact.npz touches nothing. Writes
benchmarks/results/wrench.md.

moving, rest: RMSE of the normal force in contact without the first 50 ms of a touch; at rest every joint has been
below 3 mrad/s for 30 ms. inside: share of force components within their 95 % interval.
"""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd

ROOT = Path(__file__).parent.parent
# N, in motion and at rest, of a momentum observer with the true parameters; from the README of the data
ARMS = {"sigmoid": (0.56, 0.71), "coulomb": (0.55, 1.14), "stribeck": (0.87, 1.94)}
NOTE = "Normal force in contact. The constants of the filter were chosen on these three recordings."
EARLY, STILL, SLOW = 50, 30, 3e-3  # cycles, cycles, rad/s
DETECTED = 5.0  # N


def identified(arm: Path, root: Path) -> Path:
    """Identify an arm with the defaults unless finished; return its run folder."""
    data = [f"data.path={arm}/train.npz", f"data.validation={arm}/validation.npz", f"data.ramps={arm}/ramps.npz"]
    words = ["stage=identify", "data=recording", "data.torque=commanded", *data, f"robot.tool={arm}/tool.json"]
    name = f"wrench_{arm.name}"
    command = [sys.executable, "run.py", *words, f"root={root}", f"name={name}", "skip_completed=true"]
    subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
    return root / "identify" / name


def evaluate(arm: Path, calibration: Path) -> dict:
    """Return the measures of one arm."""
    from r2s.adaptation.wrench import WrenchObserver, contact_threshold, observe_recording
    from r2s.physics.robot import load_robot
    from r2s.recordings.readers import read
    from r2s.stages.adapter_factory import calibrated
    from r2s.stages.parts import plain
    from r2s.stages.run_config import loaded

    settings = plain(loaded(calibration / "config.yaml").robot) | {"tool": str(arm / "tool.json")}
    beside = ("_target_", "torque_fraction", "tracking_fraction", "reach")
    robot = load_robot(**{k: v for k, v in settings.items() if k not in beside})
    dynamics = calibrated(calibration, robot)[0]
    observer = WrenchObserver(robot, dynamics)
    free = [read(arm / f"{name}.npz", torque="commanded") for name in ("train", "validation")]
    observer.threshold = contact_threshold(robot, observer, free)
    ramps = observe_recording(robot, observer, read(arm / "ramps.npz", torque="commanded"))
    recording = read(arm / "contact.npz", torque="commanded")
    found = observe_recording(robot, observer, recording)
    return scores(found, recording, arm) | {
        "threshold": observer.threshold,
        "false alarms in ramps": int((np.diff(ramps["in_contact"]) > 0).sum()),
        "ramps, s": len(ramps) * 1e-3,
    }


def scores(found: pd.DataFrame, recording, arm: Path) -> dict:
    """Compare a table of `observe_recording` with the truth."""
    truth = np.load(arm / "truth_contact.npz")
    normal = np.array(json.loads((arm / "truth.json").read_text())["contact"]["normal"])
    true, fn = truth["wrench"][:, :3], truth["normal_force"]
    force = found[[f"force_{c}_N" for c in "xyz"]].to_numpy()
    half = found[[f"force_{c}_N_half" for c in "xyz"]].to_numpy()
    touches = found["in_contact"].to_numpy()
    on = fn > 0
    begins = np.flatnonzero(on & ~np.r_[False, on[:-1]])
    early = np.zeros(len(fn), dtype=bool)
    for k in begins:
        early[k : k + EARLY] = True
    smooth = np.apply_along_axis(lambda x: np.convolve(x, np.ones(15) / 15, "same"), 0, recording.dq)
    still = pd.Series((np.abs(smooth) < SLOW).all(1)).rolling(STILL).min().fillna(0.0).to_numpy() > 0
    error, out = force @ normal - fn, {}
    for name, mask in (("moving", on & ~early & ~still), ("rest", on & ~early & still)):
        out[name] = float(np.sqrt((error[mask] ** 2).mean()))
        out[f"{name} inside"] = 100 * float((np.abs(force - true) < half)[mask].mean())
    delays = []
    for k in begins:
        reached = k + int(np.argmax(fn[k : k + 3000] > DETECTED))
        after = np.flatnonzero(touches[k : k + 3000])
        delays.append(int(k + after[0] - reached) if len(after) else None)
    false = (np.diff(touches) > 0) & ~on[1:] & ~on[:-1]
    return out | {
        "delays after 5 N, ms": delays,
        "false alarms": int(false.sum()),
        "free, s": float((~on).sum() * 1e-3),
    }


def main() -> None:
    """Write the table."""
    from common import RESULTS, markdown, stamp

    folder = Path(sys.argv[1] if len(sys.argv) > 1 else ROOT.parent / "shared/data/contact_arms")
    names = sys.argv[2].split(",") if len(sys.argv) > 2 else [a for a in ARMS if (folder / a).is_dir()]
    if not names:
        sys.exit(f"error: {folder} holds none of {', '.join(ARMS)}")
    rows = []
    for name in names:
        r = evaluate((folder / name).resolve(), identified((folder / name).resolve(), ROOT / "runs"))
        rows.append(row(name, r))
        print(", ".join(f"{k} {v}" for k, v in rows[-1].items()), flush=True)
    if len(names) < len(ARMS):
        return
    table = markdown(pd.DataFrame(rows).set_index("arm"))
    head = f"# Force without a sensor\n\n{stamp('python benchmarks/wrench.py')}\n\n{NOTE}\n\n"
    (RESULTS / "wrench.md").write_text(head + table + "\n")


def row(name: str, r: dict) -> dict[str, str]:
    """Return the row of an arm."""
    true_moving, true_rest = ARMS[name]
    late = ", ".join("none" if d is None else str(d) for d in r["delays after 5 N, ms"])
    return {
        "arm": name,
        "RMSE moving, N": f"{r['moving']:.2f}",
        "RMSE at rest, N": f"{r['rest']:.2f}",
        "momentum observer, true parameters, N": f"{true_moving:.2f} / {true_rest:.2f}",
        "inside 95 %, moving / rest": f"{r['moving inside']:.0f} / {r['rest inside']:.0f} %",
        "detected after 5 N, ms": late,
        "false alarms": f"{r['false alarms'] + r['false alarms in ramps']} in {r['free, s'] + r['ramps, s']:.0f} s",
    }


if __name__ == "__main__":
    main()
