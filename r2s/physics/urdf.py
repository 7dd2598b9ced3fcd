"""URDF reader: links, joints, limits, rotor inertia and primitive shapes.

The reader ignores meshes, materials, simulator elements, and the inertia of links that do not move: the base and
links fixed to the base. A link that is fixed to a moving link becomes part of the moving link.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from xml.etree import ElementTree as ET

import mujoco
import numpy as np

from r2s.errors import UserError, choices, nearest
from r2s.physics.welds import Inertia, about, combined

MOVING, FIXED = ("revolute", "continuous"), "fixed"
ROUNDED = 1e-9  # tolerated round-off of a tensor in the file, as a share of its largest moment
DRAKE = "http://drake.mit.edu"  # XML namespace of Drake's rotor elements; URDF itself has no rotor elements
ROTOR, GEAR = f"{{{DRAKE}}}rotor_inertia", f"{{{DRAKE}}}gear_ratio"
ET.register_namespace("drake", DRAKE)
NO_RANGE = "limits 0 to 0"  # value of `info` that marks a joint with a range of 0 to 0
COUNT = {"xyz": 3, "rpy": 3, "size": 3}  # attribute -> how many numbers it contains; other attributes contain one


def is_urdf(path: Path) -> bool:
    """Return whether a file is a URDF, by its suffix or its root element."""
    if path.suffix.lower() == ".urdf":
        return True
    try:
        with path.open("rb") as file:
            return next(ET.iterparse(file, ["start"]))[1].tag == "robot"
    except ET.ParseError:
        return False


def read_urdf(path: Path, lock: Mapping[str, float] | None = None) -> tuple[mujoco.MjSpec, np.ndarray]:
    """Return the spec of a URDF and the joints' velocity limits (n,) rad/s; nan: no limit.

    The spec has the file's body and joint names, joint damping and friction. `lock` ({name: rad or m}) fixes joints
    at the given positions. `lock` also fixes joints that mimic a locked joint, at the resulting positions.

    Raises:
        UserError: the file is not XML, not URDF, or not an arm of revolute (or continuous) joints.
    """
    return _Reader(path, lock or {}).spec()


class _Reader:
    def __init__(self, path: Path, lock: Mapping[str, float]):
        self.path = path
        try:
            root = ET.parse(path).getroot()
        except ET.ParseError as error:
            raise self._error(f"expected XML: {error}") from None
        if root.tag != "robot":
            raise self._error(f"expected the root element <robot>, got <{root.tag}>")
        if any("xacro" in element.tag for element in root.iter()):
            raise self._error("expected URDF, got xacro: convert it with `xacro FILE > arm.urdf`")
        self.name = root.get("name") or path.stem
        self.placed: dict[str, tuple[np.ndarray, np.ndarray]] = {}  # poses of locked joints
        self.links = self._named(root, "link")
        self.joints = self._named(root, "joint")
        self._lock({str(name): float(value) for name, value in lock.items()})
        self.rotors = dict(self._rotor(element) for element in root.findall("transmission"))
        self.children: dict[str, list[ET.Element]] = {name: [] for name in self.links}
        self.above: dict[str, ET.Element] = {}
        for joint in self.joints.values():
            self._attach(joint)
        roots = [name for name in self.links if name not in self.above]
        if len(roots) != 1:
            raise self._error(f"expected one root link, got {choices(roots) or 'none'}")
        self.root = roots[0]
        if loose := sorted(set(self.links) - {self.root, *(c for _, c in self._tree(self.root))}):
            raise self._error(f"link '{loose[0]}' is not connected to '{self.root}': its joints form a loop")

    def spec(self) -> tuple[mujoco.MjSpec, np.ndarray]:
        spec = mujoco.MjSpec()
        spec.modelname = self.name
        spec.compiler.degree = False
        world = spec.worldbody
        bodies = {self.root: world if self.root == world.name else world.add_body(name=self.root)}
        self._shapes(bodies[self.root], self.root)
        speeds = []
        for joint, child in self._tree(self.root):
            position, rotation = self._origin(joint, _what(joint))
            body = bodies[child] = bodies[self._end(joint, "parent")].add_body(name=child, pos=position)
            body.quat = _quaternion(rotation)
            if joint.get("type") != FIXED:
                body.mass, body.ipos, x = self._moved(child)
                body.explicitinertial = True
                body.fullinertia = [x[0, 0], x[1, 1], x[2, 2], x[0, 1], x[0, 2], x[1, 2]]
                speeds.append(self._move(body, joint))
            self._shapes(body, child)
        return spec, np.array(speeds)

    def _error(self, message: str) -> UserError:
        return UserError(f"robot.mjcf: {self.path.name}: {message}")

    def _named(self, root: ET.Element, tag: str) -> dict[str, ET.Element]:
        """Return {name: element} of all elements with a tag."""
        out: dict[str, ET.Element] = {}
        for element in root.findall(tag):
            name = element.get("name")
            if not name or name in out:
                raise self._error(f"two elements {tag} '{name}'" if name else f"a {tag} without a name")
            out[name] = element
        return out

    def _lock(self, at: dict[str, float]) -> None:
        """Fix the joints in `at` ({name: position, rad or m}) and the joints that mimic one of these joints."""
        for name in at:
            if name not in self.joints:
                joints = choices(self.joints)
                raise UserError(
                    f"robot.lock: no joint '{name}' in {self.path.name}; joints: {joints}{nearest(name, self.joints)}"
                )
        for name, joint in self.joints.items():
            if (mimic := joint.find("mimic")) is not None and mimic.get("joint") in at and name not in at:
                ratio, offset = (
                    self._number(mimic, k, _what(joint), d) for k, d in (("multiplier", "1"), ("offset", "0"))
                )
                at[name] = ratio * at[mimic.get("joint", "")] + offset
        for name, value in at.items():
            joint = self.joints[name]
            position, rotation = self._origin(joint, _what(joint))
            along = self._axis(joint)
            if joint.get("type") == "prismatic":
                position = position + rotation @ along * value
            elif joint.get("type") in MOVING:
                rotation = rotation @ about(along, value)
            else:
                raise self._error(f"{_what(joint)}: robot.lock: expected a hinge or slide, got {joint.get('type')}")
            self.placed[name] = position, rotation
            joint.set("type", FIXED)
            for mimic in joint.findall("mimic"):
                joint.remove(mimic)

    def _axis(self, joint: ET.Element) -> np.ndarray:
        """Return the unit axis (3,) of a joint, in the joint's frame."""
        axis = joint.find("axis")
        along = np.array([1.0, 0.0, 0.0]) if axis is None else self._numbers(axis, "xyz", "1 0 0", _what(joint))
        if np.linalg.norm(along) < 1e-6:
            raise self._error(f"{_what(joint)}: expected an axis, got 0 0 0")
        return along / np.linalg.norm(along)

    def _attach(self, joint: ET.Element) -> None:
        """Check a joint, and register the joint with its parent link and its child link."""
        kind, child = joint.get("type"), self._end(joint, "child")
        lock = f"; robot.lock={{{joint.get('name')}: 0}} welds it there"
        if kind not in (*MOVING, FIXED):
            hint = lock if kind == "prismatic" else ""
            raise self._error(f"{_what(joint)}: expected {choices((*MOVING, FIXED))}, got {kind}{hint}")
        if joint.find("mimic") is not None:
            raise self._error(f"{_what(joint)}: mimic joints are not supported{lock}")
        if child in self.above:
            raise self._error(f"link '{child}' has two joints, {_what(self.above[child])} and {_what(joint)}")
        self.above[child] = joint
        self.children[self._end(joint, "parent")].append(joint)

    def _rotor(self, transmission: ET.Element) -> tuple[str, float]:
        """Return a transmission's joint name and rotor inertia, kg m^2, reflected to the joint."""
        what, joint = f"transmission '{transmission.get('name')}'", transmission.find("joint")
        inertia = 0.0
        for actuator in transmission.findall("actuator"):
            rotor, gear = actuator.find(ROTOR), actuator.find(GEAR)
            ratio = 1.0 if gear is None else self._number(gear, "value", what)
            inertia += 0.0 if rotor is None else ratio**2 * self._number(rotor, "value", what)
        return "" if joint is None else joint.get("name", ""), inertia

    def _end(self, joint: ET.Element, which: str) -> str:
        """Return the name of a joint's parent or child link; which: "parent" or "child"."""
        element = joint.find(which)
        name = element.get("link", "") if element is not None else ""
        if name not in self.links:
            raise self._error(f"{_what(joint)}: no {which} link '{name}'{nearest(name, self.links)}")
        return name

    def _tree(self, link: str, *, fixed: bool = False) -> Iterator[tuple[ET.Element, str]]:
        """Yield the joints beyond `link` with their child links, parents first; `fixed`: follow only fixed joints."""
        for joint in self.children[link]:
            if not fixed or joint.get("type") == FIXED:
                child = self._end(joint, "child")
                yield joint, child
                yield from self._tree(child, fixed=fixed)

    def _numbers(self, element: ET.Element, key: str, default: str, owner: str) -> np.ndarray:
        """Return the numbers in the attribute `key` of an XML element as an array (k,)."""
        text = element.get(key, default)
        try:
            out = np.array([float(word) for word in text.split()])
        except ValueError:
            out = np.array([np.nan])
        count = COUNT.get(key, 1)
        if len(out) != count or not np.isfinite(out).all():
            what = f"{count} numbers" if count > 1 else "a number"
            raise self._error(f"{owner}: expected {what} in {key} of <{element.tag}>, got '{text}'")
        return out

    def _number(self, element: ET.Element | None, key: str, owner: str, default: str = "") -> float:
        return float(self._numbers(element if element is not None else ET.Element(key), key, default, owner)[0])

    def _origin(self, element: ET.Element, owner: str) -> tuple[np.ndarray, np.ndarray]:
        """Return position (3,) m and rotation (3, 3) of an element's <origin>, or of a locked joint."""
        if element.tag == "joint" and element.get("name") in self.placed:
            return self.placed[element.get("name", "")]
        origin = element.find("origin")
        origin = ET.Element("origin") if origin is None else origin
        angles = self._numbers(origin, "rpy", "0 0 0", owner)
        return self._numbers(origin, "xyz", "0 0 0", owner), _rotation(angles)

    def _move(self, body: mujoco.MjsBody, joint: ET.Element) -> float:
        """Add a joint to a body; return the joint's velocity limit, rad/s, or nan."""
        what = _what(joint)
        limit, dynamics = (joint.find(tag) for tag in ("limit", "dynamics"))
        hinge = body.add_joint(name=joint.get("name"), type=mujoco.mjtJoint.mjJNT_HINGE, axis=self._axis(joint))
        hinge.armature = self.rotors.get(joint.get("name", ""), 0.0)
        hinge.damping[0] = self._number(dynamics, "damping", what, "0")
        hinge.frictionloss = self._number(dynamics, "friction", what, "0")
        low, high, effort, speed = (
            self._number(limit, key, what, "0") for key in ("lower", "upper", "effort", "velocity")
        )
        if low > high:
            raise self._error(f"{what}: expected lower below upper, got {low:g} and {high:g} rad")
        # some files declare a continuous joint as revolute without a range; an explicit range of 0 to 0 is a mistake
        hinge.limited = int(joint.get("type") == "revolute" and low < high)
        if joint.get("type") == "revolute" and low == high and limit is not None and limit.get("upper"):
            hinge.info = NO_RANGE
        if hinge.limited:
            hinge.range = low, high
        hinge.actfrclimited = int(effort > 0)
        if effort > 0:
            hinge.actfrcrange = -effort, effort
        return speed if speed > 0 else np.nan

    def _moved(self, link: str) -> Inertia:
        """Return the inertia of a link with all links fixed to it, in the link's frame."""
        poses = {link: (np.zeros(3), np.eye(3))}
        for joint, child in self._tree(link, fixed=True):
            at, axes = poses[self._end(joint, "parent")]
            position, rotation = self._origin(joint, _what(joint))
            poses[child] = at + axes @ position, axes @ rotation
        parts = []
        for name, (at, axes) in poses.items():
            if (own := self._inertial(name)) is not None:
                parts.append((own[0], at + axes @ own[1], axes @ own[2] @ axes.T))
        if sum(m for m, _, _ in parts) <= 0:
            raise self._error(f"link '{link}': expected an <inertial> with a mass, as the link moves")
        return combined(parts)

    def _inertial(self, name: str) -> Inertia | None:
        """Return the inertia of a link alone, in the link's frame; None if the link has no mass."""
        what, element = f"link '{name}'", self.links[name].find("inertial")
        if element is None:
            return None
        mass = self._number(element.find("mass"), "value", what)
        if mass < 0:
            raise self._error(f"{what}: expected a mass of 0 or more, got {mass:g} kg")
        if mass == 0:
            return None
        tensor = element.find("inertia")
        xx, yy, zz = (self._number(tensor, key, what) for key in ("ixx", "iyy", "izz"))
        xy, xz, yz = (self._number(tensor, key, what, "0") for key in ("ixy", "ixz", "iyz"))
        x = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        moments = np.linalg.eigvalsh(x)
        if min(moments[0], moments[0] + moments[1] - moments[2]) < -ROUNDED * moments[2]:
            listed = ", ".join(f"{m:.4g}" for m in moments)
            raise self._error(
                f"{what}: expected moments >= 0 and none above the sum of the others, got {listed} kg m^2"
            )
        com, axes = self._origin(element, what)
        return mass, com, axes @ x @ axes.T

    def _shapes(self, body: mujoco.MjsBody, link: str) -> None:
        """Add boxes, cylinders and spheres of a link to its body; only shapes in <collision> have contact flags."""
        kinds = mujoco.mjtGeom
        for tag in ("visual", "collision"):
            for element in self.links[link].findall(tag):
                what = f"link '{link}'"
                at, axes = self._origin(element, what)
                for shape in element.findall("geometry/*"):
                    if shape.tag == "box":
                        kind, size = kinds.mjGEOM_BOX, 0.5 * self._numbers(shape, "size", "", what)
                    elif shape.tag == "sphere":
                        kind, size = kinds.mjGEOM_SPHERE, np.array([self._number(shape, "radius", what), 0, 0])
                    elif shape.tag == "cylinder":
                        radius, length = (self._number(shape, key, what) for key in ("radius", "length"))
                        kind, size = kinds.mjGEOM_CYLINDER, np.array([radius, 0.5 * length, 0])
                    else:
                        continue
                    contact = int(tag == "collision")
                    body.add_geom(
                        type=kind, size=size, pos=at, quat=_quaternion(axes), contype=contact, conaffinity=contact,
                        mass=0.0,
                    )  # fmt: skip


def _what(joint: ET.Element) -> str:
    return f"joint '{joint.get('name')}'"


def _rotation(rpy: np.ndarray) -> np.ndarray:
    """Return the matrix (3, 3) of Rz(yaw) Ry(pitch) Rx(roll), rad."""
    (a, b, c), (i, j, k) = np.cos(rpy), np.sin(rpy)
    return np.array(
        [
            [c * b, c * j * i - k * a, c * j * a + k * i],
            [k * b, k * j * i + c * a, k * j * a - c * i],
            [-j, b * i, b * a],
        ]
    )


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    """Return the quaternion (4,) w x y z of a rotation (3, 3)."""
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, rotation.flatten())
    return quat
