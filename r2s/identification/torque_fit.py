"""Test whether recorded torque fits the nominal arm, or only a different joint order, mounting or link mass."""

from collections.abc import Sequence
from copy import copy
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.optimize import lsq_linear

from r2s.physics.friction import WIDTH_DQ
from r2s.physics.rigid_body import LinkInertia, nominal_torque, regressor
from r2s.physics.robot import Robot

# least factor by which a reported mass is wrong; largest share of the misfit after a valid correction
MASS, MASS_LEFT = 3.0, 0.1
CARRIED = 3  # number of last links whose mass is not judged, because a payload may be undeclared
TILTED = np.radians(20)  # least reported angle of a mounting; uncertain masses can cause smaller fitted angles
INERTIA = 0.3, 4.0  # range of the factor on nominal torque, for errors of tensors, payloads and gains
FRICTION, OFFSET = 0.5, 0.1  # largest fitted friction and offset, relative to tau_max
MAX_LEFT = 2.0  # upper limit of a joint's unexplained share
# Only joints in which gravity changes are judged. CHANGES: least RMS change, relative to tau_max. CORRELATED: factor
# by which correlated rows raise the standard error of gravity's share. MAX_SIGMA: largest standard error.
CHANGES, CORRELATED, MAX_SIGMA = 0.01, 3.0, 0.15


class Moments(NamedTuple):
    """Motion q, dq, ddq and torque tau, each (T, n), zero-phase filtered; dq and ddq are time derivatives of q."""

    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray
    tau: np.ndarray


