"""The interface of adapters: a torque correction at 1 kHz under a frozen policy."""

from typing import Protocol

import numpy as np


class Adapter(Protocol):
    """A torque correction for one arm at 1 kHz; it passes through the safety filter like the policy's torque.

    Adapters are picklable: on a real-time arm the 1 kHz cycle runs in its own process.
    """

    def begin(self) -> None:
        """Begin a motion from rest, with the identified model alone."""
        ...

    def __call__(self, q: np.ndarray, dq: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Process a cycle; return (n,) Nm to add from the next cycle on.

        Args:
            q, dq: (n,) rad, rad/s, of this cycle. tau: (n,) Nm without gravity, the command sent in this cycle.
        """
        ...
