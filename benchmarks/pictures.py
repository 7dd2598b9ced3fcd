"""Draw the picture of the README: a simulated arm beside the twin, and the twin's torque against two models of it.

`python benchmarks/pictures.py` identifies arm=twin from 10 s of motion and lets algo=oracle reach the same goals in
the identified simulation and on the twin (3 minutes on two cores). To draw existing run folders:
`python benchmarks/pictures.py IDENTIFY_FOLDER TRANSFER_FOLDER`. Writes docs/overview.png.

Sphere tracing (Hart, The Visual Computer 12, 1996) draws the arm without a graphics library.
"""

import sys
from pathlib import Path

import mujoco
import numpy as np
from common import ROBOT, ROOT, run_parallel
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from r2s.physics.robot import Robot
from r2s.reporting.figures.colours import KNOWN
from r2s.reporting.figures.log_rows import without_pauses
from r2s.reporting.viewer.arms import GOAL

NAME = "overview"  # of the run folders
EYE = np.array([1.0, -0.75, 0.42]) / np.linalg.norm([1.0, -0.75, 0.42])  # direction from the arm to the eye
RIGHT = np.cross([0, 0, 1.0], EYE) / np.linalg.norm(np.cross([0, 0, 1.0], EYE))
UP = np.cross(EYE, RIGHT)
LIGHT = np.array([0.5, -0.3, 1.0]) / np.linalg.norm([0.5, -0.3, 1.0])
MARGIN = 0.13  # m around the links
PIXELS_PER_M = 480
FLOOR = np.array([0.955, 0.96, 0.97])
POSES = {0.0: 0.2, 0.25: 0.3, 0.42: 0.45, 3.9: 1.0}  # s: opacity
JOINTS = (0, 3)  # joints with a torque plot, from 0
SECONDS = 8.0  # duration of the torque plots


def distance(points: np.ndarray, shapes: list) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance (P,) m from points (P, 3) to the nearest shape, and its index (P,)."""
    nearest, which = np.full(len(points), np.inf), np.zeros(len(points), int)
    for k, (kind, size, position, rotation, _) in enumerate(shapes):
        x, y, z = ((points - position) @ rotation).T
        if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
            d = np.sqrt(x**2 + y**2 + np.maximum(np.abs(z) - size[1], 0) ** 2) - size[0]
        else:  # a cylinder, its edges rounded by 1 cm
            out = np.stack([np.hypot(x, y) - size[0], np.abs(z) - size[1]]) + 0.01
            d = np.minimum(out.max(0), 0) + np.linalg.norm(np.maximum(out, 0), axis=0) - 0.01
        closer = d < nearest
        nearest[closer], which[closer] = d[closer], k
    return nearest, which


def trace(start: np.ndarray, direction: np.ndarray, shapes: list, far: float) -> tuple[np.ndarray, np.ndarray]:
    """Return where rays from start (P, 3) m meet a shape, (P, 3) m, and whether they do within `far` m, (P,)."""
    way, alive = np.zeros(len(start)), np.ones(len(start), bool)
    for _ in range(60):
        d, _ = distance(start[alive] + way[alive, None] * direction, shapes)
        way[alive] += d
        alive[alive] = (d > 5e-4) & (way[alive] < far)
    return start + way[:, None] * direction, way < far


def shapes_at(q: np.ndarray, tint: str, robot: Robot = ROBOT) -> list:
    """Return the capsules and cylinders of the arm at q (n,) rad: kind, size, position, rotation, colour."""
    model = robot.model(gravity=False)
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    shown = np.flatnonzero(model.geom_group == 2)
    dark = model.geom_rgba[:, :3].mean(-1) < 0.4
    colour = [np.array(to_rgb(tint)) if dark[g] else model.geom_rgba[g, :3] for g in range(model.ngeom)]
    rotation = data.geom_xmat.reshape(-1, 3, 3)
    return [(model.geom_type[g], model.geom_size[g], data.geom_xpos[g], rotation[g], colour[g]) for g in shown]


def frame_of(poses: np.ndarray, robot: Robot = ROBOT) -> tuple[float, float, float, float]:
    """Return left, right, bottom and top, m from the base, of a frame around poses (K, n) rad."""
    at = np.array([position for q in poses for _, _, position, _, _ in shapes_at(q, "w", robot)])
    (left, bottom), (right, top) = (f(np.stack([at @ RIGHT, at @ UP], -1), axis=0) for f in (np.min, np.max))
    return left - MARGIN, right + MARGIN, bottom - MARGIN, top + MARGIN


def picture(
    q: np.ndarray, tint: str, frame: tuple, robot: Robot = ROBOT, pixels: float = PIXELS_PER_M
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return an image of one pose: colours (H, W, 3), mask of the arm (H, W), light on the floor (H, W)."""
    shapes = shapes_at(q, tint, robot)
    left, right, bottom, top = frame
    x, y = (np.arange(a, b, 1 / pixels) for a, b in ((left, right), (bottom, top)))
    u, v = (grid.ravel() for grid in np.meshgrid(x, y[::-1]))
    start = u[:, None] * RIGHT + v[:, None] * UP + 3 * EYE
    hit, arm = trace(start, -EYE, shapes, 6.0)
    image = np.tile(FLOOR, (len(u), 1))
    at = hit[arm]
    _, which = distance(at, shapes)
    steps = 1e-3 * np.eye(3)
    normal = np.stack([distance(at + e, shapes)[0] - distance(at - e, shapes)[0] for e in steps], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    _, shaded = trace(at + 4e-3 * normal, LIGHT, shapes, 1.5)
    bright = np.clip(normal @ LIGHT, 0, 1) * np.where(shaded, 0.35, 1.0)
    shine = np.clip(normal @ (LIGHT + EYE) / np.linalg.norm(LIGHT + EYE), 0, 1) ** 40 * np.where(shaded, 0, 0.25)
    image[arm] = np.stack([s[-1] for s in shapes])[which] * (0.42 + 0.58 * bright)[:, None] + shine[:, None]
    floor = start - EYE * (start[:, 2] / EYE[2])[:, None]
    light = np.ones(len(u))
    near = np.linalg.norm(floor[:, :2], axis=-1) < 1.4
    _, hidden = trace(floor[near] + 1e-3 * LIGHT, LIGHT, shapes, 2.5)
    light[near] = np.where(hidden, 0.86, 1.0)
    size = len(y), len(x)
    return np.clip(image, 0, 1).reshape(*size, 3), arm.reshape(size), light.reshape(size)


def draw_arm(axis: Axes, episode: dict, label: str, colour: str) -> None:
    """Draw an episode {t, q, ee, goal}: some poses, the path of the end effector and the goal."""
    image, frame = None, frame_of(episode["q"][np.searchsorted(episode["t"], list(POSES))])
    for seconds, opacity in POSES.items():
        rendered, arm, light = picture(episode["q"][np.searchsorted(episode["t"], seconds)], colour, frame)
        image = np.tile(FLOOR, (*arm.shape, 1)) if image is None else image
        cover = np.where(arm, opacity, 0.0)[..., None]
        shadow = light[..., None] if opacity == 1 else 1.0
        image = (1 - cover) * image * np.where(arm[..., None], 1.0, shadow) + cover * rendered
    axis.imshow(image, extent=frame, interpolation="bilinear")
    path, goal = (np.stack([p @ RIGHT, p @ UP], -1) for p in (episode["ee"], episode["goal"]))
    axis.plot(*path.T, color=colour, linewidth=2.2)
    axis.plot(*goal, "o", color=GOAL, markersize=13, alpha=0.55, markeredgecolor="none")
    axis.set_title(label, loc="left", fontsize=12)
    axis.set_axis_off()


def draw_torque(axes: list[Axes], saved: dict) -> None:
    """Draw the torques {t, measured, nominal, identified} of JOINTS."""
    clock, _ = without_pauses(saved["t"])
    rows = clock <= SECONDS
    for axis, j in zip(axes, JOINTS, strict=True):
        axis.plot(clock[rows], saved["measured"][rows, j], color=KNOWN["measured"], linewidth=4, label="measured")
        rmse = {}
        for name in ("nominal", "identified"):
            rmse[name] = np.sqrt(np.mean((saved[name][:, j] - saved["measured"][:, j]) ** 2))
            label = "nominal model (published)" if name == "nominal" else "identified model"
            axis.plot(clock[rows], saved[name][rows, j], color=KNOWN[name], linewidth=1.4, label=label)
        title = f"joint {j + 1}, torque in Nm: RMSE {rmse['nominal']:.2f} → {rmse['identified']:.2f}"
        axis.set_title(title, loc="left", fontsize=12)
        axis.set_xlim(0, clock[rows][-1])
        axis.grid(alpha=0.3, linewidth=0.6)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].tick_params(labelbottom=False)
    axes[-1].set_xlabel("time, s, held-out motion")
    axes[-1].legend(loc="upper center", bbox_to_anchor=(0.5, -0.24), ncols=3, frameon=False)


