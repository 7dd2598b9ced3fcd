"""Guess an unknown surface from the external force on the tip: its place, direction and increase with depth."""

from collections.abc import Iterator

import numpy as np

from r2s.errors import UserError
from r2s.identification.contact.surface_space import LOAD, Gears, SurfaceSpace
from r2s.identification.contact.tip import TipMotion
from r2s.identification.parameters import ParameterSpace
from r2s.identification.residuals.torque_residual import TorqueResidual
from r2s.recordings.recording import Recording

MOVING = 0.02  # rad/s, speed below which a joint's friction is treated as unknown
KNOWN = 0.1  # standard error of a moving joint's friction, as a share of this friction
SURE = 4.0  # a force indicates contact if it exceeds this number of standard deviations
LEAST_S = 0.2  # s, least duration of contact
STIFFNESS = (5e2, 2e5)  # N/m, range of the first guess of the stiffness
FLAT = 3.0  # positions determine the normal if they spread FLAT times more along the plane than across it


def first_guesses(
    space: ParameterSpace, x: np.ndarray, recording: Recording, gears: Gears
) -> tuple[SurfaceSpace, list[np.ndarray]]:
    """Return the space of surfaces near a first guess of the plane, and start vectors u (8,) in this space.

    Args:
        space: parameter space of an arm with a tool. x: (P,), the arm's parameter values. recording: motion with
            commanded torque.
        gears: prior of the gears' deflection.

    Raises:
        UserError: the recording shows no contact.
    """
    tool = space.robot.tool
    assert tool is not None
    torque = TorqueResidual(space, recording)
    centre, force, sure = external_force(torque, x)
    if (found_s := torque.row_s * sure.sum()) < LEAST_S:
        raise UserError(
            f"data.contact: no contact found: {found_s:.2f} s with a force that friction cannot explain, at "
            f"least {LEAST_S:g} s are needed; does the tool of robot.tool, {1e3 * tool.radius:g} mm in radius, reach "
            "the surface?"
        )
    centre, force = centre[sure], force[sure]
    normal = force.sum(0) / np.linalg.norm(force.sum(0))
    origin = centre.mean(0)
    _, spread, axes = np.linalg.svd(centre - origin, full_matrices=False)
    normals = [normal]
    if spread[1] > FLAT * spread[2]:
        normals.insert(0, axes[2] * np.sign(axes[2] @ normal))
    surfaces = SurfaceSpace(origin - tool.radius * normals[0], normals[0], space.robot.tau_max, gears)
    return surfaces, list(_starts(surfaces, normals, centre - tool.radius * normals[0], force))


def _starts(
    surfaces: SurfaceSpace, normals: list[np.ndarray], points: np.ndarray, force: np.ndarray
) -> Iterator[np.ndarray]:
    """Yield a start vector u per normal (3,) and exponent; its stiffness comes from a line fit of height to force."""
    for normal in normals:
        height, load = (points - surfaces.origin) @ normal, np.maximum(force @ normal, 0.0)
        slope = np.polyfit(load, height, 1)[0] if np.ptp(load) > 0 else 0.0
        stiffness = float(np.clip(-1.0 / slope if slope < 0 else STIFFNESS[1], *STIFFNESS))
        above = float(np.median(height + (load - LOAD) / stiffness))
        for exponent in (1.1, 1.5):
            u = surfaces.unit(above, stiffness, exponent, 0.3)
            u[:2] += surfaces.tilt_of(normal)
            yield np.clip(u, 0.0, 1.0)


def external_force(torque: TorqueResidual, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return tip center (T, 3) m, force on the tip (T, 3) N, and whether the force is significant (T,), see SURE.

    A weighted fit to joint torques below 10 Hz yields the force; resting joints have low weights (unknown friction).
    """
    space, motion = torque.space, torque.motion
    d = space.dynamics(x)
    still = np.zeros(len(motion.q), dtype=bool)
    tip = TipMotion.of(space.robot, motion.q, motion.dq, torque.row_s, still, 0.0)
    jacobian = tip.jacobian(np.arange(len(motion.q)), np.zeros(3))
    sigma = np.where(np.abs(motion.dq) < MOVING, 1.0, KNOWN) * np.maximum(d.level, 1e-3 * space.robot.tau_max)
    weighted = jacobian / sigma[:, None] ** 2
    information = weighted @ jacobian.swapaxes(1, 2)
    force = np.linalg.solve(information, (weighted @ torque.error(d)[..., None]))[..., 0]
    certain = np.einsum("ti,tij,tj->t", force, information, force) > SURE**2
    return tip.centre, force, certain
