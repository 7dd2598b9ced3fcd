"""An identified surface for other simulators: contact parameters of MuJoCo and SDF, linear about 10 N.

MuJoCo's contact force is d (aref - a0) / A with impedance d, inverse mass A and the acceleration a0 without contact
(MuJoCo documentation, Computation: Constraint model). A small d leaves a spring and damper of N/m and Ns/m divided by
A; a high `impratio` keeps friction stiff beside it.
"""

from typing import Any

from r2s.identification.contact.surface_space import LOAD
from r2s.physics.robot import Robot
from r2s.physics.surface import Surface

IMPEDANCE = 0.01  # of MuJoCo, so that the spring is exact to this share
IMPRATIO = 1000.0  # makes the impedance of friction 0.91


def linearized(surface: Surface, load: float = LOAD) -> tuple[float, float, float]:
    """Return slope (N/m), damping (Ns/m) and depth (m) of the spring that touches the force curve at `load` N.

    The depth is that at which the spring's force is 0: the plane lies so much deeper.
    """
    depth = float((load / surface.coefficient) ** (1.0 / surface.exponent))
    slope = load * float(surface.exponent) / depth
    return slope, load * float(surface.damping), depth - load / slope


def inverse_mass(robot: Robot) -> float:
    """Return 1/kg, MuJoCo's inverse mass of the last link (`body_invweight0`), which a geom of the tool has."""
    model = robot.model(gravity=False)
    return float(model.body_invweight0[model.jnt_bodyid[-1], 0])


def mujoco_contact(surface: Surface, inverse_mass: float) -> dict[str, Any]:
    """Return solref, solimp, friction, cone and impratio for a body of `inverse_mass`, 1/kg, on the plane.

    solref is negative: (-stiffness, -damping). condim is 3; the other geom is fixed and has the same values.
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
    """Return the <surface> element of an SDF collision (ODE's kp and kd, N/m and Ns/m)."""
    slope, damping, _ = linearized(surface)
    mu = f"<mu>{surface.friction:.6g}</mu><mu2>{surface.friction:.6g}</mu2>"
    ode = f"<kp>{slope:.6g}</kp><kd>{damping:.6g}</kd><min_depth>0</min_depth>"
    return f"<surface><friction><ode>{mu}</ode></friction><contact><ode>{ode}</ode></contact></surface>"
