"""What works under a frozen policy: it hears every cycle of an arm, and adds a torque to what the policy asks for."""

from typing import Protocol, runtime_checkable

import numpy as np


class Adapter(Protocol):
    """A correction of one arm's torque at 1 kHz; it goes through the driver's law, as the policy's does.

    Adapters are picklable: an arm whose clock does not wait has its 1 kHz cycle in a process of its own.
    """

    def begin(self) -> None:
        """Begin a motion from rest, as if nothing had been heard of this arm since its identification."""
        ...

    def __call__(self, q: np.ndarray, dq: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Hear a cycle; return (n,) Nm to add from the next one on.

        Args:
            q, dq: (n,) rad, rad/s, of this cycle. tau: (n,) Nm without gravity, the command that was sent in it.
        """
        ...


@runtime_checkable
class Tells(Protocol):
    """An `Adapter` that tells a policy of its arm, one that was trained to be told (telling.py).

    Attributes:
        told: (c,), the newest, an array of its own each time; zeros where a motion begins.
    """

    told: np.ndarray
