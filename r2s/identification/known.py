"""Represent prior knowledge of an arm's parameters as a normal distribution of named values.

Prior knowledge comes from an earlier identification, with any kind of torque, or from the user (stated.py). After the
earlier identification, friction and offsets x drift by w ~ N(0, drift^2): x_now = x_then + w. The prior covariance is
the earlier posterior covariance plus diag(drift^2), as in the prediction step of a Kalman filter (Kalman 1960). r2s
also estimates w from the earlier posterior and the present recording.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from r2s.identification.link_inertia import PAYLOAD
from r2s.identification.parameters import OF_LINKS, ParameterSpace, logarithmic, units
from r2s.identification.posterior import Z_95

BODY = (*OF_LINKS, *PAYLOAD)  # independent of the kind of torque, unlike friction, offsets and gains
DRIFTING = ("offset", "load", "drag_sin", "drag_cos")  # parameters that drift besides those of the friction law
FLOOR = 1e-4  # least standard deviation, relative to `ParameterSpace.usual`; needed if all draws lie at a bound
# prior and data disagree if they differ by more standard deviations along one of about thirty axes
FAR = 5.0


@dataclass(frozen=True, eq=False)
class Known:
    """A normal distribution of named values, which a problem uses as an `ExtraResidual`.

    Attributes:
        names: K names such as coulomb[2]. mean: (K,) in SI units; for logarithmic parameters, mean of the logarithm.
        covariance: (K, K), including drift. drift: (K,) standard deviation of a value's drift; 0 means no drift.
    """

    names: tuple[str, ...]
    mean: np.ndarray
    covariance: np.ndarray
    drift: np.ndarray

    @staticmethod
    def of(space: ParameterSpace, x: np.ndarray, samples: np.ndarray, drift: float = 0.0) -> "Known":
        """Convert the values x (P,) and posterior draws (S, P) of an earlier identification into a prior.

        drift: standard deviation of the change of friction, offsets and drag since the earlier identification,
        relative to the value or, if larger, to the standard deviation among arms (`ParameterSpace.usual`).
        """
        names, usual = space.names, space.usual
        mean, least = coordinates(names, x), np.where(np.isfinite(usual), usual, 0.0)
        covariance = np.atleast_2d(np.cov(coordinates(names, samples).T)) + np.diag((FLOOR * least) ** 2)
        moves = np.array([block_of(n) in (*space.nominal.family.names, *DRIFTING) for n in names])
        size = np.where(
            is_logarithmic(names), 1.0, np.maximum(np.abs(mean), np.where(np.isfinite(usual), usual, 0.0))
        )
        change = drift * size * moves
        return Known(tuple(names), mean, covariance + np.diag(change**2), change)

    def where(self, kept: Callable[[str], bool]) -> "Known":
        """Return the marginal distribution of all values whose names satisfy `kept`."""
        at = [k for k, name in enumerate(self.names) if kept(name)]
        covariance = self.covariance[np.ix_(at, at)]
        return Known(tuple(self.names[k] for k in at), self.mean[at], covariance, self.drift[at])

    def beside(self, other: "Known | None") -> "Known":
        """Return the joint distribution with the independent prior `other`; values in both follow `other` alone."""
        if other is None:
            return self
        own, k = self.where(lambda name: name not in other.names), len(other.names)
        covariance = np.zeros((len(own.names) + k,) * 2)
        covariance[: len(own.names), : len(own.names)], covariance[-k:, -k:] = own.covariance, other.covariance
        arrays = (np.concatenate(pair) for pair in ((own.mean, other.mean), (own.drift, other.drift)))
        mean, drift = arrays
        return Known((*own.names, *other.names), mean, covariance, drift)

    def residual(self, space: ParameterSpace, x: np.ndarray) -> np.ndarray:
        """Return the deviations (C, K) of candidates x (C, P) from the mean, whitened by the covariance."""
        at = [space.names.index(name) for name in self.names]
        off = coordinates(self.names, x[:, at]) - self.mean
        return np.linalg.solve(np.linalg.cholesky(self.covariance), off.T).T


def disagreement(known: Known, space: ParameterSpace, x: np.ndarray) -> tuple[float, str]:
    """Return the largest deviation of x (P,) from the prior, in standard deviations, and the name of the worst value.

    Deviations are measured along the principal axes of the prior's correlation matrix.
    """
    known = known.where(lambda name: name in space.names and name not in space.fixed)
    if not known.names:
        return 0.0, ""
    off = coordinates(known.names, x[[space.names.index(name) for name in known.names]]) - known.mean
    sigma = np.sqrt(np.diag(known.covariance))
    size, axes = np.linalg.eigh(known.covariance / np.outer(sigma, sigma))
    z = axes.T @ (off / sigma) / np.sqrt(np.maximum(size, 1e-12))
    k = int(np.abs(z).argmax())
    return float(np.abs(z[k])), known.names[int(np.abs(axes[:, k]).argmax())]


def block_of(name: str) -> str:
    """Return the parameter that a value's name contains, such as coulomb for coulomb[2]."""
    return name.split("[")[0]


def is_logarithmic(names: Iterable[str]) -> np.ndarray:
    """Return (K,) bool, whether each named value has a logarithmic coordinate."""
    log = logarithmic()
    return np.array([block_of(name) in log for name in names], dtype=bool)


def coordinates(names: Sequence[str], x: np.ndarray) -> np.ndarray:
    """Return x (..., K) with logarithmic parameters replaced by their logarithms."""
    log = is_logarithmic(names)
    return np.where(log, np.log(np.where(log, x, 1.0)), x)


def drift_table(known: Known, space: ParameterSpace, x: np.ndarray, samples: np.ndarray) -> pd.DataFrame:
    """Return a table of values that may drift, in SI units: earlier and present value, difference with 95 % interval.

    The difference is the drift w in x_now = x_then + w. With x_then ~ N(m, P), Q = diag(drift^2), S = P + Q, and
    x_now ~ N(x, V) after the new data, the Rauch-Tung-Striebel smoother (AIAA Journal 3(8), 1965) yields
    w ~ N(G (x - m), G V G^T + P - P S^-1 P), where G = Q S^-1.

    Args:
        known: prior from the earlier identification. space, x, samples: parameters, values (P,) and posterior draws
            (S, P) of the present identification.
    """
    known = known.where(lambda name: name in space.names and name not in space.fixed)
    at = [space.names.index(name) for name in known.names]
    log, now = is_logarithmic(known.names), coordinates(known.names, x[at])
    v = np.atleast_2d(np.cov(coordinates(known.names, samples[:, at]).T))
    q, s = np.diag(known.drift**2), known.covariance
    gain, p = np.linalg.solve(s, q).T, s - q
    change = gain @ (now - known.mean)
    left = np.diag(gain @ v @ gain.T + p - p @ np.linalg.solve(s, p))
    half = Z_95 * np.sqrt(np.maximum(left, 0.0))
    then, unit = np.where(log, np.exp(np.where(log, known.mean, 0.0)), known.mean), units()

    def si(w: np.ndarray) -> np.ndarray:
        return np.where(log, then * np.expm1(np.where(log, w, 0.0)), w)

    table = pd.DataFrame({
        "parameter": known.names,
        "unit": [unit[block_of(name)] for name in known.names],
        "then": then,
        "now": x[at],
        "difference": si(change),
        "low": si(change - half),
        "high": si(change + half),
    })  # fmt: skip
    table["changed"] = (table["low"] > 0) | (table["high"] < 0)
    return table[known.drift > 0].reset_index(drop=True)
