"""Show the external force over time in a figure, and as an arrow with a 95 % cone in the Rerun viewer."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import rerun as rr

from r2s.physics.robot import Robot
from r2s.recordings.recording import Recording
from r2s.reporting.figures.colours import colours
from r2s.reporting.figures.log_rows import at_rate
from r2s.reporting.figures.panels import panels
from r2s.reporting.viewer.arms import FRAMES_HZ, log_moving_robot
from r2s.reporting.viewer.layout import log_series, rgb

DRAWN_HZ = 100.0
FORCES = [f"force_{c}_N" for c in "xyz"]
FRANKA = "Franka's O_F_ext_hat_K"
METRES = 0.01  # m per N, scale of the force arrow
CONE = 24  # number of points on the cone's edge
TOUCH, NONE = "#cc0018", "#7f8790"


def force_of(wrench: pd.DataFrame) -> tuple[np.ndarray, np.ndarray]:
    """Return the force and half the width of its 95 % interval, each (T, 3) N, from a table of observe_recording."""
    return wrench[FORCES].to_numpy(), wrench[[f"{name}_half" for name in FORCES]].to_numpy()


def franka_force(recording: Recording) -> np.ndarray | None:
    """Return Franka's estimate of the force (T, 3) N on the arm, or None if the recording has no estimate.

    The result is -O_F_ext_hat_K, because O_F_ext_hat_K is the force that the arm exerts on its environment.
    """
    own = recording.signals.get("O_F_ext_hat_K")
    return None if own is None or not own.any() else -own[:, :3]


def draw_wrench(path: Path, wrench: pd.DataFrame, recording: Recording, contacts: Sequence[dict]) -> Path:
    """Draw the force over time with its 95 % band, and mark the contacts."""
    t, rows = wrench["t"].to_numpy(), at_rate(wrench["t"].to_numpy(), DRAWN_HZ)
    (force, half), own = force_of(wrench), franka_force(recording)
    palette = colours(["estimate", FRANKA])
    with panels(path, 3, 1, "force on the arm") as axes:
        for c, axis in enumerate(axes):
            x, h = force[rows, c], half[rows, c]
            axis.fill_between(t[rows], x - h, x + h, color=palette["estimate"], alpha=0.25, linewidth=0, label="95 %")
            axis.plot(t[rows], x, color=palette["estimate"], linewidth=1.0, label="estimate")
            if own is not None:
                axis.plot(t[rows], own[rows, c], color=palette[FRANKA], linewidth=0.8, label=FRANKA)
            for touch in contacts:
                axis.axvspan(touch["begin_s"], touch["end_s"], color=TOUCH, alpha=0.08, linewidth=0, label="contact")
            low, high = np.quantile(x - h, 0.01), np.quantile(x + h, 0.99)
            axis.set(xlabel="time, s", ylabel="N", xlim=(t[0], t[-1]))
            axis.set_ylim(min(low, x.min()) - 0.5, max(high, x.max()) + 0.5)
            axis.set_title(f"force along {'xyz'[c]} of the base", loc="left")
    return path


def log_wrench(stream: rr.RecordingStream, robot: Robot, recording: Recording, wrench: pd.DataFrame) -> None:
    """Log the moving arm, the force as an arrow with a 95 % cone at the tip, and Franka's estimate of the force."""
    rows = at_rate(recording.t, FRAMES_HZ)
    t, index = recording.t[rows], [rr.TimeColumn("time", duration=recording.t[rows])]
    log_moving_robot(stream, robot, "arm", colours(["estimate"])["estimate"], t, recording.q[rows])
    force, half = (x[rows] for x in force_of(wrench))
    tip = wrench[["tip_x_m", "tip_y_m", "tip_z_m"]].to_numpy()[rows]
    touches = wrench["in_contact"].to_numpy()[rows] > 0
    shades = np.where(touches[:, None], rgb(TOUCH), rgb(NONE)).astype(np.uint8)
    arrows = rr.Arrows3D.columns(origins=tip, vectors=METRES * force, colors=shades)
    stream.log("arm/force", rr.Arrows3D.from_fields(radii=0.006), static=True)
    stream.send_columns("arm/force", indexes=index, columns=arrows)
    if robot.tool is not None:
        balls = rr.Points3D.columns(positions=tip)
        stream.log("arm/tip", rr.Points3D.from_fields(colors=rgb(NONE), radii=robot.tool.radius), static=True)
        stream.send_columns("arm/tip", indexes=index, columns=balls)
    strips = [strip for k in range(len(t)) for strip in cone(tip[k], force[k], half[k])]
    lines = rr.LineStrips3D.columns(strips=strips).partition([len(strips) // len(t)] * len(t))
    stream.log("arm/cone", rr.LineStrips3D.from_fields(colors=[150, 150, 150], radii=0.0008), static=True)
    stream.send_columns("arm/cone", indexes=index, columns=lines)
    own, shade = franka_force(recording), colours(["estimate", FRANKA])[FRANKA]
    for c, name in enumerate(FORCES if own is not None else ()):
        log_series(stream, f"{name}/Franka", index, own[rows, c], FRANKA, shade)  # type: ignore[index]


def cone(tip: np.ndarray, force: np.ndarray, half: np.ndarray) -> list[np.ndarray]:
    """Return the 95 % cone of the force's direction as lines: the edge of the cone, and four lines from tip to edge.

    In each direction normal to the force, the distance from the end of the arrow to the edge is half the width of the
    force's 95 % interval.
    """
    size = max(float(np.linalg.norm(force)), 1e-9)
    across = np.linalg.svd(force[None] / size)[2][1:]
    angle = np.linspace(0.0, 2.0 * np.pi, CONE + 1)
    ring = np.cos(angle)[:, None] * across[0] + np.sin(angle)[:, None] * across[1]
    edge = tip + METRES * (force + ring * np.linalg.norm(ring * half, axis=1, keepdims=True))
    return [edge, *(np.stack([tip, edge[k]]) for k in range(0, CONE, CONE // 4))]
