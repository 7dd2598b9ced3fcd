"""What conf/adapt names: adapters, made of what is known of an arm.

One of your own is a function of `Known` and its settings, or a class, that a yaml in conf/adapt names.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from r2s.adaptation.believed import Believed, believed
from r2s.adaptation.compensation import Compensation
from r2s.adaptation.history import History
from r2s.adaptation.kalman import Noise
from r2s.adaptation.listen import learn
from r2s.adaptation.network_file import NETWORK, load_network
from r2s.adaptation.observer import Observer
from r2s.adaptation.refinement import refined
from r2s.adaptation.telling import Latent, Telling
from r2s.errors import UserError
from r2s.identification.parameters import ParameterSpace
from r2s.physics.dynamics import Dynamics
from r2s.physics.payload import hand
from r2s.physics.robot import Robot
from r2s.recordings.recording import Recording


@dataclass(frozen=True)
class Known:
    """What an identification says of an arm.

    Attributes:
        robot, dynamics: what is believed of it.
        posterior: the space and draws of its parameters. unloaded: its two recordings of commanded torque, without a
            payload. None where they are not there, as of `r2s.adaptation.listen.estimator`.
        policy: run folder of the policy that the adapter works under; None: of none.
    """

    robot: Robot
    dynamics: Dynamics
    posterior: tuple[ParameterSpace, np.ndarray] | None = None
    unloaded: tuple[Recording, Recording] | None = None
    policy: Path | None = None

    @cached_property
    def arm(self) -> Believed:
        """The arm as arrays."""
        return believed(self.robot, self.dynamics)

    @cached_property
    def learnt(self) -> tuple[Believed, Noise]:
        """The arm with what motion without a payload says of it, and how wrong that may be."""
        more, noise = learn(self.robot, self.dynamics, self.posterior, self.unloaded)
        return refined(self.arm, more), noise


def observer(known: Known, filter_s: float) -> Observer:
    """Return a disturbance observer: `adapt=observer`; raises UserError as of `Observer`."""
    return Observer(known.arm, filter_s)


def rls(known: Known) -> Compensation:
    """Return compensation by the recursive estimate: `adapt=rls`."""
    return Compensation(*known.learnt)


def osi(known: Known) -> Telling:
    """Return what tells a policy the recursive estimate: `adapt=osi`."""
    place, axes = hand(known.robot)
    mass, moments = known.dynamics.told[0], known.dynamics.told[1:]
    return Telling(*known.learnt, np.concatenate([[mass], (moments - mass * place) @ axes]))


def rma(known: Known, network: str | Path | None) -> Latent:
    """Return what tells a policy a latent of the history: `adapt=rma`; network: None is that of the policy.

    Raises:
        UserError: `network` is no run folder of stage=train adapt=rma, or one of another policy, arm or model.
    """
    folder = Path(network or known.policy or "")
    if not (folder / NETWORK).is_file():
        raise UserError(f"network: '{folder}' is no run folder of stage=train adapt=rma")
    return Latent(known.arm, load_network(folder / NETWORK, known.arm, known.policy))


def history(known: Known, network: str | Path | None) -> History:
    """Return a torque that was learnt from history: `adapt=history`.

    Raises:
        UserError: `network` is no run folder of stage=train adapt=history, or one for another arm or model.
    """
    path = Path(network or "") / NETWORK
    if not network or not path.is_file():
        raise UserError(f"network: '{network}' is no run folder of stage=train adapt=history")
    return History(known.arm, load_network(path, known.arm))
