"""What is searched and by what measure: the parameters of a model, and residuals on the unit cube.

A search is a function on the unit cube; it knows nothing of arms.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from r2s.errors import UserError, choices, nearest
from r2s.identification.levenberg_marquardt import minimise
from r2s.identification.link_inertia import LINK, PAYLOAD
from r2s.identification.parameters import ParameterSpace, check_parameters, logarithmic, of_torque, parameter_space
from r2s.identification.replay_residual import ReplayResidual
from r2s.identification.torque_residual import STEP, TorqueResidual
from r2s.physics.actuation import EARLY
from r2s.physics.dynamics import Dynamics
from r2s.physics.friction import family as friction_family
from r2s.physics.friction import known_families
from r2s.physics.robot import SIM_DT, Robot
from r2s.recordings.recording import Recording

NONE = 1e-4  # of its bounds' width, standard deviation of the belief in a value that is not searched
CLEAR, ABOUT = 3.0, (0.5, 2.0)  # standard deviations by which friction must be early; as a share of what it would be
TERMS: tuple[str, ...] = ("offset", "inertia_scale", "link", "payload", "armature", "delay", "lag", "load", "gain")
TERMS += ("drag", "drag_sin", "drag_cos")
Report = Callable[[dict], None]


class Known(Protocol):
    """What is known of a space beside its motion."""

    def residual(self, space: ParameterSpace, x: np.ndarray) -> np.ndarray:
        """Return (C, K), in standard deviations, for x (C, P)."""
        ...


def check_choices(family: str, terms: Sequence[str]) -> None:
    """Raise UserError if there is no such friction family, or no such term to search."""
    if family != "auto":
        friction_family(family)
    check_terms("identify.terms", terms)


def check_terms(where: str, terms: Sequence[str]) -> None:
    """Raise UserError if there is no such term to search."""
    known = (*optional_friction(), *TERMS)
    for name in terms:
        if name not in known:
            raise UserError(f"{where}: unknown term '{name}'; allowed: {choices(known)}{nearest(str(name), known)}")


def optional_friction() -> list[str]:
    """Return the friction parameters that are searched only where terms name them, of whichever family."""
    return list(dict.fromkeys(name for f in known_families() for name in f.optional))


def parts(term: str) -> tuple[str, ...]:
    """Return the blocks that a term stands for."""
    return {"link": tuple(LINK), "payload": PAYLOAD, "drag": ("drag_sin", "drag_cos")}.get(term, (term,))


def check_prior(prior: Mapping[str, ArrayLike]) -> None:
    """Raise UserError if the prior names what does not exist (it may name what is not searched), or no deviation."""
    check_parameters("prior", prior)
    for name, sigma in prior.items():
        if isinstance(sigma, str) or not np.all(np.greater(sigma, 0)):
            raise UserError(f"prior.{name}: {sigma!s} is not a positive standard deviation")


def searched(
    robot: Robot,
    nominal: Dynamics,
    bounds: Mapping[str, Sequence[ArrayLike]],
    terms: Sequence[str],
    recording: Recording,
) -> ParameterSpace:
    """Return the space of the family's parameters and `terms`; `link` and `payload` stand for several.

    What `bounds` do not name has those of the family's record.

    Delay and lag lie between a command and the motion, a gain error in what recorded the torque, and a link-side
    sensor does not feel rotors: each is searched where it is.

    Raises:
        UserError: a term without bounds.
    """
    left_out = set(nominal.family.optional) - set(terms)
    own = [name for name in nominal.family.names if name not in left_out]
    bounds = dict(zip(nominal.family.names, nominal.family.bounds, strict=False)) | dict(bounds)
    if not set(own) & set(bounds):
        raise UserError(f"identify.bounds: none for {choices(own)} of friction family '{nominal.family.name}'")
    bounds = fitting(bounds, robot, recording)
    names = [name for name in own if name in bounds]
    elsewhere = {"commanded": ("gain",), "measured": ("delay", "lag", "armature"), "motor": ("delay", "lag")}
    for term in terms:
        if term not in elsewhere[recording.torque] and term not in optional_friction():
            names += parts(term)
    if missing := [name for name in names if name not in bounds]:
        raise UserError(f"identify.bounds: none for {choices(missing)}")
    return parameter_space(robot, nominal, {name: bounds[name] for name in names})


def fitting(
    bounds: Mapping[str, Sequence[ArrayLike]], robot: Robot, recording: Recording
) -> dict[str, Sequence[ArrayLike]]:
    """Return bounds that fit an arm of any size: for motor torque what is in Nm reaches as far as the joint's torque.

    A motor's torque holds all friction of its gear: 0.5 Nm in a small wrist, 50 Nm in an axis of an industrial arm.
    """
    out = dict(bounds)
    if recording.torque == "motor":
        reach = _largest_torque(robot, recording)
        for name in out.keys() & of_torque():
            low, high = (np.asarray(end, dtype=float) for end in out[name])
            out[name] = [np.where(low < 0.0, np.minimum(low, -reach), low), np.maximum(high, reach)]
    return out


def believed(prior: Mapping[str, ArrayLike], robot: Robot, recording: Recording) -> dict[str, ArrayLike]:
    """Return deviations in SI units: of rotors prior names shares of each joint's largest torque.

    So it does of motor torque for all that is in Nm.
    """
    own = of_torque() - logarithmic() if recording.torque == "motor" else {"armature"}
    reach = _largest_torque(robot, recording)
    return {name: sigma * reach if name in own else sigma for name, sigma in prior.items()}


def _largest_torque(robot: Robot, recording: Recording) -> np.ndarray:
    """Return (n,) Nm: the arm's limits, or what was recorded where that is more."""
    return np.maximum(robot.tau_max, np.abs(recording.tau).max(0))


