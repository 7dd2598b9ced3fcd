"""Represent a planned motion, which has no noise and needs no filter, in place of a recording."""

from dataclasses import dataclass

import numpy as np

from r2s.physics.dynamics import Dynamics
from r2s.physics.rigid_body import nominal_torque
from r2s.physics.robot import Robot


@dataclass(frozen=True)
class PlannedMotion:
    """Concatenated samples of B planned motions, with the interface of `SmoothMotion`.

    Attributes:
        t: (T,) s, times. q, dq, ddq: (T, n), motion. tau: (T, n) Nm, nominal torque. change: (T, n) Nm/s, d tau/dt.
        torque: kind of torque in tau, as in `Recording`.
    """

    t: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray
    tau: np.ndarray
    change: np.ndarray
    torque: str

    @staticmethod
    def of(
        robot: Robot,
        nominal: Dynamics,
        torque: str,
        t: np.ndarray,
        motions: tuple[np.ndarray, ...],
    ) -> "PlannedMotion":
        """Return B motions (q, dq and ddq, each (B, T, n)) at times t (T,) s, with the torque of the nominal arm."""
        q, dq, ddq = (x.reshape(-1, robot.n) for x in motions)
        tau = nominal_torque(robot, q, dq, ddq, torque != "commanded") + nominal.friction(dq, np.sign(dq))
        change = np.gradient(tau.reshape(motions[0].shape), t, axis=1).reshape(tau.shape)
        return PlannedMotion(np.tile(t, len(motions[0])), q, dq, ddq, tau, change, torque)

    @property
    def friction_dq(self) -> np.ndarray:
        """(T, n) rad/s, velocity at which friction is evaluated."""
        return self.dq

    @property
    def bristle(self) -> np.ndarray:
        """(T, n), presliding state if every joint slides."""
        return np.sign(self.dq)

    def filtered(self, x: np.ndarray) -> np.ndarray:
        """Return x (T, n, ...) unchanged, because a planned motion needs no filter."""
        return x

    rows = filtered

    def command(self, delay: float, lag: float) -> np.ndarray:
        """Return the command (T, n) Nm that acts after `delay` and `lag` (s), linearized in `delay` and `lag`."""
        return self.tau - (delay + lag) * self.change
