"""An adapter that stops while the arm touches something: it would read the contact as an error of the model and push.

In contact the torque stays what it was before the contact began, and the adapter's estimate is held.
"""

from typing import Protocol

import numpy as np

from r2s.adaptation.adapter import Adapter
from r2s.adaptation.wrench import WrenchObserver

REWIND = 100  # cycles before a detected contact: longer than its detection takes (benchmarks/wrench.py)


class Holdable(Adapter, Protocol):
    """An adapter whose estimate can be held."""

    held: bool


class ContactGate:
    """The `Adapter` that holds another one in contact.

    Args:
        adapter: what it holds. wrench: decides on contact.
    """

    def __init__(self, adapter: Holdable, wrench: WrenchObserver):
        self.adapter, self.wrench = adapter, wrench
        self.begin()

    def begin(self) -> None:
        """Begin a motion from rest, without contact."""
        self.adapter.begin()
        self.wrench.begin()
        self.adapter.held = False
        self._past = np.zeros((REWIND, len(self.wrench.rests)))  # torques of the last cycles
        self._cycle = 0

    def __call__(self, q: np.ndarray, dq: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Process a cycle and return (n,) Nm to add; see `Adapter`."""
        self.adapter.held = self.wrench(q, dq, tau)
        torque = self.adapter(q, dq, tau)
        oldest = self._past[self._cycle % REWIND]
        if self.adapter.held:
            return oldest
        oldest[:] = torque
        self._cycle += 1
        return torque
