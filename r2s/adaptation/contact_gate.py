"""Freeze an adapter in contact, because adapters treat a contact force as a model error and push against the force.

In contact, the gate freezes the adapter's estimate and returns the torque that the adapter added REWIND cycles before
the gate detected the contact.
"""

from typing import Protocol

import numpy as np

from r2s.adaptation.adapter import Adapter
from r2s.adaptation.wrench import WrenchObserver

REWIND = 100  # cycles, age of the torque added in contact: longer than a detection takes (benchmarks/wrench.py)


class Holdable(Adapter, Protocol):
    """An adapter whose estimate is frozen while `held` is True."""

    held: bool


class ContactGate:
    """Wrap an adapter, and freeze the wrapped adapter in contact.

    Args:
        adapter: the wrapped adapter. wrench: observer that detects contacts.
    """

    def __init__(self, adapter: Holdable, wrench: WrenchObserver):
        self.adapter, self.wrench = adapter, wrench
        self.begin()

    def begin(self) -> None:
        """Start a motion from rest and without contact."""
        self.adapter.begin()
        self.wrench.begin()
        self.adapter.held = False
        self._past = np.zeros((REWIND, len(self.wrench.rests)))  # added torques of the last cycles without contact
        self._cycle = 0

    def __call__(self, q: np.ndarray, dq: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Process one cycle; return the torque (n,) Nm that the driver adds in the next cycle; see `Adapter`."""
        self.adapter.held = self.wrench(q, dq, tau)
        torque = self.adapter(q, dq, tau)
        oldest = self._past[self._cycle % REWIND]
        if self.adapter.held:
            return oldest
        oldest[:] = torque
        self._cycle += 1
        return torque
