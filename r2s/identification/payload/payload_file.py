"""Write an identified payload to payload.yaml and payload_posterior.npz, for later stages and libfranka."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from r2s.files import atomic_write
from r2s.identification.payload.estimate import ELEMENTS, PayloadEstimate
from r2s.physics.robot import Robot

UNITS = {"mass": "kg", "centre": "m", "inertia": "kg m^2"}


def save_payload(path: Path, robot: Robot, found: PayloadEstimate, source: Mapping[str, Any]) -> None:
    """Write payload.yaml, payload_posterior.npz and, if the robot has a tool, tool.json with the identified mass.

    `arm.payload`, `arm.declared_payload` and `data.declared_payload` read payload.yaml; `robot.tool` reads tool.json.

    Args:
        path: the payload.yaml to write. robot: the loaded arm. source: names of recording, calibration and run.
    """

    def numbers(values: np.ndarray) -> Any:
        rounded = [float(f"{v:.6g}") for v in np.ravel(values)]
        return rounded if np.ndim(values) else rounded[0]

    document: dict[str, Any] = {"robot": robot.name, "source": dict(source), "frame": robot.ee_site}
    document["elements"] = {"inertia": list(ELEMENTS)}
    document["parameters"] = {}
    for name, value in found.values.items():
        low, high = found.interval(name)
        entry = {"unit": UNITS[name], "value": numbers(value)}
        entry |= {"interval95_low": numbers(low), "interval95_high": numbers(high)}
        document["parameters"][name] = entry | {"identifiable": np.asarray(found.identifiable[name]).tolist()}
    # with all digits, because rounding may make a thin body's tensor unphysical
    document["payload"] = {name: np.asarray(value).tolist() for name, value in found.values.items()}
    columns = found.tensor.T.ravel().tolist()
    document["libfranka"] = {"load_mass": found.mass, "F_x_Cload": found.centre.tolist(), "load_inertia": columns}
    with atomic_write(path.with_name("payload_posterior.npz")) as part:  # first, as payload.yaml needs it
        np.savez_compressed(part, **found.draws)  # type: ignore[arg-type]
    with atomic_write(path) as part:
        part.write_text(yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=110))
    if robot.tool is not None:
        tool = {"tip_in_flange_m": robot.tool.tip.tolist(), "radius_m": robot.tool.radius, "mass_kg": found.mass}
        with atomic_write(path.with_name("tool.json")) as part:
            part.write_text(json.dumps(tool) + "\n")
