"""Export an identified surface to other simulators as contact parameters of MuJoCo and SDF, linearized at 10 N.

MuJoCo's contact force is d (aref - a0) / A with impedance d, reference acceleration aref, inverse mass A and free
acceleration a0 (MuJoCo documentation, Computation: Constraint model). For a small impedance d, a contact is a spring
and damper with coefficients solref / A (N/m, Ns/m). A high `impratio` makes friction stiff although the impedance d
is small.
"""

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from r2s.identification.contact.surface_space import LOAD
from r2s.physics.description import add_text, pose_words, words, write_xml
from r2s.physics.payload import ee_pose
from r2s.physics.robot import Robot
from r2s.physics.surface import Surface
from r2s.physics.welds import make_pose

IMPEDANCE = 0.01  # MuJoCo's impedance d, which is also the relative error of the spring
WIDE = 1.0  # m, half the edge length with which a viewer displays a plane
IMPRATIO = 1000.0  # makes the impedance of friction 0.91


def linearized(surface: Surface, load: float = LOAD) -> tuple[float, float, float]:
    """Return slope (N/m), damping (Ns/m) and depth (m) of the spring that is tangent to the force curve at `load` N.

    The spring's force is zero down to `depth`, so a simulated plane with this spring lies `depth` below the surface.
    """
    depth = float((load / surface.coefficient) ** (1.0 / surface.exponent))
    slope = load * float(surface.exponent) / depth
    return slope, load * float(surface.damping), depth - load / slope


def inverse_mass(robot: Robot) -> float:
    """Return the last link's inverse mass `body_invweight0`, 1/kg, which MuJoCo uses for contacts of the tip."""
    model = robot.model(gravity=False)
    return float(model.body_invweight0[model.jnt_bodyid[-1], 0])


def mujoco_contact(surface: Surface, inverse_mass: float) -> dict[str, Any]:
    """Return MuJoCo's parameters of the contact between the plane and a body with `inverse_mass`, 1/kg.

    solref is (-stiffness, -damping). The plane must be fixed. The geoms of body and plane must both have these
    contact parameters.
    """
    slope, damping, deeper = linearized(surface)
    share = (1.0 - IMPEDANCE) * inverse_mass
    return {
        "solref": [-slope * share, -damping * share],
        "solimp": [IMPEDANCE, IMPEDANCE, 0.001, 0.5, 2.0],
        "friction": [surface.friction, 0.0, 0.0],
        "condim": 3,
        "cone": "elliptic",
        "impratio": IMPRATIO,
        "pos_m": (surface.point - deeper * surface.normal).tolist(),
        "zaxis": surface.normal.tolist(),
        "inverse_mass_per_kg": inverse_mass,
        "slope_N_per_m": slope,
        "damping_Ns_per_m": damping,
    }


def sdf_surface(surface: Surface) -> str:
    """Return the <surface> element of an SDF collision, with ODE's kp and kd in N/m and Ns/m."""
    slope, damping, _ = linearized(surface)
    mu = f"<mu>{surface.friction:.6g}</mu><mu2>{surface.friction:.6g}</mu2>"
    ode = f"<kp>{slope:.6g}</kp><kd>{damping:.6g}</kd><min_depth>0</min_depth>"
    return f"<surface><friction><ode>{mu}</ode></friction><contact><ode>{ode}</ode></contact></surface>"


def write_surface(folder: Path, robot: Robot, surface: Surface) -> None:
    """Write a surface and the tool's tip into arm.xml, the surface into surface.sdf, and the tip into arm.sdf.

    The surface is a plane or a box. In arm.xml, only surface and tip can touch. If arm.sdf is missing, the function
    does not create it.

    Args:
        folder: output of `write_description`. robot: an arm with a tool. surface: the surface, without batch axes.
    """
    site, own_axes = ee_pose(robot)
    tip, radius = site + own_axes @ robot.tool.tip, robot.tool.radius  # type: ignore[union-attr]
    path = folder / "arm.xml"
    model = mujoco.MjModel.from_xml_path(str(path))
    contact = mujoco_contact(surface, float(model.body_invweight0[model.jnt_bodyid[-1], 0]))
    across = np.cross(surface.normal, np.eye(3)[np.abs(surface.normal).argmin()])
    across /= np.linalg.norm(across)
    axes = np.stack([across, np.cross(surface.normal, across), surface.normal], -1)
    axes, place = axes if surface.axes is None else np.asarray(surface.axes), np.array(contact["pos_m"])
    root = ET.parse(path).getroot()
    for option in root.iter("option"):
        option.attrib |= {"cone": contact["cone"], "impratio": repr(contact["impratio"])}
    own = {key: words(np.array(contact[key])) for key in ("solref", "solimp", "friction")} | {"condim": "3"}
    shape = {"type": "plane", "size": f"{WIDE} {WIDE} 0.01"}
    if surface.half is not None:
        shape = {"type": "box", "size": words(np.asarray(surface.half))}
    shape |= {"pos": words(place), "xyaxes": words(axes[:, :2].T.ravel())}
    sphere = {"type": "sphere", "size": repr(radius), "pos": words(tip)}
    ET.SubElement(list(root.iter("body"))[-1], "geom", {"name": "tip"} | sphere | own)
    ET.SubElement(next(root.iter("worldbody")), "geom", {"name": "surface"} | shape | own)
    write_xml(path, root)
    _write_sdf(folder, surface, make_pose(place, axes), (tip, radius))


def _write_sdf(folder: Path, surface: Surface, pose: np.ndarray, tip: tuple[np.ndarray, float]) -> None:
    """Write surface.sdf with the surface at `pose` (4, 4), and add the sphere `tip` (center, radius) to arm.sdf."""
    root = ET.Element("sdf", version="1.9")
    solid = ET.SubElement(root, "model", name="surface")
    add_text(solid, static="true", pose=pose_words(pose))
    geometry = _collision(ET.SubElement(solid, "link", name="surface"), "surface", surface)
    if surface.half is None:
        add_text(ET.SubElement(geometry, "plane"), normal="0 0 1", size=f"{2 * WIDE} {2 * WIDE}")
    else:
        add_text(ET.SubElement(geometry, "box"), size=words(2 * np.asarray(surface.half)))
    write_xml(folder / "surface.sdf", root)
    path, (place, radius) = folder / "arm.sdf", tip
    if path.is_file():
        root = ET.parse(path).getroot()
        geometry = _collision(list(root.iter("link"))[-1], "tip", surface, f"{words(place)} 0 0 0")
        add_text(ET.SubElement(geometry, "sphere"), radius=repr(radius))
        write_xml(path, root)


def _collision(link: ET.Element, name: str, surface: Surface, pose: str = "0 0 0 0 0 0") -> ET.Element:
    """Append a collision with a surface's parameters to an SDF link; return the collision's empty <geometry>."""
    collision = ET.SubElement(link, "collision", name=name)
    add_text(collision, pose=pose)
    geometry = ET.SubElement(collision, "geometry")
    collision.append(ET.fromstring(sdf_surface(surface)))
    return geometry
