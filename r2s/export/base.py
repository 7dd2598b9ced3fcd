"""What a policy's torque is added to, in NumPy: a second writing of r2s/tasks/model_torque.py, and of its feedback.

It needs nothing of r2s; `r2s export` puts it into the one file of a bundle.
"""

from typing import Any

import numpy as np

from r2s.export.law import LINK, BundleError, Model, is_number

BASE_JOINT = ("rotors", "offset_Nm", "load", "drag_sin_Nm", "drag_cos_Nm")
BASE_NUMBER = ("late_s", "bandwidth_rad_per_s", "sign_rad_per_s", "load_sign_rad_per_s")
_STRIBECK = ("coulomb", "asymmetry", "viscous", "rise", "stribeck_velocity", "rise_asymmetry", "viscous_asymmetry")
FRICTION = {
    "sigmoid": ("phi1", "phi2", "phi3", "viscous"),
    "coulomb": ("coulomb", "asymmetry", "viscous", "viscous_asymmetry"),
    "stribeck": _STRIBECK,
    "bristle": _STRIBECK,  # a model's torque has no memory
}


def check_base(base: dict[str, Any], n: int) -> None:
    """Raise BundleError where what a contract says of the base lacks something."""
    friction = base["friction"]
    if friction["family"] not in FRICTION:
        raise BundleError(
            f"contract.json: friction of the base is '{friction['family']}'; this runtime knows {', '.join(FRICTION)}"
        )
    if missing := [k for link in base["links"] for k in LINK if k not in link]:
        raise BundleError(f"contract.json: base.links has a link without {missing[0]}")
    lists = {f"base.{k}": base[k] for k in ("links", *BASE_JOINT)}
    own = FRICTION[friction["family"]]
    lists |= {f"base.friction.parameters.{k}": friction["parameters"][k] for k in own}
    for name, values in lists.items():
        if len(values) != n:
            raise BundleError(f"contract.json: {name} is of {len(values)} joints, the arm has {n}")
        if name != "base.links" and not all(map(is_number, values)):
            raise BundleError(f"contract.json: {name} is {values}; it has to be finite")
    if len(base["gravity_m_per_s2"]) != 3:
        raise BundleError(f"contract.json: base.gravity_m_per_s2 is {base['gravity_m_per_s2']}; 3 are allowed")
    for name in BASE_NUMBER:
        value = base["number"].get(name)
        if not is_number(value) or value < 0 or (value == 0 and name != "late_s"):
            raise BundleError(f"contract.json: base.number.{name} is {value}; a number above 0 is allowed")


class Base:
    """Computed torque with the identified model: inverse dynamics of the plan, and feedback.

    Args:
        contract: whose `base` is what the arm is believed to be; of `model` is what the arm itself compensates.
    """

    def __init__(self, contract: dict[str, Any]):
        self._said = base = contract["base"]
        no_hand = {"hand_m": [0.0, 0.0, 0.0]}
        self._own = Model({"links": base["links"], "rotors": base["rotors"]} | no_hand)
        self._nominal = Model(contract["model"])
        self._gravity = np.array(base["gravity_m_per_s2"], dtype=float)
        joint = {name: np.array(base[name], dtype=float) for name in BASE_JOINT}
        self._offset, self._load = joint["offset_Nm"], joint["load"]
        self._drag = joint["drag_sin_Nm"], joint["drag_cos_Nm"]
        parameters = base["friction"]["parameters"]
        self._friction = [np.array(parameters[k], dtype=float) for k in FRICTION[base["friction"]["family"]]]
        number = base["number"]
        self._late, self._bandwidth = number["late_s"], number["bandwidth_rad_per_s"]
        self._sign, self._slides = number["sign_rad_per_s"], number["load_sign_rad_per_s"]

    def prepare(self, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray, hz: float, rows: int) -> None:
        """Work out what does not depend on the arm, for the first `rows` rows of a plan's joints (T, n) at hz.

        A cycle of 1 ms has no time for it.
        """
        self._q, self._dq, n = q, dq, q.shape[1]
        self._mass, self._torque = np.empty((rows, n, n)), np.empty((rows, n))
        whole, last = int(self._late * hz), len(q) - 1
        h = self._late - whole / hz
        for row in range(rows):  # the plan when the torque acts; its acceleration is linear between rows
            a, b = min(row + whole, last), min(row + whole + 1, last)
            jerk = (ddq[b] - ddq[a]) * hz
            to = q[a] + h * (dq[a] + h * (ddq[a] / 2 + h * jerk / 6))
            dto = dq[a] + h * (ddq[a] + h * jerk / 2)
            self._mass[row], self._torque[row] = self.needs(to, dto, ddq[a] + h * jerk)

    def __call__(self, row: int, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
        """Return the torque (n,) Nm at q, dq (n,) in a row of the plan.

        The feedback compares the plan of now with the arm of now, and is weighed with the model's inertia.
        """
        w = self._bandwidth
        back = w**2 * (self._q[row] - q) + 2 * w * (self._dq[row] - dq)
        return self._torque[row] + self._mass[row] @ back

    def needs(self, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the mass matrix (n, n) kg m^2, and a motion's torque (n,) Nm without what the arm compensates."""
        self._own.place(q)
        self._nominal.place(q)
        mass, bias = self._own.equations(dq)
        held = self._nominal.weight(self._gravity)
        out = mass @ ddq + bias + self._own.weight(self._gravity) - held
        out += self.friction(dq) - self._offset - self._drag[0] * np.sin(q) - self._drag[1] * np.cos(q)
        return mass, out + self._load * np.abs(held) * np.tanh(dq / self._slides)

    def friction(self, v: np.ndarray) -> np.ndarray:
        """Return (n,) Nm at v (n,) rad/s: r2s/physics/friction.py."""
        p, sign = self._friction, np.tanh(v / self._sign)
        if self._said["friction"]["family"] == "sigmoid":
            return p[0] * (_logistic(p[1] * (v + p[2])) - _logistic(p[1] * p[2])) + p[3] * v
        level, side = p[0] * (1 + np.sign(sign) * p[1]) * sign, np.sign(v)
        if self._said["friction"]["family"] == "coulomb":
            return level + p[2] * (1 + side * p[3]) * v
        rise = p[3] * (1 + np.sign(sign) * p[5]) * np.exp(-((v / p[4]) ** 2))
        return level * (1 + rise) + p[2] * (1 + side * p[6]) * v


def _logistic(x: np.ndarray) -> np.ndarray:
    e = np.exp(-np.abs(x))
    return np.where(x >= 0, 1.0, e) / (1.0 + e)
