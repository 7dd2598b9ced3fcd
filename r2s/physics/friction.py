"""Joint friction: families of one interface, breakaway (eq. 6) and offsets, in NumPy, for readers and tests.

native_friction.py has the same laws, compiled, inside the physics step.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from r2s.errors import UserError, choices, nearest

WIDTH_DQ = 0.01  # rad/s, over which the sign of Coulomb friction turns: inside the dead zone
PRESLIDING = 1e-3  # rad, over which friction turns, where it is not searched


def sigmoid(x: np.ndarray) -> np.ndarray:
    """Return the logistic function, without overflow at any finite x."""
    e = np.exp(-np.abs(x))
    return np.where(x >= 0, 1.0, e) / (1.0 + e)


@dataclass(frozen=True)
class Family:
    """A friction law of one joint with K parameters; `code` is what the native form calls it.

    sigmoid, eq. (5) of the paper and a viscous term that may be left out (K = 3):
        tau_f = phi1 (s(phi2 (v + phi3)) - s(phi2 phi3)) + viscous v,  s the logistic function
    coulomb, level and viscous term, asymmetric:
        tau_f = coulomb (1 +- asymmetry) tanh(v / 0.01) + viscous v,  + for v > 0
    stribeck, falling from rest over stribeck_velocity:
        the same with coulomb (1 + rise exp(-(v / stribeck_velocity)^2)) as its level
    bristle, Stribeck's with a memory (Dahl 1968; LuGre without its own damping term): z in place of the tanh,
        dz/dt = (v - |v| z) / presliding: the sign turns over a distance, and a joint at rest is held by a spring.
        It needs no dead zone: what it holds is its level at rest.
    """

    name: str
    code: int
    names: tuple[str, ...]
    units: tuple[str, ...]

    def torque(self, dq: np.ndarray, phi: np.ndarray, turn: np.ndarray | None = None) -> np.ndarray:
        """Return the friction torque, Nm; zero at rest, positive for positive velocity.

        Args:
            dq: (..., n) rad/s.
            phi: (..., n, K), in the order of `names`.
            turn: (..., n), in place of tanh(v / 0.01) where it is known better (`presliding`); the sigmoid has none.
        """
        p = [phi[..., i] for i in range(phi.shape[-1])]
        if self.name == "sigmoid":
            viscous = p[3] * dq if len(p) > 3 else 0.0
            return p[0] * (sigmoid(p[1] * (dq + p[2])) - sigmoid(p[1] * p[2])) + viscous
        turn = np.tanh(dq / WIDTH_DQ) if turn is None else turn
        level = p[0] * (1 + np.sign(turn) * p[1])
        if self.name in ("stribeck", "bristle"):
            level = level * (1 + p[3] * np.exp(-((dq / p[4]) ** 2)))
        return level * turn + p[2] * dq

    def slope(self, dq: np.ndarray, phi: np.ndarray) -> np.ndarray:
        """Return d torque / d dq, Nm s/rad, for the arguments of `torque`."""
        p = [phi[..., i] for i in range(phi.shape[-1])]
        if self.name == "sigmoid":
            s = sigmoid(p[1] * (dq + p[2]))
            return p[0] * p[1] * s * (1.0 - s) + (p[3] if len(p) > 3 else 0.0)
        turn = np.tanh(dq / WIDTH_DQ)
        level, fall = p[0] * (1 + np.sign(dq) * p[1]), np.zeros_like(dq)
        if self.name in ("stribeck", "bristle"):
            bump = p[3] * np.exp(-((dq / p[4]) ** 2))
            level, fall = level * (1 + bump), level * bump * -2 * dq / p[4] ** 2
        return level * (1 - turn**2) / WIDTH_DQ + fall * turn + p[2]

    def level(self, phi: np.ndarray, dq_max: np.ndarray) -> np.ndarray:
        """Return (..., n) Nm: the mean magnitude of friction at plus and minus `dq_max` (..., n) rad/s."""
        return 0.5 * (self.torque(dq_max, phi) - self.torque(-dq_max, phi))

    def like(self, other: "Family", phi: np.ndarray) -> np.ndarray:
        """Return (..., n, K) parameters of this family with the level at 1 rad/s of `other` (..., n, K')."""
        if other == self:
            return phi
        one = np.ones(phi.shape[:-1])
        level, zero = other.level(phi, one), np.zeros(phi.shape[:-1])
        if self.name == "sigmoid":
            return np.stack([2 * level, 20 * one, zero], -1)
        phi = np.stack([level, zero, zero, 0.1 * one, 0.1 * one, 1e-3 * one], -1)
        return phi[..., : len(self.names)]


@njit(cache=True)
def presliding(dq: np.ndarray, dt: float, distance: float) -> np.ndarray:
    """Return (T, n) in [-1, 1]: the sign of friction where it turns over a distance, not over a velocity.

    Dahl 1968: dz/dt = (v - |v| z) / distance, stepped exactly, z = 0 at the start.

    Args:
        dq: (T, n) rad/s, dt s apart. distance: rad; about 1 mrad on a Panda.
    """
    z = np.zeros(dq.shape[1])
    out = np.empty_like(dq)
    for k in range(len(dq)):
        for j in range(len(z)):
            s = 1.0 if dq[k, j] > 0 else -1.0
            z[j] = s + (z[j] - s) * np.exp(-abs(dq[k, j]) * dt / distance)
            out[k, j] = z[j]
    return out


SIGMOID = Family("sigmoid", 0, ("phi1", "phi2", "phi3", "viscous"), ("Nm", "s/rad", "rad/s", "Nm s/rad"))
COULOMB = Family("coulomb", 1, ("coulomb", "asymmetry", "viscous"), ("Nm", "1", "Nm s/rad"))
STRIBECK = Family(
    "stribeck",
    2,
    ("coulomb", "asymmetry", "viscous", "rise", "stribeck_velocity"),
    ("Nm", "1", "Nm s/rad", "1", "rad/s"),
)
BRISTLE = Family("bristle", 3, (*STRIBECK.names, "presliding"), (*STRIBECK.units, "rad"))
FAMILIES = (SIGMOID, COULOMB, STRIBECK, BRISTLE)


def family(name: str) -> Family:
    """Return the family of that name; UserError if there is none."""
    names = [f.name for f in FAMILIES]
    if name not in names:
        raise UserError(f"friction.family: no family '{name}'; allowed: {choices(names)}{nearest(str(name), names)}")
    return FAMILIES[names.index(name)]


def passive_torque(
    dq: np.ndarray, tau: np.ndarray, friction: np.ndarray, offset: np.ndarray, breakaway: np.ndarray, dq_min: float
) -> np.ndarray:
    """Return what the joints feel beside the command `tau`, Nm: offset - friction, or the dead zone's hold.

    Dead zone (eq. 6 and Table II): while abs(dq) < dq_min and command plus offset lie within the breakaway band,
    the action is nullified (the joint feels neither command nor offset).

    Args:
        dq, tau: (..., n) rad/s, Nm. friction: (..., n) Nm, of a family at dq.
        offset: (..., n) Nm, whatever else pulls: drag and gravity error included.
        breakaway: (..., n, 2) Nm, negative and positive.
        dq_min: rad/s.
    """
    drive = tau + offset
    held = (np.abs(dq) < dq_min) & (drive > breakaway[..., 0]) & (drive < breakaway[..., 1])
    return np.where(held, -tau, offset) - friction
