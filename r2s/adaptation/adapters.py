"""What conf/adapt names: adapters, made of what is known of an arm.

One of your own is a function of `Known` and its settings, or a class, that a yaml in conf/adapt names.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from r2s.adaptation.believed import Believed, believed
from r2s.adaptation.compensation import Compensation
from r2s.adaptation.history import History, Network, inputs
from r2s.adaptation.kalman import Noise
from r2s.adaptation.listen import noise
from r2s.adaptation.observer import Observer
from r2s.errors import UserError
from r2s.files import DAMAGED, whole
from r2s.identification.parameters import ParameterSpace
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot
from r2s.recordings.recording import Recording

NETWORK = "network.npz"


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


def history(known: Known, network: str | Path | None) -> History:
    """Return a torque that was learnt from history: `adapt=history`.

    Raises:
        UserError: `network` is no run folder of stage=train adapt=history, or one for another arm or model.
    """
    path = Path(network or "") / NETWORK
    if not network or not path.is_file():
        raise UserError(f"network: '{network}' is no run folder of stage=train adapt=history")
    return History(known.arm, load_network(path, known.arm))


def save_network(path: Path, arm: Believed, network: Network) -> None:
    """Write a network, with the friction of the arm that it was taught for, by which it is known again."""
    arrays = {"mean": network.mean, "scale": network.scale, "size": network.size, "table": arm.table}
    arrays |= {f"layer_{k}": a for k, a in enumerate(network.layers)}
    with whole(path) as part:
        np.savez(part, **arrays)  # type: ignore[arg-type]


def load_network(path: Path, arm: Believed) -> Network:
    """Return the network of a file for this arm.

    Raises:
        UserError: the file is damaged, or the network was taught for another arm or model.
    """
    try:
        with np.load(path, allow_pickle=False) as saved:
            arrays = dict(saved)
        layers = tuple(arrays[f"layer_{k}"] for k in range(len(arrays) - 4))
        network, table = Network(arrays["mean"], arrays["scale"], arrays["size"], layers), arrays["table"]
        n = len(arm.level)
        if network(np.zeros(inputs(n))).shape != (n,):
            raise ValueError(f"it does not tell {n} torques")
    except DAMAGED as error:
        raise UserError(f"network: {path} cannot be read: {' '.join(str(error).split())}") from None
    if not np.array_equal(table, arm.table):
        raise UserError(f"network: {path.parent} was taught for another model; train it with this calibration=")
    return network
