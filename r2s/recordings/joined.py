"""Join recordings of one arm and one kind of torque; their clocks and trajectories remain separate."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from r2s.errors import UserError
from r2s.recordings.recording import FIELDS, Recording

SAME_RATE = 0.01  # largest relative difference of rates that are treated as equal
DT = 1e-3  # s, step of the common grid of recordings with different rates; r2s filters every recording on this grid


def joined(recordings: Sequence[Recording]) -> Recording:
    """Join recordings into one; if their rates or command periods differ, resample all of them to 1 kHz first.

    The result contains only signals that all recordings have. The result's `period` is None; `Recording.in_phase`
    finds a common period.

    Raises:
        UserError: the recordings differ in kind of torque or number of joints.
    """
    first = recordings[0]
    if len(recordings) == 1:
        return first
    for r in recordings[1:]:
        for what, own, other in (("torque", first.torque, r.torque), ("joints", first.n_joints, r.n_joints)):
            if own != other:
                raise UserError(f"recordings: expected {what} {own} as in {first.name}, got {other} in {r.name}")
    rates = np.array([r.rate_hz for r in recordings])
    held = {r.command_period for r in recordings}
    if np.ptp(rates) > SAME_RATE * rates.max() or len(held) > 1:
        recordings = [replace(r.resample(DT), command_period=None) for r in recordings]
    after = np.cumsum([0, *(r.trajectory.max() + 1 for r in recordings[:-1])])
    arrays = {name: np.concatenate([getattr(r, name) for r in recordings]) for name in FIELDS[:4]}
    arrays["trajectory"] = np.concatenate([r.trajectory + k for r, k in zip(recordings, after, strict=True)])
    shared = set.intersection(*({*r.signals} for r in recordings))
    signals = {name: np.concatenate([r.signals[name] for r in recordings]) for name in sorted(shared)}
    return replace(
        recordings[0],
        **arrays,  # type: ignore[arg-type]
        signals=signals,
        period=None,
        name=", ".join(dict.fromkeys(r.name for r in recordings)),
        notes=tuple(note for r in recordings for note in r.notes),
    )
