"""A torque learnt from history: a network is shown the last half second, and says what lacks now.

The idea of the Torque Adaptation Module (TAM, arXiv 2606.06218), a learnt correction under a frozen policy, made anew
and much smaller: what it sees is not the raw history but what the identified model cannot explain of it (balance.py),
and where the arm is and how it moves. r2s/learning/history.py trains it.
"""

from typing import NamedTuple

import numpy as np

from r2s.adaptation.balance import SPAN, Balance, Kept, observe
from r2s.adaptation.believed import Believed

SPANS = 25  # of the history: 0.5 s


def inputs(n: int) -> int:
    """Return how many numbers `Seen` shows of an arm of n joints."""
    return (SPANS + 4) * n


class Network(NamedTuple):
    """A perceptron with tanh between its layers; inputs (d,), outputs (n,) Nm.

    Attributes:
        mean, scale: (d,) of the inputs. size: (n,) Nm of the outputs. layers: weights (k, l) and biases (l,) in turn.
    """

    mean: np.ndarray
    scale: np.ndarray
    size: np.ndarray
    layers: tuple[np.ndarray, ...]

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Return (n,) Nm for the inputs (d,)."""
        x = (x - self.mean) / self.scale
        for k in range(0, len(self.layers), 2):
            x = x @ self.layers[k] + self.layers[k + 1]
            if k + 2 < len(self.layers):
                np.tanh(x, out=x)
        return self.size * x


class Seen:
    """What the network is shown of one arm, span by span.

    Args:
        arm: what is believed of it.
    """

    def __init__(self, arm: Believed):
        self._arm, n = arm, len(arm.level)
        self._kept, self._balance = Kept.fresh(n), Balance.empty(n)
        self._lacked = np.zeros((SPANS, n))

    def __call__(self, q: np.ndarray, dq: np.ndarray, tau: np.ndarray) -> np.ndarray | None:
        """Hear a cycle, as of `Adapter`; return the inputs (d,) at the end of a span, else None."""
        if not observe(self._arm, self._kept, q, dq, tau, self._balance):
            return None
        level = self._arm.level
        self._lacked[:-1] = self._lacked[1:]
        self._lacked[-1] = self._balance.y / level
        return np.concatenate([self._lacked.ravel(), np.sin(q), np.cos(q), dq, self._balance.rub / level])


class History:
    """The `Adapter` that adds what a network says, through a low-pass of a span.

    Args:
        arm: what is believed of it. network: which.
    """

    def __init__(self, arm: Believed, network: Network):
        self._arm, self._network = arm, network
        self.begin()

    def begin(self) -> None:
        """Begin a motion from rest: nothing has been seen."""
        self._seen = Seen(self._arm)
        self._aim, self._adds = (np.zeros(len(self._arm.level)) for _ in range(2))

    def __call__(self, q: np.ndarray, dq: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Hear a cycle and return (n,) Nm to add; arguments as of `Adapter`."""
        inputs = self._seen(q, dq, tau)
        if inputs is not None:
            self._aim = self._network(inputs)
        self._adds = self._adds + (self._aim - self._adds) / SPAN
        return self._adds
