"""Estimate the external wrench on an arm without a force sensor, with 95 % intervals, and detect contacts.

    observer = WrenchObserver(robot, dynamics)
    for each millisecond: observer(state.q, state.dq, command)
    observer.force, observer.force_half, observer.in_contact

The estimate is the force at the tip of `robot.tool`, or force and moment at the end effector of a robot without a
tool (wrench_filter.py). With the estimated force f and its covariance C, the squared force is f^T C^-1 f. The force
test compares the squared force with a threshold: a chi-square test of the hypothesis that no force acts. A second
test, the impact test, detects sudden contacts (contact_detection.py). A contact begins when the squared force of a
test exceeds the test's threshold for 15 ms while a joint moves. The two tests together aim at one false alarm per
hour. The smallest threshold, GAUSSIAN, is for normal errors (`normal_threshold`). For larger errors,
`contact_thresholds` computes the thresholds from recordings without contact. The distribution of the largest squared
force per half second has an exponential tail (extreme values of a chi-square variable: Embrechts, Klueppelberg and
Mikosch, Modelling Extremal Events, 1997, 3.3). `contact_thresholds` extrapolates this tail to one hour. Without
recordings, the observer uses only the force test.
"""

from collections.abc import Callable, Sequence
from copy import copy
from typing import Self

import numpy as np
import pandas as pd
from scipy.stats import chi2

from r2s.adaptation import tuning
from r2s.adaptation.arm_model import make_arm_model
from r2s.adaptation.estimator import Estimate, Estimator
from r2s.adaptation.offline_estimation import LEAST_HZ, at_rate, pauses
from r2s.adaptation.sensor_noise import SensorNoise, panda_noise, sensor_noise
from r2s.adaptation.wrench_filter import update_wrench
from r2s.adaptation.wrench_state import HANGING, IMPACT_SQUARE, REST, SQUARE, TOUCHES, WrenchNoise, WrenchState
from r2s.errors import UserError
from r2s.identification.posterior import Z_95
from r2s.physics.dynamics import Dynamics
from r2s.physics.inverse_dynamics import InverseDynamics
from r2s.physics.payload import ee_pose
from r2s.physics.robot import SIM_DT, Robot
from r2s.recordings.recording import Recording

ALARMS_PER_TEST = tuning.ALARMS_PER_HOUR / 2  # per hour


def normal_threshold(alarms_per_hour: float) -> float:
    """Return the threshold of a contact test with at most this many false alarms, if the errors are normal.

    The squared force then is a chi-square variable with three degrees of freedom. A contact needs CONFIRMED
    successive cycles above the threshold, and these cycles include one whose index is a multiple of CONFIRMED. The
    bound therefore sums only over these cycles (Boole's inequality). It holds for any correlation in time.
    """
    return float(chi2.isf(alarms_per_hour * tuning.CONFIRMED * SIM_DT / 3600.0, 3))


GAUSSIAN = normal_threshold(ALARMS_PER_TEST)
SQUARES = ["square", "impact_square"]  # columns with the squared forces of the two contact tests
BLOCK, LEAST_BLOCKS = round(tuning.BLOCK_S / SIM_DT), 10  # rows per block; least number of blocks for a threshold


