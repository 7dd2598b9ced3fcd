"""Whether an arm touches itself or the table, compiled, for many arms at once: the geoms of the robot's file.

Left out, because nothing there can go wrong or nothing can be told:

- of the table: geoms on the base, and on links that only vertical axes carry; no joint moves them up or down.
- of each other: links next to each other, which touch in their joint, and pairs of geoms that are near at q_home:
  two parts of a joint's housing two links apart, as in the Panda's shoulder, not a collision.

Where a file has geoms that collide, the others are for looking at and do not count. Planes and height fields are
surroundings, not the arm. Meshes count as their convex hulls, as in MuJoCo; a signed distance field as its sphere.
"""

from dataclasses import dataclass

import mujoco
import numpy as np

from r2s.compiled import njit
from r2s.errors import UserError
from r2s.physics import convex
from r2s.physics.convex import BODY, BOUND, POSE, farthest, within
from r2s.physics.newton_euler import AXIS, FRAME, PLACE, links_of, product, spun, turned
from r2s.physics.robot import Robot

TABLE_M = 0.0  # height of the table in the base frame, by default
HOUSING_M = 0.045  # geoms nearer than this at q_home are parts of one joint's housing
LINK, LOCAL, WIDTH = BODY, BODY + 1, BODY + 1 + POSE  # of a row: the link that it moves with (-1: none), pose in it


@dataclass(frozen=True)
class Watched:
    """The geoms of a model that may touch something.

    Attributes:
        above: those to keep above the table. pairs: those to keep apart.
        link: (ngeom,), the number of the joint that moves each geom, from 1; 0: the base.
    """

    above: list[int]
    pairs: list[tuple[int, int]]
    link: np.ndarray


def watched(robot: Robot, model: mujoco.MjModel, *, table: bool = True) -> Watched:
    """Return what of `robot.model` may touch the table, where there is one, and itself."""
    link = np.searchsorted(model.jnt_bodyid, model.body_weldid[model.geom_bodyid], side="right")
    solid = ~np.isin(model.geom_type, [mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD])
    colliding = solid & ((model.geom_contype != 0) | (model.geom_conaffinity != 0))
    geoms = np.flatnonzero(colliding if colliding.any() else solid).tolist()
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    mujoco.mj_kinematics(model, data)
    lifted = np.abs(data.xaxis[:, 2]) <= 1 - 1e-9  # by this joint
    above = [g for g in geoms if table and lifted[: link[g]].any()]
    data.qpos[:] = robot.q_home
    mujoco.mj_kinematics(model, data)
    pairs = [
        (a, b)
        for a in geoms
        for b in geoms
        if link[b] - link[a] >= 2 and mujoco.mj_geomDistance(model, data, a, b, 1.0, None) >= HOUSING_M
    ]
    return Watched(above, pairs, link)


def name_of(model: mujoco.MjModel, geom: int) -> str:
    """Return "link 'hand'" for a geom of the body of that name."""
    body = model.geom_bodyid[geom]
    return f"link '{model.body(body).name}'" if model.body(body).name else f"the link of body {body}"


class Touching:
    """Whether arms touch themselves or the table; called with q (m, n) rad it returns (m,) bool.

    Attributes:
        names: of what can touch, such as "link 'link5' and link 'link1'", in the order of `first`.
    """

    def __init__(self, robot: Robot, *, table: float | None = TABLE_M, more: float = 0.0):
        model = robot.model(gravity=False)
        stands = table is None
        table = TABLE_M if table is None else table
        found = watched(robot, model, table=bool(np.isfinite(table)))
        geoms = sorted({*found.above, *(g for pair in found.pairs for g in pair)})
        self._links = links_of(robot, robot.mass, robot.com, robot.inertia)
        self._bodies, self._vertices = _bodies(robot, model, geoms, found.link, self._links)
        row = {g: k for k, g in enumerate(geoms)}
        self._above = np.array([row[g] for g in found.above], dtype=int)
        self._pairs = np.array([(row[a], row[b]) for a, b in found.pairs], dtype=int).reshape(-1, 2)
        self._table, self._more = float(table), float(more)
        self.names = [f"{name_of(model, g)} and the table" for g in found.above]
        self.names += [f"{name_of(model, a)} and {name_of(model, b)}" for a, b in found.pairs]
        at_home = int(self.first(robot.q_home[None])[0])
        if stands and 0 <= at_home < len(found.above):
            self._table, at_home = -np.inf, -1
        if at_home >= 0:
            raise UserError(f"{robot.name}: {self.names[at_home]} at {table:g} m touch already at robot.q_home")

    def __call__(self, q: np.ndarray) -> np.ndarray:
        """Return (m,), whether the arms at q (m, n) rad touch anything."""
        return self.first(q) >= 0

    def first(self, q: np.ndarray) -> np.ndarray:
        """Return (m,), the place in `names` of the first that touches, -1 where nothing does."""
        q = np.ascontiguousarray(q, dtype=float)
        out = np.empty(len(q), dtype=np.int64)
        _first(
            q, self._links, self._bodies, self._vertices, self._above, self._pairs, self._table, self._more, out
        )  # fmt: skip
        return out


