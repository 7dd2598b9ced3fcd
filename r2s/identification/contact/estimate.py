"""Identify a surface that an arm has pressed: stiffness, exponent, damping, friction and plane, with intervals.

If an arm's encoders are on the motors, the measured penetration includes the gears' deflection. r2s estimates the
surface first with rigid gears, then with compliant gears. If the user gives the gears' stiffness, the prior of the
compliance uses this stiffness.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from r2s.errors import UserError
from r2s.identification.arm_uncertainty import Arm
from r2s.identification.contact.problem import SLOWEST, ContactProblem, contact_problem
from r2s.identification.contact.start import LEAST_S, first_guesses
from r2s.identification.contact.surface_space import (
    LOWER,
    NAMES,
    SOFTEST,
    SURFACE,
    UPPER,
    WIDTH,
    Gears,
    unknown_gears,
)
from r2s.identification.contact.validation import Press, press_errors, presses
from r2s.identification.posterior import posterior
from r2s.identification.result import SHARPER
from r2s.physics.surface import UNIT_DEPTH, Surface
from r2s.recordings.recording import Recording

STEPS, ROUNDS = 25, 4  # most Jacobians per search; number of searches, each after a reweighting
AT_BOUND = 0.02  # a stiffness is at a bound if it is closer to the bound than this share of the logarithmic range
COVERED = (2.5, 97.5)  # %, percentiles of a 95 % interval
# Standard deviations of errors that more data do not reduce, due to friction laws and time steps: slope and bristle
# relative, damping in s/m, height in m, tilt in rad. Source: simulations in benchmarks/contact_identification.py.
SYSTEMATIC = {"tilt_a": 5e-6, "tilt_b": 5e-6, "height": 1e-6, "slope": 6e-4, "exponent": 3e-3}
SYSTEMATIC |= {"damping": 0.1, "friction": 1.5e-4, "bristle": 0.15}
Fit = Callable[[ContactProblem, np.ndarray], tuple[ContactProblem, np.ndarray]]


@dataclass(frozen=True, eq=False)
class ContactEstimate:
    """An identified surface.

    Attributes:
        surface: the estimate; `surface.point` is the mean of the tip centers in contact, projected onto the plane.
        draws: posterior draws {name: (S, ...)}. The names are parameters, point and normal of `Surface`, "slope"
            (N/m, of the force curve at LOAD) and "gears" (compliance (S, n) in rad/Nm).
        identifiable: {name: whether the data determine this value}.
        penetration: (2,) m, smallest and largest penetration depth in the recording.
        training: predicted and measured forces of fitted presses. validation: forces of presses that were not fitted;
            None if all were fitted.
        gears: (n,) rad/Nm, compliance of the gears between encoders and links; near 0 for rigid gears or encoders on
            the links. If a joint bears little load, its gear's ratio deflection / mean deflection stays near the
            prior mean.
        stated: whether the stiffness of the gears was known, see `Gears.stated`.
        tau_max: (n,) Nm, largest torques of the joints.
        rigid_gears: the estimate for simulations with rigid gears; its surface includes the compliance of the gears.
            `rigid_gears` is None in an estimate that assumes rigid gears.
    """

    surface: Surface
    draws: dict[str, np.ndarray]
    identifiable: dict[str, bool]
    penetration: tuple[float, float]
    training: Press
    validation: Press | None
    gears: np.ndarray
    stated: bool
    tau_max: np.ndarray
    rigid_gears: "ContactEstimate | None" = None

    def interval(self, name: str) -> tuple[float, float]:
        """Return the 95 % interval of the value `name` in `draws`."""
        low, high = np.percentile(self.draws[name], COVERED)
        return float(low), float(high)

    def deflection(self, gears: np.ndarray) -> np.ndarray:
        """Return the gears' mean deflection (...) rad at the largest torques, for compliances (..., n) rad/Nm."""
        return (gears * self.tau_max).mean(-1)

    @property
    def slope(self) -> float:
        """Posterior median, N/m, of the force curve's slope at LOAD."""
        return float(np.median(self.draws["slope"]))

    @property
    def height(self) -> tuple[float, float]:
        """95 % interval, m, of the plane's position along its normal, relative to the estimate `surface.point`."""
        along = (self.draws["point"] - self.surface.point) @ self.surface.normal
        low, high = np.percentile(along, COVERED)
        return float(low), float(high)

    @property
    def tilt_deg(self) -> float:
        """Angle in degrees; 95 % of the normals in `draws` differ from the estimated normal by at most this angle."""
        across = self.draws["normal"] - self.surface.normal
        return float(np.degrees(np.percentile(np.linalg.norm(across, axis=1), 95)))


