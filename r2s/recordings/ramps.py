"""Recorded ramps of the breakaway protocol: which joint, which way, where the arm stood."""

import os
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from r2s.errors import UserError
from r2s.files import whole
from r2s.recordings.recording import Recording


@dataclass(frozen=True, eq=False)
class Ramps:
    """K recorded ramps, one trajectory of the recording each; joint, sign and pose may be one number for all.

    Attributes:
        recording: of the command; of it t, and q and tau of the joint that is ramped.
        joint: (K,) which joint, from 0. sign: (K,) 1 or -1, which way. pose: (K,) where the arm stood, from 0.

    Raises:
        UserError: the torque is not the command, or numbers that do not fit the recording.
    """

    recording: Recording
    joint: np.ndarray
    sign: np.ndarray
    pose: np.ndarray = 0  # type: ignore[assignment]

    def __post_init__(self):
        r, count = self.recording, len(self.recording.stretches)
        if r.torque != "commanded":
            raise UserError(f"ramps: torque is '{r.torque}'; allowed: commanded (a sensor hides what friction holds)")
        allowed = {"joint": range(r.n_joints), "sign": (-1, 1), "pose": range(1_000_000)}
        for field, values in allowed.items():
            told = np.asarray(getattr(self, field))
            numbers = np.full(count, told) if told.ndim == 0 else told
            if numbers.shape != (count,):
                raise UserError(f"ramps: {field} has shape {told.shape}; the recording has {count} trajectories")
            for k, number in enumerate(numbers.tolist()):
                if number not in values:
                    names = "-1 or 1" if field == "sign" else f"0 to {values[-1]}"
                    raise UserError(f"ramps: {field} of ramp {k} is {number}, allowed {names}")
            object.__setattr__(self, field, numbers.astype(np.int64))
            getattr(self, field).flags.writeable = False

    def save(self, path: str | os.PathLike) -> None:
        """Write everything to `path` (.npz, plain arrays); `readers.read` reads it as a recording, too."""
        path = Path(path)
        if path.suffix != ".npz":
            raise UserError(f"ramps are saved as .npz; '{path.name}' ends in '{path.suffix}'")
        which = {"joint": self.joint, "sign": self.sign, "pose": self.pose}
        with whole(path) as part:
            np.savez_compressed(part, **which, **self.recording.arrays())  # type: ignore[arg-type]

    @staticmethod
    def load(path: str | os.PathLike) -> "Ramps":
        """Return what `save` wrote.

        Raises:
            UserError: no such file, or one that holds no ramps.
        """
        if not Path(path).is_file():
            raise UserError(f"ramps: no file {path}")
        try:
            with np.load(path, allow_pickle=False) as saved:
                a = {name: saved[name] for name in saved.files}
            motion = Recording(
                **{k: a[k] for k in ("t", "q", "dq", "tau", "trajectory")},
                torque=a["torque"].item(),
                name=a["name"].item(),
            )
            return Ramps(motion, a["joint"], a["sign"], a["pose"])
        except UserError as error:
            raise UserError(f"{path}: {error}") from None
        except (KeyError, ValueError, OSError, EOFError, AttributeError, zipfile.BadZipFile) as error:
            seen = " ".join(str(error).split())
            raise UserError(f"ramps: {path} is not a file of ramps by r2s ({seen})") from None
