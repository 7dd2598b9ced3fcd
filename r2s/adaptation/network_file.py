"""The file of a network that was taught for an arm, `network.npz`, and by what it is known again."""

from pathlib import Path

import numpy as np

from r2s.adaptation.balance import RAMP
from r2s.adaptation.believed import Believed
from r2s.adaptation.history import Network, inputs
from r2s.errors import UserError
from r2s.files import DAMAGED, whole
from r2s.provenance import sha256

NETWORK, POLICY = "network.npz", "policy.pt"


def save_network(path: Path, arm: Believed, network: Network, policy: Path | None = None) -> None:
    """Write a network, with the friction of the arm that it was taught for and how balances heard, to be known again.

    policy: the run folder of the one whose latent it says; None: it says torques.
    """
    arrays = {"mean": network.mean, "scale": network.scale, "size": network.size, "table": arm.table}
    arrays["hears"] = RAMP
    arrays["policy"] = np.array(_of(policy))
    arrays |= {f"layer_{k}": a for k, a in enumerate(network.layers)}
    with whole(path) as part:
        np.savez(part, **arrays)  # type: ignore[arg-type]


def load_network(path: Path, arm: Believed, policy: Path | None = None) -> Network:
    """Return the network of a file for this arm; policy: as of `save_network`.

    Raises:
        UserError: the file is damaged, or the network was taught for another arm, model or policy, or by a version
            whose balances weighed time otherwise.
    """
    try:
        with np.load(path, allow_pickle=False) as saved:
            arrays = dict(saved)
        layers = tuple(arrays[f"layer_{k}"] for k in range(sum(name.startswith("layer_") for name in arrays)))
        network, table = Network(arrays["mean"], arrays["scale"], arrays["size"], layers), arrays["table"]
        of = str(arrays.get("policy", ""))
        n = len(arm.level)
        count = len(network.size) if of else n
        if network(np.zeros(inputs(n))).shape != (count,):
            raise ValueError(f"it does not tell {count} numbers")
    except DAMAGED as error:
        raise UserError(f"network: {path} cannot be read: {' '.join(str(error).split())}") from None
    if not np.array_equal(arrays.get("hears", ()), RAMP):
        raise UserError(f"network: {path.parent} was taught with other balances of momentum; train it again")
    if not np.array_equal(table, arm.table):
        raise UserError(f"network: {path.parent} was taught for another model; train it with this calibration=")
    if of != _of(policy):
        other = "says the latent of another policy" if of and policy else "is of another kind of adapter"
        raise UserError(f"network: {path.parent} {other}; the folder of this policy has its own")
    return network


def _of(policy: Path | None) -> str:
    """Return by what a policy is known again; "" of none."""
    return sha256(policy / POLICY) if policy is not None else ""
