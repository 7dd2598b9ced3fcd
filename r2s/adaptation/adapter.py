"""The interface of adapters, which correct the torque of a frozen policy at 1 kHz."""

from typing import Protocol

import numpy as np


class Adapter(Protocol):
    """A torque correction for one arm at 1 kHz; like the policy's torque, it passes through the safety filter.

    Adapters are picklable: on a real-time arm the 1 kHz cycle runs in its own process.
    """

    def begin(self) -> None:
        """Begin a motion from rest, with the identified model and no earlier estimates."""
        ...

    def __call__(self, q: np.ndarray, dq: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Process one cycle; return the torque (n,) Nm to add from the next cycle on.

        Args:
            q, dq: (n,) rad, rad/s, of this cycle. tau: (n,) Nm without gravity, the command sent in this cycle.
        """
        ...
