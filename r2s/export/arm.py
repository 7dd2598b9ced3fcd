"""Check that a bundle was made for the arm on which it will run. `r2s export` copies this module into the bundle."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from r2s.export.law import BundleError, Driver, Model, per_joint


@dataclass(frozen=True)
class Arm:
    """Description of the arm on which a bundle will run. The runtime refuses a bundle made for another arm.

    Attributes:
        joints: joint names in order from the base. cycle_hz: Hz, rate of the torque commands to the arm.
        torque: "without gravity" if the arm itself compensates gravity, as a Franka arm does.
        q_min, q_max, dq_max, tau_max, dtau_max: the limits of each joint, in rad, rad, rad/s, Nm, Nm/s.
        slows: (decelerations rad/s^2, offsets rad/s) of an arm such as the FR3, which limits each joint's speed to
            sqrt(2 deceleration d) - offset at d rad before a position limit; None: no limits of this kind.
    """

    joints: Sequence[str]
    cycle_hz: float
    torque: str
    q_min: Sequence[float]
    q_max: Sequence[float]
    dq_max: Sequence[float]
    tau_max: Sequence[float]
    dtau_max: Sequence[float]
    slows: tuple[Sequence[float], Sequence[float]] | None = None


def fits(contract: dict[str, Any], arm: Arm) -> None:
    """Raise BundleError if a bundle was made for an arm other than `arm`, or if its limits exceed those of `arm`."""
    own, n = contract["joints"], len(contract["joints"])
    if len(arm.joints) != n:
        raise BundleError(f"expected {n} joints, got {len(arm.joints)} of the arm")
    for j, (theirs, ours) in enumerate(zip(arm.joints, own, strict=True), 1):
        if theirs != ours:
            raise BundleError(f"expected joint {j} '{ours}', got '{theirs}' of the arm")
    if arm.cycle_hz != contract["rates"]["cycle_hz"]:
        raise BundleError(f"expected {contract['rates']['cycle_hz']} Hz, got {arm.cycle_hz:g} Hz of the arm")
    if arm.torque != contract["torque"]["convention"]:
        raise BundleError(f"expected torque '{contract['torque']['convention']}', got '{arm.torque}' of the arm")
    limits, torque = contract["limits"], contract["torque"]
    asked = {"q_max": ("rad", limits["q_max_rad"]), "dq_max": ("rad/s", limits["dq_max_rad_per_s"])}
    asked |= {"tau_max": ("Nm", torque["max_Nm"]), "dtau_max": ("Nm/s", torque["max_rate_Nm_per_s"])}
    asked["q_min"] = "rad", limits["q_min_rad"]
    for name, (unit, most) in asked.items():
        allowed = np.array(getattr(arm, name), dtype=float)
        sign = -1.0 if name == "q_min" else 1.0
        needed = per_joint(most, sign * np.inf)
        if allowed.shape != (n,):
            raise BundleError(f"expected {n} values of {name}, got {allowed.size} of the arm")
        if (beyond := ~(sign * allowed >= sign * needed)).any():
            j = int(beyond.argmax())
            raise BundleError(
                f"{name} of joint {j + 1}: the arm allows {allowed[j]:g} {unit}, the bundle needs {needed[j]:g}"
            )
    if arm.slows is not None:
        _slows(contract, arm)


def _slows(contract: dict[str, Any], arm: Arm) -> None:
    """Raise BundleError if a bundle allows a higher speed near a position limit than `Arm.slows` allows."""
    law = Driver(contract["law"], Model(contract["model"]))
    deceleration, offset = np.array(arm.slows, dtype=float)
    for way in np.linspace(0.0, 1.0, 101):  # rad before the limit
        allowed = np.maximum(np.sqrt(2 * deceleration * way) - offset, 0.0)
        for up in (True, False):
            asked = law.fastest(np.array(arm.q_max) - way if up else np.array(arm.q_min) + way, up)
            if (beyond := asked > allowed).any():
                j = int(beyond.argmax())
                raise BundleError(
                    f"{way:.2f} rad before a limit of joint {j + 1} the arm allows {allowed[j]:.2f} rad/s, "
                    f"the bundle {asked[j]:.2f} rad/s: it was exported for another arm"
                )
