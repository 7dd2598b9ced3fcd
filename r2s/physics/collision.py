"""Check many arms for collisions in compiled code: each arm with itself and the table.

r2s checks the geoms of the robot's file, except planes and height fields. If the file enables collision only for some
geoms, r2s checks only these geoms. Convex hulls replace meshes, as in MuJoCo, and bounding spheres replace signed
distance fields. The check omits some pairs:

- The check omits a geom and the table if the geom's height is constant: either no joint moves the geom, or only
  joints with vertical axes do.
- The check omits two geoms of neighboring links, because neighboring links touch at their joint.
- The check omits two geoms closer than HOUSING_M at q_home, because both geoms may belong to the housing of one
  joint. In the Panda's shoulder, for example, one housing contains geoms of links that are two joints apart.
"""

from collections.abc import Collection
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np

from r2s.compiled import njit
from r2s.errors import UserError
from r2s.physics import convex
from r2s.physics.convex import BODY, BOUND, separation, support_point
from r2s.physics.kinematics import POSE, link_frames, pose_axes, write_pose
from r2s.physics.newton_euler import links_of, product, rotate
from r2s.physics.obstacle import PREFIX
from r2s.physics.robot import Robot

TABLE_M = 0.0  # m, default height of the table in the base frame
HOUSING_M = 0.045  # m, geoms closer than this at q_home are parts of one joint's housing
LINK, LOCAL, WIDTH = BODY, BODY + 1, BODY + 1 + POSE  # columns of a body: link (-1: base), pose in the link's frame


@dataclass(frozen=True)
class CollisionPairs:
    """Pairs of geoms whose distance the collision check computes.

    Attributes:
        above: ids of geoms to check against the table. pairs: pairs of geom ids; pairs with an obstacle come first.
        link: (ngeom,) number of each geom's link, from 1; 0: the base.
    """

    above: list[int]
    pairs: list[tuple[int, int]]
    link: np.ndarray


def collision_pairs(
    robot: Robot, model: mujoco.MjModel, *, table: bool = True, may_touch: Collection[tuple[str, str]] = ()
) -> CollisionPairs:
    """Return the pairs of geoms to check; table: whether to check for collisions with the table.

    may_touch: pairs that the check omits; a pair contains two body names, or a body name and "table".
    """
    link = np.searchsorted(model.jnt_bodyid, model.body_weldid[model.geom_bodyid], side="right")
    box = np.array([model.geom(g).name.startswith(PREFIX) for g in range(model.ngeom)], dtype=bool)
    solid = ~np.isin(model.geom_type, [mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD]) & ~box
    colliding = solid & ((model.geom_contype != 0) | (model.geom_conaffinity != 0))
    geoms = np.flatnonzero(colliding if colliding.any() else solid).tolist()
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    mujoco.mj_kinematics(model, data)
    lifts = np.abs(data.xaxis[:, 2]) <= 1 - 1e-9  # joints with an axis that is not vertical
    free = {frozenset(pair) for pair in may_touch}
    body = [model.body(b).name for b in model.geom_bodyid]
    above = [g for g in geoms if table and lifts[: link[g]].any() and {body[g], "table"} not in free]
    data.qpos[:] = robot.q_home
    mujoco.mj_kinematics(model, data)
    pairs = [
        (a, b)
        for a in geoms
        for b in geoms
        if link[b] - link[a] >= 2
        and {body[a], body[b]} not in free
        and mujoco.mj_geomDistance(model, data, a, b, 1.0, None) >= HOUSING_M
    ]
    around = [(b, g) for b in np.flatnonzero(box).tolist() for g in geoms if link[g] > 0]
    return CollisionPairs(above, around + pairs, link)


def link_name(model: mujoco.MjModel, geom: int) -> str:
    """Return the name of a geom's body for messages: "link 'hand'" or, for an obstacle, "obstacle 1"."""
    if model.geom(geom).name.startswith(PREFIX):
        return str(model.geom(geom).name)
    body = model.geom_bodyid[geom]
    return f"link '{model.body(body).name}'" if model.body(body).name else f"the link of body {body}"


class Scene(NamedTuple):
    """Bodies (G, WIDTH), vertices (V, 3) m of their hulls, and the height of the table, m.

    above: (A,), indices of bodies to check against the table. pairs: (P, 2), pairs of body indices to check.
    """

    bodies: np.ndarray
    vertices: np.ndarray
    above: np.ndarray
    pairs: np.ndarray
    table: float


