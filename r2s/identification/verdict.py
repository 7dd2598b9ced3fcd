"""Judge a recording before a fit: pass, warn or fail for each check, and expected interval widths.

A recording fails if the checks of an identification would refuse it (checks.py, unit_checks.py). Each line of a
verdict also shows the values that its check measured.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from r2s.errors import UserError
from r2s.identification.checks import check_motion, check_rate, check_recording
from r2s.identification.expected_width import ExpectedWidths, expected_widths
from r2s.identification.parameters import PER_JOINT, TIMING
from r2s.identification.residuals.windows import MOVED
from r2s.identification.residuals.zero_phase import FRICTION_CUTOFF
from r2s.identification.result import UNSEEN
from r2s.identification.settings import Settings
from r2s.identification.unit_checks import CLOCK, GRAVITY, MOVING, ORDER, SUSPECT, UNITS_OF, Judged
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot
from r2s.recordings.lateness import lateness
from r2s.recordings.parts import spread
from r2s.recordings.recording import Recording

PASS, WARN, FAIL, OPEN = "pass", "warn", "fail", "-"  # OPEN: not judged
# a step that deviates from the median by more than this share is uneven; allowed share of uneven steps
UNEVEN, UNEVEN_SHARE = 0.5, 0.05
OFF_CLOCK = 0.03  # largest error of dq's scale; filters and elastic gears cause 1 to 2 % (recordings/clock.py)
LATE_S = 1e-3  # s; lateness below this or, if longer, half a row period causes no warning
SURE = 2.0  # half-width of the displayed interval of lateness, in standard deviations
# tau's gravity torque / nominal gravity torque without undeclared load; masses in files err by up to a third
LOADED = 0.7, 1.4
SPEEDS_S = 600.0  # s, longest part of a recording whose speeds are examined
FAST, SLOW = 0.2, 0.05  # relative to dq_max; a friction curve needs speeds from below SLOW to above FAST
# of the rows in which a joint moves: least share slower than SLOW; least share in each direction
LEAST_SLOW, LEAST_WAY = 0.01, 0.1


@dataclass(frozen=True)
class Line:
    """Result of a check: verdict, finding, advice, and measured values by name (an array has one value per joint)."""

    check: str
    verdict: str
    found: str
    advice: str = ""
    values: Mapping[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        return f"{self.check}: {self.found}{f'; {self.advice}' if self.advice else ''}"


@dataclass(frozen=True)
class Verdict:
    """The results of all checks of a recording, and the expected interval widths (None if a check fails)."""

    lines: tuple[Line, ...]
    expected: ExpectedWidths | None = None

    @property
    def fails(self) -> list[Line]:
        """Results of the checks that the recording fails."""
        return [line for line in self.lines if line.verdict == FAIL]

    @property
    def warnings(self) -> list[Line]:
        """Results of the checks that end with a warning."""
        return [line for line in self.lines if line.verdict == WARN]

    @property
    def worst(self) -> str:
        """The verdict on the whole recording: the worst verdict of its checks."""
        return FAIL if self.fails else WARN if self.warnings else PASS

    def refuse(self, name: str = "") -> None:
        """Raise UserError for the first failed check, if any; the message begins with the recording's `name`."""
        for line in self.fails:
            raise UserError(f"{name}{line.found}")

    def document(self) -> dict[str, Any]:
        """Return the verdict as a dict that JSON can store."""
        lines = [
            {"check": x.check, "verdict": x.verdict, "found": x.found, "advice": x.advice}
            | {k: v.tolist() if isinstance(v, np.ndarray | np.generic) else v for k, v in x.values.items()}
            for x in self.lines
        ]
        out: dict[str, Any] = {"verdict": self.worst, "checks": lines}
        if (e := self.expected) is not None:
            rows = zip(e.space.names, e.width.tolist(), e.share.tolist(), e.identifiable.tolist(), strict=True)
            keys = "width", "share_of_prior", "identifiable"
            out["expected_width95"] = {name: dict(zip(keys, values, strict=True)) for name, *values in rows}
        return out


def judge(robot: Robot, nominal: Dynamics, recording: Recording, settings: Settings) -> Verdict:
    """Return the verdict on a recording.

    Args:
        robot, nominal: the arm, and the dynamics from which an identification starts.
        recording: the recording; if the motion repeats, `Recording.in_phase` must have found the period.
        settings: settings of the identification.
    """
    lines, judged = _file(recording), None
    try:
        check_motion(robot, recording)
        lines.append(_joints(robot, recording))
        judged = check_recording(robot, recording)
    except UserError as error:
        check = getattr(error, "check", "joints" if len(lines) == 1 else "rows")
        lines.append(Line(check, FAIL, str(error)))
    try:
        check_rate(settings.cutoff_hz, recording)
        lines.append(_rate(settings.cutoff_hz, recording))
    except UserError as error:
        lines.append(Line("rate", FAIL, str(error)))
    if any(line.verdict == FAIL for line in lines):
        return Verdict((*lines, Line("the rest", OPEN, "not judged", "mend this first")))
    expected = expected_widths(robot, nominal, recording, settings)
    lines += [_clock(recording, judged), *_signals(robot, recording, judged)]
    lines += [_late_speed(recording, settings.cutoff_hz), _late_torque(recording, expected), _repeats(recording)]
    return Verdict((*lines, _speeds(robot, recording), _excitation(expected)), expected)


