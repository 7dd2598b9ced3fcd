"""Joint friction laws, called families; r2s contains four families, and users can add families.

A friction family contains a law for arrays and, for the physics step (mujoco_callback.py), a compiled version of the
law. `friction.family=` selects a built-in family by name, or a user's family by a dotted path such as
my_module.MY_FAMILY.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module

import numpy as np

from r2s.compiled import njit, vectorize
from r2s.errors import UserError, choices, nearest

WIDTH_DQ = 0.01  # rad/s, width of the sign change of Coulomb friction; equal to the default dq_min of stiction
PRESLIDING = 1e-3  # rad, presliding distance if it is not identified; typical of a Panda's joints
MICRO_DAMPING = 5e-3  # s, ratio of bristle damping to bristle stiffness; bristle oscillations decay in a few periods
FALLEN = 40.0  # (speed / Stribeck velocity)^2 above which the Stribeck term is below the rounding error of 1
PHI = 8  # maximum number of parameters of a family
VISCOUS = "viscous"  # name of the viscous parameter in every family that has one, Nm s/rad


@dataclass(frozen=True)
class Family:
    """Friction law with K parameters for a joint; the torque is 0 at rest and positive for positive velocity.

    Attributes:
        name: name of the friction family in tables.
        names, units: names and units of the K parameters.
        logarithmic: names of positive parameters that span decades; their search space is logarithmic.
        bounds: search ranges (low, high) of the parameters; `identify.bounds` overrides these ranges.
        optional: last entries of `names`; these parameters stay 0 unless `identify.terms` lists them.
        formula: text of the law in one line.
        law: function (dq, p, sign) -> torque, Nm. dq and sign have shape (..., n); p is a list of K arrays (..., n).
            `sign` is tanh(dq / 0.01) or, for a law with a memory, the bristle deflection, in [-1, 1].
        native: law of a joint in one step of h s, compiled by numba.njit: (p (PHI,), v, h, memory (1,)) ->
            torque and its derivative at v. `memory` is the state of the joint's friction, 0 after a reset.
        sharp: version of `native` whose torque is discontinuous at v = 0, for stiction_model="net"; None: the law is
            continuous at rest.
        start: function from friction (..., n) Nm at 1 rad/s to a list of start values, one per required parameter.
        held: for a law with memory, function from phi (..., n, K) to negative and positive breakaway torques (..., n,
            2) Nm; None: the law itself has no stiction, so `Dynamics.stiction_model` adds stiction.

    Raises:
        UserError: the attributes are inconsistent.
    """

    name: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    formula: str
    law: Callable[..., np.ndarray]
    native: Callable[..., tuple[float, float]]
    start: Callable[[np.ndarray], list[np.ndarray]]
    logarithmic: tuple[str, ...] = ()
    bounds: tuple[tuple[float, float], ...] = ()
    optional: tuple[str, ...] = ()
    held: Callable[[np.ndarray], np.ndarray] | None = None
    sharp: Callable[..., tuple[float, float]] | None = None

    def __post_init__(self) -> None:
        where, k = f"friction family '{self.name}'", len(self.names)
        if not 1 <= k <= PHI or len(set(self.names)) < k or len(self.units) != k:
            raise UserError(f"{where}: expected 1 to {PHI} different names with units, got {k} and {len(self.units)}")
        if self.bounds and len(self.bounds) != k:
            raise UserError(f"{where}: expected {k} bounds, got {len(self.bounds)}")
        for name in (*self.logarithmic, *self.optional):
            if name not in self.names:
                raise UserError(f"{where}: expected one of the parameters {choices(self.names)}, got '{name}'")
        if self.optional != self.names[k - len(self.optional) :]:
            raise UserError(f"{where}: expected the optional parameters last, got {choices(self.names)}")

    @property
    def has_memory(self) -> bool:
        """Whether the law has a memory; a law with memory contains stiction."""
        return self.held is not None

    def at_rest(self, phi: np.ndarray) -> np.ndarray:
        """Return friction (..., n, 2) Nm just below and just above zero velocity; 0 for a continuous law.

        phi: (..., n, K), parameters of the law.
        """
        if self.sharp is None:
            return np.zeros((*phi.shape[:-1], 2))
        still = np.zeros(phi.shape[:-1])
        return np.stack([self.torque(still, phi, bristle=still + sign) for sign in (-1.0, 1.0)], -1)

    def scale(self, name: str) -> tuple[str, str]:
        """Return a parameter's unit and its search scale, "logarithmic" or "linear"."""
        return self.units[self.names.index(name)], "logarithmic" if name in self.logarithmic else "linear"

    def torque(self, dq: np.ndarray, phi: np.ndarray, bristle: np.ndarray | None = None) -> np.ndarray:
        """Return the friction torque (..., n) Nm.

        Args:
            dq: (..., n) rad/s, joint velocities.
            phi: (..., n, K), parameters in the order of `names`; optional parameters may be missing.
            bristle: (..., n), deflections in [-1, 1] from `presliding`; if None, the law uses tanh(dq / 0.01).
        """
        columns = [phi[..., k] for k in range(phi.shape[-1])] + [np.zeros(())] * (len(self.names) - phi.shape[-1])
        return self.law(dq, columns, np.tanh(dq / WIDTH_DQ) if bristle is None else bristle)

    def level(self, phi: np.ndarray, dq_max: np.ndarray) -> np.ndarray:
        """Return the mean of the friction magnitudes (..., n) Nm at the velocities `dq_max` and -`dq_max`, rad/s."""
        return 0.5 * (self.torque(dq_max, phi) - self.torque(-dq_max, phi))

    def matched_to(self, other: "Family", phi: np.ndarray) -> np.ndarray:
        """Return parameters (..., n, K) with the same friction at 1 rad/s as phi (..., n, K') of the family `other`.

        If this family requires a viscous parameter and `phi` contains one, viscous friction stays unchanged.
        """
        if other == self:
            return phi
        level, shared = other.level(phi, np.ones(phi.shape[:-1])), self.names[: len(self.names) - len(self.optional)]
        if VISCOUS not in shared or VISCOUS not in other.names[: phi.shape[-1]]:
            return np.stack(self.start(level), -1)
        viscous = phi[..., other.names.index(VISCOUS)]
        columns = self.start(level - viscous)
        columns[self.names.index(VISCOUS)] = viscous
        return np.stack(columns, -1)


