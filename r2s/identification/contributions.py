"""Assess what each of several recordings adds to an identification, and whether one contradicts the others.

Two further fits assess each recording: a fit without the recording, and a fit to the recording alone. Every further
fit starts at the solution for all recordings, so few least-squares steps on torque suffice. A recording's weights
come from the fit to this recording alone, because contradictory recordings would increase the residual of a common
fit.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from r2s.identification.identify import STANDSTILL
from r2s.identification.parameters import ParameterSpace
from r2s.identification.posterior import FLAT
from r2s.identification.residuals.torque_residual import TorqueResidual
from r2s.identification.result import IdentificationResult
from r2s.identification.search.levenberg_marquardt import minimize, normal_equations
from r2s.recordings.parts import spread
from r2s.recordings.recording import Recording

# a recording contradicts the others if the sums of squares of fits have at least this ratio:
# fit to all / (fit without this recording + fit to this recording alone + number of parameters)
CONTRADICTS = 2.0
# a recording is reported if the RMSE of a fit to it alone is at least this multiple of the others' median
WORSE = 4.0
CARRIED = 0.5  # a body on the last link is reported if it explains more than this share of the squared torque error
LEAST_MASS = 0.01  # least reported mass of a body on the last link, relative to the arm's mass
ROUNDS = 3  # number of reweighted fits to each recording alone
STEPS, FTOL = 10, 1e-3  # most Jacobians in a fit; a fit ends when a step reduces the cost by less than this share
USED_S, RATE_HZ = 120.0, 50.0  # s, longest compared part of a recording; residual rows per second


@dataclass(frozen=True, eq=False)
class Contribution:
    """Contribution of one recording to a fit; each error is the torque RMSE on this recording.

    Attributes:
        label, torque, seconds: name, kind of torque and length of the recording. use: "training" or "validation".
        rmse: (n,) Nm, error of the fit to all recordings.
        left_out: (n,) Nm, error of a fit without this recording; None for a validation recording.
        narrower: (P,), width of the 95 % intervals without this recording / width with it; None for a validation
            recording.
        alone: (n,) Nm, error of a fit to this recording alone. contradiction: ratio of sums of squares, see
            CONTRADICTS; 1 for a single recording. body_kg: additional mass on the last link that explains the error
            `left_out`; nan if no mass explains it.
    """

    label: str
    torque: str
    seconds: float
    rmse: np.ndarray
    use: str = "validation"
    left_out: np.ndarray | None = None
    narrower: np.ndarray | None = None
    alone: np.ndarray | None = None
    contradiction: float = 1.0
    body_kg: float = np.nan


def contributions(
    found: IdentificationResult, recordings: Mapping[str, Recording], cutoff_hz: float
) -> list[Contribution]:
    """Return each recording's contribution to the fit `found`; all recordings have the same kind of torque."""
    space, u = found.space, found.space.to_unit(found.x)
    r0, slope = found.prior_rows
    flat = np.diag(np.sqrt(FLAT) * ~slope.any(0))  # flat priors have no rows in the prior residual
    prior = np.concatenate([r0, np.zeros(len(u))]), np.concatenate([slope, flat])
    parts = [_torque(space, spread(r, USED_S), cutoff_hz) for r in recordings.values()]
    parts = [p.reweighted(found.x, fitted=True) for p in parts]
    alone = [u] * len(parts)
    for _ in range(ROUNDS):
        alone = [_fitted([p], u, prior) for p in parts]
        parts = [p.reweighted(space.from_unit(v), fitted=True) for p, v in zip(parts, alone, strict=True)]
    # assume that unused parts of a recording contain as much information as used parts
    more = [max(1.0, r.duration / USED_S) for r in recordings.values()]
    information = [k * normal_equations(p.linearize(u))[1] for k, p in zip(more, parts, strict=True)]
    total = sum(information) + prior[1].T @ prior[1]
    width, square = np.sqrt(np.diag(np.linalg.inv(total))), _square(parts, _fitted(parts, u, prior))
    out = []
    for (label, r), p, own, v in zip(recordings.items(), parts, information, alone, strict=True):
        others = [q for q in parts if q is not p]
        without = _fitted(others, u, prior)
        error, left_out, alone_error = (p.errors(space.from_unit(w)[None])[0] for w in (u, without, v))
        ratio = square / (_square(others, without) + _square([p], v) + len(u)) if others else 1.0
        more_of_it = {
            "left_out": _rmse(left_out, p.seen),
            "alone": _rmse(alone_error, p.seen),
            "narrower": np.sqrt(np.diag(np.linalg.inv(total - own))) / width,
            "contradiction": ratio,
            "body_kg": _carried(p, left_out, space.robot.mass.sum()) if others else np.nan,
        }
        out.append(Contribution(label, r.torque, r.duration, _rmse(error, p.seen), "training", **more_of_it))
    return out