class CollisionCheck:
    """Collision check of many arms: a call with q (m, n) rad returns whether each arm collides, (m,) bool.

    Attributes:
        names: names of the checked pairs, such as "link 'link5' and link 'link1'", in the order of the check.
        links, scene: arrays for the compiled functions `body_poses` and `pair_distance`.

    Args:
        robot: the arm, whose file contains the geoms.
        table: m, height of the table in the base frame; -inf: no table; None: TABLE_M, or no table for an arm that
            reaches below TABLE_M at q_home, such as a hanging arm.
        may_touch: pairs that the check omits; a pair contains two body names, or a body name and "table".

    Raises:
        UserError: a checked pair touches at q_home.
    """

    def __init__(
        self,
        robot: Robot,
        *,
        table: float | None = TABLE_M,
        may_touch: Collection[tuple[str, str]] = (),
    ):
        model = robot.model(gravity=False)
        optional = table is None
        table = TABLE_M if table is None else table
        found = collision_pairs(robot, model, table=bool(np.isfinite(table)), may_touch=may_touch)
        geoms = sorted({*found.above, *(g for pair in found.pairs for g in pair)})
        self.links = links_of(robot, robot.mass, robot.com, robot.inertia)
        bodies, vertices = _bodies(robot, model, geoms, found.link, self.links)
        row = {g: k for k, g in enumerate(geoms)}
        above = np.array([row[g] for g in found.above], dtype=int)
        pairs = np.array([(row[a], row[b]) for a, b in found.pairs], dtype=int).reshape(-1, 2)
        self.scene = Scene(bodies, vertices, above, pairs, float(table))
        self.names = [f"{link_name(model, g)} and the table" for g in found.above]
        self.names += [f"{link_name(model, a)} and {link_name(model, b)}" for a, b in found.pairs]
        at_home = int(self.first_contact(robot.q_home[None])[0])
        if optional and 0 <= at_home < len(found.above):
            self.scene, at_home = self.scene._replace(table=-np.inf), -1
        if at_home >= 0:
            raise UserError(f"{robot.name}: {self.names[at_home]} at {table:g} m touch at robot.q_home")

    def __call__(self, q: np.ndarray) -> np.ndarray:
        """Return whether each arm at q (m, n) rad collides, (m,) bool."""
        return self.first_contact(q) >= 0

    def first_contact(self, q: np.ndarray) -> np.ndarray:
        """Return the index (m,) in `names` of each arm's first colliding pair; -1: no collision."""
        q = np.ascontiguousarray(q, dtype=float)
        out = np.empty(len(q), dtype=np.int64)
        _first_contacts(q, self.links, self.scene, out)
        return out

    def distances(self, q: np.ndarray) -> np.ndarray:
        """Return the distances (m, K) m of the pairs in `names` at q (m, n) rad, 0 or less for overlapping pairs."""
        q = np.ascontiguousarray(q, dtype=float)
        out = np.empty((len(q), len(self.names)))
        _distances(q, self.links, self.scene, out)
        return out


def empty_scene() -> Scene:
    """Return a scene without bodies and pairs, so that no arm collides."""
    none = np.zeros((0, 2), dtype=int)
    return Scene(np.zeros((0, WIDTH)), np.zeros((0, 3)), np.zeros(0, dtype=int), none, -np.inf)