def sigmoid(x: np.ndarray) -> np.ndarray:
    """Return the logistic function without overflow."""
    e = np.exp(-np.abs(x))
    return np.where(x >= 0, 1.0, e) / (1.0 + e)


def _sigmoid_law(dq: np.ndarray, p: list[np.ndarray], sign: np.ndarray) -> np.ndarray:
    """Return the friction of the paper's equation (5) plus viscous friction, Nm."""
    return p[0] * (sigmoid(p[1] * (dq + p[2])) - sigmoid(p[1] * p[2])) + p[3] * dq


@njit(cache=True)
def _sigmoid_native(p, v, h, memory):
    x = p[1] * (v + p[2])
    e = np.exp(-abs(x))
    s = (1.0 if x >= 0 else e) / (1.0 + e)
    x = p[1] * p[2]
    e = np.exp(-abs(x))
    s0 = (1.0 if x >= 0 else e) / (1.0 + e)
    return p[0] * (s - s0) + p[3] * v, p[0] * p[1] * s * (1.0 - s) + p[3]


# The `start`s are named functions, not lambdas, because a family may be pickled for another process.
def _sigmoid_start(level: np.ndarray) -> list[np.ndarray]:
    return [2 * level, np.full_like(level, 20.0), np.zeros_like(level)]


SIGMOID = Family(
    name="sigmoid",
    names=("phi1", "phi2", "phi3", "viscous"),
    units=("Nm", "s/rad", "rad/s", "Nm s/rad"),
    logarithmic=("phi1", "phi2"),
    optional=("viscous",),
    formula="phi1 (s(phi2 (v + phi3)) - s(phi2 phi3)) + viscous v, s the logistic function: eq. (5)",
    law=_sigmoid_law,
    native=_sigmoid_native,
    start=_sigmoid_start,
)


# Compiled elementwise functions: an identification evaluates friction some thousand times.
@vectorize(cache=True)
def _two_sided(x, factor, asymmetry):
    return factor * (1.0 + np.sign(x) * asymmetry) * x


def _coulomb_law(dq: np.ndarray, p: list[np.ndarray], sign: np.ndarray) -> np.ndarray:
    return _two_sided(sign, p[0], p[1]) + _two_sided(dq, p[2], p[-1])


@njit(cache=True)
def _coulomb_native(p, v, h, memory):
    sign, side = np.tanh(v / WIDTH_DQ), np.sign(v)
    level, viscous = p[0] * (1.0 + side * p[1]), p[2] * (1.0 + side * p[3])
    return level * sign + viscous * v, level * (1.0 - sign * sign) / WIDTH_DQ + viscous


