"""Compute rigid-body torque and its regressor for inertial parameters at the sample times of a torque residual."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from r2s.identification.residuals.modulating_functions import SlidingMotion
from r2s.identification.residuals.zero_phase import SmoothMotion
from r2s.physics.rigid_body import LinkInertia, mass_matrix, regressor, rigid_body
from r2s.physics.robot import Robot
from r2s.recordings.parts import joined_arrays


@dataclass(frozen=True)
class RigidBodyRows:
    """Rigid-body torque at the T sample times of a torque residual.

    Attributes:
        q: (T, n) rad, joint angles.
        rest: (T, n) Nm, torque of damping, springs and welded bodies in the robot's file. For commanded torque, the
            links' nominal gravity torque is subtracted, because the arm's gravity compensation adds it.
        y: (T, n, 10 n), regressor of rigid-body torque, gravity included, for the links' standard parameters.
        load: (T, n) Nm, magnitude of the nominal gravity torque.
        rotors: (T, n) rad/s^2, rotor acceleration; 0 if recorded torque excludes the torque on the rotors.
        encoder: (T, n) Nm per unit of `SlidingMotion.noise`, torque error due to encoder noise.
    """

    q: np.ndarray
    rest: np.ndarray
    y: np.ndarray
    load: np.ndarray
    rotors: np.ndarray
    encoder: np.ndarray

    @staticmethod
    def of(robot: Robot, m: SmoothMotion | SlidingMotion, torque: str) -> "RigidBodyRows":
        """Compute the rigid-body torque for a motion m, recorded with the kind of torque `torque`."""
        still, shape = np.zeros_like(m.q), (*m.q.shape, -1)
        commanded = torque == "commanded"
        rest, y = rigid_body(robot, m.q, m.dq, m.ddq, None if commanded else robot.gravity)
        rest = m.rows(rest - robot.armature * m.ddq)  # the torque residual adds the rotor torque of each candidate
        nominal = LinkInertia(robot.mass, robot.com, robot.inertia).standard().ravel()
        weight = m.rows(regressor(robot, m.q, still, still, robot.gravity).reshape(shape))
        y = m.rows(y.reshape(shape))
        if commanded:  # in place, as rows of an hour occupy hundreds of MB
            rest -= weight @ nominal
            y += weight
        encoder = np.zeros_like(rest)
        if isinstance(m, SlidingMotion):
            encoder = np.sqrt(m.rows(mass_matrix(robot, m.q) ** 2) @ m.encoder**2)
        return RigidBodyRows(
            q=m.rows(m.q),
            rest=rest,
            y=y,
            load=np.abs(weight @ nominal),
            # a link-side sensor does not measure the torque that accelerates the rotors
            rotors=np.zeros_like(rest) if torque == "measured" else m.rows(m.ddq),
            encoder=encoder,
        )

    @staticmethod
    def joined(parts: "Sequence[RigidBodyRows]") -> "RigidBodyRows":
        """Join consecutive parts of a recording, and delete the arrays of the parts to save memory."""
        return RigidBodyRows(**joined_arrays(parts, [f.name for f in fields(RigidBodyRows)]))