class Problem:
    """What a search sees: residuals on the unit cube, with what was believed before as rows of its own.

    Args:
        data: the residual that decides. quick: one on the level of torque, for a fast start; may be the same.
        prior: {"offset": sigma, ...}, standard deviation of the belief in the nominal value (of its logarithm where
            the scale is logarithmic), one or (n,). Blocks that are not named are uniform in their bounds.
        kept: (n,) bool, joints whose friction and offset stay nominal.
        beside: what is known without the motion and was not believed before: ramps, replays.
    """

    def __init__(
        self,
        data: ReplayResidual | TorqueResidual,
        quick: TorqueResidual,
        prior: Mapping[str, ArrayLike],
        kept: np.ndarray | None = None,
        beside: Sequence[Known] = (),
    ):
        self.beside = list(beside)
        self.data, self.quick_data, self.space = data, quick, data.space
        space = data.space
        self.start = space.to_unit(space.start)
        uniform = space.spread / np.sqrt(12)
        self.sigma = np.minimum(space.spread_out(prior, np.inf), uniform)
        if kept is not None:
            self.fix(space.of_joints(kept))
        self.clusters = data.clusters

    @property
    def weight(self) -> np.ndarray:
        """(P,) rows of the prior per unit of the cube."""
        return self.space.spread / self.sigma

    def believe(self, at: np.ndarray, sigma: np.ndarray | float) -> None:
        """Set the standard deviation of the belief in the nominal values `at`."""
        self.sigma[at] = sigma

    def fix(self, at: np.ndarray) -> None:
        """Let the values `at` stay nominal."""
        self.sigma[at] = NONE * self.space.spread[at]

    def cost(self, u: np.ndarray) -> float:
        """Return the sum of squares at u (P,)."""
        return float((self.residual(u[None]) ** 2).sum())

    def residual(self, u: np.ndarray) -> np.ndarray:
        """Return (C, R + B) for u (C, P) on the unit cube: data, then beliefs, in standard deviations."""
        return self._with_prior(self.data, u)

    def quick(self, u: np.ndarray) -> np.ndarray:
        """Return `residual` on the level of torque."""
        return self._with_prior(self.quick_data, u)

    def quick_jacobian(self, u: np.ndarray) -> np.ndarray:
        """Return (R + B, P), the Jacobian of `quick` at u (P,)."""
        return np.concatenate([self.quick_data.jacobian(u), self._belief_jacobian(u)])

    def _with_prior(self, data: ReplayResidual | TorqueResidual, u: np.ndarray) -> np.ndarray:
        return np.concatenate([data(self.space.from_unit(u)), self._belief(u)], axis=1)

    def _belief(self, u: np.ndarray) -> np.ndarray:
        """Return (C, B), what is believed without the motion, in standard deviations: the prior, then `beside`."""
        prior, x = (u - self.start) * self.weight, self.space.from_unit(u)
        return np.concatenate([prior, *(known.residual(self.space, x) for known in self.beside)], axis=1)

    def _belief_jacobian(self, u: np.ndarray) -> np.ndarray:
        h = np.where(u > 0.5, -STEP, STEP)
        r = self._belief(np.concatenate([u[None], u + np.diag(h)]))
        return ((r[1:] - r[0]) / h[:, None]).T

    def known(self, u: np.ndarray) -> np.ndarray:
        """Return (P, P), half the Hessian at u (P,) of what is believed without the motion."""
        j = self._belief_jacobian(u)
        return j.T @ j

    def adapt(self, u: np.ndarray, fitted: bool) -> None:
        """Let the residuals find their weights about u (P,)."""
        for data in {id(d): d for d in (self.data, self.quick_data)}.values():
            data.adapt(self.space.from_unit(u), fitted)

    def jacobian(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the residual (R + B,) and its Jacobian (R + B, P) at u (P,)."""
        if self.data is self.quick_data:
            return self.quick(u[None])[0], self.quick_jacobian(u)
        h = np.where(u > 0.5, -STEP, STEP)  # always into the cube
        r = self.residual(np.concatenate([u[None], u + np.diag(h)]))
        return r[0], ((r[1:] - r[0]) / h[:, None]).T


def answers_early(problem: Problem, u: np.ndarray, clear: float = CLEAR) -> bool:
    """Say whether friction is that of the velocity half a step ahead, at u (P,), a fit to the level of torque.

    It is in a simulator that solves for friction at the end of a step, on no arm whose time is continuous. What the
    torque shows of it must be about as large as it would be, and `clear` standard deviations: a rotor that the model
    lacks looks alike, a hundred times larger.
    """
    data = problem.quick_data
    r, j = problem.quick(u[None])[0], problem.quick_jacobian(u)
    data.ahead = EARLY * SIM_DT
    moved = problem.quick(u[None])[0] - r
    data.ahead = 0.0
    own = moved - j @ np.linalg.lstsq(j, moved, rcond=None)[0]  # what the parameters cannot stand in for
    share = -(own @ r) / (own @ own)
    return bool(ABOUT[0] < share < ABOUT[1] and share * np.linalg.norm(own) > clear)


class Search(Protocol):
    """A search minimises the sum of squares of a Problem's residual from `start` (P,) and returns where it ended.

    `report` gets a dict after every step or generation: search, evaluations, cost, done, total. `local` says whether
    it goes on from its start, so that it can polish.
    """

    local: bool

    def __call__(self, problem: Problem, start: np.ndarray, report: Report) -> np.ndarray:
        """Return u (P,) on the unit cube."""
        ...


def fit_torque(problem: Problem) -> np.ndarray:
    """Return u (P,) by least squares on the level of torque, weighed again after every round.

    Of motor torque the nominal friction may be off by tens of Nm, so the first weights say little.
    """
    u, rounds = problem.start, 4 if problem.quick_data.at_motor else 2
    for k in range(rounds):
        u = minimise(problem.quick, problem.quick_jacobian, u, 12, 1e-3)
        if k < rounds - 1:
            problem.quick_data.adapt(problem.space.from_unit(u), fitted=True)
    return u