@njit(cache=True)
def _coulomb_sharp(p, v, h, memory):
    sign = np.sign(v)
    viscous = p[2] * (1.0 + sign * p[3])
    return p[0] * (1.0 + sign * p[1]) * sign + viscous * v, viscous


def _coulomb_start(level: np.ndarray) -> list[np.ndarray]:
    return [level, np.zeros_like(level), np.zeros_like(level)]


COULOMB = Family(
    name="coulomb",
    names=("coulomb", "asymmetry", "viscous", "viscous_asymmetry"),
    units=("Nm", "1", "Nm s/rad", "1"),
    logarithmic=("coulomb",),
    optional=("viscous_asymmetry",),
    formula="coulomb (1 ± asymmetry) sign(v) + viscous (1 ± viscous_asymmetry) v",
    law=_coulomb_law,
    native=_coulomb_native,
    sharp=_coulomb_sharp,
    start=_coulomb_start,
)


@vectorize(cache=True)
def _stribeck_torque(dq, sign, coulomb, asymmetry, rise, stribeck_velocity, rise_asymmetry):
    side, ratio = np.sign(sign), (dq / stribeck_velocity) ** 2
    level = coulomb * (1.0 + side * asymmetry)
    if not ratio > FALLEN:
        level *= 1.0 + rise * (1.0 + side * rise_asymmetry) * np.exp(-ratio)
    return level * sign


def _stribeck_law(dq: np.ndarray, p: list[np.ndarray], sign: np.ndarray) -> np.ndarray:
    return _stribeck_torque(dq, sign, p[0], p[1], p[3], p[4], p[-2]) + _two_sided(dq, p[2], p[-1])


@njit(cache=True)
def _stribeck_native(p, v, h, memory):
    sign = np.tanh(v / WIDTH_DQ)
    side = np.sign(v)
    level, bump = p[0] * (1.0 + side * p[1]), p[3] * (1.0 + side * p[5]) * np.exp(-((v / p[4]) ** 2))
    fall, viscous = level * bump * -2.0 * v / p[4] ** 2, p[2] * (1.0 + side * p[6])
    level *= 1.0 + bump
    return level * sign + viscous * v, level * (1.0 - sign * sign) / WIDTH_DQ + fall * sign + viscous


@njit(cache=True)
def _stribeck_sharp(p, v, h, memory):
    sign = np.sign(v)
    level, bump = p[0] * (1.0 + sign * p[1]), p[3] * (1.0 + sign * p[5]) * np.exp(-((v / p[4]) ** 2))
    viscous = p[2] * (1.0 + sign * p[6])
    return level * (1.0 + bump) * sign + viscous * v, viscous - level * bump * 2.0 * abs(v) / p[4] ** 2


def _stribeck_start(level: np.ndarray) -> list[np.ndarray]:
    return [*_coulomb_start(level), np.full_like(level, 0.1), np.full_like(level, 0.1)]


STRIBECK = Family(
    name="stribeck",
    names=(*COULOMB.names[:3], "rise", "stribeck_velocity", "rise_asymmetry", "viscous_asymmetry"),
    units=(*COULOMB.units[:3], "1", "rad/s", "1", "1"),
    logarithmic=("coulomb", "stribeck_velocity"),
    optional=("rise_asymmetry", "viscous_asymmetry"),
    formula=(
        "coulomb (1 ± asymmetry) (1 + rise (1 ± rise_asymmetry) exp(-(v / stribeck_velocity)²)) sign(v) "
        "+ viscous (1 ± viscous_asymmetry) v"
    ),
    law=_stribeck_law,
    native=_stribeck_native,
    sharp=_stribeck_sharp,
    start=_stribeck_start,
)


@njit(cache=True)
def _bristle_native(p, v, h, memory):
    """Return torque and slope of Stribeck friction with LuGre damping.

    The bristle deflection z replaces sign(v); its rate is dz/dt = (v - |v| z) / presliding (Dahl).
    """
    s = 1.0 if v > 0 else -1.0
    z = s + (memory[0] - s) * np.exp(-abs(v) * h / p[5])  # deflection after the last step
    memory[0] = z
    side = 1.0 if z > 0 else -1.0
    level = p[0] * (1.0 + side * p[1]) * (1.0 + p[3] * (1.0 + side * p[6]) * np.exp(-((v / p[4]) ** 2)))
    stiff = level / p[5]
    rate = h + MICRO_DAMPING * np.exp(-((v / 0.02) ** 2))
    # second term: force due to the change of z in the coming step at constant velocity, and bristle damping
    viscous = p[2] * (1.0 + s * p[7])
    return level * z + stiff * rate * (v - abs(v) * z) + viscous * v, stiff * rate * (1.0 - s * z) + viscous


