"""Read a user's values for an arm: prior mean and prior width, or a fixed value, in SI units."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from r2s.errors import UserError, choices, nearest
from r2s.identification.known import Known
from r2s.identification.parameters import WHOLE_ARM, ParameterSpace, check_parameters, logarithmic
from r2s.physics.friction import family, known_families

Stated = Mapping[str, Mapping[str, Any]]  # {"coulomb": {"mean": [3.1, None, 2.0], "width": 0.2}, ...}
KEYS = ("mean", "width", "fixed")
TINY = 1e-9  # half-width of a fixed value's bounds, relative to the value or to the width of its original bounds


def check_stated(stated: Stated, n: int | None = None) -> None:
    """Raise UserError for an unknown parameter or key, a wrong value, or a mean or width of a fixed parameter.

    A value is a number, null or a list of n numbers or nulls. n: number of joints; if None, the lengths of lists are
    not checked.
    """
    check_parameters("identify.prior", stated)
    for name, entry in stated.items():
        where = f"identify.prior.{name}"
        if not isinstance(entry, Mapping):
            raise UserError(f"{where}: expected {choices(f'{where}.{key}=' for key in KEYS)}, got {entry!r}")
        for key, value in entry.items():
            if key not in KEYS:
                raise UserError(f"{where}: expected {choices(KEYS)}, got '{key}'{nearest(key, KEYS)}")
            _check(f"{where}.{key}", value, 1 if name in WHOLE_ARM else n, key == "width" or name in logarithmic())
        if n is not None:
            mean, width, fixed = (np.isfinite(_values(entry, key, 1 if name in WHOLE_ARM else n)) for key in KEYS)
            if (both := fixed & (mean | width)).any():
                joint = "" if name in WHOLE_ARM else f" of joint {int(both.argmax()) + 1}"
                raise UserError(f"{where}: a fixed value{joint} has no mean and no width; leave them out")


def check_family(stated: Stated, name: str) -> None:
    """Raise UserError if family `name` lacks a stated friction parameter; "auto" allows no friction parameter."""
    known = {own for f in known_families() for own in f.names}
    for parameter in stated:
        if parameter not in known or (name != "auto" and parameter in family(name).names):
            continue
        where = f"identify.prior.{parameter}"
        if name == "auto":
            raise UserError(
                f"{where}: friction.family=auto may choose a law without {parameter}; set friction.family="
            )
        raise UserError(f"{where}: friction family '{name}' has {choices(family(name).names)}; set friction.family=")


def _check(where: str, value: Any, count: int | None, positive: bool) -> None:
    """Raise UserError unless a setting is a number or null, or a list of `count` such values."""
    what = "a positive number" if positive else "a number"
    several = f" or a list of {count} (null: nothing is stated of a joint)" if count != 1 else ""
    parts = value if isinstance(value, list | tuple) else [value]
    if isinstance(value, list | tuple) and count is not None and len(value) != count:
        raise UserError(f"{where}: expected {what}{several}, got {len(value)} values")
    for x in parts:
        wrong = isinstance(x, bool) or not isinstance(x, Real) or not np.isfinite(float(x))
        if x is not None and (wrong or (positive and float(x) <= 0)):
            raise UserError(f"{where}: expected {what}{several}, got {x!r}")


def _values(entry: Mapping[str, Any], key: str, count: int) -> np.ndarray:
    """Return the user's values (count,) for `key`, such as "mean"; nan for joints without a value."""
    value = entry.get(key)
    parts = value if isinstance(value, list | tuple) else [value]
    return np.broadcast_to(np.array([np.nan if x is None else x for x in parts], dtype=float), count).copy()


def fixed_in(space: ParameterSpace, stated: Stated) -> ParameterSpace:
    """Return the space with bounds so close to the user's fixed values that no search can change these values."""
    lower, upper, names = space.lower.copy(), space.upper.copy(), []
    for block, entry in stated.items():
        if block not in space.blocks:
            continue
        at, value = space.where(block), _values(entry, "fixed", space.size(block))
        log = block in logarithmic()
        half = TINY * (value if log else np.maximum(np.abs(value), upper[at] - lower[at]))
        some = np.isfinite(value)
        lower[at[some]], upper[at[some]] = (value - half)[some], (value + half)[some]
        names += [space.names[k] for k in at[some]]
    return replace(space, lower=lower, upper=upper, fixed=frozenset(names)) if names else space


def stated_prior(space: ParameterSpace, stated: Stated, prior: Mapping[str, ArrayLike]) -> Known | None:
    """Return the user's prior (mean and width) for values in `space`; None if the user gives no mean and no width.

    If the user gives only a mean, the width is from `prior`; if the user gives only a width, the mean is nominal. The
    user's widths are standard deviations in SI units; for a logarithmic parameter, the function divides the user's
    width by the mean.

    Args:
        space: the searched parameters. stated: see `check_stated`. prior: standard deviations, as in `Problem.of`.

    Raises:
        UserError: a stated parameter is not in `space`, a mean is outside the bounds, or neither the user nor `prior`
            gives a width for a mean.
    """
    names, means, widths = [], [], []
    for block, entry in stated.items():
        where = f"identify.prior.{block}"
        if block not in space.blocks:
            raise UserError(
                f"{where}: {block} is not estimated here (friction family {space.nominal.family.name}); estimated: "
                f"{choices(space.blocks)}{nearest(block, space.blocks)}"
            )
        at, count, log = space.where(block), space.size(block), block in logarithmic()
        mean, width = (_values(entry, key, count) for key in KEYS[:2])
        given = np.isfinite(mean) | np.isfinite(width)
        mean = np.where(np.isnan(mean), space.start[at], mean)
        if (bad := given & ((mean < space.lower[at]) | (mean > space.upper[at]))).any():
            j = int(bad.argmax())
            ends = f"[{space.lower[at][j]:.4g}, {space.upper[at][j]:.4g}]"
            raise UserError(f"{where}.mean: {mean[j]:g} is outside identify.bounds.{block}, {ends}; widen them")
        usual = np.broadcast_to(np.asarray(prior.get(block, np.inf), dtype=float), count)
        width = np.where(np.isnan(width), usual, width / mean if log else width)
        if np.isinf(width[given]).any():
            raise UserError(f"{where}.width: expected a number, because identify.prior has no width of {block}")
        names += [space.names[k] for k in at[given]]
        means += (np.log(mean) if log else mean)[given].tolist()
        widths += width[given].tolist()
    if not names:
        return None
    return Known(tuple(names), np.array(means), np.diag(np.square(widths)), np.zeros(len(names)))


def with_terms_of(stated: Stated, terms: Sequence[str], blocks_of: Any, every: Sequence[str]) -> list[str]:
    """Return `terms` plus terms of stated parameters; a stated `inertia_scale` replaces `link`, and vice versa."""
    out = list(terms)
    for block in stated:
        own = [t for t in every if block in blocks_of(t)]
        if not own or own[0] in out:
            continue
        other = {"inertia_scale": "link", "link": "inertia_scale"}.get(own[0])
        out = [t for t in out if t != other] + own[:1]
    return out
