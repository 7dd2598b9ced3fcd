"""Log arms for the Rerun viewer: links, goals, trails of the end effectors, and plots of error and torque."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
import rerun as rr

from r2s.physics.robot import Robot
from r2s.reporting.figures.colours import colours
from r2s.reporting.figures.log_rows import at_rate
from r2s.reporting.viewer.data import Episode
from r2s.reporting.viewer.layout import SPACING, entity, log_series, rgb, starts_of
from r2s.tasks.measures import Measure

FRAMES_HZ = 50.0
TRAIL_EVERY = 3  # frames per point of a trail
GOAL_RADIUS = 0.025  # m; the diameter is the paper's success distance of 5 cm
GOAL = "#ff5252"
WORST_M = 0.01  # m, error from which the trail on a path is red


class _Arm(NamedTuple):
    """An arm in the Rerun recording; `frames`: indices of each episode's logged rows; `starts`: episode starts, s."""

    stream: rr.RecordingStream
    base: str
    model: mujoco.MjModel
    episodes: Sequence[Episode]
    frames: Sequence[np.ndarray]
    starts: np.ndarray
    colour: str

    def clocks(self) -> list[np.ndarray]:
        """Return the times of each episode's logged rows on the timeline, s."""
        parts = zip(self.starts, self.episodes, self.frames, strict=False)
        return [start + e.t[f] - e.t[0] for start, e, f in parts]

    def send(self, name: str, style: rr.AsComponents, columns: Any, per_episode: bool) -> None:
        """Log `columns` with one value per logged row or, if `per_episode`, one value per episode."""
        times = self.starts[: len(self.episodes)] if per_episode else np.concatenate(self.clocks())
        path = f"{self.base}/{name}"
        self.stream.log(path, style, static=True)
        self.stream.send_columns(path, indexes=[rr.TimeColumn("time", duration=times)], columns=columns)