def touching(robot: Robot, *, table: float | None = TABLE_M, more: float = 0.0) -> Touching:
    """Return what tells of many arms at once whether they touch themselves or the table.

    Args:
        robot: its file's geoms.
        table: m, its height in the base frame; -inf where there is none. None: TABLE_M, or none where the arm is
            below that at q_home, as one that hangs is.
        more: m, of distance that already counts as touching.

    Raises:
        UserError: it touches at q_home.
    """
    return Touching(robot, table=table, more=more)


def _bodies(
    robot: Robot, model: mujoco.MjModel, geoms: list[int], link: np.ndarray, links: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows (G, WIDTH) of these geoms and the vertices (V, 3) of their hulls."""
    data = mujoco.MjData(model)
    data.qpos[:] = np.zeros(robot.n)
    mujoco.mj_kinematics(model, data)
    frames = np.empty((robot.n, POSE))
    _place_links(np.zeros(robot.n), links, frames)
    rows, vertices = np.zeros((len(geoms), WIDTH)), [np.zeros((0, 3))]
    for row, g in zip(rows, geoms, strict=True):
        place, axes = data.geom_xpos[g], data.geom_xmat[g].reshape(3, 3)
        row[LINK] = link[g] - 1
        if link[g]:
            frame = frames[link[g] - 1]
            turn = frame[3:].reshape(3, 3)
            place, axes = turn.T @ (place - frame[:3]), turn.T @ axes
        row[LOCAL : LOCAL + 3], row[LOCAL + 3 :] = place, axes.ravel()
        row[convex.FIRST] = sum(len(v) for v in vertices)
        row[convex.KIND], row[convex.ROUND], row[convex.SIZE : convex.SIZE + 3], hull = _shape(model, g)
        row[convex.COUNT], row[BOUND] = len(hull), model.geom_rbound[g]
        vertices.append(hull)
    return rows, np.concatenate(vertices)


def _shape(model: mujoco.MjModel, g: int) -> tuple[int, float, np.ndarray, np.ndarray]:
    """Return kind, radius, half sizes (3,) and hull (V, 3) of a geom."""
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
def _place_links(q, links, frames):
    """Write the poses (n, POSE) of the links at q (n,)."""
    R = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    x, y, z = 0.0, 0.0, 0.0
    for i in range(len(q)):
        k = links[i]
        dx, dy, dz = turned(R, k[PLACE], k[PLACE + 1], k[PLACE + 2])
        x, y, z = x + dx, y + dy, z + dz
        R = spun(product(R, k, FRAME), k[AXIS], k[AXIS + 1], k[AXIS + 2], q[i])
        _write(frames[i], x, y, z, R)


@njit(cache=True, inline="always")
def _write(pose, x, y, z, R):
    pose[0], pose[1], pose[2] = x, y, z
    pose[3], pose[4], pose[5], pose[6], pose[7], pose[8] = R[0], R[1], R[2], R[3], R[4], R[5]
    pose[9], pose[10], pose[11] = R[6], R[7], R[8]


@njit(cache=True, error_model="numpy")
def _first(q, links, bodies, vertices, above, pairs, table, more, out):
    frames, poses, work = np.empty((len(links), POSE)), np.empty((len(bodies), POSE)), np.empty((10, 3))
    for arm in range(len(q)):
        _place_links(q[arm], links, frames)
        for g in range(len(bodies)):
            body, link = bodies[g], int(bodies[g, LINK])
            if link < 0:
                for c in range(POSE):
                    poses[g, c] = body[LOCAL + c]
                continue
            f = frames[link]
            R = (f[3], f[4], f[5], f[6], f[7], f[8], f[9], f[10], f[11])
            x, y, z = turned(R, body[LOCAL], body[LOCAL + 1], body[LOCAL + 2])
            _write(poses[g], f[0] + x, f[1] + y, f[2] + z, product(R, body, LOCAL + 3))
        out[arm] = _look(bodies, poses, vertices, above, pairs, table, more, work)


@njit(cache=True, error_model="numpy")
def _look(bodies, poses, vertices, above, pairs, table, more, work):
    """Return the number of the first that touches, -1 if nothing does."""
    for k in range(len(above)):
        body, pose = bodies[above[k]], poses[above[k]]
        if pose[2] - body[BOUND] > table + more:
            continue
        if farthest(body, vertices, pose, 0.0, 0.0, -1.0)[2] - body[convex.ROUND] <= table + more:
            return k
    for k in range(len(pairs)):
        a, b = pairs[k, 0], pairs[k, 1]
        p, r = poses[a], poses[b]
        x, y, z = p[0] - r[0], p[1] - r[1], p[2] - r[2]
        far = bodies[a, BOUND] + bodies[b, BOUND] + more
        if x * x + y * y + z * z <= far * far and within(bodies[a], p, bodies[b], r, vertices, more, work):
            return len(above) + k
    return -1
