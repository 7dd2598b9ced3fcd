"""One rerun recording to look at: arms moving side by side, torques, learning curves, and their layout.

Everything is one file, because two recordings do not share a timeline: a comparison has an entity per label.
`rerun FILE` opens it with the arms playing. Episodes and torque overlays are on the timeline `time`, learning
curves on `env_steps` and `wall_clock`; every view shows the timeline picked at the bottom of the viewer.
"""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
import rerun as rr

from r2s.files import whole
from r2s.physics.robot import Robot
from r2s.reporting.colours import colours
from r2s.reporting.log_rows import at_rate, without_pauses
from r2s.reporting.viewer_layout import (
    CURVES,
    LEARNING,
    SPACING,
    Episode,
    Overlay,
    blueprint,
    entity,
    starts_of,
)

FRAMES_HZ = 50.0
OVERLAY_HZ = 100.0
WIDTH = 1.6  # of a plot's line
GOAL_RADIUS = 0.025  # m
GOAL = "#ff5252"
WORST_M = 0.01  # m, an error of the path that is shown red


def write_recording(
    path: str | os.PathLike,
    robot: Robot,
    *,
    episodes: Mapping[str, Sequence[Episode]] | None = None,
    overlays: Mapping[str, Overlay] | None = None,
    curves: Mapping[str, pd.DataFrame] | None = None,
    figures: Mapping[str, Path] | None = None,
    torque: np.ndarray | None = None,
) -> Path:
    """Write `path` (.rrd, there once it is whole) and return it; what is not given is left out of the layout.

    `episodes` {label: episodes} become one arm per label, all k-th episodes starting together. `overlays` are
    a tab of torque plots each. `curves` {run: evaluations.csv} share a tab. `figures` {name: PNG} are a tab
    each: what has no time axis, such as friction over speed. One named "learning" joins the curves' tab.
    `torque` (n,) Nm are limits, drawn beside the commands of the episodes.
    """
    path = Path(path)
    episodes = {label: sequence for label, sequence in (episodes or {}).items() if sequence}
    overlays, curves, figures = overlays or {}, curves or {}, figures or {}
    name = path.absolute().parent.name.replace(".", "-")  # the viewer keeps a layout per name, without dots
    stream = rr.RecordingStream(f"r2s {name}")
    with whole(path) as part:
        stream.save(part, default_blueprint=blueprint(robot, episodes, overlays, curves, figures))
        _arms(stream, robot, episodes)
        if torque is not None and episodes:
            _limits(stream, torque, float(starts_of(episodes)[-1]))
        for label, overlay in overlays.items():
            _overlay(stream, label, overlay)
        _learning(stream, curves)
        for name, picture in figures.items():
            stream.log(entity("figures", name), rr.EncodedImage(path=picture), static=True)
        stream.flush()
        stream.disconnect()
    return path


def _rgb(colour: str) -> np.ndarray:
    return np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])


def _series(
    stream: rr.RecordingStream,
    path: str,
    index: Sequence[rr.TimeColumn],
    values: np.ndarray,
    name: str,
    colour: str,
    width: float = WIDTH,
) -> None:
    """Send one line of a plot."""
    stream.log(path, rr.SeriesLines(names=name, colors=_rgb(colour), widths=width), static=True)
    stream.send_columns(path, indexes=index, columns=rr.Scalars.columns(scalars=values))