def log_arms(
    stream: rr.RecordingStream, robot: Robot, episodes: Mapping[str, Sequence[Episode]], error: Measure
) -> None:
    """Log one arm per label, side by side; the plotted error has the unit of the measure `error`."""
    stream.log("arms", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    model, palette, starts = robot.model(gravity=False), colours(episodes), starts_of(episodes)
    for i, (label, sequence) in enumerate(episodes.items()):
        base, colour = entity("arms", label), palette[label]
        y = (i - (len(episodes) - 1) / 2) * SPACING
        stream.log(base, rr.Transform3D(translation=[0, y, 0]), static=True)
        name = rr.Points3D([[0, 0, _height(model)]], radii=0.001, labels=label, colors=rgb(colour), show_labels=True)
        stream.log(f"{base}/label", name, static=True)
        for body in _shown_bodies(model):
            _shapes(stream, model, body, _link(base, model, body), colour)
        arm = _Arm(stream, base, model, sequence, [at_rate(e.t, FRAMES_HZ) for e in sequence], starts, colour)
        _motion(arm)
        (_paths if sequence[0].moves else _goals)(arm)
        if sequence[0].box is not None:
            _boxes(arm, -robot.gravity)
        _plots(arm, label, error)


def log_moving_robot(
    stream: rr.RecordingStream, robot: Robot, base: str, colour: str, t: np.ndarray, q: np.ndarray
) -> None:
    """Log the links of one arm below the entity path `base`, and their poses at angles q (T, n) rad over t (T,) s."""
    stream.log(base, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    model, index = robot.model(gravity=False), rr.TimeColumn("time", duration=t)
    for body, (position, quaternion) in _poses(model, q).items():
        _shapes(stream, model, body, _link(base, model, body), colour)
        columns = rr.Transform3D.columns(translation=position, quaternion=quaternion)
        stream.send_columns(_link(base, model, body), indexes=[index], columns=columns)


def _plots(arm: _Arm, label: str, error: Measure) -> None:
    """Log the error and each joint's torque as lines; a nan after each episode interrupts a line."""
    ends = [np.append(clock, clock[-1] + 1 / FRAMES_HZ) for clock in arm.clocks()]
    index = [rr.TimeColumn("time", duration=np.concatenate(ends))]

    def line(path: str, values: Sequence[np.ndarray]) -> None:
        log_series(arm.stream, path, index, np.concatenate([np.append(v, np.nan) for v in values]), label, arm.colour)

    pairs = list(zip(arm.episodes, arm.frames, strict=True))
    line(entity("distance", label), [error.scale * e.distance[f] for e, f in pairs])
    for j in range(arm.episodes[0].tau.shape[1]):
        line(entity("command", f"joint {j + 1}", label), [e.tau[f, j] for e, f in pairs])


def _motion(arm: _Arm) -> None:
    """Log the poses of the links."""
    index = rr.TimeColumn("time", duration=np.concatenate(arm.clocks()))
    q = np.concatenate([e.q[f] for e, f in zip(arm.episodes, arm.frames, strict=True)])
    for body, (position, quaternion) in _poses(arm.model, q).items():
        columns = rr.Transform3D.columns(translation=position, quaternion=quaternion)
        arm.stream.send_columns(_link(arm.base, arm.model, body), indexes=[index], columns=columns)


def _goals(arm: _Arm) -> None:
    """Log a goal per episode and the growing trail of the end effector."""
    pairs = list(zip(arm.episodes, arm.frames, strict=True))
    trail = [e.ee[[*f[:k:TRAIL_EVERY], row]] for e, f in pairs for k, row in enumerate(f)]
    style = rr.LineStrips3D.from_fields(colors=rgb(arm.colour), radii=0.005)
    arm.send("trail", style, rr.LineStrips3D.columns(strips=trail), per_episode=False)
    goals = rr.Points3D.columns(positions=np.stack([e.goal for e in arm.episodes]))
    arm.send("goal", rr.Points3D.from_fields(colors=rgb(GOAL), radii=GOAL_RADIUS), goals, per_episode=True)


def _boxes(arm: _Arm, up: np.ndarray) -> None:
    """Log the box that the arm pushes on a level table; `up` (3,) is an upward vector of any length."""
    rows = np.concatenate([e.box[f] for e, f in zip(arm.episodes, arm.frames, strict=True) if e.box is not None])
    first, up = rows[:, 3:6], up / np.linalg.norm(up)
    axes = np.stack([first, np.cross(up, first), np.broadcast_to(up, first.shape)], axis=-1)
    solid = rr.components.FillMode.Solid
    shape = rr.Boxes3D(half_sizes=[0.5 * rows[0, 8:]], colors=rgb(arm.colour), fill_mode=solid)
    arm.send("box", shape, rr.Transform3D.columns(translation=rows[:, :3], mat3x3=axes), per_episode=False)


def _paths(arm: _Arm) -> None:
    """Log each episode's path, the current goal on the path, and the end effector's trail, colored by error."""
    pairs = list(zip(arm.episodes, arm.frames, strict=True))
    grey = rr.LineStrips3D.from_fields(colors=[150, 150, 150], radii=0.0015)
    arm.send("path", grey, rr.LineStrips3D.columns(strips=[e.goal for e in arm.episodes]), per_episode=True)
    points = rr.Points3D.columns(positions=np.concatenate([e.goal[f] for e, f in pairs]))
    arm.send("goal", rr.Points3D.from_fields(colors=rgb(GOAL), radii=0.4 * GOAL_RADIUS), points, per_episode=False)
    pieces: list[np.ndarray] = []
    shades: list[np.ndarray] = []
    lengths: list[int] = []
    for e, f in pairs:
        rows = f[::TRAIL_EVERY]
        of_piece = _shades(e.distance[rows[1:]])
        for k in range(len(f)):
            past = k // TRAIL_EVERY
            pieces += [e.ee[rows[i : i + 2]] for i in range(past)]
            shades += list(of_piece[:past])
            lengths.append(past)
    if pieces:
        columns = rr.LineStrips3D.columns(strips=pieces, colors=np.array(shades)).partition(lengths)
        arm.send("trail", rr.LineStrips3D.from_fields(radii=0.004), columns, per_episode=False)


def _shades(error: np.ndarray) -> np.ndarray:
    """Return colors (T, 3) of errors (T,) m: green at 0, yellow at WORST_M / 2, red from WORST_M on."""
    share = np.clip(error / WORST_M, 0.0, 1.0)[:, None]
    low, middle, high = np.array([[61, 170, 109], [235, 200, 60], [255, 60, 60]], dtype=float)
    warm = np.where(share < 0.5, low + 2 * share * (middle - low), middle + (2 * share - 1) * (high - middle))
    return warm.astype(np.uint8)


def _shown_geoms(model: mujoco.MjModel) -> np.ndarray:
    """Return the geoms in groups 0-2, which MuJoCo's viewer shows, except planes; if none exist, return all geoms."""
    shown = np.flatnonzero((model.geom_group < 3) & (model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE))
    return shown if len(shown) else np.arange(model.ngeom)


def _shown_bodies(model: mujoco.MjModel) -> list[int]:
    return sorted({int(body) for body in model.geom_bodyid[_shown_geoms(model)]})


def _link(base: str, model: mujoco.MjModel, body: int) -> str:
    return base + entity("links", model.body(body).name or f"body {body}")


def _height(model: mujoco.MjModel) -> float:
    """Return a height in m above the base at which a label does not hide the arm."""
    return 0.85 * float(np.linalg.norm(model.body_pos[1:], axis=1).sum())


def _poses(model: mujoco.MjModel, q: np.ndarray) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Return {body: (position (T, 3) m, quaternion (T, 4) x y z w)} in the base frame at angles q (T, n) rad."""
    data = mujoco.MjData(model)
    position, quaternion = np.empty((len(q), model.nbody, 3)), np.empty((len(q), model.nbody, 4))
    for k, angles in enumerate(q):
        data.qpos[:] = angles
        mujoco.mj_kinematics(model, data)
        position[k], quaternion[k] = data.xpos, np.roll(data.xquat, -1, axis=1)
    return {body: (position[:, body], quaternion[:, body]) for body in _shown_bodies(model)}


def _shapes(stream: rr.RecordingStream, model: mujoco.MjModel, body: int, path: str, colour: str) -> None:
    """Log the geoms of one link in the link's frame; geoms that are dark in the model get the arm's color."""
    for geom in _shown_geoms(model)[model.geom_bodyid[_shown_geoms(model)] == body]:
        own = 255 * model.geom_rgba[geom, :3]
        own = rgb(colour) if own.mean() < 100 else own
        shape = _shape(model, int(geom), own.astype(np.uint8))
        if shape is None:
            continue
        frame = f"{path}/geom{geom}"
        quaternion = np.roll(model.geom_quat[geom], -1)
        stream.log(frame, rr.Transform3D(translation=model.geom_pos[geom], quaternion=quaternion), static=True)
        stream.log(frame, shape, static=True)


def _shape(model: mujoco.MjModel, geom: int, colour: np.ndarray) -> rr.AsComponents | None:
    """Return Rerun's shape for a geom, in the geom's frame; None if Rerun has no shape (plane, height field)."""
    radius, half, _ = size = model.geom_size[geom]
    kind = mujoco.mjtGeom
    solid: dict[str, Any] = {"colors": colour, "fill_mode": rr.components.FillMode.Solid}
    match int(model.geom_type[geom]):
        case kind.mjGEOM_CAPSULE:
            below = [[0, 0, -half]]  # Rerun's capsule starts at the origin of its frame; MuJoCo's is centered there
            return rr.Capsules3D(lengths=2 * half, radii=radius, translations=below, **solid)
        case kind.mjGEOM_CYLINDER:
            return rr.Cylinders3D(lengths=2 * half, radii=radius, **solid)
        case kind.mjGEOM_SPHERE:
            return rr.Ellipsoids3D(radii=[radius], **solid)
        case kind.mjGEOM_ELLIPSOID:
            return rr.Ellipsoids3D(half_sizes=size, **solid)
        case kind.mjGEOM_BOX:
            return rr.Boxes3D(half_sizes=size, **solid)
        case kind.mjGEOM_MESH:
            mesh = model.mesh(model.geom_dataid[geom])
            vertices = model.mesh_vert[mesh.vertadr[0] : mesh.vertadr[0] + mesh.vertnum[0]]
            faces = model.mesh_face[mesh.faceadr[0] : mesh.faceadr[0] + mesh.facenum[0]]
            return rr.Mesh3D(vertex_positions=vertices, triangle_indices=faces, albedo_factor=colour)
    return None
