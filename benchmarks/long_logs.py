"""Time and memory of stage=identify by the length of the recording, for each kind of torque.

`python benchmarks/long_logs.py [KIND ...] [MINUTES ...]` writes recordings at 1 kHz of a synthetic arm of
three joints, 1, 4, 15 and 60 minutes, and identifies each by the command line: time, and the largest resident memory
of the process. Writes benchmarks/results/long_logs.md and long_logs.png from all rows in runs/long_logs.csv, so that
one kind of torque can be measured again.
"""

import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
from common import RESULTS, ROOT, markdown, write_page
from scipy.interpolate import CubicSpline

from r2s.physics.rigid_body import LinkInertia, rigid_body
from r2s.physics.robot import load_robot
from r2s.provenance import git
from r2s.recordings.recording import save_npz

ARM = """<mujoco><compiler angle="radian"/><worldbody><body pos="0 0 0.4"><body>
<inertial pos="0.02 0 0.1" mass="12" diaginertia="0.3 0.3 0.2"/>
<joint name="yaw" axis="0 0 1" range="-2.6 2.6" actuatorfrcrange="-150 150" armature="1.2"/><body pos="0 0 0.2">
<inertial pos="0 0 0.15" mass="8" diaginertia="0.2 0.2 0.04"/>
<joint name="pitch" axis="0 1 0" range="-1.8 1.8" actuatorfrcrange="-150 150" armature="0.9"/><body pos="0 0 0.3">
<inertial pos="0.03 0 0.1" mass="3" diaginertia="0.06 0.06 0.03"/>
<joint name="elbow" axis="0 1 0" range="-2 2" actuatorfrcrange="-60 60" armature="0.3"/>
<site name="tip" pos="0 0 0.25"/></body></body></body></body></worldbody></mujoco>"""
MINUTES = (1.0, 4.0, 15.0, 60.0)
KINDS = ("measured", "motor", "commanded")
DELAY_ROWS = 3  # ms, of the arm's response to a command
COULOMB, VISCOUS = np.array([12.0, 9.0, 4.0]), np.array([6.0, 4.0, 2.0])  # Nm, Nm s/rad
NOISE = 1e-5, 3e-3, 2e-3  # rad, rad/s, and of tau_max: standard deviations
ROWS = ROOT / "runs" / "long_logs.csv"
CHUNK = 60_000  # rows written at once
COARSE_S = 0.01  # s between the moments at which rigid-body torque is computed


def write_log(arm: Path, torque: str, minutes: float, path: Path) -> None:
    """Write a recording of inverse dynamics along a sum of six sines per joint that does not repeat."""
    robot = load_robot(str(arm), ddq_max=15.0)
    rng, rows = np.random.default_rng(0), round(60_000 * minutes)
    inertia = LinkInertia(robot.mass, robot.com, robot.inertia).standard().ravel()
    w = 2 * np.pi * rng.uniform(0.03, 0.4, (6, 3))
    amplitude, phase = 0.2 * rng.uniform(0.5, 1.0, (6, 3)) / (1 + 0.3 * w), rng.uniform(0, 2 * np.pi, (6, 3))
    q, dq, tau = (np.empty((rows, 3)) for _ in range(3))

    def motion(t: np.ndarray) -> list[np.ndarray]:
        x = w * t[:, None, None] + phase
        return [(amplitude * y).sum(1) for y in (np.sin(x), w * np.cos(x), -(w**2) * np.sin(x))]

    for k in range(0, rows, CHUNK):
        part = slice(k, min(k + CHUNK, rows))
        # a commanded arm answers late: its motion is that of an earlier command
        for at, late in ((part, 0), *([(part, DELAY_ROWS)] if torque == "commanded" else [])):
            t = (np.arange(at.start, at.stop) + late) * 1e-3
            move = motion(t)
            coarse = np.arange(t[0], t[-1] + COARSE_S, COARSE_S)  # the fastest sine lasts 2.5 s: off by 1e-8 of it
            rest, y = rigid_body(robot, *motion(coarse), robot.gravity if torque != "commanded" else None)
            tau[at] = CubicSpline(coarse, rest + y.reshape(len(rest), 3, -1) @ inertia)(t)
            tau[at] += np.sign(move[1]) * COULOMB + move[1] * VISCOUS
            tau[at] -= robot.armature * move[2] if torque == "measured" else 0.0
            if not late:
                q[at], dq[at] = move[:2]
    for x, noise in zip((q, dq, tau), (NOISE[0], NOISE[1], NOISE[2] * robot.tau_max), strict=True):
        x += noise * rng.standard_normal(x.shape)
    save_npz(path, {"t": 1e-3 * np.arange(rows), "q": q, "dq": dq, "tau": tau})


