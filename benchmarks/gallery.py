"""Draw the pictures of docs/gallery.md: arms, overlays before and after, friction, learning, transfers, the viewer.

`python benchmarks/gallery.py` runs what is missing (identification of twin 0 and of the Kinova's recordings, the
trainings of benchmarks/minutes.py, a comparison, a transfer to twin 0: a quarter of an hour on two cores) and writes
docs/gallery/*.png, each at most 150 kB. Pictures of the viewer need Xvfb and a Vulkan driver such as Mesa's (Debian:
xvfb mesa-vulkan-drivers libxkbcommon-x11-0); without them they stay unchanged.
"""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import numpy as np
from common import ROOT, conf, run_parallel
from matplotlib.figure import Figure
from pictures import FLOOR, frame_of, picture
from PIL import Image

from r2s.physics.robot import load_robot
from r2s.reporting.figures.colours import KNOWN
from r2s.reporting.figures.log_rows import without_pauses

NAME = "gallery"  # of the run folders
OUT = ROOT / "docs" / "gallery"
RUNS = ROOT / "runs"
TINTS = {"panda": "#3b8fe0", "kinova_gen3": "#3daa6d", "ur10e": "#c9a227", "iiwa14": "#d65f9e", "xarm7": "#9b7ede"}
SEEDS = range(95, 98)  # of the compared trainings
MAX_BYTES = 150_000
WIDTH = 1100  # pixels
SECONDS = 8.0  # of torque
SHADOW_M = 0.15  # room for the shadow beside an arm
DISPLAY = ":97"


def save(image: Image.Image, name: str, colours: int = 128, width: int = WIDTH) -> None:
    """Write docs/gallery/NAME.png with few colours and at most `width` pixels width."""
    if image.width > width:
        image = image.resize((width, round(image.height * width / image.width)), Image.Resampling.LANCZOS)
    image.convert("RGB").quantize(colours).save(OUT / f"{name}.png", optimize=True)
    size = (OUT / f"{name}.png").stat().st_size
    if size > MAX_BYTES:
        raise SystemExit(f"{name}.png: expected at most {MAX_BYTES} bytes, got {size}")
    print(f"written: docs/gallery/{name}.png, {size / 1e3:.0f} kB")


def save_figure(figure: Figure, name: str) -> None:
    """Write a Matplotlib figure."""
    out = BytesIO()
    figure.savefig(out, dpi=110)
    save(Image.open(out), name)


def arms() -> None:
    """Draw the arms that come with r2s in their home postures."""
    robots = {
        name: load_robot(**{key: value for key, value in conf(f"robot/{name}").items() if key != "defaults"})
        for name in TINTS
    }
    frames = np.array([frame_of(robot.q_home[None], robot) for robot in robots.values()])
    bottom, top = frames[:, 2].min(), frames[:, 3].max()  # one scale for all arms
    left, right = frames[:, 0].min(), frames[:, 1].max() + SHADOW_M
    figure = Figure(figsize=(11, 0.3 + 2.2 * (top - bottom) / (right - left)))
    for k, (name, robot) in enumerate(robots.items()):
        frame = left, right, bottom, top
        seen, arm, light = picture(robot.q_home, TINTS[name], frame, robot, 1.3 * WIDTH / 5 / (right - left))
        axis = figure.add_axes((0.2 * k, 0.0, 0.2, 0.88))
        axis.imshow(np.where(arm[..., None], seen, FLOOR * light[..., None]), extent=frame)
        axis.set_title(name, fontsize=12)
        axis.set_axis_off()
    figure.set_facecolor(tuple(FLOOR))
    save_figure(figure, "arms")


