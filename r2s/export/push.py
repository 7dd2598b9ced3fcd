"""Limit contact force and closing speed, and stop an arm whose tip presses on a surface, in NumPy.

r2s itself uses compiled modules instead: r2s/physics/push_limit.py, with the derivation, and
r2s/physics/contact_stop.py. `r2s export` copies this module into r2s_runtime.py of a bundle.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from r2s.export.law import OVER, Model, cross

PUSH_NUMBER = (
    *("force_max", "speed_near", "slope", "margin", "radius", "near_m", "overshoot", "trials", "close", "leave"),
    *("leaves_s", "released", "slides", "retreat_m", "most", "gain"),
)
PUSH_VECTOR = ("point", "normal", "tip")
STOPS = ("hold", "release", "retreat")
BEGINS, PRESSES, CLEAR = range(3)  # phases of a stop, before OVER


class PushLimit:
    """Limit one arm's contact force; in every cycle call `see`, then `stop` if the arm stops, then `limit`.

    Args:
        law: a contract's entry `law`. model: the arm's `Model`; in every cycle, call `model.place(q)` before `see`.
    """

    def __init__(self, law: dict[str, Any], model: Model):
        self._p, self._c, self._model = law["push"], law["number"], model
        self._point, self._normal, self._tip = (np.array(self._p[k], dtype=float) for k in PUSH_VECTOR)
        self._friction = np.array(law["joint"]["friction"], dtype=float)
        self._most = np.array(law["joint"]["most"], dtype=float)
        self.reset()

    def reset(self) -> None:
        """Prepare the next motion: reset the estimated contact force and the phase of a stop."""
        self._resisted, self._speed = 0.0, 0.0
        self._before: float | None = None  # closing speed in the previous cycle, m/s; None: tip far from the plane
        self.phase, self._felt, self._from, self._pull = BEGINS, 0.0, 0.0, 0.0

    def see(self, dq: np.ndarray, mass: np.ndarray, bias: np.ndarray) -> None:
        """Compute the tip's motion from dq (n,) rad/s, mass (n, n) kg m^2 and Coriolis torque `bias` (n,) Nm."""
        m, p = self._model, self._p
        place, jacobian = m.point(self._tip)
        off = place - self._point
        height = float(self._normal @ off)
        aside = np.sqrt(max(float(off @ off) - height * height, 0.0))
        self._height = height - (p["radius"] + p["margin"] + p["slope"] * aside)
        velocity = jacobian @ dq
        self._speed = -float(self._normal @ velocity)
        self._along = np.sqrt(max(float(velocity @ velocity) - self._speed**2, 0.0))
        spin = m.axis * dq[:, None]
        omega = np.cumsum(spin, 0)
        alpha = np.cumsum(cross(omega - spin, spin), 0)
        way = np.diff(np.vstack([m.origin, place]), axis=0)
        self._convective = -float(self._normal @ (cross(alpha, way) + cross(omega, cross(omega, way))).sum(0))
        self._row = -self._normal @ jacobian
        self._lever = np.linalg.solve(mass, self._row)
        self._mobility = float(self._row @ self._lever)
        self._dq, self._mass, self._bias = dq, mass, bias

    def _bound(self, last: np.ndarray) -> float:
        """Return the largest tip acceleration (m/s^2) into the surface that torque may cause; `last`: last torque."""
        p, c, mobility = self._p, self._c, self._mobility
        if self._height > p["near_m"]:
            self._resisted, self._before = 0.0, None
            return np.inf
        before = self._convective + float(self._lever @ (last - self._bias))
        own = self._convective - float(self._lever @ self._bias)
        hidden = float(np.abs(self._lever) @ self._friction)
        mass, speed = 1.0 / mobility, self._speed
        faster = speed - (speed if self._before is None else self._before)
        pushed = c["cycle_s"] * (mass * before - self._resisted)
        resisted = self._resisted + c["rate"] * (pushed - mass * faster)
        allowed = p["speed_near"] - p["slope"] * self._along + c["approach"] * max(self._height, 0.0)
        slowest = p["speed_near"] if self.phase == BEGINS else p["overshoot"] * p["leave"]
        if speed > allowed or speed < -slowest:
            resisted = min(resisted, 0.0)
        self._resisted, self._before = min(max(resisted, -p["force_max"]), p["force_max"]), speed
        most = min(c["rate"] * (allowed - speed) + mobility * self._resisted, mobility * p["force_max"] - hidden)
        return most - own

    def limit(self, effort: np.ndarray, last: np.ndarray, bounded: Callable[..., Any]) -> tuple[np.ndarray, bool]:
        """Return the torque (n,) Nm within all bounds that is nearest to `effort` (n,) Nm; also, whether they differ.

        bounded: function of torque and bias torque in contact, (n,) Nm each, that limits the torque to the joint
        bounds.
        """
        bound, p, row = self._bound(last), self._p, self._row
        bias = self._bias + max(self._resisted, 0.0) * row
        out, changed = bounded(effort, bias)
        before = float(self._lever @ out) - bound
        if before <= 0.0:
            return out, changed
        low, high, after, force = 0.0, np.inf, 0.0, (before + 0.5 * p["close"]) / self._mobility
        for _ in range(int(p["trials"])):
            out, _ = bounded(effort - force * row, bias)
            now = float(self._lever @ out) - bound
            if -p["close"] <= now <= 0.0:
                break
            if now > 0.0:
                low, before, after = force, now, 0.5 * after
            else:
                high, after, before = force, now, (0.5 if high < np.inf else 1.0) * before
            if high == np.inf:
                force *= 2.0
            else:
                x, y = before + 0.5 * p["close"], after + 0.5 * p["close"]
                force = (low * y - high * x) / (y - x) if y < 0.0 else 0.5 * (low + high)
        return out, True

    def stop(self, held: np.ndarray, cycles: int) -> tuple[np.ndarray, float]:
        """Return a stop's target torque (n,) Nm, and the fraction of the allowed joint speeds that the stop uses.

        Args:
            held: (n,) Nm, torque that the driver adds to the target torque. cycles: cycles since the stop began.
        """
        p, row, lever, mobility = self._p, self._row, self._lever, self._mobility
        if cycles * self._c["cycle_s"] > p["leaves_s"]:
            self.phase = OVER
        felt = self._resisted - float(lever @ held) / mobility
        if self.phase == BEGINS:
            self._felt = max(felt, 0.0) if self._height < 0.0 else 0.0
            self.phase = OVER if p["stop"] == "hold" or self._height >= 0.0 else PRESSES
        if self.phase == OVER:
            return (self._felt if p["stop"] == "hold" else 0.0) * row, 0.0
        share = float((p["leave"] / mobility * np.abs(lever) / self._most).max())
        part = min(1.0, p["most"] / share)
        asked = -p["leave"] / mobility * part * lever
        ahead = self._friction * np.tanh(asked / self._c["dry"])
        behind = -float(lever @ ahead) / mobility
        pull = self._pull + self._c["cycle_s"] * p["gain"] ** 2 / mobility * (p["leave"] * part + self._speed)
        self._pull = min(max(pull, 0.0), behind)
        target = self._bias + max(felt, 0.0) * row + ahead - self._pull * row
        target = target + self._mass @ (p["gain"] * (asked - self._dq))
        if self.phase == PRESSES and self._speed < -0.2 * p["leave"] and felt <= p["released"] - p["slides"] * behind:
            self.phase, self._from = (CLEAR if p["stop"] == "retreat" else OVER), self._height
        if self.phase == CLEAR and self._height >= self._from + p["retreat_m"]:
            self.phase = OVER
        return target, min(share, p["most"])
