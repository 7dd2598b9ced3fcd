"""What an identification is told: what is searched, within what, and how the residuals are made."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from numpy.typing import ArrayLike

from r2s.errors import UserError, check_number, choices
from r2s.identification.parameters import check_bounds, check_parameters
from r2s.identification.problem import check_choices, check_prior, check_terms, optional_friction, parts


@dataclass(frozen=True)
class Settings:
    """The settings of `identify`: `identify.*` of the config, with the terms and the prior of one kind of torque.

    Attributes:
        bounds: {"phi1": [low, high], ...}, of whatever may be searched; an end is a number, or one per joint.
        prior: {"inertia_scale": sigma, ...}, see `Problem`.
        terms: what is searched beside friction: viscous, offset, inertia_scale or link, payload, armature, delay,
            lag, load, drag, gain.
        extra: terms that enter where motion left out demands them; `link` then takes the place of `inertia_scale`.
        family: of the friction; auto keeps the one with the smallest error on motion left out.
        window_s: length of a replayed window, s (commanded torque).
        stride: ms that compared angles are means of (commanded torque).
        cutoff_hz: zero-phase filter of the torque.
        breakaway: scan the dead zone's edges up to this, Nm, where there are no ramps (commanded torque; a link-side
            sensor does not feel the motor's breakaway). None keeps the nominal edges.
        folds: of the cross-validation within the recording.
        spare: those of the terms that are left out where motion left out is predicted as well without them.
        keep_nominal: a joint whose refit predicts motion left out not clearly better than the nominal one keeps that.

    Raises:
        UserError: a family, term or parameter that does not exist, or a number outside its range.
    """

    bounds: Mapping[str, Sequence[ArrayLike]]
    prior: Mapping[str, ArrayLike]
    terms: Sequence[str]
    family: str = "sigmoid"
    window_s: float = 0.2
    stride: int = 5
    cutoff_hz: float = 10.0
    breakaway: float | None = 1.5
    folds: int = 4
    keep_nominal: bool = False
    extra: Sequence[str] = ()
    spare: Sequence[str] = ()

    def __post_init__(self):
        check_choices(self.family, [*self.terms, *self.extra])
        check_terms("identify.spare", self.spare)
        check_parameters("bounds", self.bounds)
        check_bounds("bounds", self.bounds)
        check_prior(self.prior)
        terms = [name for term in (*self.terms, *self.extra) for name in parts(term)]
        if missing := [name for name in terms if name not in {*self.bounds, *optional_friction()}]:
            raise UserError(f"identify.bounds: none for {choices(missing)}")
        check_number("identify.window_s", self.window_s, "(0, inf)")
        check_number("identify.stride", self.stride, "[1, inf)", whole=True)
        check_number("identify.cutoff_hz", self.cutoff_hz, "(0, 500]")  # half the rate of rows
        if self.breakaway is not None:
            check_number("identify.breakaway", self.breakaway, "[0, inf)")
        check_number("identify.folds", self.folds, "[1, inf)", whole=True)
        chosen = self.extra or {*self.spare} & {*self.terms}
        if self.folds < 2 and (self.family == "auto" or self.keep_nominal or chosen):
            raise UserError(f"identify.folds: {self.folds} is too few to leave motion out; at least 2 are needed")