def identify_contact(
    arm: Arm,
    recording: Recording,
    held_out: Recording | None = None,
    *,
    gears: Gears | None = None,
    seed: int = 0,
    report: Callable[[float, str], None] = lambda share, what: None,
) -> ContactEstimate:
    """Estimate the surface from a recording with contact; the field `rigid_gears` is the estimate for rigid gears.

    Args:
        arm: identified arm with a tool. recording: free motion, presses and slides, with commanded torque.
        held_out: further presses on the surface, for validation; if None, r2s refits without the last press and
            validates the refit on this press.
        gears: prior of the gears' deflection; if None, `unknown_gears`.
        seed: seed of the posterior's draws. report: function that receives the completed share and the next step.

    Raises:
        UserError: there is too little contact, or the recording does not determine the stiffness.
    """
    report(0.0, "forces of the arm")
    gears = gears or unknown_gears(arm.robot.n)
    surfaces, starts = first_guesses(arm.space, arm.x, recording, gears)
    problem = contact_problem(arm.space, arm.x, arm.samples, recording, surfaces)
    other = contact_problem(arm.space, arm.x, arm.samples, held_out, surfaces) if held_out is not None else None
    report(0.4, "surface")
    u = min((problem.minimized(u, STEPS) for u in starts), key=lambda found: found[1])[0]
    rigid = refined(problem, u)
    _check(*rigid)
    report(0.6, "gears")
    elastic = with_gears(*rigid)
    report(0.8, "validation and intervals")
    behind_gears = _concluded(*elastic, _held_out(*elastic, other, _fitted), seed)
    return replace(behind_gears, rigid_gears=_concluded(*rigid, _held_out(*rigid, other, refined), seed))


def _held_out(problem: ContactProblem, u: np.ndarray, other: ContactProblem | None, refit: Fit) -> Press | None:
    """Return predicted and measured forces of all presses in `other`, or of the last press if `other` is None.

    Without `other`, the prediction comes from a refit without the last press, and the result is None for fewer than
    two presses.
    """
    if other is not None:
        return press_errors(other.reweighted(u), u, presses(other, u))
    touched = presses(problem, u)
    if len(touched) < 2:
        return None
    rest, without = refit(problem.within(~touched[-1]), u)
    return press_errors(replace(rest.reweighted(without), torque=problem.torque), without, touched[-1:])


def with_gears(problem: ContactProblem, u: np.ndarray) -> tuple[ContactProblem, np.ndarray]:
    """Return the problem and its solution (8 + 1 + n,) for elastic gears, given the solution u (8,) for rigid gears.

    The weights remain those of the fit with rigid gears. Elastic gears also fit errors of the friction law, so their
    residual is smaller. Weights from this residual would make intervals too narrow: on the elastic twins 0 to 9, 23
    of 80 intervals would miss the true value, instead of 9.
    """
    return _fitted(problem, problem.space.with_gears(u))


def _fitted(problem: ContactProblem, u: np.ndarray) -> tuple[ContactProblem, np.ndarray]:
    return problem, problem.minimized(u, STEPS)[0]


