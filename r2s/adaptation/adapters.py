"""What conf/adapt names: adapters, made of what is known of an arm.

One of your own is a function of `Known` and its settings, or a class, that a yaml in conf/adapt names.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from r2s.adaptation.believed import Believed, believed
from r2s.adaptation.compensation import Compensation
from r2s.adaptation.kalman import Noise
from r2s.adaptation.listen import noise
from r2s.adaptation.observer import Observer
from r2s.identification.parameters import ParameterSpace
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot
from r2s.recordings.recording import Recording


@dataclass(frozen=True)
class Known:
    """What an identification says of an arm.

    Attributes:
        robot, dynamics: what is believed of it.
        posterior: the space and draws of its parameters. unloaded: its two recordings of commanded torque, without a
            payload. None where they are not there, as of `r2s.adaptation.listen.estimator`.
    """

    robot: Robot
    dynamics: Dynamics
    posterior: tuple[ParameterSpace, np.ndarray] | None = None
    unloaded: tuple[Recording, Recording] | None = None

    @cached_property
    def arm(self) -> Believed:
        """The arm as arrays."""
        return believed(self.robot, self.dynamics)

    @cached_property
    def noise(self) -> Noise:
        """How wrong that may be."""
        return noise(self.robot, self.arm, self.posterior, self.unloaded)


def observer(known: Known, filter_s: float) -> Observer:
    """Return a disturbance observer: `adapt=observer`; raises UserError as of `Observer`."""
    return Observer(known.arm, filter_s)


def rls(known: Known) -> Compensation:
    """Return compensation by the recursive estimate: `adapt=rls`."""
    return Compensation(known.arm, known.noise)
