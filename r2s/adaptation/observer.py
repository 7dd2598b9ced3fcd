"""A disturbance observer: what commands, friction and links do not explain is added, through one low-pass.

With p = M(q) dq and dp/dt = tau + C^T dq - g - friction - d, generalised momentum tells the lacking torque d without
accelerations (De Luca and Mattone, ICRA 2003; De Luca, Albu-Schaeffer, Haddadin and Hirzinger, IROS 2006), here as
a mean over three spans (balance.py), which a low-pass of first order follows: filter_s dd^/dt = d - d^. Commands go
through the identified delay and lag first.

A joint that does not slide all the time may be held by anything within its edges: d is somewhere between two bounds
then, and d^ changes no more than it has to. So stiction is left to hold the arm, as the policy has learnt it.
"""

import numpy as np

from r2s.adaptation.balance import Balance, Kept, observe
from r2s.adaptation.believed import Believed
from r2s.compiled import njit
from r2s.errors import check_number
from r2s.physics.robot import SIM_DT


class Observer:
    """The `Adapter` that adds all that is lacking, whatever its cause.

    Args:
        arm: what is believed of it. filter_s: s, the constant of the low-pass.

    Raises:
        UserError: a constant that is not above 0.
    """

    def __init__(self, arm: Believed, filter_s: float):
        check_number("filter_s", filter_s, "(0, inf)")
        self._arm, self._share = arm, -np.expm1(-SIM_DT / filter_s)
        self.begin()

    def begin(self) -> None:
        """Begin a motion from rest: nothing lacks."""
        n = len(self._arm.level)
        self._kept, self._balance = Kept.fresh(n), Balance.empty(n)
        self._aim, self._lacks = np.zeros(n), np.zeros(n)

    def __call__(self, q: np.ndarray, dq: np.ndarray, tau: np.ndarray) -> np.ndarray:
        """Hear a cycle and return (n,) Nm to add; arguments as of `Adapter`."""
        _hear(self._arm, self._kept, self._balance, q, dq, tau, self._share, self._aim, self._lacks)
        return self._lacks


@njit(cache=True, error_model="numpy")
def _hear(arm, kept, balance, q, dq, tau, share, aim, lacks):
    """Take one cycle into `lacks` (n,) Nm; aim: (n,) Nm, what the last span said of it."""
    n = len(q)
    if observe(arm, kept, q, dq, tau, balance):
        for j in range(n):
            aim[j] = balance.y[j]
            if balance.slides[j] == 0.0:
                free, edge = balance.y[j] + balance.rub[j], max(arm.edge[j], abs(balance.rub[j]))
                aim[j] = min(max(lacks[j], free - edge), free + edge)
    for j in range(n):
        lacks[j] += share * (aim[j] - lacks[j])
