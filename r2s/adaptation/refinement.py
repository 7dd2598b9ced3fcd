"""What motion without a payload says of an arm beyond its identification.

An identification searches what its recording demands: a term that would improve little stays out, as it trades with
others. For an estimate of what a hand carries little counts: 0.1 Nm at 0.5 m is 20 g. Here nothing is chosen. Each
joint has all terms named below, all links have masses and first moments, all gears give, and each number has a prior
about zero, of the size that such things have: ridge regression, or the mean of the posterior of a linear model
(Bishop 2006, 3.3). The rows are balances of momentum (balance.py), which need no accelerations.

A gear gives: its link goes with the motor less what it bends by, torque / K, and so a balance that takes the link for
the motor lacks M d2(torque)/dt2 / K, with 15 kNm/rad on a Panda 0.7 Nm where a torque swings by 4 Nm at 7 Hz.
"""

from typing import NamedTuple

import numpy as np

from r2s.adaptation.balance import Balance
from r2s.adaptation.believed import DOWN, FLAT, UP, Believed
from r2s.physics.newton_euler import COM, MASS
from r2s.physics.rigid_body import regressor
from r2s.physics.robot import Robot

LEAST = 50  # spans of sliding that say something
LONGEST = 15  # spans in a row whose errors are one error: 0.3 s, LASTING of noise.py
ROUNDS = 3  # in which the errors' size is found
SLOW = 0.03  # rad/s, of the term that falls with speed as friction does after a rest
# of each joint: a share of its friction, offset, s |gravity|, s, s sqrt v, s / (1 + v / slow), v, s sin q, s cos q,
# sin q, cos q; s is the sign of the speed v
SHARE, OFFSET, OF_LOAD, OF_LAW, OF_TURN, OF_DRAG, TERMS = 0, 1, 2, 3, 7, 9, 11
# standard deviations of priors: what goes with friction's level in shares of it
LINK_SHARE, LINK_M = 0.02, 0.002  # of a link's mass, and of its centre
LOAD, DRAG = 0.01, 0.15  # Nm per Nm; Nm
LAW, TURN = 0.2, 0.03  # of the level
KNOWN = 0.3  # of friction, and Nm
ROTOR, LATE, GIVES = 0.1, 0.002, 1e-4  # kg m^2, s, rad/Nm


class Beyond(NamedTuple):
    """What is beyond an identification of n joints.

    Attributes:
        links: (n, 4) kg and kg m, mass and first moment of each link. gives: (n,) rad/Nm, of each gear.
        own: (n, TERMS), of each joint. inertia: (n, n) kg m^2, late: (n, n) s, as of `Noise`.
    """

    links: np.ndarray
    gives: np.ndarray
    own: np.ndarray
    inertia: np.ndarray
    late: np.ndarray

    @staticmethod
    def none(n: int) -> "Beyond":
        """Return that of an arm of n joints of which nothing more is known."""
        return Beyond(*map(np.zeros, ((n, 4), (n,), (n, TERMS), (n, n), (n, n))))


def beyond(robot: Robot, arm: Believed, rows: list[Balance]) -> Beyond:
    """Return what balances without a payload, made with `arm`, say beyond it; nothing of joints that hardly slid."""
    n = robot.n
    carried, own, y, slides = _columns(robot, arm, rows)
    slides = slides & (slides.sum(0) >= LEAST)
    if not slides.any():
        return Beyond.none(n)
    K, L = own.shape[2], 5 * n
    deviation = np.concatenate([_of_links(arm).ravel(), np.full(n, GIVES), _of_joints(arm).ravel()])
    size: np.ndarray = KNOWN * np.maximum(arm.level, 1e-6)
    out: np.ndarray = np.zeros(len(deviation))
    parts = []
    for j in range(n):
        one = np.column_stack([carried[slides[:, j], j], own[slides[:, j], j]])
        at = np.concatenate([np.arange(L), L + j * K + np.arange(K)])
        parts.append((at, one, y[slides[:, j], j], one.T @ one, one.T @ y[slides[:, j], j]))
    for _ in range(ROUNDS):
        normal, right = np.diag(deviation**-2.0), np.zeros_like(out)
        for j, (at, _, _, square, product) in enumerate(parts):
            weight = 1 / (LONGEST * size[j] ** 2)
            normal[np.ix_(at, at)] += weight * square
            right[at] += weight * product
        out = np.linalg.solve(normal, right)
        for j, (at, one, left, _, _) in enumerate(parts):
            if len(left):
                size[j] = max(np.sqrt(np.mean((left - one @ out[at]) ** 2)), 1e-6 * arm.level[j])
    links, gives, terms = out[: 4 * n].reshape(n, 4), out[4 * n : L], out[L:].reshape(n, K)
    return Beyond(links, gives, terms[:, :TERMS], terms[:, TERMS : TERMS + n], terms[:, TERMS + n :])


