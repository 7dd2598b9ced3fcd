"""What a policy may be told of the arm that it moves, and who tells it: `adapt=osi` and `adapt=rma`.

Such adapters add no torque. A policy that was trained with more inputs than its task's observation is told what is in
the hand and how friction stands, of an arm of n joints 4 + n numbers, `SAID`; zeros are the arm as it is believed to
be. In training that is the truth (`truth`), on an arm the recursive estimate: Yu, Tan, Liu and Turk, RSS 2017, arXiv
1702.02453 (universal policy with online system identification). Or the policy is told a latent that a network makes
of the history, as it was taught by one that sees the truth: Kumar, Fu, Pathak and Malik, RSS 2021, arXiv 2107.04034
(rapid motor adaptation).
"""

import numpy as np

from r2s.adaptation.balance import SPAN
from r2s.adaptation.believed import FIRM, Believed
from r2s.adaptation.compensation import thing
from r2s.adaptation.estimator import Estimator
from r2s.adaptation.history import Network, Seen
from r2s.adaptation.kalman import JUMP, Noise
from r2s.adaptation.momentum import BODY
from r2s.physics.dynamics import Dynamics
from r2s.physics.payload import hand
from r2s.physics.robot import Robot

SAID = (
    "payload kg, first moments about the hand kg m, of each joint by which share friction is above what is believed"
)
USUAL = np.array([0.75, 0.05, 0.05, 0.05])  # kg, kg m: of payloads up to 1.5 kg within 7.5 cm
MOST_SHARE = 0.5  # by which friction may be said to be more or less


def said_count(n: int) -> int:
    """Return how many numbers are told of an arm of n joints."""
    return JUMP + n


def said_scale(n: int) -> np.ndarray:
    """Return (4 + n,), the scale of each."""
    return np.concatenate([USUAL, np.full(n, 0.2)])


def truth(robot: Robot, center: Dynamics, dynamics: Dynamics) -> np.ndarray:
    """Return (m, 4 + n), what there is to be told of m arms.

    Args:
        robot: the arm. center: what is believed of it. dynamics: of m arms, or of one.
    """
    place, axes = hand(robot)
    one = _last(center)
    more = np.atleast_2d(_last(dynamics) - one)
    moments = (more[:, 1:] - more[:, :1] * place) @ axes
    own, level = _level(center, robot.n), np.atleast_2d(_level(dynamics, robot.n))
    share = np.where(own > 0, level / np.where(own > 0, own, 1.0) - 1.0, 0.0)
    rows = max(len(more), len(share))
    parts = (more[:, :1], moments, share)
    return np.concatenate([np.broadcast_to(x, (rows, x.shape[1])) for x in parts], axis=1)


def _last(d: Dynamics) -> np.ndarray:
    """Return (..., 4) kg and kg m, mass and first moment of the last link in its frame."""
    mass = np.asarray(d.mass)[..., -1, None]
    return np.concatenate([mass, mass * d.com[..., -1, :]], -1)


def _level(d: Dynamics, n: int) -> np.ndarray:
    """Return (..., n) Nm, the level of sliding friction, as of `Believed`."""
    firm = np.full(n, FIRM)
    return 0.5 * np.abs(d.friction(firm) - d.friction(-firm))


class Telling:
    """The `Adapter` that tells a policy what `Estimator` is sure of: `adapt=osi`.

    A payload is told as one that may be in a hand, less what the arm was told of it itself; each number is shrunk as
    of compensation.py: what may as well be nothing is not told.

    Attributes:
        told: (4 + n,), see `SAID`; the newest.

    Args:
        arm: what is believed of it. noise: how wrong that may be. load: (4,) kg and kg m about the hand, what the
            arm's own gravity compensation was told.
    """

    def __init__(self, arm: Believed, noise: Noise, load: np.ndarray):
        self._arm, self._noise, self._load = arm, noise, load
        self.begin()

    def begin(self) -> None:
        """Begin a motion from rest: nothing is known of the arm beyond its identification."""
        n = len(self._arm.level)
        self.estimator = Estimator(self._arm, self._noise)
        self.told, self._adds, self._thing = np.zeros(said_count(n)), np.zeros(n), np.zeros(BODY)

    def __call__(self, q: np.ndarray, dq: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Hear a cycle and return (n,) Nm of zero; arguments as of `Adapter`."""
        if self.estimator(q, dq, tau):
            filter, _, _ = self.estimator.inside
            n = len(self._adds)
            thing(filter.x, self._thing)
            of = np.array([0, *range(BODY, BODY + n)])  # mass, shares of friction
            x = filter.x[of]
            unsure = np.divide(filter.P[of, of], x**2, out=np.ones(n + 1), where=x != 0)
            sure = np.maximum(0.0, 1.0 - unsure)
            share = np.clip(sure[1:] * x[1:], -MOST_SHARE, MOST_SHARE)
            self.told = np.concatenate([sure[0] * self._thing[:JUMP] - self._load, share])
        return self._adds


class Latent:
    """The `Adapter` that tells a policy a latent of what it has seen, through a low-pass of a span: `adapt=rma`.

    Attributes:
        told: (l,), the newest.

    Args:
        arm: what is believed of it. network: that says the latent of what `Seen` shows.
    """

    def __init__(self, arm: Believed, network: Network):
        self._arm, self._network = arm, network
        self.begin()

    def begin(self) -> None:
        """Begin a motion from rest: nothing has been seen."""
        self._seen, self._adds = Seen(self._arm), np.zeros(len(self._arm.level))
        self._aim, self.told = (np.zeros(len(self._network.size)) for _ in range(2))

    def __call__(self, q: np.ndarray, dq: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Hear a cycle and return (n,) Nm of zero; arguments as of `Adapter`."""
        inputs = self._seen(q, dq, tau)
        if inputs is not None:
            self._aim = self._network(inputs)
        self.told = self.told + (self._aim - self.told) / SPAN
        return self._adds