def _bodies(
    robot: Robot, model: mujoco.MjModel, geoms: list[int], link: np.ndarray, links: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the geoms as rows (G, WIDTH) of `Scene.bodies`, and the vertices (V, 3) m of their convex hulls."""
    data = mujoco.MjData(model)
    data.qpos[:] = np.zeros(robot.n)
    mujoco.mj_kinematics(model, data)
    frames = np.empty((robot.n, POSE))
    link_frames(links, np.zeros(robot.n), frames, np.empty((robot.n, 3)))
    rows, vertices = np.zeros((len(geoms), WIDTH)), [np.zeros((0, 3))]
    for row, g in zip(rows, geoms, strict=True):
        place, axes = data.geom_xpos[g], data.geom_xmat[g].reshape(3, 3)
        row[LINK] = link[g] - 1
        if link[g]:
            frame = frames[link[g] - 1]
            rotation = frame[3:].reshape(3, 3)
            place, axes = rotation.T @ (place - frame[:3]), rotation.T @ axes
        row[LOCAL : LOCAL + 3], row[LOCAL + 3 :] = place, axes.ravel()
        row[convex.FIRST] = sum(len(v) for v in vertices)
        row[convex.KIND], row[convex.RADIUS], row[convex.SIZE : convex.SIZE + 3], hull = _shape(model, g)
        row[convex.COUNT], row[BOUND] = len(hull), model.geom_rbound[g]
        vertices.append(hull)
    return rows, np.concatenate(vertices)


def _shape(model: mujoco.MjModel, g: int) -> tuple[int, float, np.ndarray, np.ndarray]:
    """Return a geom's kind, radius m, half sizes (3,) m and convex hull (V, 3) m."""
    size, kind, none = model.geom_size[g], mujoco.mjtGeom, np.zeros((0, 3))
    match model.geom_type[g]:
        case kind.mjGEOM_SPHERE:
            return convex.POINT, size[0], np.zeros(3), none
        case kind.mjGEOM_CAPSULE:
            return convex.SEGMENT, size[0], np.array([0, 0, size[1]]), none
        case kind.mjGEOM_CYLINDER:
            return convex.CYLINDER, 0.0, np.array([size[0], size[0], size[1]]), none
        case kind.mjGEOM_BOX:
            return convex.BOX, 0.0, size, none
        case kind.mjGEOM_ELLIPSOID:
            return convex.ELLIPSOID, 0.0, size, none
        case kind.mjGEOM_MESH:
            from scipy.spatial import ConvexHull

            mesh = model.geom_dataid[g]
            first = model.mesh_vertadr[mesh]
            points = model.mesh_vert[first : first + model.mesh_vertnum[mesh]].astype(float)
            return convex.HULL, 0.0, np.zeros(3), points[ConvexHull(points).vertices]
        case _:
            return convex.POINT, model.geom_rbound[g], np.zeros(3), none


@njit(cache=True, error_model="numpy")
def body_poses(links, bodies, q, frames, poses):
    """Write the poses (G, POSE) of the bodies at q (n,) rad; `frames` (n, POSE) is a scratch array."""
    link_frames(links, q, frames, np.empty((len(links), 3)))
    for g in range(len(bodies)):
        body, link = bodies[g], int(bodies[g, LINK])
        if link < 0:
            for c in range(POSE):
                poses[g, c] = body[LOCAL + c]
            continue
        f = frames[link]
        R = pose_axes(f)
        x, y, z = rotate(R, body[LOCAL], body[LOCAL + 1], body[LOCAL + 2])
        write_pose(poses[g], f[0] + x, f[1] + y, f[2] + z, product(R, body, LOCAL + 3))


@njit(cache=True, error_model="numpy", forceinline=True)
def pair_distance(scene, k, enough, poses, work):
    """Return pair k's distance, m, or a lower bound of it that exceeds `enough` m. work: (10, 3), scratch array."""
    bodies, vertices, above, pairs, table = scene
    if k < len(above):
        body, pose = bodies[above[k]], poses[above[k]]
        bound = pose[2] - body[BOUND] - table
        if bound > enough:
            return bound
        return support_point(body, vertices, pose, 0.0, 0.0, -1.0)[2] - body[convex.RADIUS] - table
    a, b = pairs[k - len(above), 0], pairs[k - len(above), 1]
    p, r = poses[a], poses[b]
    x, y, z = p[0] - r[0], p[1] - r[1], p[2] - r[2]
    bound = np.sqrt(x * x + y * y + z * z) - bodies[a, BOUND] - bodies[b, BOUND]
    if bound > enough:
        return bound
    return separation(enough, bodies[a], p, bodies[b], r, vertices, work)


@njit(cache=True, error_model="numpy")
def _first_contacts(q, links, scene, out):
    bodies = scene.bodies
    frames, poses, work = np.empty((len(links), POSE)), np.empty((len(bodies), POSE)), np.empty((10, 3))
    for arm in range(len(q)):
        body_poses(links, bodies, q[arm], frames, poses)
        out[arm] = -1
        for k in range(len(scene.above) + len(scene.pairs)):
            if pair_distance(scene, k, 0.0, poses, work) <= 0.0:
                out[arm] = k
                break


@njit(cache=True, error_model="numpy")
def _distances(q, links, scene, out):
    bodies = scene.bodies
    frames, poses, work = np.empty((len(links), POSE)), np.empty((len(bodies), POSE)), np.empty((10, 3))
    for arm in range(len(q)):
        body_poses(links, bodies, q[arm], frames, poses)
        for k in range(out.shape[1]):
            out[arm, k] = pair_distance(scene, k, np.inf, poses, work)
