"""Compute the inverse dynamics of the identified arm in NumPy, as r2s/physics/inverse_dynamics.py does.

A bundle needs inverse dynamics for the setpoints of control=computed_torque and for the estimate of contact force.
`r2s export` copies this module into r2s_runtime.py of a bundle.
"""

from typing import Any

import numpy as np

from r2s.export.law import Model

MODEL_JOINT = ("rotors", "offset_Nm", "load", "drag_sin_Nm", "drag_cos_Nm")
_STRIBECK = ("coulomb", "asymmetry", "viscous", "rise", "stribeck_velocity", "rise_asymmetry", "viscous_asymmetry")
FRICTION = {
    "sigmoid": ("phi1", "phi2", "phi3", "viscous"),
    "coulomb": ("coulomb", "asymmetry", "viscous", "viscous_asymmetry"),
    "stribeck": _STRIBECK,
    "bristle": _STRIBECK,  # feedforward without presliding
}


class InverseDynamics:
    """Inverse dynamics of the identified arm, and the setpoints of a plan.

    Args:
        contract: contract of the bundle, with the identified arm `control.model` and the nominal arm `model`.
    """

    def __init__(self, contract: dict[str, Any]):
        own = contract["control"]["model"]
        no_hand = {"hand_m": [0.0, 0.0, 0.0]}
        self._own = Model({"links": own["links"], "rotors": own["rotors"]} | no_hand)
        self._nominal = Model(contract["model"])
        self._gravity = np.array(own["gravity_m_per_s2"], dtype=float)
        joint = {name: np.array(own[name], dtype=float) for name in MODEL_JOINT}
        self._offset, self._load = joint["offset_Nm"], joint["load"]
        self._drag = joint["drag_sin_Nm"], joint["drag_cos_Nm"]
        self._family, parameters = own["friction"]["family"], own["friction"]["parameters"]
        self._friction = [np.array(parameters[k], dtype=float) for k in FRICTION[self._family]]
        number = own["number"]
        self._ahead = number["ahead_s"]
        self._sign, self._slides = number["sign_rad_per_s"], number["load_sign_rad_per_s"]

    def setpoints(self, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray, hz: float, rows: int) -> np.ndarray:
        """Return the setpoints (rows, 3 n + n n) for the first `rows` rows of a joint motion (T, n) sampled at `hz`.

        A setpoint contains the feedforward torque, Nm, q_d, dq_d and the flattened mass matrix. Computing a setpoint
        takes over 1 ms.
        """
        n = q.shape[1]
        out = np.empty((rows, 3 * n + n * n))
        whole, last = int(self._ahead * hz), len(q) - 1
        h = self._ahead - whole / hz
        for row in range(rows):  # evaluate the plan at the time at which torque acts; interpolate acceleration
            a, b = min(row + whole, last), min(row + whole + 1, last)
            jerk = (ddq[b] - ddq[a]) * hz
            to = q[a] + h * (dq[a] + h * (ddq[a] / 2 + h * jerk / 6))
            dto = dq[a] + h * (ddq[a] + h * jerk / 2)
            mass, torque = self.equations(to, dto, ddq[a] + h * jerk)
            out[row] = np.concatenate([torque, q[row], dq[row], mass.ravel()])
        return out

    def equations(self, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the mass matrix (n, n) kg m^2, and the torque (n,) Nm minus the arm's own gravity compensation."""
        self._own.place(q)
        self._nominal.place(q)
        mass, bias = self._own.equations(dq)
        held = self._nominal.weight(self._gravity)
        out = mass @ ddq + bias + self._own.weight(self._gravity) - held
        out += self.friction(dq) - self._offset - self._drag[0] * np.sin(q) - self._drag[1] * np.cos(q)
        return mass, out + self._load * np.abs(held) * np.tanh(dq / self._slides)

    def friction(self, v: np.ndarray) -> np.ndarray:
        """Return the friction torque (n,) Nm at the speeds v (n,) rad/s, as r2s/physics/friction.py does."""
        p, sign = self._friction, np.tanh(v / self._sign)
        if self._family == "sigmoid":
            return p[0] * (_logistic(p[1] * (v + p[2])) - _logistic(p[1] * p[2])) + p[3] * v
        level, side = p[0] * (1 + np.sign(sign) * p[1]) * sign, np.sign(v)
        if self._family == "coulomb":
            return level + p[2] * (1 + side * p[3]) * v
        rise = p[3] * (1 + np.sign(sign) * p[5]) * np.exp(-((v / p[4]) ** 2))
        return level * (1 + rise) + p[2] * (1 + side * p[6]) * v


def _logistic(x: np.ndarray) -> np.ndarray:
    e = np.exp(-np.abs(x))
    return np.where(x >= 0, 1.0, e) / (1.0 + e)
