"""Create the adapters of conf/adapt from the result of an identification.

To add an adapter, write a function or class that accepts an `AdapterContext` and the adapter's settings. Then name
this function or class in a new file of conf/adapt.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from r2s.adaptation.adapter import Adapter
from r2s.adaptation.arm_model import ArmModel, make_arm_model
from r2s.adaptation.contact_gate import ContactGate, Holdable
from r2s.adaptation.feedforward import Feedforward
from r2s.adaptation.kalman import Noise
from r2s.adaptation.model_correction import apply_correction
from r2s.adaptation.observer import Observer
from r2s.adaptation.offline_estimation import fit_correction
from r2s.adaptation.wrench import WrenchObserver
from r2s.identification.parameters import ParameterSpace
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot
from r2s.recordings.recording import Recording


@dataclass(frozen=True)
class AdapterContext:
    """Result of an arm's identification; functions such as `observer` create an adapter from this result.

    Attributes:
        robot, dynamics: the identified arm.
        posterior: parameter space and samples of the posterior; if None, `default_noise` assumes a prior.
        unloaded: two recordings with commanded torque and without a payload; if None, the model is not corrected.
    """

    robot: Robot
    dynamics: Dynamics
    posterior: tuple[ParameterSpace, np.ndarray] | None = None
    unloaded: tuple[Recording, Recording] | None = None

    @cached_property
    def arm(self) -> ArmModel:
        """Return the identified arm as an `ArmModel`, whose arrays compiled functions can read."""
        return make_arm_model(self.robot, self.dynamics)

    @cached_property
    def corrected(self) -> tuple[ArmModel, Noise]:
        """Return the arm model corrected by a fit to `unloaded`, together with the corrected model's uncertainty."""
        correction, noise = fit_correction(self.robot, self.dynamics, self.posterior, self.unloaded)
        return apply_correction(self.arm, correction), noise

    def gated(self, adapter: Holdable) -> Adapter:
        """Return the adapter; for a robot with a tool, wrap the adapter in a `ContactGate`."""
        if self.robot.tool is None:
            return adapter
        wrench = WrenchObserver(self.robot, self.dynamics)
        if self.unloaded is not None:
            wrench.calibrate(self.robot, self.unloaded)
        return ContactGate(adapter, wrench, *self.corrected)


def observer(context: AdapterContext, filter_s: float) -> Adapter:
    """Return the disturbance observer of `adapt=observer`; raise UserError unless filter_s is above 0.

    The observer's model omits the declared payload, because the arm itself compensates this payload's weight.
    """
    bare = replace(context.dynamics, declared_payload=np.zeros(4))
    return context.gated(Observer(make_arm_model(context.robot, bare), filter_s))


def rls(context: AdapterContext) -> Adapter:
    """Return the adapter of `adapt=rls`: feedforward from recursive estimates of payload, friction and offsets."""
    return context.gated(Feedforward(*context.corrected))
