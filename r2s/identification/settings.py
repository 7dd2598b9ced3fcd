"""Settings of an identification: parameters, bounds, prior, and how residuals are computed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from numpy.typing import ArrayLike

from r2s.errors import UserError, check_number, choices
from r2s.identification.known import Known
from r2s.identification.parameters import check_bounds
from r2s.identification.stated import Stated, check_family, check_stated
from r2s.identification.terms import blocks_of, check_prior, check_terms, optional_friction
from r2s.physics.friction import family as friction_family


@dataclass(frozen=True)
class Settings:
    """Settings of `identify` (conf/identify) for the kind of torque in the recording.

    Attributes:
        bounds: {"phi1": [low, high], ...} for every parameter that may be fitted; a bound is a number or (n,).
            Bounds of torque-like parameters are relative to the largest torque (terms.py: `scaled_bounds`).
        prior: {"inertia_scale": sigma or None (flat), ...} in the units of `bounds`, see `scaled_prior`, `Problem`.
        terms: model terms to estimate besides friction, see terms.py.
        family: friction family; auto selects it by cross-validation.
        window_s: s, length of a replayed window; used only with commanded torque.
        stride: ms, averaging time of angles in the replay residual; used only with commanded torque.
        cutoff_hz: cutoff of the zero-phase filter for torque.
        breakaway: largest breakaway torque, relative to the identified friction, in the scan that replaces missing
            ramps for commanded torque. If None, r2s does not scan; without ramps, breakaway torques then stay
            nominal.
        folds: number of folds of the cross-validation within the recording.
        candidate_terms: terms to add if they improve prediction of held-out torque; `link` replaces `inertia_scale`.
        prunable_terms: terms to remove if the model predicts held-out torque equally well without them.
        stated: the user's mean, width or fixed value per parameter (stated.py).
        known: prior knowledge from an earlier identification, with any kind of torque (known.py).
        seed: seed of the random draws from the posterior.
        nthread: threads of the simulator; 0 uses all cores.

    Raises:
        UserError: a friction family, term or parameter is unknown, or a number is outside its range.
    """

    bounds: Mapping[str, Sequence[ArrayLike]]
    prior: Mapping[str, ArrayLike | None]
    terms: Sequence[str]
    family: str = "sigmoid"
    window_s: float = 0.2
    stride: int = 5
    cutoff_hz: float = 10.0
    breakaway: float | None = 1.5
    folds: int = 4
    candidate_terms: Sequence[str] = ()
    prunable_terms: Sequence[str] = ()
    stated: Stated = field(default_factory=dict)
    known: Known | None = None
    seed: int = 0
    nthread: int = 0

    def __post_init__(self):
        if self.family != "auto":
            friction_family(self.family)
        for name in ("terms", "candidate_terms", "prunable_terms"):
            check_terms(f"identify.{name}", getattr(self, name))
        check_bounds("bounds", self.bounds)
        check_prior(self.prior)
        check_stated(self.stated)
        check_family(self.stated, self.family)
        names = [name for term in (*self.terms, *self.candidate_terms) for name in blocks_of(term)]
        if missing := [name for name in names if name not in {*self.bounds, *optional_friction()}]:
            raise UserError(f"identify.bounds: none for {choices(missing)}")
        check_number("identify.window_s", self.window_s, "(0, inf)")
        check_number("identify.stride", self.stride, "[1, inf)", whole=True)
        check_number("identify.cutoff_hz", self.cutoff_hz, "(0, 500]")  # Nyquist frequency of 1 kHz
        if self.breakaway is not None:
            check_number("identify.breakaway", self.breakaway, "[0, inf)")
        check_number("identify.folds", self.folds, "[1, inf)", whole=True)
        selects = self.candidate_terms or {*self.prunable_terms} & {*self.terms}
        if self.folds < 2 and (self.family == "auto" or selects):
            raise UserError(f"identify.folds: {self.folds} is too few for cross-validation; at least 2 are needed")