def validated(
    found: IdentificationResult, recordings: Mapping[str, Recording], cutoff_hz: float
) -> list[Contribution]:
    """Return contributions of the validation recordings {label: recording}, with `rmse` as the only error."""
    out = []
    for label, r in recordings.items():
        data = _torque(found.space, r, cutoff_hz)
        out.append(Contribution(label, r.torque, r.duration, _rmse(data.errors(found.x[None])[0], data.seen)))
    return out


def _torque(space: ParameterSpace, recording: Recording, cutoff_hz: float) -> TorqueResidual:
    slowest = STANDSTILL if recording.torque == "commanded" else 0.0
    return TorqueResidual(space, recording, cutoff_hz=cutoff_hz, rate_hz=RATE_HZ, slowest=slowest)


def _square(parts: Sequence[TorqueResidual], u: np.ndarray) -> float:
    """Return the sum of squares of the residuals in `parts` at the unit-cube parameters u (P,)."""
    return sum(float((p(p.space.from_unit(u)[None]) ** 2).sum()) for p in parts)


def _fitted(parts: Sequence[TorqueResidual], u: np.ndarray, prior: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Fit the residuals `parts` from start u (P,); return the solution (P,). prior: residual (B,) and Jacobian."""
    offset, root = prior

    def residual(v: np.ndarray) -> np.ndarray:
        data = [p(p.space.from_unit(v)) for p in parts]
        return np.concatenate([*data, (v - u) @ root.T + offset], axis=1)

    def linearize(v: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for p in parts:
            yield from p.linearize(v)
        yield root @ (v - u) + offset, root

    return minimize(residual, linearize, u, STEPS, FTOL)


def _rmse(error: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return the RMSE (n,) Nm over the rows marked in `seen`; nan for a joint without marked rows."""
    square = np.where(seen, error**2, 0.0).sum(0)
    return np.sqrt(square / np.where(seen.any(0), seen.sum(0), np.nan))


def _carried(data: TorqueResidual, error: np.ndarray, arm_kg: float) -> float:
    """Return the additional mass on the last link, kg, that explains a torque error (T, n) Nm; nan if none does."""
    some = data.seen.ravel()
    y = data.rigid_body_of_last_link()
    rows, tau = y.reshape(-1, y.shape[-1])[some], -error.ravel()[some]
    body = np.linalg.lstsq(rows, tau, rcond=1e-6)[0]
    explained = 1.0 - ((tau - rows @ body) ** 2).sum() / max((tau**2).sum(), 1e-12)
    return float(body[0]) if explained > CARRIED and abs(body[0]) > LEAST_MASS * arm_kg else np.nan


def contradictions(parts: Sequence[Contribution]) -> list[str]:
    """Return [message] if a recording contradicts the others or has far larger torque errors, else []."""
    trained = [p for p in parts if p.left_out is not None and p.alone is not None]
    if len(trained) < 2:
        return []
    odd = max(trained, key=lambda p: p.contradiction)
    level = np.array([np.nanmean(p.alone) for p in trained])  # type: ignore[arg-type]
    worse = [float(x / np.median(np.delete(level, k))) for k, x in enumerate(level)]
    if odd.contradiction < CONTRADICTS:
        if max(worse) < WORSE:
            return []
        odd = trained[int(np.argmax(worse))]
    others = next(p.label for p in trained if p is not odd) if len(trained) == 2 else "the other recordings"
    far = np.nan_to_num(odd.left_out)  # type: ignore[arg-type]
    worst = int(far.argmax())
    why = "another tool, load or mounting, or has friction changed?"
    if np.isfinite(odd.body_kg):
        more = "more" if odd.body_kg > 0 else "less"
        why = f"{abs(odd.body_kg):.2g} kg {more} on the last link would explain it: another tool?"
    return [
        f"{odd.label} contradicts {others}: a fit without it misses its torque in joint {worst + 1} by "
        f"{far[worst]:.3g} Nm; {why}"
    ]