class WrenchObserver:
    """Observer that estimates the wrench on one arm, cycle by cycle.

    Attributes:
        thresholds: (2,), thresholds of force test and impact test for f^T C^-1 f, with force f and covariance C.
        sensors: sensor noise that the observer assumes.
        tool: the robot's tool, or None if the robot has no tool.

    Args:
        robot, dynamics: the identified arm. thresholds: see the attribute; if None, the threshold of the force test
            is UNCALIBRATED * GAUSSIAN, and the observer has no impact test. sensors: if None, those of a Panda.
            `calibrate` computes both from recordings.
    """

    def __init__(
        self,
        robot: Robot,
        dynamics: Dynamics,
        thresholds: np.ndarray | None = None,
        sensors: SensorNoise | None = None,
    ):
        self._arm, self.tool = make_arm_model(robot, dynamics), robot.tool
        position, axes = ee_pose(robot)
        self._tip = position if robot.tool is None else position + axes @ robot.tool.tip
        self._components = 6 if robot.tool is None else 3
        self.sensors = sensors or panda_noise()
        self._noise = wrench_noise(robot, dynamics, self.sensors)
        uncalibrated = (tuning.UNCALIBRATED * GAUSSIAN, np.inf)
        self.thresholds = np.array(uncalibrated if thresholds is None else thresholds, dtype=float)
        self._q, self._dq, self._tau = np.zeros((3, robot.n))
        self.begin()
        zero = np.zeros(robot.n)
        self(robot.q_home, zero, zero)  # compile now, while no arm waits for the result
        self.begin()

    def calibrate(self, robot: Robot, free: Sequence[Recording]) -> None:
        """Set sensor noise and contact thresholds from recordings without contact, see `contact_thresholds`."""
        self.sensors = sensor_noise(free)
        self._noise = self._noise._replace(speed=self.sensors.combined, angle=self.sensors.angle)
        self.thresholds = contact_thresholds(robot, self, free)

    def begin(self) -> None:
        """Start a motion of an arm that rests, touches nothing, and carries only the payload of its model."""
        self._state = WrenchState.fresh(len(self._arm.level), self._components)

    def __call__(self, q: np.ndarray, dq: np.ndarray, tau: np.ndarray) -> bool:
        """Process one cycle: q, dq (n,) rad, rad/s and command (n,) Nm without gravity; return `in_contact`.

        If a value is not finite, reset the estimate as `begin` does.

        Raises:
            UserError: an array does not have one value per joint.
        """
        n = len(self._arm.level)
        if q.shape != (n,) or dq.shape != (n,) or tau.shape != (n,):
            raise UserError(f"expected q, dq and tau of {n} joints, got {q.shape}, {dq.shape} and {tau.shape}")
        if not np.isfinite(q.sum() + dq.sum() + tau.sum()):
            self.begin()
            return False
        self._q[:], self._dq[:], self._tau[:] = q, dq, tau  # arrays of one type, so that numba compiles once
        update_wrench(self._arm, self._tip, self._noise, self.thresholds, self._state, self._q, self._dq, self._tau)
        return self.in_contact

    def carry(self, payload: np.ndarray) -> None:
        """Set the inertial parameters (10,) of a payload that the model lacks, in the payload frame (momentum.py)."""
        n, state = len(self._arm.level), self._state
        state.x[-n:] += state.terms.payload_p @ (payload - state.payload)  # momentum that the payload change adds
        state.payload[:] = payload

    def undeclared(self) -> Self:
        """Return a copy for an arm whose gravity compensation includes no declared payload."""
        compensated = self._arm.compensated.copy()
        compensated[-1] -= self._arm.declared
        other = copy(self)
        other._arm = self._arm._replace(compensated=compensated, declared=np.zeros(4))
        other.begin()
        return other

    @property
    def in_contact(self) -> bool:
        """Whether the arm touches its surroundings; the weight of a payload (`hangs`) is not a contact."""
        return bool(self._state.contact[TOUCHES] > 0.0) and not self.hangs

    @property
    def hangs(self) -> bool:
        """Whether the force pointed down along 5 cm of the tip's path, and therefore is a payload's weight."""
        return bool(self._state.contact[HANGING] > tuning.WEIGHT_PATH)

    @property
    def wrench(self) -> np.ndarray:
        """Wrench on the arm at the tip, in base axes: force (3,) N with a tool, else force and moment (6,) N, Nm."""
        return self._state.x[: self._components]

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of `wrench`."""
        return self._state.P[: self._components, : self._components]

    @property
    def wrench_half(self) -> np.ndarray:
        """Half widths of the 95 % intervals of `wrench`."""
        return Z_95 * np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    @property
    def force(self) -> np.ndarray:
        """Force on the arm at the tip, (3,) N, base axes."""
        return self.wrench[:3]

    @property
    def force_half(self) -> np.ndarray:
        """(3,) N, half widths of the 95 % intervals of `force`."""
        return self.wrench_half[:3]

    @property
    def tip(self) -> np.ndarray:
        """(3,) m, position of the tip in the base frame; the estimated force acts at the tip."""
        return self._state.place

    @property
    def squares(self) -> np.ndarray:
        """(2,), f^T C^-1 f of force test and impact test, with force f and covariance C; see `thresholds`."""
        return self._state.contact[[SQUARE, IMPACT_SQUARE]]

    @property
    def rests(self) -> np.ndarray:
        """(n,) bool, True for a joint at rest; the friction of a resting joint may hide a force."""
        return self._state.joints[REST] > 0.0


def wrench_noise(robot: Robot, dynamics: Dynamics, sensors: SensorNoise | None = None) -> WrenchNoise:
    """Return the uncertainty of an identified arm's model and sensors, by default a Panda's sensors."""
    arm = make_arm_model(robot, dynamics)
    friction = tuning.WRENCH_FRICTION * arm.level + tuning.LEAST_FRICTION * robot.tau_max.min()
    edges = np.array(dynamics.breakaway, dtype=float)
    measured = np.abs(edges).max(1) > 0.0
    edges = np.where(measured[:, None], edges, np.column_stack([-arm.breakaway, arm.breakaway]))
    excess = np.where(measured[:, None], _excess(robot, dynamics), 0.0)
    excess_speed = tuning.EXCESS_SPEED * np.array(robot.dq_max)
    presliding = arm.presliding if "presliding" in dynamics.family.names else np.zeros(robot.n)
    sensors = sensors or panda_noise()
    rest = tuning.INERTIA_SHARE, sensors.combined, sensors.angle, tuning.FORCE_FLOOR * robot.payload_max[0]
    return WrenchNoise(friction, np.ascontiguousarray(edges), excess, excess_speed, presliding, *rest)


def _excess(robot: Robot, dynamics: Dynamics) -> np.ndarray:
    """Return the excess (n, 2) Nm of breakaway torque over modeled friction at the onset of sliding, at q_home.

    The excess is 0 if friction is larger, and for a friction family with bristles, with a Stribeck effect, or without
    a jump of friction at zero speed.
    """
    family, edges = dynamics.family, np.array(dynamics.breakaway, dtype=float)
    if family.sharp is None or family.has_memory or "rise" in family.names:
        return np.zeros_like(edges)
    loaded = InverseDynamics(robot, dynamics).load_friction(robot.q_home[None])[0]
    onset = dynamics.onset_friction() + np.column_stack([-loaded, loaded])
    return np.where(np.abs(edges) > np.abs(onset), edges - onset, 0.0)


def observe_recording(
    robot: Robot,
    observer: WrenchObserver,
    recording: Recording,
    estimator: Estimator | None = None,
    report: Callable[[Estimate], None] | None = None,
) -> pd.DataFrame:
    """Return a table with one row per millisecond: wrench, half widths of 95 % intervals, contact, tip position.

    Args:
        estimator: payload estimator, which contact freezes if the robot has a tool. The observer subtracts the
            payload's effect from the wrench. If `estimator` is None, the observer assumes no payload.
        report: called with each new estimate of the payload.
    """
    recording = at_rate(robot, recording)
    touch = 1 + 2 * len(observer.wrench)  # column of `in_contact`
    rows = np.empty((len(recording.t), touch + 6))
    for stretch, pause_s in zip(recording.stretches, pauses(recording), strict=True):
        observer.begin()
        if estimator is not None:
            estimator.begin(pause_s)
        begun = stretch.start
        for k in range(stretch.start, stretch.stop):
            sample = recording.q[k], recording.dq[k], recording.tau[k]
            touches = observer(*sample)
            if estimator is not None:
                estimator.held = touches and robot.tool is not None
                if estimator(*sample):
                    observer.carry(estimator.payload)
                    if report is not None:
                        report(estimator.now)
            values = np.stack([observer.wrench, observer.wrench_half], -1).ravel()
            rows[k] = np.concatenate([[recording.t[k]], values, [touches], observer.squares, observer.tip])
            if touches and not (k > stretch.start and rows[k - 1, touch]):
                begun = k
            if observer.hangs:  # the force is a payload's weight: erase the contact from row `begun` on
                rows[begun:k, touch] = 0.0
    names = [f"force_{c}_N" for c in "xyz"] + [f"moment_{c}_Nm" for c in "xyz"]
    columns = [c for name in names[: len(observer.wrench)] for c in (name, f"{name}_half")]
    table = pd.DataFrame(rows, columns=["t", *columns, "in_contact", *SQUARES, "tip_x_m", "tip_y_m", "tip_z_m"])
    return table.astype({"in_contact": int})


def contacts(table: pd.DataFrame) -> list[dict[str, float]]:
    """Return start and end (s) and the largest force (N) of each contact in a table from `observe_recording`."""
    touches = np.diff(np.concatenate([[0], table["in_contact"].to_numpy(), [0]]))
    force = np.linalg.norm(table[["force_x_N", "force_y_N", "force_z_N"]].to_numpy(), axis=1)
    t = table["t"].to_numpy()
    spans = zip(np.flatnonzero(touches > 0), np.flatnonzero(touches < 0), strict=True)
    return [
        {"begin_s": float(t[a]), "end_s": float(t[b - 1]), "force_max_N": float(force[a:b].max())} for a, b in spans
    ]


def unfit_for_threshold(free: Sequence[Recording]) -> str | None:
    """Return why rate or length of the recordings is too small for `contact_thresholds`, or None if both suffice."""
    if slow := [r.rate_hz for r in free if r.rate_hz < LEAST_HZ]:
        return f"expected recordings of at least {LEAST_HZ:g} Hz, got {min(slow):.0f} Hz"
    rows = [sum(int(np.ptp(r.t[s]) / SIM_DT + 1e-6) + 1 for s in r.stretches) for r in free]
    if sum(count // BLOCK for count in rows) < LEAST_BLOCKS:
        return f"expected at least {LEAST_BLOCKS * tuning.BLOCK_S:g} s of motion without contact"
    return None


def contact_thresholds(robot: Robot, observer: WrenchObserver, free: Sequence[Recording]) -> np.ndarray:
    """Return the contact thresholds (2,) for one false alarm per hour, determined from recordings without contact.

    Args:
        robot, observer: the arm and its observer; the copy `observer.undeclared()` processes the recordings.
        free: recordings without contact and without a declared payload, such as those of an identification.

    Raises:
        UserError: the recordings are shorter than 5 s, or their rate is below 200 Hz.
    """
    if why := unfit_for_threshold(free):
        raise UserError(f"contact threshold: {why}")
    observer, maxima = observer.undeclared(), []
    for recording in free:
        squares = observe_recording(robot, observer, recording)[SQUARES].rolling(tuning.CONFIRMED).min()
        square = squares.fillna(0.0).to_numpy()
        maxima += [square[k : k + BLOCK].max(0) for k in range(0, len(square) - BLOCK + 1, BLOCK)]
    return np.array([max(GAUSSIAN, _exceeded_hourly(column)) for column in np.transpose(maxima)])


def _exceeded_hourly(maxima: np.ndarray) -> float:
    """Extrapolate the blocks' `maxima` (N,) to a squared force that blocks exceed ALARMS_PER_TEST times per hour."""
    level = np.quantile(maxima, 1.0 - tuning.TAIL)
    excess = np.mean(maxima[maxima >= level] - level)
    blocks_per_hour = 3600.0 / tuning.BLOCK_S
    return float(level + excess * np.log(tuning.TAIL * blocks_per_hour / ALARMS_PER_TEST))