def _file(r: Recording) -> list[Line]:
    count = len(r.stretches)
    words = f"{len(r.t)} rows, {count} {'trajectory' if count == 1 else 'trajectories'}, {r.duration:.1f} s"
    return [Line("file", WARN if r.notes else PASS, f"{words}, {r.torque} torque", "; ".join(r.notes))]


def _joints(robot: Robot, r: Recording) -> Line:
    still = np.flatnonzero(np.ptp(r.q, axis=0) < MOVED)
    found = f"{robot.n} joints within the limits of {robot.name}"
    if len(still):
        return Line("joints", WARN, f"joint {_listed(still)} hardly moves", "its own parameters stay nominal")
    return Line("joints", PASS, f"{found}, all move")


def _rate(cutoff_hz: float, r: Recording) -> Line:
    need, found = 2 * FRICTION_CUTOFF * cutoff_hz, f"{r.rate_hz:.4g} rows/s"
    slow = r.rate_hz < need
    advice = f"friction at a reversal needs {need:g} rows/s: log faster" if slow else ""
    return Line("rate", WARN if slow else PASS, found, advice, {"rate_hz": r.rate_hz})


def _clock(r: Recording, judged: Judged | None) -> Line:
    step = np.diff(r.t)[np.diff(r.trajectory) == 0]
    uneven = float((np.abs(step / np.median(step) - 1.0) > UNEVEN).mean())
    found = f"steps of {1e3 * np.median(step):.4g} ms, {100 * uneven:.1f} % of them uneven"
    factor = np.full(r.n_joints, np.nan) if judged is None else judged.clock
    if not np.isfinite(factor).any():
        found += "; too little motion to compare it with dq"
        return Line(CLOCK, WARN if uneven > UNEVEN_SHARE else PASS, found, values={"q_over_integral": factor})
    found += f"; q changes {_span(factor, '{:.2f}')} times as much as dq integrates to"
    off = np.nanmax(np.abs(factor - 1.0)) > OFF_CLOCK
    advice = "the scale of dq or the clock is off" if off else "log the time at which values were measured"
    bad = off or uneven > UNEVEN_SHARE
    return Line(CLOCK, WARN if bad else PASS, found, advice if bad else "", {"q_over_integral": factor})


def _signals(robot: Robot, r: Recording, judged: Judged | None) -> list[Line]:
    if judged is None:
        return [Line(check, OPEN, "too few rows to judge") for check in (UNITS_OF, ORDER, GRAVITY)]
    seen = np.isfinite(judged.scale).any()
    found = f"dq is {_span(judged.scale, '{:.2f}')} times the slope of q" if seen else "too little motion"
    lines = [Line(UNITS_OF, PASS if seen else OPEN, found, values={"dq_over_slope": judged.scale})]
    if judged.misfit is None:
        lines.append(Line(ORDER, OPEN, "no joint moves or carries enough"))
    else:
        share, doubt = 100 * (1 - judged.misfit), judged.misfit > SUSPECT
        found = f"{robot.name} without a fit explains {share:.0f} % of tau's square beside friction"
        advice = "is it this arm, without contact and without a load?" if doubt else ""
        lines.append(Line(ORDER, WARN if doubt else PASS, found, advice, {"misfit": judged.misfit}))
    return [*lines, _gravity(robot, r, judged.shares)]


def _gravity(robot: Robot, r: Recording, shares: np.ndarray | None) -> Line:
    if shares is None:
        return Line(GRAVITY, OPEN, "gravity changes too little along this motion")
    share, contains = float(shares.mean()), r.torque != "commanded"
    found = f"{r.torque} tau contains {100 * share:z.0f} % of {robot.name}'s gravity torque"
    far = not LOADED[0] < share < LOADED[1] if contains else abs(share) > 1 - LOADED[0]
    advice = "an undeclared load, or other masses than in the robot's file?" if far else ""
    return Line(GRAVITY, WARN if far else PASS, found, advice, {"share_of_gravity": shares})


