"""Remove a known payload's torque from a recording."""

from dataclasses import replace

import mujoco
import numpy as np

from r2s.identification.residuals.zero_phase import FRICTION_CUTOFF
from r2s.physics.payload import Payload, with_payload
from r2s.physics.rigid_body import mujoco_inverse_dynamics, set_links
from r2s.physics.robot import SIM_DT, Robot
from r2s.recordings.recording import Recording


def without_payload(robot: Robot, recording: Recording, payload: Payload, cutoff_hz: float) -> Recording:
    """Return the recording with the payload's torque subtracted from tau.

    Rigid-body torque is linear in the inertial parameters of a payload. Measured and motor torque contain the weight
    of the payload. Commands do not contain a declared payload's weight, because gravity compensation adds it.

    Args:
        payload: the known payload. cutoff_hz: the identification's cutoff for torque; the cutoff for acceleration is
            higher.
    """
    grid = recording.resample(SIM_DT)
    smooth = grid.smooth(min(FRICTION_CUTOFF * cutoff_hz, 0.4 * recording.rate_hz))
    ddq = smooth.derivative(smooth.dq)
    own = robot.mass, robot.com, robot.inertia
    model = robot.model(gravity=recording.torque != "commanded")
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_LIMIT)
    loaded = np.zeros_like(ddq)
    for sign, links in ((-1.0, own), (1.0, with_payload(robot, payload, own))):
        set_links(model, *links, armature=robot.armature)
        loaded += sign * mujoco_inverse_dynamics(model, smooth.q, smooth.dq, ddq)
    tau, of_grid = recording.tau.copy(), {int(grid.trajectory[s.start]): s for s in grid.stretches}
    for s in recording.stretches:
        if (rows := of_grid.get(int(recording.trajectory[s.start]))) is None:  # trajectory shorter than a step
            continue
        for j in range(robot.n):
            tau[s, j] -= np.interp(recording.t[s], grid.t[rows], loaded[rows, j])
    return replace(recording, tau=tau)