def draw(identified: Path, transferred: Path, path: Path) -> None:
    """Draw both run folders into one picture."""
    saved = dict(np.load(identified / "torque.npz"))
    both = {where: dict(np.load(transferred / f"episodes_{where}.npz")) for where in ("predicted", "twin")}
    k = int(np.argmax(both["twin"]["distance"][:, 0]))
    figure = Figure(figsize=(16, 5), dpi=100)
    grid = figure.add_gridspec(
        2, 3, width_ratios=(1, 1, 2), left=0.01, right=0.985, top=0.93, bottom=0.17, wspace=0.1, hspace=0.28
    )
    apart = both["twin"]["ee"][k] - both["predicted"]["ee"][k]
    path_mm = 1e3 * np.sqrt(np.mean(np.sum(apart**2, -1)))
    titles = {"predicted": "in the identified simulation", "twin": f"on the twin: {path_mm:.1f} mm from simulation"}
    for i, (where, e) in enumerate(both.items()):
        episode = {"t": e["t"]} | {name: e[name][k] for name in ("q", "ee", "goal")}
        draw_arm(figure.add_subplot(grid[:, i]), episode, titles[where], KNOWN["identified"])
    draw_torque([figure.add_subplot(grid[row, 2]) for row in range(2)], saved)
    figure.savefig(path)


def main() -> None:
    """Draw the given run folders, or create them first."""
    if len(sys.argv) == 3:
        identified, transferred = map(Path, sys.argv[1:])
    else:
        identified, policy, transferred = (ROOT / "runs" / s / NAME for s in ("identify", "train", "transfer"))
        run_parallel([["stage=identify", f"name={NAME}", "data.seconds=10"]])
        run_parallel([["algo=oracle", f"name={NAME}", f"calibration={identified}", "evaluation.episodes=12"]])
        run_parallel([["stage=transfer", f"name={NAME}", f"policy={policy}", "evaluation.episodes=12"]])
    draw(identified, transferred, ROOT / "docs" / "overview.png")


if __name__ == "__main__":
    main()
