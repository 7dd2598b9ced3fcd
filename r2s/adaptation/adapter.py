"""Define the interface of adapters, which correct the torque of a frozen policy at 1 kHz."""

from typing import Protocol

import numpy as np


class Adapter(Protocol):
    """An object that computes a torque at 1 kHz; the driver adds it to the policy's torque before the safety filter.

    An adapter must be picklable, because on a real-time arm, adapter and policy run in different processes.
    """

    def begin(self) -> None:
        """Start a motion from rest, and discard all estimates of earlier motions."""
        ...

    def __call__(self, q: np.ndarray, dq: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Process one cycle; return the torque (n,) Nm that the driver adds in the next cycle.

        Args:
            q, dq: (n,) rad, rad/s, measured in this cycle. tau: (n,) Nm, command sent in this cycle, without gravity.
        """
        ...