def before_and_after(folder: Path, joints: Sequence[int], name: str) -> None:
    """Draw measured torque with that of the nominal (left) and the identified model (right), same as in the paper."""
    saved = dict(np.load(folder / "torque.npz"))
    clock, _ = without_pauses(saved["t"])
    rows = clock <= SECONDS
    figure = Figure(figsize=(11, 2.2 * len(joints) + 0.5), layout="constrained")
    axes = figure.subplots(len(joints), 2, sharex=True, sharey="row", squeeze=False)
    for pair, j in zip(axes, joints, strict=True):
        for axis, model in zip(pair, ("nominal", "identified"), strict=True):
            rmse = np.sqrt(np.mean((saved[model][:, j] - saved["measured"][:, j]) ** 2))
            axis.plot(clock[rows], saved["measured"][rows, j], color=KNOWN["measured"], lw=3.5, label="measured")
            axis.plot(clock[rows], saved[model][rows, j], color=KNOWN[model], lw=1.3, label=f"{model} model")
            axis.set_title(f"joint {j + 1}, {model} model: RMSE {rmse:.2f} Nm", loc="left", fontsize=11)
            axis.grid(alpha=0.3, linewidth=0.6)
            axis.spines[["top", "right"]].set_visible(False)
        pair[0].set_ylabel("torque, Nm")
    for axis in axes[-1]:
        axis.set_xlabel("time, s, held-out motion")
    lines = [line for axis in axes[0] for line in axis.get_lines()]
    by_label = {str(line.get_label()): line for line in lines}
    figure.legend(by_label.values(), by_label.keys(), loc="outside lower center", ncols=3, frameon=False)
    save_figure(figure, name)


def viewer(recording: Path, name: str) -> None:
    """Take a picture of the viewer with a recording, on a virtual screen."""
    if not shutil.which("Xvfb"):
        print(f"docs/gallery/{name}.png stays unchanged: Xvfb is not installed")
        return
    shot = OUT / f"{name}_raw.png"
    screen = subprocess.Popen(["Xvfb", DISPLAY, "-screen", "0", "1400x900x24"], stderr=subprocess.DEVNULL)
    try:
        time.sleep(2)
        words = [Path(sys.executable).parent / "rerun", recording, "--window-size", "1300x800"]
        words += ["--renderer", "vulkan", "--screenshot-to", shot]
        env = os.environ | {"DISPLAY": DISPLAY}
        subprocess.run(words, env=env, check=True, timeout=180, capture_output=True)
        with Image.open(shot) as image:
            save(image.copy(), name)
    finally:
        shot.unlink(missing_ok=True)
        screen.terminate()
        screen.wait()


def make_runs() -> None:
    """Run what is missing."""
    run_parallel(
        [
            ["stage=identify", f"name={NAME}", "data.seconds=10"],
            ["stage=identify", f"name={NAME}_kinova", "data=kinova_gen3"],
        ]
    )
    minutes = [["algo=tqc", "dr=paper", "budget.minutes=4", f"seed={s}", f"name=four_{s}"] for s in SEEDS]
    run_parallel([*minutes, ["algo=oracle", "dr=paper", "name=minutes_oracle"]])
    run_parallel(
        [
            ["stage=transfer", f"policy={RUNS / 'train' / f'four_{SEEDS[0]}'}", f"name={NAME}"],
            ["stage=compare", 'runs="runs/train/[fm]*_[9o]*"', f"name={NAME}"],
        ]
    )


def main() -> None:
    """Run what is missing, then draw."""
    os.chdir(ROOT)
    OUT.mkdir(exist_ok=True)
    make_runs()
    arms()
    before_and_after(RUNS / "identify" / NAME, (0, 1), "twin_torque")
    before_and_after(RUNS / "identify" / f"{NAME}_kinova", (1, 3), "kinova_torque")
    for stage, run, figure, name in (
        ("identify", NAME, "friction", "friction"),
        ("identify", NAME, "position", "position"),
        ("compare", NAME, "learning", "learning"),
        ("transfer", NAME, "reach", "reach"),
        ("transfer", NAME, "traces", "traces"),
    ):
        with Image.open(RUNS / stage / run / "figures" / f"{figure}.png") as image:
            save(image.copy(), name)
    viewer(RUNS / "transfer" / NAME / "recording.rrd", "viewer_transfer")
    viewer(RUNS / "identify" / NAME / "recording.rrd", "viewer_identify")


if __name__ == "__main__":
    main()
