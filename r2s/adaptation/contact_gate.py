"""Freeze an adapter in contact, because adapters treat a contact force as a model error and push against the force.

In contact, the gate freezes the adapter's estimate and returns the torque that the adapter added REWIND cycles before
the gate detected the contact. The gate passes the estimated payload to the wrench observer, so that the observer does
not detect the payload's weight as a contact. For an adapter without an `Estimator`, the gate itself estimates the
payload.
"""

from typing import Any, Protocol

import numpy as np

from r2s.adaptation.adapter import Adapter
from r2s.adaptation.arm_model import ArmModel
from r2s.adaptation.estimator import Estimator
from r2s.adaptation.kalman import Noise
from r2s.adaptation.wrench import WrenchObserver

REWIND = 100  # cycles, age of the torque added in contact; a detection takes less time (benchmarks/wrench.py)


class Holdable(Adapter, Protocol):
    """An adapter whose estimate is frozen while `held` is True."""

    held: bool


class ContactGate:
    """Wrap an adapter, and freeze the wrapped adapter in contact.

    Args:
        adapter: the wrapped adapter; if it has an attribute `estimator`, the gate uses the payload of this estimator.
        wrench: observer that detects contacts.
        arm, noise: arm model and model uncertainty, for an estimator of the gate.
    """

    def __init__(self, adapter: Holdable, wrench: WrenchObserver, arm: ArmModel, noise: Noise):
        self.adapter, self.wrench, self._model = adapter, wrench, (arm, noise)
        self.begin()

    def begin(self) -> None:
        """Start a motion from rest and without contact."""
        self.adapter.begin()
        self.wrench.begin()
        self.adapter.held = False
        given: Any = getattr(self.adapter, "estimator", None)
        self._own = given is None
        self._estimator: Estimator = Estimator(*self._model) if self._own else given
        self._past = np.zeros((REWIND, len(self.wrench.rests)))  # torques added in the last cycles without contact
        self._cycle = 0

    def __call__(self, q: np.ndarray, dq: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Process one cycle; return the torque (n,) Nm that the driver adds in the next cycle; see `Adapter`."""
        self.adapter.held = self.wrench(q, dq, tau)
        torque = self.adapter(q, dq, tau)
        if self._own:
            self._estimator.held = self.adapter.held
            self._estimator(q, dq, tau)
        self.wrench.carry(self._estimator.payload)
        oldest = self._past[self._cycle % REWIND]
        if self.adapter.held:
            return oldest
        oldest[:] = torque
        self._cycle += 1
        return torque