def _late_speed(r: Recording, cutoff_hz: float) -> Line:
    check, late = "lateness of dq", lateness(r, cutoff_hz)
    if not np.isfinite(late.s).any():
        return Line(check, OPEN, "too little motion")
    values = {"dq_late_s": late.s, "sigma_s": late.sigma}
    found = f"{_span(1e3 * late.s, '{:z.1f}')} ms behind the slope of q"
    if r.torque == "commanded":
        found += "; with commanded torque r2s takes the slope of q"
    elif np.nan_to_num(late.sure).any():
        found += f"; r2s corrects it as {'a filter' if late.filtered else 'a delay'}"
    return Line(check, PASS, found, values=values)


def _late_torque(r: Recording, expected: ExpectedWidths) -> Line:
    (late, sigma), fitted = expected.late, [name for name in TIMING if name in expected.space.blocks]
    commanded = r.torque == "commanded"
    size = f"{1e3 * late:z.1f} ± {1e3 * SURE * sigma:.1f} ms"
    found = f"commands act {size} later" if commanded else f"{size} behind the motion"
    found += f"; {' and '.join(fitted)} will be fitted" if fitted else ""
    bad = not fitted and not commanded and abs(late) - SURE * sigma > max(LATE_S, 0.5 / r.rate_hz)
    advice = "inertia takes the lateness for its own: shift tau by it, or log q and tau at one time" if bad else ""
    return Line("lateness of tau", WARN if bad else PASS, found, advice, {"tau_late_s": late, "sigma_s": sigma})


def _repeats(r: Recording) -> Line:
    if r.period is None:
        return Line("repeats", PASS, "no motion is repeated", values={"period_s": None})
    found = f"the motion repeats after {r.period:.2f} s, {r.duration / r.period:.1f} times in all"
    often = r.duration > 1.5 * r.period
    advice = "repetitions lower the noise and excite nothing new: other motion tells more" if often else ""
    return Line("repeats", WARN if often else PASS, found, advice, {"period_s": r.period})


def _speeds(robot: Robot, r: Recording) -> Line:
    r = spread(r, SPEEDS_S)
    speed = np.abs(r.dq) / robot.dq_max
    fastest = np.quantile(speed, 0.98, axis=0)
    moving = np.abs(r.dq) > np.minimum(MOVING, 0.1 * SLOW * robot.dq_max)
    count = np.maximum(moving.sum(0), 1)
    slow = ((speed < SLOW) & moving).sum(0) / count
    forth = ((r.dq > 0) & moving).sum(0) / count
    parts = {
        f"faster than {100 * FAST:g} % of dq_max": fastest < FAST,
        f"slower than {100 * SLOW:g} % of dq_max": slow < LEAST_SLOW,
        "in both directions": np.minimum(forth, 1 - forth) < LEAST_WAY,
    }
    found = f"up to {_span(fastest * robot.dq_max, '{:.2g}')} rad/s, {_span(100 * fastest, '{:.0f}')} % of dq_max"
    missing = [f"joint {_listed(np.flatnonzero(few))} {words}" for words, few in parts.items() if few.any()]
    advice = f"friction is extrapolated there; move {'; '.join(missing)}" if missing else ""
    values = {"fastest_rad_s": fastest * robot.dq_max, "share_slow": slow, "share_forward": forth}
    return Line("friction speeds", WARN if missing else PASS, found, advice, values)


def _excitation(expected: ExpectedWidths) -> Line:
    space, share = expected.space, expected.share
    count, narrower = int(expected.identifiable.sum()), int((share < UNSEEN).sum())
    found = f"the data will determine {count} of {len(share)} values one by one, and narrow {narrower}"
    own = [b for b in space.blocks if b in PER_JOINT or b in space.nominal.family.names]
    best = np.array([space.block(share, b) for b in own]).reshape(len(own), space.n).min(0, initial=np.inf)
    none = np.flatnonzero(best > UNSEEN)
    advice = f"nothing about joint {_listed(none)} itself: move it more" if len(none) and own else ""
    advice = advice or ("the prior decides all values: move faster and farther" if not count else "")
    values = {"identifiable": count, "narrower_than_the_prior": narrower}
    return Line("excitation", WARN if advice else PASS, found, advice, values)


def _listed(joints: Sequence[int] | np.ndarray) -> str:
    return ", ".join(str(j + 1) for j in joints)


def _span(x: np.ndarray, form: str = "{:.3g}") -> str:
    """Return the range of x as text, such as "0.98 to 1.02"; nan is ignored."""
    low, high = form.format(np.nanmin(x)), form.format(np.nanmax(x))
    return low if low == high else f"{low} to {high}"


def with_validation(verdict: Verdict, error: UserError | None, name: str = "") -> Verdict:
    """Add a line for the validation file `name` to a verdict: FAIL if the file has an `error`, else PASS."""
    check = f"validation {name}".strip()
    line = Line(check, FAIL, str(error)) if error else Line(check, PASS, "holds other motion")
    return replace(verdict, lines=(*verdict.lines, line))