def identified(arm: Path, torque: str, path: Path) -> tuple[float, float]:
    """Return seconds and the largest resident memory in MB of one identification."""
    command = [sys.executable, str(ROOT / "run.py"), "stage=identify", "robot=other", f"robot.mjcf={arm}"]
    command += ["robot.ddq_max=15", "data=recording", f"data.path={path}", f"data.torque={torque}"]
    command += [f"root={path.parent}"]
    began = time.perf_counter()
    child = subprocess.Popen(command, stdout=subprocess.DEVNULL, env=os.environ | {"OMP_NUM_THREADS": "1"})
    _, status, usage = os.wait4(child.pid, 0)
    if status:
        sys.exit(f"{' '.join(command)}: exit status {os.waitstatus_to_exitcode(status)}")
    return time.perf_counter() - began, usage.ru_maxrss * 1024 / 1e6  # from KiB


def draw(table: pd.DataFrame) -> None:
    """Draw time and memory over length into long_logs.png."""
    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9, 3.5), layout="constrained")
    for kind, one in table.groupby("torque", sort=False):
        for axis, (key, label) in zip(axes, {"s": "time, s", "MB": "largest memory, MB"}.items(), strict=True):
            axis.plot(one["minutes"], one[key], "o-", label=kind)
            axis.set(xlabel="length of the recording, min", ylabel=label, xscale="log")
            axis.set_xticks(MINUTES, [f"{x:g}" for x in MINUTES], minor=False)
            axis.minorticks_off()
    for axis in axes:
        axis.set_ylim(bottom=0)
    axes[0].legend()
    figure.savefig(RESULTS / "long_logs.png", dpi=110)


def main() -> None:
    """Measure every length and kind, and write the page."""
    kinds = [word for word in sys.argv[1:] if word in KINDS] or KINDS
    lengths, rows = [float(x) for x in sys.argv[1:] if x not in KINDS] or MINUTES, []
    with tempfile.TemporaryDirectory() as folder:
        arm, log = Path(folder) / "arm.xml", Path(folder) / "log.npz"
        arm.write_text(ARM)
        for torque in kinds:
            for k, minutes in enumerate([lengths[0], *lengths]):  # the first run may compile and is not counted
                # in a process of its own: a child's largest memory begins with its parent's
                writer = multiprocessing.get_context("spawn").Process(
                    target=write_log, args=(arm, torque, minutes, log)
                )
                writer.start()
                writer.join()
                if writer.exitcode:
                    sys.exit(f"the log of {minutes:g} min was not written: exit status {writer.exitcode}")
                seconds, memory = identified(arm, torque, log)
                if not k:
                    continue
                row = {"torque": torque, "minutes": minutes, "s": round(seconds), "MB": round(memory)}
                rows.append(row | {"commit": (git()["commit"] or "unknown")[:7]})
                print(rows[-1], flush=True)
    write(merged(pd.DataFrame(rows)))


def merged(new: pd.DataFrame) -> pd.DataFrame:
    """Add rows to runs/long_logs.csv in place of older ones of the same kind and length; return all rows."""
    old = pd.read_csv(ROWS) if ROWS.exists() else new[:0]
    both = pd.concat([old, new]).drop_duplicates(["torque", "minutes"], keep="last")
    both = both.sort_values(["torque", "minutes"], key=lambda x: x.map(KINDS.index) if x.name == "torque" else x)
    ROWS.parent.mkdir(exist_ok=True)
    both.to_csv(ROWS, index=False)
    return both.reset_index(drop=True)


def write(table: pd.DataFrame) -> None:
    """Write the page and its picture."""
    first = table.groupby("torque")["s"].transform("first")
    table.insert(3, "times the first", (table["s"] / first).round(1))
    draw(table)
    text = (
        "Recordings of a synthetic arm of three joints at 1 kHz, identified with the settings of `stage=identify`, "
        "from the command line to the exit: wall-clock time, its ratio to that of the first recording, and largest "
        "resident memory (libraries alone: about 300 MB). From five minutes on, torque rows are farther apart, and "
        "windows are replayed from 4 minutes spread over the recording."
    )
    parts = [text, markdown(table.set_index("torque")), "![Time and memory by length](long_logs.png)"]
    write_page("long_logs", "Long recordings: time and memory", "python benchmarks/long_logs.py", parts)


if __name__ == "__main__":
    main()
