"""What an arm is believed to need for a motion: inverse dynamics with all that `Dynamics` says of it."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from r2s.compiled import njit
from r2s.physics.dynamics import Dynamics
from r2s.physics.newton_euler import WORK, equations, links_of
from r2s.physics.robot import Robot

SLIDES = 0.01  # rad/s, about which friction that goes with the load changes sign


@dataclass(frozen=True)
class ModelTorque:
    """Inverse dynamics of one believed arm behind its gravity compensation.

    Attributes:
        robot: the arm, whose nominal links its compensation believes in. dynamics: what it is believed to be.
    """

    robot: Robot
    dynamics: Dynamics

    @cached_property
    def _links(self) -> tuple[np.ndarray, np.ndarray]:
        r, d = self.robot, self.dynamics
        return links_of(r, d.mass, d.com, d.inertia), links_of(r, r.mass, r.com, r.inertia)

    def rigid(self, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
        """Return (m, n) Nm, what links and rotors need, gravity that is not compensated included.

        M ddq + C dq + g - g of the nominal links, at q, dq, ddq (m, n) rad, rad/s, rad/s^2.
        """
        own, nominal = self._links
        out = np.empty_like(q)
        _rigid(own, nominal, self.robot.gravity, self.dynamics.armature, q, dq, ddq, out)
        return out

    def __call__(self, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray, sliding: np.ndarray) -> np.ndarray:
        """Return (m, n) Nm to command, without gravity; friction is that of the speeds `sliding` (m, n) rad/s."""
        d = self.dynamics
        out = self.rigid(q, dq, ddq) + d.friction(sliding) - d.offset
        if d.drag.any():
            out -= d.drag[:, 0] * np.sin(q) + d.drag[:, 1] * np.cos(q)
        if d.load.any():
            weight = np.empty_like(q)
            none = np.zeros_like(q)
            _rigid(self._links[1], self._links[1], self.robot.gravity, none[0], q, none, none, weight, True)
            out += d.load * np.abs(weight) * np.tanh(sliding / SLIDES)
        return out


@njit(cache=True, error_model="numpy")
def _rigid(links, nominal, gravity, armature, q, dq, ddq, out, whole=False):
    """Write the torque (m, n) Nm; `whole`: with all of gravity, not what the nominal links leave of it."""
    m, n = q.shape
    mass, bias, held, still = np.empty((n, n)), np.empty(n), np.empty(n), np.zeros(n)
    work = np.empty((n, WORK))
    for i in range(m):
        equations(links, gravity, q[i], dq[i], mass, bias, work)
        if whole:
            held[:] = 0.0
        else:
            _weight(nominal, gravity, q[i], still, held, work)
        for j in range(n):
            torque = bias[j] - held[j] + armature[j] * ddq[i, j]
            for k in range(n):
                torque += mass[j, k] * ddq[i, k]
            out[i, j] = torque


@njit(cache=True, error_model="numpy")
def _weight(links, gravity, q, still, out, work):
    mass = np.empty((len(q), len(q)))
    equations(links, gravity, q, still, mass, out, work)
