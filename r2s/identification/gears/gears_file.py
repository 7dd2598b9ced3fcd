"""Write and read gears.yaml, which passes identified gears to an identification of a surface."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from r2s.errors import UserError
from r2s.files import DAMAGED, atomic_write, run_file
from r2s.identification.gears.estimate import GearEstimate
from r2s.physics.robot import Robot

COVERED = (2.5, 97.5)  # %, percentiles of a 95 % interval
UNITS = {
    "damping": "Nm s/rad", "loop": "Nm s/rad", "rotor": "kg m^2", "viscous": "Nm s/rad", "delay": "s", "lag": "s",
}  # fmt: skip
LAW = "torque of the gear = stiffness (motor - link) + damping (motor' - link'), at the joint's side of the gear"


def save_gears(path: Path, robot: Robot, found: GearEstimate, source: Mapping[str, Any]) -> None:
    """Write gears.yaml at `path`. source: names of recording, calibration and run."""

    def numbers(values: np.ndarray) -> list[float]:
        return [float(f"{v:.6g}") for v in values]

    low, high = np.percentile(found.draws, COVERED, axis=0)
    stiffness = {"unit": "Nm/rad", "value": numbers(found.drives.stiffness)}
    stiffness |= {"interval95_low": numbers(low), "interval95_high": numbers(high)}
    stiffness |= {"relative_sd": numbers(found.spread), "identifiable": found.identifiable.tolist()}
    fitted = {name: {"unit": unit, "value": numbers(getattr(found.drives, name))} for name, unit in UNITS.items()}
    document = {"robot": robot.name, "joints": robot.n, "source": dict(source), "law": LAW, "stiffness": stiffness}
    document["fitted_along"] = fitted
    with atomic_write(path) as part:
        part.write_text(yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=110))


def load_gears(folder: str | Path, robot: Robot, where: str) -> dict[str, np.ndarray]:
    """Return the arguments `stiffness`, `spread` and `determined` of `identified_gears`.

    folder: run folder, or gears.yaml. where: the option with which the user named the folder, for error messages.

    Raises:
        UserError: the file is missing or damaged, or belongs to another robot.
    """
    path = run_file(folder, "gears.yaml", where)
    try:
        document = yaml.safe_load(path.read_text())
        found, of = document["stiffness"], str(document["robot"])
        out = {"stiffness": found["value"], "spread": found["relative_sd"]}
        out = {name: np.array(values, dtype=float) for name, values in out.items()}
        if any(x.ndim != 1 or not (np.isfinite(x) & (x > 0)).all() for x in out.values()):
            raise ValueError("expected a list of positive numbers")
        out["determined"] = np.array(found["identifiable"], dtype=bool)
    except (*DAMAGED, TypeError, AttributeError, yaml.YAMLError) as error:
        seen = " ".join(str(error).split())
        raise UserError(f"{where}: {path} is not a gears.yaml of r2s ({seen})") from None
    if of != robot.name or any(x.shape != (robot.n,) for x in out.values()):
        expected, got = f"'{robot.name}' ({robot.n} joints)", f"'{of}' ({len(out['spread'])})"
        raise UserError(f"{where}: expected gears of {expected}, got {got} in {path}")
    return out
