"""Write and read contact.yaml and contact_posterior.npz, which pass an identified surface to other programs."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from r2s.errors import UserError
from r2s.files import DAMAGED, atomic_write, run_file
from r2s.identification.contact.estimate import COVERED, ContactEstimate
from r2s.identification.contact.exchange import inverse_mass, mujoco_contact, sdf_surface
from r2s.identification.contact.surface_space import LOAD
from r2s.physics.robot import Robot
from r2s.physics.surface import Surface

UNITS = {"stiffness": "N/m", "exponent": "1", "damping": "s/m", "friction": "1", "bristle": "m"}
RIGID_GEARS = "rigid_gears"  # key of the surface for simulations with rigid gears
LAWS = {
    "normal": "F = k 1mm (d / 1mm)^exponent (1 + damping d') >= 0 of the penetration d, k the stiffness at 1 mm",
    "tangential": "friction F in sliding, reached over a deflection of about `bristle`",
}


@dataclass(frozen=True, eq=False)
class IdentifiedSurface:
    """The surface in a contact.yaml, with 95 % intervals and posterior draws.

    Attributes:
        surface: the estimate. interval: {name: (low, high)} of stiffness, exponent, damping, friction, bristle, slope
            (N/m at 10 N), height (m along the normal) and tilt_deg (angle from the normal).
        identifiable: {name: whether the recording determines this value}; names include plane and slope.
        draws: surfaces drawn from the posterior.
        rigid_gears: the surface for simulators with rigid gears, such as r2s; see `ContactEstimate`.
    """

    surface: Surface
    interval: dict[str, tuple[float, float]]
    identifiable: dict[str, bool]
    draws: list[Surface]
    rigid_gears: "IdentifiedSurface | None" = None

    @property
    def simulated(self) -> "IdentifiedSurface":
        """The surface for simulations with rigid gears."""
        return self.rigid_gears or self


def save_contact(path: Path, robot: Robot, found: ContactEstimate, source: Mapping[str, Any]) -> None:
    """Write contact.yaml at `path`, and contact_posterior.npz in the same folder.

    Args:
        path: the contact.yaml to write. robot: the arm with its tool. source: names of recording, calibration and
            run.
    """
    tool, simulated = robot.tool, found.rigid_gears or found
    assert tool is not None
    document: dict[str, Any] = {"robot": robot.name, "source": dict(source), "law": LAWS}
    document["tool"] = {"tip_in_flange_m": tool.tip.tolist(), "radius_m": tool.radius}
    document |= _entries(found)
    ends = np.percentile(found.draws["gears"], COVERED, axis=0)
    rows = {"value": found.gears, "interval95_low": ends[0], "interval95_high": ends[1]}
    gears = {"unit": "rad/Nm"} | {name: [_number(v) for v in row] for name, row in rows.items()}
    document["gears"] = gears | {"stated": found.stated, "identifiable": found.identifiable.get("gears", False)}
    document[RIGID_GEARS] = _entries(simulated)
    document["mujoco"] = mujoco_contact(simulated.surface, inverse_mass(robot))
    document["sdf"] = sdf_surface(simulated.surface)
    draws = found.draws | {f"{RIGID_GEARS}_{name}": values for name, values in simulated.draws.items()}
    with atomic_write(path.with_name("contact_posterior.npz")) as part:  # first, as contact.yaml needs it
        np.savez_compressed(part, **draws)  # type: ignore[arg-type]
    with atomic_write(path) as part:
        part.write_text(yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=110))


def _entries(found: ContactEstimate) -> dict[str, Any]:
    """Return the entries of contact.yaml for a surface: parameters, plane and penetration."""

    def entry(value: float, unit: str, ends: tuple[float, float], name: str) -> dict[str, Any]:
        out = {"unit": unit, "value": _number(value)}
        out |= {"interval95_low": _number(ends[0]), "interval95_high": _number(ends[1])}
        return out | {"identifiable": found.identifiable[name]}

    surface = found.surface
    parameters = {n: entry(getattr(surface, n), unit, found.interval(n), n) for n, unit in UNITS.items()}
    parameters[f"slope_at_{LOAD:g}N"] = entry(found.slope, "N/m", found.interval("slope"), "slope")
    plane = {
        "point_m": [float(f"{v:.9g}") for v in surface.point],
        "height_interval95_m": [_number(v) for v in found.height],
        "normal": [float(f"{v:.9g}") for v in surface.normal],
        "tilt95_deg": _number(found.tilt_deg),
        "identifiable": found.identifiable["plane"],
    }
    return {"parameters": parameters, "plane": plane, "penetration_m": [_number(v) for v in found.penetration]}


def _number(value: float) -> float:
    return float(f"{value:.6g}")


def load_contact(folder: str | Path, where: str = "contact") -> IdentifiedSurface:
    """Return the surface from a run folder of stage=identify or from a contact.yaml.

    where: the option with which the user named the folder, for error messages.

    Raises:
        UserError: a file is missing or damaged.
    """
    path = run_file(folder, "contact.yaml", where)
    try:
        document = yaml.safe_load(path.read_text())
        with np.load(path.with_name("contact_posterior.npz"), allow_pickle=False) as file:
            draws = {name: file[name] for name in file.files}
        found = _parse(document, draws)
        if RIGID_GEARS not in document:  # file of an older r2s, which did not estimate gears
            return found
        own = {name.removeprefix(f"{RIGID_GEARS}_"): values for name, values in draws.items() if RIGID_GEARS in name}
        return replace(found, rigid_gears=_parse(document[RIGID_GEARS], own))
    except (*DAMAGED, AttributeError, IndexError, yaml.YAMLError) as error:
        seen = " ".join(str(error).split())
        raise UserError(f"{where}: {path} is not a contact.yaml of r2s ({seen})") from None


def _parse(document: dict[str, Any], draws: dict[str, np.ndarray]) -> IdentifiedSurface:
    """Parse the document for `load_contact`; a malformed document raises KeyError, ValueError or a similar error."""
    found, plane = document["parameters"], document["plane"]
    interval = {n: (float(v["interval95_low"]), float(v["interval95_high"])) for n, v in found.items()}
    interval["slope"] = interval.pop(f"slope_at_{LOAD:g}N")
    low, high = map(float, plane["height_interval95_m"])
    interval |= {"height": (low, high), "tilt_deg": (0.0, float(plane["tilt95_deg"]))}
    identifiable = {n: bool(v["identifiable"]) for n, v in found.items()}
    identifiable["slope"] = identifiable.pop(f"slope_at_{LOAD:g}N")
    identifiable["plane"] = bool(plane["identifiable"])
    if "gears" in document:
        identifiable["gears"] = bool(document["gears"]["identifiable"])
    values = {n: float(found[n]["value"]) for n in UNITS}
    surface = _surface(values, np.array(plane["point_m"], dtype=float), np.array(plane["normal"], dtype=float))
    rows = zip(draws["point"], draws["normal"], *(draws[n] for n in UNITS), strict=True)
    each = [_surface(dict(zip(UNITS, map(float, row[2:]), strict=True)), row[0], row[1]) for row in rows]
    return IdentifiedSurface(surface, interval, identifiable, each)


def _surface(values: Mapping[str, float], point: np.ndarray, normal: np.ndarray) -> Surface:
    if point.shape != (3,) or normal.shape != (3,) or not np.isfinite([*values.values(), *point, *normal]).all():
        raise ValueError(f"expected a finite point and normal of 3 numbers, got {point.tolist()}, {normal.tolist()}")
    if values["stiffness"] <= 0 or values["exponent"] <= 0 or not np.isclose(np.linalg.norm(normal), 1.0, atol=1e-6):
        raise ValueError("expected a positive stiffness and exponent, and a unit normal")
    v = values
    return Surface(point, normal, v["stiffness"], v["exponent"], v["damping"], v["friction"], v["bristle"])
