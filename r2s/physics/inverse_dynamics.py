"""Inverse dynamics of an arm with gravity compensation: rigid-body torque, friction, offset and drag."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from r2s.compiled import njit
from r2s.physics.dynamics import Dynamics
from r2s.physics.newton_euler import WORK, equations, links_of
from r2s.physics.robot import Robot

SLIDES = 0.01  # rad/s, width of the sign change of load-dependent friction, as in physics.friction


@dataclass(frozen=True)
class InverseDynamics:
    """Inverse dynamics of one arm with gravity compensation.

    Attributes:
        robot: the arm, which compensates the gravity torque of its nominal links.
        dynamics: estimated dynamics of the arm.
    """

    robot: Robot
    dynamics: Dynamics

    @cached_property
    def _links(self) -> tuple[np.ndarray, np.ndarray]:
        r, d = self.robot, self.dynamics
        return links_of(r, d.mass, d.com, d.inertia), links_of(r, r.mass, r.com, r.inertia)

    def rigid(self, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
        """Return the torque (m, n) Nm that links and rotors need for q, dq, ddq (m, n) rad, rad/s, rad/s^2.

        The torque is M ddq + C dq + g, minus the nominal links' gravity torque, which the arm compensates.
        """
        own, nominal = self._links
        out = np.empty_like(q)
        motion = np.array(q), np.array(dq), np.array(ddq)  # one array type, so that numba compiles only once
        _rigid(own, nominal, self.robot.gravity, np.array(self.dynamics.armature), motion, out, False)
        return out

    def mass(self, q: np.ndarray) -> np.ndarray:
        """Return the mass matrices (m, n, n) kg m^2 at q (m, n) rad, rotors included."""
        out = np.empty((*q.shape, q.shape[1]))
        _mass(self._links[0], self.robot.gravity, self.dynamics.armature, q, out)
        return out

    def __call__(self, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray, sliding: np.ndarray) -> np.ndarray:
        """Return the command (m, n) Nm without gravity for q, dq, ddq; sliding: (m, n) rad/s, speeds for friction."""
        d = self.dynamics
        out = self.rigid(q, dq, ddq) + d.friction(sliding) - d.offset
        if d.drag.any():
            out -= d.drag[:, 0] * np.sin(q) + d.drag[:, 1] * np.cos(q)
        if d.load.any():
            out += self.load_friction(q) * np.tanh(sliding / SLIDES)
        return out

    def gravity(self, q: np.ndarray) -> np.ndarray:
        """Return the torque (m, n) Nm with which the joints hold the links at rest at q (m, n) rad."""
        return self._at_rest(self._links[0], q)

    def load_friction(self, q: np.ndarray) -> np.ndarray:
        """Return the magnitude (m, n) Nm of load-dependent friction at q (m, n) rad."""
        return self.dynamics.load * np.abs(self._at_rest(self._links[1], q))

    def _at_rest(self, links: np.ndarray, q: np.ndarray) -> np.ndarray:
        none, out = np.zeros(q.shape), np.empty(q.shape)
        _rigid(links, links, self.robot.gravity, none[0], (np.array(q), none, none), out, True)
        return out


@njit(cache=True, error_model="numpy")
def _rigid(links, nominal, gravity, armature, motion, out, full_gravity):
    """Write the torque (m, n) Nm for `motion`; full_gravity: include the gravity torque that the arm compensates."""
    q, dq, ddq = motion
    m, n = q.shape
    mass, bias, compensated, at_rest = np.empty((n, n)), np.empty(n), np.empty(n), np.zeros(n)
    work = np.empty((n, WORK))
    for i in range(m):
        equations(links, gravity, q[i], dq[i], mass, bias, work)
        if full_gravity:
            compensated[:] = 0.0
        else:
            _gravity_torque(nominal, gravity, q[i], at_rest, compensated, work)
        for j in range(n):
            torque = bias[j] - compensated[j] + armature[j] * ddq[i, j]
            for k in range(n):
                torque += mass[j, k] * ddq[i, k]
            out[i, j] = torque


@njit(cache=True, error_model="numpy")
def _gravity_torque(links, gravity, q, at_rest, out, work):
    mass = np.empty((len(q), len(q)))
    equations(links, gravity, q, at_rest, mass, out, work)


@njit(cache=True, error_model="numpy")
def _mass(links, gravity, armature, q, out):
    n = q.shape[1]
    bias, at_rest, work = np.empty(n), np.zeros(n), np.empty((n, WORK))
    for i in range(len(q)):
        equations(links, gravity, q[i], at_rest, out[i], bias, work)
        for j in range(n):
            out[i, j, j] += armature[j]