def _bristle_held(phi: np.ndarray) -> np.ndarray:
    level, asymmetry, rise = (phi[..., k, None] for k in (0, 1, 3))
    sides, other = np.array([-1.0, 1.0]), phi[..., 6, None] if phi.shape[-1] > 6 else 0.0
    return sides * level * (1 + sides * asymmetry) * (1 + rise * (1 + sides * other))


def _bristle_start(level: np.ndarray) -> list[np.ndarray]:
    return [*_stribeck_start(level), np.full_like(level, PRESLIDING)]


BRISTLE = Family(
    name="bristle",
    names=(*STRIBECK.names[:5], "presliding", *STRIBECK.optional),
    units=(*STRIBECK.units[:5], "rad", "1", "1"),
    logarithmic=(*STRIBECK.logarithmic, "presliding"),
    optional=STRIBECK.optional,
    formula="Stribeck's law with a sign that changes over the distance `presliding`: it has a memory and stiction",
    law=_stribeck_law,
    native=_bristle_native,
    start=_bristle_start,
    held=_bristle_held,
)
FAMILIES = (SIGMOID, COULOMB, STRIBECK, BRISTLE)  # the candidates of friction.family=auto
_imported: dict[str, Family] = {}  # by dotted path


def known_families() -> tuple[Family, ...]:
    """Return the built-in friction families and all families that the function `family` has imported."""
    return (*FAMILIES, *_imported.values())


def family(name: str) -> Family:
    """Return a built-in friction family by name, or import a family by dotted path.

    Raises:
        UserError: the family is unknown, or one of its parameters has another unit or scale in another family.
    """
    name, names = str(name), [f.name for f in FAMILIES]
    if name in names:
        return FAMILIES[names.index(name)]
    if name in _imported:
        return _imported[name]
    module, _, attribute = name.rpartition(".")
    if not module:
        raise UserError(
            f"friction.family: expected {choices(names)}, auto, or my_module.MY_FAMILY, got '{name}'"
            f"{nearest(name, [*names, 'auto'])}"
        )
    try:
        found = getattr(import_module(module), attribute)
    except (ImportError, AttributeError, SyntaxError, TypeError, ValueError) as error:
        raise UserError(f"friction.family: cannot import '{name}' ({error})") from None
    if not isinstance(found, Family):
        raise UserError(f"friction.family: expected a Family, got '{name}' of type {type(found).__name__}")
    for other in known_families():
        for own in set(found.names) & set(other.names):
            scales = [" ".join(f.scale(own)) for f in (found, other)]
            if scales[0] != scales[1]:
                raise UserError(
                    f"friction.family: expected '{own}' of '{name}' to be {scales[1]}, as in '{other.name}', got "
                    f"{scales[0]}; rename it"
                )
    _imported[name] = found
    return found


def check_trusted(name: str, trust: Sequence[str], file: str) -> None:
    """Raise UserError if `family` would import the family `name` in `file` from a module that is not in `trust`."""
    module = name.split(".")[0]
    if "." in name and name not in _imported and module not in trust:
        raise UserError(
            f"{file}: friction_family is '{name}', no part of r2s, and r2s would run it; if you trust it, add "
            f"trust={module}"
        )


def family_path(one: Family) -> str:
    """Return the name or dotted path for which the function `family` returns the family `one`."""
    return next((path for path, f in _imported.items() if f is one), one.name)


def presliding(dq: np.ndarray, dt: float, distance: np.ndarray | float) -> np.ndarray:
    """Return the bristle deflection z (T, n) in [-1, 1] for dq (T, n) rad/s in steps of dt s.

    The deflection z starts at 0, solves dz/dt = (v - |v| z) / distance for v = dq (Dahl 1968), and replaces sign(v).
    distance: rad, () or (n,).
    """
    return _presliding(dq, dt, np.broadcast_to(np.asarray(distance, dtype=float), dq.shape[1:]).copy())


@njit(cache=True)
def _presliding(dq, dt, distance):
    z = np.zeros(dq.shape[1])
    out = np.empty_like(dq)
    for k in range(len(dq)):
        for j in range(len(z)):
            s = 1.0 if dq[k, j] > 0 else -1.0
            z[j] = s + (z[j] - s) * np.exp(-abs(dq[k, j]) * dt / distance[j])
            out[k, j] = z[j]
    return out
