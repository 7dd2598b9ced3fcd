"""Run driver and safety filter in NumPy, as r2s/arm/driver.py and r2s/physics/safety_filter.py do on an arm.

`r2s export` copies this module into r2s_runtime.py of a bundle, so this module imports nothing from r2s.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

LINK = {"place": (3,), "frame": (3, 3), "axis": (3,), "mass": (), "com": (3,), "tensor": (3, 3)}

OVER = 3  # last phase of a stop in contact; it needs no further action, see push.py


class BundleError(ValueError):
    """A bundle does not fit the arm, or a program calls the runtime wrongly; the error message is one line."""


def per_joint(values: Sequence[float | None], none: float) -> np.ndarray:
    """Return a list of a contract as an array (n,); null, which stands for infinity, becomes `none`."""
    return np.array([none if v is None else v for v in values], dtype=float)


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross product of a and b (..., 3), three times as fast as np.cross."""
    x, y, z = a[..., 0], a[..., 1], a[..., 2]
    u, v, w = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], -1)


class Model:
    """Kinematics and dynamics of an arm, from a contract's entry `model`, at the joint angles that `place` sets."""

    def __init__(self, model: dict[str, Any]):
        self.n = len(model["links"])
        place, frame, axis, mass, com, tensor = (
            np.array([link[k] for link in model["links"]], dtype=float).reshape(self.n, *shape)
            for k, shape in LINK.items()
        )
        self._place, self._axis, self._mass, self._com, self._tensor = place, axis, mass, com, tensor
        along = axis[:, :, None] * axis[:, None, :]
        skew = np.stack([cross(axis, np.broadcast_to(e, axis.shape)) for e in np.eye(3)], -1)
        # Rodrigues' rotation by q in the frame of a joint: constant + sin(q) odd + cos(q) even
        self._constant, self._odd, self._even = frame @ along, frame @ skew, frame @ (np.eye(3) - along)
        self._hand = np.array(model["hand_m"], dtype=float)
        self._rotors = np.diag(np.array(model["rotors"], dtype=float))
        self._before = np.tril(np.ones((self.n, self.n)))[:, :, None]  # 1 if joint j moves link k: j <= k

    def place(self, q: np.ndarray) -> None:
        """Move the model to the joint angles q (n,) rad."""
        rotation = self._constant + np.sin(q)[:, None, None] * self._odd + np.cos(q)[:, None, None] * self._even
        self.frame, self.origin = np.empty((self.n, 3, 3)), np.empty((self.n, 3))
        R, p = np.eye(3), np.zeros(3)
        for i in range(self.n):
            p = p + R @ self._place[i]
            R = R @ rotation[i]
            self.frame[i], self.origin[i] = R, p
        self.axis = (self.frame @ self._axis[:, :, None])[..., 0]

    def hand(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the position of the end effector (3,) m and its Jacobian (3, n) m/rad."""
        return self.point(self._hand)

    def point(self, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return position (3,) m and Jacobian (3, n) m/rad of the point `own` (3,) m in the last link's frame."""
        place = self.frame[-1] @ own + self.origin[-1]
        return place, cross(self.axis, place - self.origin).T

    def equations(self, dq: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the mass matrix (n, n) kg m^2 and the Coriolis torque (n,) Nm at dq (n,) rad/s.

        Newton-Euler recursion yields the Coriolis torque. The mass matrix is diag(armatures) + sum_k J_k^T M_k J_k,
        where M_k contains mass and tensor of link k.
        """
        R, p, z, n = self.frame, self.origin, self.axis, self.n
        spin = z * dq[:, None]
        omega = np.cumsum(spin, 0)
        alpha = np.cumsum(cross(omega - spin, spin), 0)
        own = (R @ self._com[:, :, None])[..., 0]
        centre = p + own
        way = np.diff(p, axis=0)
        carried = cross(alpha[:-1], way) + cross(omega[:-1], cross(omega[:-1], way))
        a = cross(alpha, own) + cross(omega, cross(omega, own))
        a[1:] += np.cumsum(carried, 0)
        tensor = R @ self._tensor @ R.transpose(0, 2, 1)
        force = self._mass[:, None] * a
        turning = (tensor @ omega[:, :, None])[..., 0]
        moment = (tensor @ alpha[:, :, None])[..., 0] + cross(omega, turning) + cross(centre, force)
        force, moment = np.cumsum(force[::-1], 0)[::-1], np.cumsum(moment[::-1], 0)[::-1]
        bias = (z * (moment - cross(p, force))).sum(1)
        moves = self._before * cross(np.broadcast_to(z, (n, n, 3)), centre[:, None] - p)  # Jacobians [link, joint]
        rotates = self._before * np.broadcast_to(z, (n, n, 3))
        heavy = moves * self._mass[:, None, None]

        def flat(x: np.ndarray) -> np.ndarray:
            return x.transpose(1, 0, 2).reshape(n, -1)

        mass = flat(heavy) @ flat(moves).T + flat(rotates @ tensor) @ flat(rotates).T
        return mass + self._rotors, bias

    def weight(self, gravity: np.ndarray) -> np.ndarray:
        """Return the gravity torque (n,) Nm that holds the arm at rest; gravity (3,) m/s^2 is in the base frame."""
        centre = self.origin + (self.frame @ self._com[:, :, None])[..., 0]
        force = -self._mass[:, None] * gravity
        moment = cross(centre, force)
        force, moment = np.cumsum(force[::-1], 0)[::-1], np.cumsum(moment[::-1], 0)[::-1]
        return (self.axis * (moment - cross(self.origin, force))).sum(1)


class Driver:
    """Run control law, low-pass and safety filter; one call per cycle returns a torque within the arm's limits.

    Attributes:
        effort: (n,) Nm, the target torque after the low-pass. stopping: reason for a stop, or None without a stop.
        limited: number of cycles of this motion in which the safety filter changed the torque.

    Args:
        law: a contract's entry `law`. model: the arm's `Model`. soft_start_s: s, time over which torque fades in.
        control: the contract's `Control`; if None, commands are torques.
        push: the contract's `PushLimit`; if None, nothing limits the contact force.
    """

    def __init__(
        self, law: dict[str, Any], model: Model, soft_start_s: float = 0.0, control: Any = None, push: Any = None
    ):
        self._model, self._number, self._control, self._push = model, law["number"], control, push
        none = {"q_low": -np.inf, "q_stop_low": -np.inf}
        self._j = {k: per_joint(v, none.get(k, np.inf)) for k, v in law["joint"].items()}
        self._fade = round(soft_start_s / self._number["cycle_s"])
        self.reset()

    def reset(self) -> None:
        """Clear the state of the driver, so that the next motion begins from zero torque."""
        n = self._model.n
        self.effort, self._target, self._filtered, self._sent, self._held = np.zeros((5, n))
        self.stopping: str | None = None
        self._brakes_alone = False  # a limit or an invalid state caused the stop: brake, even in contact
        self._share, self._cycle, self._silent, self._damped, self._rests = 1.0, 0, 0, 0, False
        self.limited = 0
        self._command: np.ndarray | None = None
        for part in (self._control, self._push):
            if part is not None:
                part.reset()

    @property
    def done(self) -> bool:
        """Whether a stop has ended: the arm is at rest, or the stop has reached its longest duration."""
        over = self._damped * self._number["cycle_s"] >= self._number["damp_s"]
        return self.stopping is not None and self._damped > 0 and (self._rests or over)

    def __call__(
        self, q: np.ndarray, dq: np.ndarray, tau_J_d: np.ndarray, command: np.ndarray | None, placed: bool = False
    ) -> np.ndarray:
        """Return the torque command (n,) Nm of this cycle.

        Args:
            q, dq: joint state (n,) rad, rad/s, in this cycle. tau_J_d: (n,) Nm, the torque that the arm applied last.
            command: (c,), new command; if None, the previous command applies.
            placed: whether the caller has already called `model.place(q)`.
        """
        j, c = self._j, self._number
        seen = bool(np.isfinite(q).all() and np.isfinite(dq).all())
        if command is not None and np.isfinite(command).all():
            self._command, self._silent = command, 0
        else:
            self._silent += 1
        if self.stopping is None:
            self.stopping = self._reason(q, dq, seen)
        stopping = self.stopping is not None
        self._damped += stopping
        self._rests = seen and bool((np.abs(dq) < c["still"]).all())
        if seen:
            if not placed:
                self._model.place(q)
            mass, bias = self._model.equations(dq)
            if self._push is not None:
                self._push.see(dq, mass, bias)
        if stopping:  # brake at once: the allowed speed falls from the present speed
            self._target, needs = np.zeros_like(self._target), 0.0
            if seen and self._damped == 1:
                self._share = min(1.0, float((np.abs(dq) / j["most"]).max()))
            if seen and self._push is not None and not self._brakes_alone:
                target, needs = self._push.stop(self._held, self._damped)
                self._target = np.clip(target, -j["asked"], j["asked"])
                self._rests = self._rests and self._push.phase == OVER
            self._share = max(needs, self._share - c["cycle_s"] / c["brake_s"])
            if seen and self._share == 0.0:  # a spring stops joints that a load or model error still moves
                slides = np.abs(dq) > c["still"]
                along = np.where(slides & (dq * self._held > 0), np.minimum(j["release"], np.abs(self._held)), 0.0)
                turned = self._held - along * np.sign(dq) - c["cycle_s"] * j["spring"] * np.where(slides, dq, 0.0)
                self._held = np.clip(turned, -j["held_most"], j["held_most"])
        elif self._command is not None:
            target = self._command if self._control is None else self._control(q, dq, self._command)
            if np.isfinite(target).all():
                self._target = np.clip(target, -j["asked"], j["asked"])
            else:
                self.stopping, self._target = "the controller's torque is not finite", np.zeros_like(self._target)
        self._cycle += 1
        faded = self._target * (self._cycle / self._fade if self._cycle < self._fade else 1.0)
        self._filtered = self._filtered + c["low_pass"] * (faded - self._filtered)
        self.effort = self.effort + np.clip(self._clipped(self._filtered) - self.effort, -j["step"], j["step"])
        last = tau_J_d if np.isfinite(tau_J_d).all() else self._sent
        if seen:
            out, changed = self._guard(q, dq, last, mass, bias)
            self.limited += changed
            way = self._clipped(out) - last
            way *= 1.0 / max(1.0, float((np.abs(way) / j["step"]).max()))
        else:
            way = -last
        self._sent = last + np.clip(way, -j["step"], j["step"])
        return self._sent.copy()

    def _clipped(self, tau: np.ndarray) -> np.ndarray:
        return np.clip(tau, -self._j["tau_max"], self._j["tau_max"])

    def _reason(self, q: np.ndarray, dq: np.ndarray, seen: bool) -> str | None:
        j, c = self._j, self._number
        if self._silent * c["cycle_s"] > c["deadline_s"]:
            return f"no finite action for {1e3 * c['deadline_s']:g} ms"
        self._brakes_alone = True
        if not seen:
            return "the arm's state is not finite"
        if (near := (q < j["q_stop_low"]) | (q > j["q_stop_high"])).any():
            return f"joint {near.argmax() + 1} is at {q[near.argmax()]:.3f} rad, too close to its limit"
        if (fast := np.abs(dq) > j["dq_stop"]).any():
            return f"joint {fast.argmax() + 1} is at {dq[fast.argmax()]:.3f} rad/s, too close to its limit"
        self._brakes_alone = False
        return None

    def _guard(
        self, q: np.ndarray, dq: np.ndarray, last: np.ndarray, mass: np.ndarray, bias: np.ndarray
    ) -> tuple[np.ndarray, bool]:
        """Return the allowed torque (n,) Nm nearest to effort + holding torque, and whether both differ."""
        j, c = self._j, self._number
        near = max(
            float(((np.abs(dq) / j["dq_max"] - c["allowed"]) / (c["nothing"] - c["allowed"])).max()),
            float((np.maximum(q - j["q_high"], j["q_low"] - q) / j["q_fade"]).max()),
        )
        left = 1.0 - min(max(near, 0.0), 1.0)
        out = left * (self.effort + self._held)
        mobility = np.linalg.inv(mass + np.diag(j["added"]))
        high = c["rate"] * (self._allowed(j["q_high"] - q) - dq)
        low = -c["rate"] * (self._allowed(q - j["q_low"]) + dq)

        def bounded(tau: np.ndarray, bias: np.ndarray) -> tuple[np.ndarray, bool]:
            return self._bounded(tau, dq, mobility @ (tau - bias), (mobility, low, high))

        out, changed = bounded(out, bias) if self._push is None else self._push.limit(out, last, bounded)
        return out, changed or left < 1.0

    def _bounded(
        self, tau: np.ndarray, dq: np.ndarray, ddq: np.ndarray, bounds: tuple[np.ndarray, np.ndarray, np.ndarray]
    ) -> tuple[np.ndarray, bool]:
        """Return the torque (n,) Nm nearest to tau that keeps ddq in `bounds`, and whether it differs from tau.

        ddq: (n,) rad/s^2, acceleration that tau causes. bounds: inverse mass matrix, lowest and highest ddq (n,). For
        light joints, the share of friction that certainly acts widens the range of ddq.
        """
        j, c, (mobility, low, high) = self._j, self._number, bounds
        if ((low <= ddq) & (ddq <= high)).all():
            return tau, False
        light = (j["friction"] > 0.0) & (j["added"] > 0.0)
        held = np.where(light, j["friction"], 1.0)
        eaten = np.where(light, c["sure"] * held * np.abs(np.tanh(dq / c["dry"] + tau / held)), 0.0)
        wider = np.abs(mobility) @ eaten
        low, high = low - wider, high + wider
        if ((low <= ddq) & (ddq <= high)).all():
            return tau, False
        return tau + self._stops(mobility, ddq, low, high), True

    def fastest(self, q: np.ndarray, up: bool) -> np.ndarray:
        """Return the speeds (n,) rad/s that the filter allows at q (n,) rad, towards q_max (`up`) or q_min."""
        return self._allowed(self._j["q_high"] - q if up else q - self._j["q_low"])

    def _allowed(self, way: np.ndarray) -> np.ndarray:
        """Return the allowed speeds (n,) rad/s of joints at distances `way` (n,) rad from their position limits."""
        j, c = self._j, self._number
        speed = np.minimum(self._share * j["most"], c["approach"] * way)
        slows = (way > 0.0) & np.isfinite(j["slowing"])
        if slows.any():
            by = np.where(
                slows, np.sqrt(np.where(slows, j["slowing"] * way, 0.0) + j["offset"] ** 2) - j["offset"], np.inf
            )
            speed = np.minimum(speed, by)
        return speed

    def _stops(self, mobility: np.ndarray, ddq: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Return the torques (n,) Nm to add so that ddq stays in [low, high]; method: block principal pivoting."""
        c = self._number
        side = np.where(ddq > high, 1, np.where(ddq < low, -1, 0))
        push = np.zeros_like(ddq)
        for iteration in range(c["rounds"]):
            at = np.flatnonzero(side)
            push = np.zeros_like(ddq)
            push[at] = np.linalg.solve(mobility[np.ix_(at, at)], np.where(side > 0, high, low)[at] - ddq[at])
            reached = ddq + mobility @ push
            free = np.where(reached > high + c["exact"], 1, np.where(reached < low - c["exact"], -1, 0))
            other = np.where(side == 0, free, np.where(side * push > 0.0, 0, side))  # a bound only pushes ddq inwards
            changed = np.flatnonzero(other != side)
            if not len(changed):
                break
            changed = changed if iteration < c["pivots"] else changed[-1:]
            side[changed] = other[changed]
        return push