def _arms(stream: rr.RecordingStream, robot: Robot, episodes: Mapping[str, Sequence[Episode]]) -> None:
    """Send an arm per label, side by side."""
    stream.log("arms", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    palette, starts = colours(episodes), starts_of(episodes)
    for i, (label, sequence) in enumerate(episodes.items()):
        y = (i - (len(episodes) - 1) / 2) * SPACING
        stream.log(entity("arms", label), rr.Transform3D(translation=[0, y, 0]), static=True)
        _arm(stream, robot, label, sequence, starts, palette[label])


def _limits(stream: rr.RecordingStream, torque: np.ndarray, seconds: float) -> None:
    """Send both limits of each joint's torque as lines over the whole time."""
    index = [rr.TimeColumn("time", duration=np.array([0.0, seconds]))]
    for j, limit in enumerate(torque):
        for side, sign in (("upper", 1.0), ("lower", -1.0)):
            path = entity("command", f"joint {j + 1}", f"{side} limit")
            _series(stream, path, index, np.full(2, sign * limit), f"{side} limit", GOAL, 0.8)


def _arm(
    stream: rr.RecordingStream,
    robot: Robot,
    label: str,
    episodes: Sequence[Episode],
    starts: np.ndarray,
    colour: str,
) -> None:
    """Send one arm: its links, trail and goals, and its distance and torque plots."""
    model, base, rgb = robot.model(gravity=False), entity("arms", label), _rgb(colour)
    name = rr.Points3D([[0, 0, _height(model)]], radii=0.001, labels=label, colors=rgb, show_labels=True)
    stream.log(f"{base}/label", name, static=True)
    for body in _shown_bodies(model):
        _shapes(stream, model, body, _link(base, model, body), colour)
    frames = [at_rate(e.t, FRAMES_HZ) for e in episodes]
    clocks = [start + e.t[f] - e.t[0] for start, e, f in zip(starts, episodes, frames, strict=False)]
    _motion(stream, base, model, episodes, frames, clocks, starts, rgb)

    ends = [np.append(clock, clock[-1] + 1 / FRAMES_HZ) for clock in clocks]  # a nan there: no line over the pause
    index = [rr.TimeColumn("time", duration=np.concatenate(ends))]
    distance = [np.append(100 * e.distance[f], np.nan) for e, f in zip(episodes, frames, strict=True)]
    _series(stream, entity("distance", label), index, np.concatenate(distance), label, colour)
    for j in range(robot.n):
        tau = [np.append(e.tau[f, j], np.nan) for e, f in zip(episodes, frames, strict=True)]
        path = entity("command", f"joint {j + 1}", label)
        _series(stream, path, index, np.concatenate(tau), label, colour)


def _motion(
    stream: rr.RecordingStream,
    base: str,
    model: mujoco.MjModel,
    episodes: Sequence[Episode],
    frames: Sequence[np.ndarray],
    clocks: Sequence[np.ndarray],
    starts: np.ndarray,
    rgb: np.ndarray,
) -> None:
    """Send the poses of the links, the trail of the end effector, which grows, and the goals."""
    index = rr.TimeColumn("time", duration=np.concatenate(clocks))
    q = np.concatenate([e.q[f] for e, f in zip(episodes, frames, strict=True)])
    for body, (position, quaternion) in _poses(model, q).items():
        columns = rr.Transform3D.columns(translation=position, quaternion=quaternion)
        stream.send_columns(_link(base, model, body), indexes=[index], columns=columns)

    changes = rr.TimeColumn("time", duration=starts[: len(episodes)])
    if episodes[0].goal.ndim == 2:
        _paths(stream, base, episodes, frames, index, changes)
        return
    trail = [e.ee[[*f[:k:3], row]] for e, f in zip(episodes, frames, strict=True) for k, row in enumerate(f)]
    stream.log(f"{base}/trail", rr.LineStrips3D.from_fields(colors=rgb, radii=0.005), static=True)
    stream.send_columns(f"{base}/trail", indexes=[index], columns=rr.LineStrips3D.columns(strips=trail))
    goals = rr.Points3D.columns(positions=np.stack([e.goal for e in episodes]))
    stream.log(f"{base}/goal", rr.Points3D.from_fields(colors=_rgb(GOAL), radii=GOAL_RADIUS), static=True)
    stream.send_columns(f"{base}/goal", indexes=[changes], columns=goals)


def _paths(
    stream: rr.RecordingStream,
    base: str,
    episodes: Sequence[Episode],
    frames: Sequence[np.ndarray],
    index: rr.TimeColumn,
    changes: rr.TimeColumn,
) -> None:
    """Send the path of each episode, where the hand is to be on it, and the hand's trace, coloured by its error."""
    stream.log(f"{base}/path", rr.LineStrips3D.from_fields(colors=[150, 150, 150], radii=0.0015), static=True)
    whole_paths = rr.LineStrips3D.columns(strips=[e.goal for e in episodes])
    stream.send_columns(f"{base}/path", indexes=[changes], columns=whole_paths)
    stream.log(f"{base}/goal", rr.Points3D.from_fields(colors=_rgb(GOAL), radii=0.4 * GOAL_RADIUS), static=True)
    wanted = np.concatenate([e.goal[f] for e, f in zip(episodes, frames, strict=True)])
    stream.send_columns(f"{base}/goal", indexes=[index], columns=rr.Points3D.columns(positions=wanted))
    pieces: list[np.ndarray] = []
    shades: list[np.ndarray] = []
    lengths: list[int] = []
    for e, f in zip(episodes, frames, strict=True):
        rows = f[::3]
        of_piece = _shades(e.distance[rows[1:]])
        for k in range(len(f)):
            past = k // 3
            pieces += [e.ee[rows[i : i + 2]] for i in range(past)]
            shades += list(of_piece[:past])
            lengths.append(past)
    if not pieces:
        return
    stream.log(f"{base}/trail", rr.LineStrips3D.from_fields(radii=0.004), static=True)
    columns = rr.LineStrips3D.columns(strips=pieces, colors=np.array(shades)).partition(lengths)
    stream.send_columns(f"{base}/trail", indexes=[index], columns=columns)


def _shades(error: np.ndarray) -> np.ndarray:
    """Return (T, 3) colours of errors (T,) m: green for none, yellow at half of WORST_M, red from there on."""
    share = np.clip(error / WORST_M, 0.0, 1.0)[:, None]
    low, middle, high = np.array([[61, 170, 109], [235, 200, 60], [255, 60, 60]], dtype=float)
    warm = np.where(share < 0.5, low + 2 * share * (middle - low), middle + (2 * share - 1) * (high - middle))
    return warm.astype(np.uint8)


def _shown_geoms(model: mujoco.MjModel) -> np.ndarray:
    """Return the geoms that MuJoCo's own viewer shows (groups 0-2); all of them where there are none."""
    shown = np.flatnonzero((model.geom_group < 3) & (model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE))
    return shown if len(shown) else np.arange(model.ngeom)


def _shown_bodies(model: mujoco.MjModel) -> list[int]:
    return sorted({int(body) for body in model.geom_bodyid[_shown_geoms(model)]})


def _link(base: str, model: mujoco.MjModel, body: int) -> str:
    return base + entity("links", model.body(body).name or f"body {body}")


def _height(model: mujoco.MjModel) -> float:
    """Return m above the base where the arm's name stands clear of it."""
    return 0.85 * float(np.linalg.norm(model.body_pos[1:], axis=1).sum())


def _poses(model: mujoco.MjModel, q: np.ndarray) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Return {body: ((T, 3) m, (T, 4) quaternion x y z w)} in the base frame at q (T, n)."""
    data = mujoco.MjData(model)
    position, quaternion = np.empty((len(q), model.nbody, 3)), np.empty((len(q), model.nbody, 4))
    for k, angles in enumerate(q):
        data.qpos[:] = angles
        mujoco.mj_kinematics(model, data)
        position[k], quaternion[k] = data.xpos, np.roll(data.xquat, -1, axis=1)
    return {body: (position[:, body], quaternion[:, body]) for body in _shown_bodies(model)}


def _shapes(stream: rr.RecordingStream, model: mujoco.MjModel, body: int, path: str, colour: str) -> None:
    """Log the geoms of one link in its frame; dark ones (joints) are tinted with the arm's colour."""
    for geom in _shown_geoms(model)[model.geom_bodyid[_shown_geoms(model)] == body]:
        rgb = 255 * model.geom_rgba[geom, :3]
        rgb = _rgb(colour) if rgb.mean() < 100 else rgb
        shape = _shape(model, int(geom), rgb.astype(np.uint8))
        if shape is None:
            continue
        frame = f"{path}/geom{geom}"
        quaternion = np.roll(model.geom_quat[geom], -1)
        stream.log(frame, rr.Transform3D(translation=model.geom_pos[geom], quaternion=quaternion), static=True)
        stream.log(frame, shape, static=True)


def _shape(model: mujoco.MjModel, geom: int, rgb: np.ndarray) -> rr.AsComponents | None:
    """Return a geom as rerun draws it, in the geom's own frame; None for kinds that arms are not made of."""
    radius, half, _ = size = model.geom_size[geom]
    solid = rr.components.FillMode.Solid
    kind = mujoco.mjtGeom
    match int(model.geom_type[geom]):
        case kind.mjGEOM_CAPSULE:
            below = [[0, 0, -half]]  # rerun's capsule starts at its frame, MuJoCo's is centred on it
            return rr.Capsules3D(lengths=2 * half, radii=radius, translations=below, colors=rgb, fill_mode=solid)
        case kind.mjGEOM_CYLINDER:
            return rr.Cylinders3D(lengths=2 * half, radii=radius, colors=rgb, fill_mode=solid)
        case kind.mjGEOM_SPHERE:
            return rr.Ellipsoids3D(radii=[radius], colors=rgb, fill_mode=solid)
        case kind.mjGEOM_ELLIPSOID:
            return rr.Ellipsoids3D(half_sizes=size, colors=rgb, fill_mode=solid)
        case kind.mjGEOM_BOX:
            return rr.Boxes3D(half_sizes=size, colors=rgb, fill_mode=solid)
        case kind.mjGEOM_MESH:
            mesh = model.mesh(model.geom_dataid[geom])
            vertices = model.mesh_vert[mesh.vertadr[0] : mesh.vertadr[0] + mesh.vertnum[0]]
            faces = model.mesh_face[mesh.faceadr[0] : mesh.faceadr[0] + mesh.facenum[0]]
            return rr.Mesh3D(vertex_positions=vertices, triangle_indices=faces, albedo_factor=rgb)
    return None


def _overlay(stream: rr.RecordingStream, label: str, overlay: Overlay) -> None:
    """Send measured and predicted torque, one plot per joint, the measured one as a broad band beneath."""
    clock, _ = without_pauses(overlay.t)
    rows = at_rate(clock, OVERLAY_HZ)
    index = [rr.TimeColumn("time", duration=clock[rows])]
    lines = {"measured": overlay.measured, **overlay.predicted}
    palette = colours(lines)
    for i, (name, torque) in enumerate(lines.items()):
        for j in range(torque.shape[1]):
            path = entity("torque", label, f"joint {j + 1}", f"{i + 1} {name}")  # drawn in the order of their paths
            width = 4.0 if name == "measured" else WIDTH
            _series(stream, path, index, torque[rows, j], name, palette[name], width)


def _learning(stream: rr.RecordingStream, curves: Mapping[str, pd.DataFrame]) -> None:
    """Send the evaluations of training runs, on both of their timelines."""
    palette = colours(curves)
    for run, table in curves.items():
        index = [
            rr.TimeColumn("env_steps", sequence=table["env_steps"].to_numpy(int)),
            rr.TimeColumn("wall_clock", duration=table["wall_clock_s"].to_numpy(float)),
        ]
        for column in CURVES:
            if column in table:
                values = table[column].to_numpy(float)
                _series(stream, entity(LEARNING, CURVES[column], run), index, values, run, palette[run])