def refined(problem: ContactProblem, u: np.ndarray) -> tuple[ContactProblem, np.ndarray]:
    """Reweight and solve the problem repeatedly, starting at u (U,); return the problem and its solution (U,)."""
    for _ in range(ROUNDS):
        problem = problem.reweighted(u)
        u = problem.minimized(u, STEPS)[0]
    return problem, u


def _check(problem: ContactProblem, u: np.ndarray) -> None:
    """Raise UserError if joints slide too briefly in contact, or if the stiffness is at a bound."""
    rows = np.any([problem.rows.any(1) & press for press in presses(problem, u)], axis=0).sum()
    if (touched := problem.torque.row_s * rows) < LEAST_S:
        raise UserError(
            f"data.contact: joints slide faster than {SLOWEST:g} rad/s for {touched:.2f} s in contact, at least "
            f"{LEAST_S:g} s are needed: friction hides the force on an arm at rest"
        )
    if not AT_BOUND < u[3] < 1 - AT_BOUND:
        low, high, seen = np.exp([LOWER[3], UPPER[3], LOWER[3] + u[3] * WIDTH[3]])
        raise UserError(
            f"data.contact: the stiffness is at its bound, {seen:.3g} N/m of {low:g} to {high:g}: the recording does "
            "not determine it; press with several forces, or check robot.tool"
        )


def _concluded(problem: ContactProblem, u: np.ndarray, validation: Press | None, seed: int) -> ContactEstimate:
    """Return the surface estimate at u (U,), with posterior draws."""
    steps = posterior(problem, problem.whole(u), seed).steps[:, : len(u)]
    steps[:, :SURFACE] += _systematic(np.random.default_rng(seed), len(steps))
    draws = np.clip(u + steps, 0.0, 1.0)
    surface, space = problem.space.surface(u), problem.space
    depth = problem.contact(u)[2]
    point, normal = space.plane(draws)
    K, exponent, damping, friction, bristle = space.law(draws).T
    named = {"exponent": exponent, "damping": damping, "friction": friction, "bristle": bristle}
    named |= {"stiffness": K * UNIT_DEPTH ** (exponent - 1.0), "slope": np.exp(LOWER[3] + draws[:, 3] * WIDTH[3])}
    half = np.percentile(draws, COVERED[1], axis=0) - np.percentile(draws, COVERED[0], axis=0)
    known = half / 2 < 1 / np.sqrt(12.0) / SHARPER
    identifiable = dict(zip(NAMES[3:], known[3:SURFACE].tolist(), strict=True))
    identifiable["slope"] &= bool(AT_BOUND < u[3] < 1 - AT_BOUND)  # soft gears may hide the stiffness
    identifiable |= {"plane": bool(known[:3].all()), "stiffness": identifiable["slope"] and identifiable["exponent"]}
    if len(u) > SURFACE:  # compare the mean deflection with its prior
        sure = half[SURFACE] / 2 < space.gears.width / SOFTEST / SHARPER
        identifiable["gears"] = bool(sure and u[SURFACE] < 1 - AT_BOUND)
    touched = problem.tip.centre[depth > 0].mean(0)
    at = touched - ((touched - surface.point) @ surface.normal) * surface.normal
    point = at + ((point - at) * normal).sum(-1, keepdims=True) * normal
    return ContactEstimate(
        surface=replace(surface, point=at),
        draws=named | {"point": point, "normal": normal, "gears": space.compliance(draws)},
        identifiable=identifiable,
        penetration=(float(depth[depth > 0].min()), float(depth.max())),
        training=press_errors(problem.reweighted(u), u, presses(problem, u)),
        validation=validation,
        gears=space.compliance(u),
        stated=space.gears.stated,
        tau_max=space.tau_max,
    )


def _systematic(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return random errors (S, 8) of a surface's vector u, with the standard deviations SYSTEMATIC."""
    return rng.standard_normal((count, SURFACE)) * [SYSTEMATIC[name] for name in NAMES] / WIDTH
