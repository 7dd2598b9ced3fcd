"""Base parameters: the fewest combinations of inertial parameters on which joint torque depends.

Torque is linear in ten standard parameters per link and one per rotor, but many parameters act only in combination. A
QR decomposition (without pivoting) of the regressor at random states selects each column that is independent of the
columns before it. Each selected column yields one base parameter, which also contains the parameters of dependent
columns (Gautier, J. Robotic Systems 8(4), 1991).
"""

from typing import NamedTuple

import numpy as np
import pandas as pd

from r2s.identification.parameters import ParameterEstimate, ParameterSpace
from r2s.physics.dynamics import Dynamics
from r2s.physics.rigid_body import LinkInertia, regressor
from r2s.physics.robot import Robot

STANDARD = ("mass", "mx", "my", "mz", "xx", "yy", "zz", "xy", "xz", "yz")  # of a link, about its origin
UNITS = ("kg", *["kg m"] * 3, *["kg m^2"] * 6)
# order of a link's columns; the mass is last, because QR regroups later columns into earlier ones
ORDER = (*range(4, 10), 1, 2, 3, 0)
# relative tolerances: a column with a smaller remainder is dependent; a smaller coefficient is set to 0
DEPENDENT, NONE = 1e-9, 1e-9


class BaseParameters(NamedTuple):
    """Base parameters: `matrix` (K, 10 n + n) maps 10 n link and n rotor parameters to K base parameters.

    combinations: formula of each base parameter, such as "zz[2] + 0.1 my[3]". names: the formula's first term.
    units: the parameter's unit.
    """

    names: list[str]
    units: list[str]
    combinations: list[str]
    matrix: np.ndarray

    def values(self, d: Dynamics) -> np.ndarray:
        """Return the values (..., K) of the base parameters for the dynamics of one or many arms."""
        links = LinkInertia(d.mass, d.com, d.inertia).standard()
        links = links.reshape(*links.shape[:-2], -1)
        count = links.shape[-1]  # add two products: `d` may have many sets of rotors but one of links
        return links @ self.matrix[:, :count].T + d.armature @ self.matrix[:, count:].T


def base_parameters(robot: Robot, rotors: bool) -> BaseParameters:
    """Return the base parameters of an arm.

    rotors: true if the measured torque includes the torque that accelerates the rotors; false for link-side torque.
    """
    n, rng = robot.n, np.random.default_rng(0)
    q = rng.uniform(*robot.q_range, (40 * n, n))
    dq, ddq = (rng.normal(size=q.shape) * most for most in (robot.dq_max, robot.ddq_max))
    columns = regressor(robot, q, dq, ddq, robot.gravity).reshape(q.size, -1)
    columns = np.concatenate([columns, (ddq[..., None] * np.eye(n)).reshape(q.size, n)], 1)
    named = [(f"{name}[{k + 1}]", unit) for k in range(n) for name, unit in zip(STANDARD, UNITS, strict=True)]
    named += [(f"rotor[{j + 1}]", "kg m^2") for j in range(n)]
    order = np.array([10 * k + i for k in range(n) for i in ORDER] + [10 * n + j for j in range(n) if rotors])
    sizes = np.linalg.norm(columns, axis=0)
    order = order[sizes[order] > DEPENDENT * sizes.max()]
    rest = np.abs(np.diagonal(np.asarray(np.linalg.qr(columns[:, order] / sizes[order], mode="r"))))
    kept, others = order[rest > DEPENDENT * n], order[rest <= DEPENDENT * n]
    matrix = np.zeros((len(kept), columns.shape[1]))
    matrix[np.arange(len(kept)), kept] = 1.0
    matrix[:, others] = np.linalg.lstsq(columns[:, kept] / sizes[kept], columns[:, others], rcond=None)[0]
    matrix[:, others] /= sizes[kept][:, None]
    matrix[np.abs(matrix) < NONE * np.abs(matrix).max(0).clip(1.0)] = 0.0
    names, units = zip(*(named[c] for c in kept), strict=True)
    words = [_combination(row, [name for name, _ in named], c) for row, c in zip(matrix, kept, strict=True)]
    return BaseParameters(list(names), list(units), words, matrix)


def base_table(space: ParameterSpace, found: ParameterEstimate, rotors: bool) -> pd.DataFrame:
    """Return a table with a row per base parameter: nominal and identified value, 95 % interval, unit, formula."""
    base = base_parameters(space.robot, rotors)
    low, high = np.percentile(base.values(space.dynamics(found.samples)), [2.5, 97.5], axis=0)
    columns = {"parameter": base.names, "unit": base.units, "nominal": base.values(space.nominal)}
    columns |= {"value": base.values(space.dynamics(found.x)), "interval95_low": low, "interval95_high": high}
    return pd.DataFrame(columns | {"combination": base.combinations})


def _combination(row: np.ndarray, names: list[str], first: int) -> str:
    """Return a row of the matrix as text such as "zz[2] + 0.1 my[3]"; parameter number `first` comes first."""
    others = [k for k in np.flatnonzero(row).tolist() if k != first]
    parts = [f"{'-' if row[k] < 0 else '+'} {_factor(abs(row[k]))}{names[k]}" for k in others]
    return " ".join([names[first], *parts])


def _factor(value: float) -> str:
    return "" if abs(value - 1.0) < NONE else f"{value:.6g} "