class Unexplained:
    """Compute the share of recorded torque, in the S joints with indices `seen`, that the model does not explain."""

    def __init__(self, robot: Robot, m: Moments, gravity: bool):
        self.robot, self.m = robot, m
        self.seen, self.need = np.arange(robot.n), self.inverse_dynamics(gravity)

    def with_need(self, need: np.ndarray) -> "Unexplained":
        """Return a copy of this object that compares tau with `need` (T, n) Nm as the nominal torque."""
        out = copy(self)
        out.need = need
        return out

    def inverse_dynamics(self, gravity: bool | np.ndarray) -> np.ndarray:
        """Return the `nominal_torque` (T, n) Nm of the recorded motion."""
        return nominal_torque(self.robot, self.m.q, self.m.dq, self.m.ddq, gravity)

    def fit(self, parts: np.ndarray) -> np.ndarray:
        """Fit tau - `need` by a weighted sum of the K torques in `parts` (K, T, n) Nm; return the weights (K,)."""
        rows = np.concatenate(self._apart([*parts, self.m.tau - self.need]))
        return np.linalg.lstsq(rows[:, :-1], rows[:, -1], rcond=None)[0]

    def misfit(self) -> float:
        """Return sum (tau - nominal torque)^2 / sum tau^2 after removal of each joint's friction and offset."""
        left, whole = np.square(np.concatenate(self._apart([self.m.tau - self.need, self.m.tau]))).sum(0)
        return float(left / max(whole, 1e-12))

    def scaled(self) -> tuple[np.ndarray, float]:
        """Fit each joint's tau by a factor times its nominal torque; return the factors (S,) and the misfit."""
        factors, left, whole = [], 0.0, 1e-12
        for need, tau in (x.T for x in self._apart([self.need, self.m.tau])):
            factors.append(need @ tau / max(need @ need, 1e-12))
            left, whole = left + float(((tau - factors[-1] * need) ** 2).sum()), whole + float(tau @ tau)
        return np.array(factors), left / whole

    def _apart(self, torques: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return, for each judged joint, K torques / tau_max (T, K) minus fitted friction and offset."""
        out = []
        for j in self.seen.tolist():
            own = np.column_stack([np.tanh(self.m.dq[:, j] / WIDTH_DQ), self.m.dq[:, j], np.ones(len(self.m.dq))])
            x = np.column_stack([tau[:, j] for tau in torques]) / self.robot.tau_max[j]
            out.append(x - own @ np.linalg.lstsq(own, x, rcond=None)[0])
        return out

    def gravity_shares(self) -> np.ndarray | None:
        """Return tau's gravity torque / nominal gravity torque of joints whose motion determines it, else None."""
        inertial = self.inverse_dynamics(False)
        weight, shares = self.inverse_dynamics(True) - inertial, []
        for j in self.seen:
            parts = inertial[:, j], np.tanh(self.m.dq[:, j] / WIDTH_DQ), self.m.dq[:, j], np.ones(len(weight))
            rest = np.column_stack(parts)
            a, b = (x - rest @ np.linalg.lstsq(rest, x, rcond=None)[0] for x in (weight[:, j], self.m.tau[:, j]))
            square = max(a @ a, 1e-12)
            share = a @ b / square
            if CORRELATED * np.sqrt(((b - a * share) ** 2).mean() / square) < MAX_SIGMA and (
                square / len(a) > (CHANGES * self.robot.tau_max[j]) ** 2
            ):
                shares.append(share)
        return np.array(shares) if shares else None

    def each(self, tau: np.ndarray) -> np.ndarray:
        """Fit tau (T, n) of each judged joint with the motion of the same joint; return unexplained shares (S,)."""
        return np.array([self._share(j, tau[:, j]) for j in self.seen.tolist()])

    def pairs(self) -> np.ndarray:
        """Fit each column k of tau with the motion of each joint j; return unexplained shares (S, S) at [j, k]."""
        return np.array([[self._share(j, self.m.tau[:, k]) for k in self.seen] for j in self.seen.tolist()])

    def _share(self, j: int, tau: np.ndarray) -> float:
        """Fit tau (T,) by nominal torque, rotor, friction and offset of joint j; return the unexplained share."""
        most, m = self.robot.tau_max[j], self.m
        slow = [m.ddq[:, j], np.tanh(m.dq[:, j] / WIDTH_DQ), m.dq[:, j]]
        scale = most / np.maximum([np.sqrt((x**2).mean()) for x in slow], 1e-9)
        scaled = [x * s for x, s in zip(slow, scale, strict=True)]
        columns = np.column_stack([self.need[:, j], *scaled, np.full(len(tau), most)])
        low, high = [INERTIA[0], 0.0, 0.0, 0.0, -OFFSET], [INERTIA[1], *[FRICTION] * 3, OFFSET]
        fit = lsq_linear(columns, tau, bounds=(low, high))
        return min(float(2.0 * fit.cost / max((tau**2).sum(), 1e-12)), MAX_LEFT)


def other_orders(left: Unexplained, gravity: bool) -> list[tuple[float, str]]:
    """Return (misfit, message) for joint orders of tau or of all signals: by name, rotated, reversed, swapped."""
    robot, m, every, out = left.robot, left.m, np.arange(left.robot.n), []
    names = [robot.model(gravity=False).joint(i).name for i in range(robot.n)]
    orders = {tuple(np.argsort(np.argsort(names))): " (the log has them in alphabetical order)"}
    for k in range(1, robot.n):
        orders.setdefault(tuple(np.roll(every, k)), "")
    orders.setdefault(tuple(every[::-1]), "")
    for i, j in combinations(range(robot.n), 2):
        swap = every.copy()
        swap[[i, j]] = j, i
        orders.setdefault(tuple(swap), "")
    orders.pop(tuple(every), None)
    for order, why in orders.items():
        own = left.with_need(left.need)
        own.m = m._replace(tau=m.tau[:, order])
        off = [j for j in range(robot.n) if order[j] != j]
        columns, joints = (", ".join(str(k + 1) for k in x) for x in ([order[j] for j in off], off))
        words = f"has its joints in another order than q: columns {columns} of tau fit joints {joints}{why}"
        out.append((own.misfit(), words))
        turned = Moments(*(x[:, order] for x in m))
        if (turned.q >= robot.q_min).all() and (turned.q <= robot.q_max).all():
            columns = " ".join(str(k + 1) for k in order)
            words = f"and the motion fit {robot.name} only with the joints in another order: columns {columns}{why}"
            out.append((Unexplained(robot, turned, gravity).misfit(), words))
    return out


def other_masses(left: Unexplained, gravity: bool) -> list[tuple[float, str]]:
    """Return (misfit, message) for each link that needs a different mass; its moments scale with the mass."""
    robot, m, out = left.robot, left.m, []
    y = regressor(robot, m.q, m.dq, m.ddq, robot.gravity if gravity else None)
    standard, names = LinkInertia(robot.mass, robot.com, robot.inertia).standard(), robot.model(gravity=False)
    for k in range(robot.n - CARRIED):
        own = y[:, :, k] @ standard[k]
        (change,) = left.fit(own[None])
        if (1 + change > MASS or 1 + change < 1 / MASS) and 1 + change > 0:
            link, mass = names.body(names.jnt_bodyid[k]).name or f"link {k + 1}", robot.mass[k]
            words = (
                f"fits {robot.name} only if link '{link}' has {mass * (1 + change):.3g} kg, not {mass:.3g}: correct "
                f"its mass and tensor in {robot.mjcf.name}"
            )
            out.append((left.with_need(left.need + change * own).misfit(), words))
    return out


def mounting(left: Unexplained) -> list[tuple[float, str]]:
    """Fit the direction of gravity; return [(misfit, message)] if it contradicts the nominal mounting, else []."""
    robot, size = left.robot, float(np.linalg.norm(left.robot.gravity))
    inertial = left.inverse_dynamics(False)
    parts = np.array([left.inverse_dynamics(g) - inertial for g in np.eye(3)])
    fitted = left.with_need(inertial).fit(parts)
    if size == 0 or not np.any(fitted):
        return []
    down = fitted / np.linalg.norm(fitted)
    axis = np.eye(3)[np.abs(down).argmax()] * np.sign(down[np.abs(down).argmax()])
    down = axis if down @ axis > np.cos(0.5 * TILTED) else down
    cosine = float(down @ robot.gravity / size)
    if cosine > np.cos(TILTED):
        return []
    where = "hangs" if cosine < -0.9 else "is mounted on a wall" if abs(cosine) < 0.4 else "is mounted at an angle"
    given = ", ".join(f"{size * x + 0.0:.3g}" for x in down)
    words = f"fits {robot.name} only if it {where}: set robot.gravity=[{given}]"
    return [(left.with_need(inertial + size * np.tensordot(down, parts, 1)).misfit(), words)]