def refined(arm: Believed, more: Beyond) -> Believed:
    """Return the arm with what is beyond its identification, but for inertia and delay, which `Noise` has."""
    links, table = arm.links.copy(), arm.table.copy()
    before, weighs = arm.links[:, MASS, None], arm.links[:, MASS] > 0.0
    mass = np.maximum(before + more.links[:, :1], 0.5 * before)[weighs]
    moment = (before * arm.links[:, COM : COM + 3] + more.links[:, 1:])[weighs]
    links[weighs, MASS], links[weighs, COM : COM + 3] = mass[:, 0], moment / mass
    side = np.linspace(-1, 1, table.shape[2])
    v = side**2 * arm.fastest[:, None]
    own, grows = more.own, 1.0 + more.own[:, SHARE]
    firm, root, slow, viscous = own[:, OF_LAW:OF_TURN].T[..., None]
    signed = firm + root * np.sqrt(v) + slow / (1 + v / SLOW)
    table *= grows[:, None, None]
    table[:, UP] += signed
    table[:, DOWN] += signed
    table[:, FLAT] += viscous * np.sign(side) * v
    return arm._replace(
        links=links, table=table, gives=arm.gives + more.gives, offset=arm.offset - own[:, OFFSET],
        load=grows * arm.load + own[:, OF_LOAD], turn=grows[:, None] * arm.turn + own[:, OF_TURN:OF_DRAG],
        drag=arm.drag - own[:, OF_DRAG:],
    )  # fmt: skip


def corrected(robot: Robot, arm: Believed, more: Beyond, rows: list[Balance]) -> list[Balance]:
    """Return balances that were made with `arm` as the arm with `more` would have made them.

    Inertia and delay are taken out, too.
    """
    links, own, y, _ = _columns(robot, arm, rows)
    each = own * np.concatenate([more.own, more.inertia, more.late], 1)
    left = y - links @ np.concatenate([more.links.ravel(), more.gives]) - each.sum(-1)
    rub = np.array([b.rub for b in rows]) + each[..., SHARE] + each[..., OF_LOAD:OF_DRAG].sum(-1)
    return [b._replace(y=one, rub=two) for b, one, two in zip(rows, left, rub, strict=True)]


def _columns(
    robot: Robot, arm: Believed, rows: list[Balance]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return what links and gears (T, n, 5 n) and own terms (T, n, K) make of balances, these, and what slid."""
    q, v, rub, y, slides, faster, firmer = (
        np.array([getattr(b, name) for b in rows]) for name in ("q", "dq", "rub", "y", "slides", "faster", "firmer")
    )
    samples, n = q.shape
    still = np.zeros_like(q)
    mass = arm.links[:, MASS, None]
    moments = np.concatenate([mass, mass * arm.links[:, COM : COM + 3]], 1)
    weight = np.abs(np.einsum("tjkc,kc->tj", regressor(robot, q, still, still, arm.gravity)[..., :4], moments))
    links = regressor(robot, q, v, faster, arm.gravity)[..., :4].reshape(samples, n, 4 * n)
    links = np.concatenate([links, -np.array([b.bent for b in rows])], -1)
    s, speed = np.sign(v), np.abs(v)
    terms = [rub, np.ones_like(q), s * weight, s, s * np.sqrt(speed), s / (1 + speed / SLOW), v]
    terms += [s * np.sin(q), s * np.cos(q), np.sin(q), np.cos(q)]
    shared = [np.broadcast_to(x[:, None], (samples, n, n)) for x in (faster, firmer)]
    return links, np.concatenate([np.stack(terms, -1), *shared], -1), y, slides > 0


def _of_links(arm: Believed) -> np.ndarray:
    """Return (n, 4) kg and kg m, standard deviations of masses and first moments."""
    mass = np.maximum(arm.links[:, MASS, None], 1e-6)
    return np.concatenate([LINK_SHARE * mass, np.repeat(LINK_M * mass, 3, 1)], 1)


def _of_joints(arm: Believed) -> np.ndarray:
    """Return (n, K), standard deviations of a joint's own terms."""
    n, level = len(arm.level), np.maximum(arm.level, 1e-6)[:, None]
    one = np.ones((n, 1))
    parts = [KNOWN * one, KNOWN * one, LOAD * one, *[LAW * level] * 4, *[TURN * level] * 2, *[DRAG * one] * 2]
    return np.concatenate([*parts, np.full((n, n), ROTOR), np.full((n, n), LATE)], 1)
