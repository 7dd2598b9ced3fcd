"""Define the wrench filter's state, and the uncertainties that the filter assumes."""

from typing import NamedTuple

import numpy as np

from r2s.adaptation.momentum import BODY, MOMENTUM_WORK, MomentumTerms
from r2s.physics.actuation import SLOTS
from r2s.physics.kinematics import POSE
from r2s.physics.newton_euler import WORK

COMMAND, CYCLE = range(2)  # indices of `WrenchState.counts`
# indices of `WrenchState.contact`
# SURPRISE: low-passed mean of the joints' squared innovations, in variances. USUAL: mean of SURPRISE over 1 s.
# SQUARE: squared force in units of its covariance, 0 if no joint moves. TOUCHES: 1 in contact.
# ABOVE, BELOW: cycles of SQUARE above the contact threshold, below the release threshold.
# HANGING: path of the tip, m, along which the force pointed down. SURPRISED: cycles with SURPRISE far above USUAL.
# IMPACT_SQUARE, IMPACT_ABOVE: squared force of the impact test, cycles above its threshold.
SURPRISE, SQUARE, TOUCHES, ABOVE, BELOW, HANGING, IMPACT_SQUARE, IMPACT_ABOVE, USUAL, SURPRISED, ENTRIES = range(11)
# rows of `joints`
# ANGLE: filtered angle, rad. SLOW, FAST: low-passed speeds, rad/s. REST: 1 at rest. QUIET: successive slow cycles.
# ANCHOR, MOVED, CREEP: reference angle at rest, motion since rest began, creep of this cycle, rad.
# FRICTION, FRICTION_BEFORE: modeled friction now, a cycle ago, Nm. DEFLECTION: presliding deflection.
# TORQUE, KNOWN: known torque without motor and friction, mean known torque with both, Nm.
# MOTOR, MOTOR_MEAN: motor torque now, mean motor torque in the coming cycle, Nm.
# MOMENTUM_NOISE: variance of the measured momentum, (Nm s)^2. SLOW_P: low-passed momentum, Nm s.
# FAST_P: low-passed difference momentum - SLOW_P, Nm s. SHAKE: mean square of the momentum's high-frequency part.
# PATH: motion since the last reversal, rad, with the sign of its direction.
ANGLE, SLOW, FAST, REST, QUIET, ANCHOR, MOVED, CREEP, FRICTION, FRICTION_BEFORE, TORQUE, KNOWN = range(12)
MOTOR, MOTOR_MEAN, MOMENTUM_NOISE, DEFLECTION, SLOW_P, FAST_P, SHAKE, PATH, ROWS = range(12, 21)


class WrenchNoise(NamedTuple):
    """Uncertainties that the wrench filter assumes: friction of n joints, inertia, sensor noise, and force."""

    friction: np.ndarray  # (n,) Nm, standard deviation of the friction model of a joint in motion
    edges: np.ndarray  # (n, 2) Nm, negative and positive breakaway torque: bounds of friction at rest
    excess: np.ndarray  # (n, 2) Nm, `edges` minus the model's friction at the onset of sliding, see `excess_friction`
    excess_speed: np.ndarray  # (n,) rad/s, speed over which `excess` decays
    presliding: np.ndarray  # (n,) rad, decay length of presliding; 0: a joint sticks until it breaks away
    inertia: float  # inertia error as a share of a joint's net torque
    speed: float  # rad/s, white noise of the speeds from dq and q, see `SensorNoise.combined`
    angle: float  # rad, noise of measured angles
    floor: float  # N, per axis: force error beyond the filter's covariance


class WrenchState(NamedTuple):
    """State of the wrench filter, updated in every cycle."""

    x: np.ndarray  # (N,), mean
    P: np.ndarray  # (N, N), covariance
    joints: np.ndarray  # (ROWS, n), see ANGLE to PATH
    counts: np.ndarray  # (2,), COMMAND, CYCLE
    contact: np.ndarray  # (ENTRIES,), see SURPRISE to SURPRISED
    calm: np.ndarray  # (3, 3) N^2, covariance of the force in the impact test
    smooth: np.ndarray  # (3,) N, low-passed force in the impact test
    payload: np.ndarray  # (10,), parameters of a payload that the model lacks, in the payload frame (momentum.py)
    commands: np.ndarray  # (SLOTS, n) Nm, the last commands
    place: np.ndarray  # (3,) m, tip in the base frame
    jacobian: np.ndarray  # (6, n), Jacobian of the tip's position (3 rows) and rotation (3 rows)
    frames: np.ndarray  # (n, POSE)
    terms: MomentumTerms
    work: np.ndarray
    column: np.ndarray  # (N,)
    mass: np.ndarray  # (n, n) kg m^2, mass matrix
    coupling: np.ndarray  # (n, n): momentum rate of a joint at rest (row) per net torque of a sliding joint (column)
    mass_rate: np.ndarray  # (n, n) kg m^2/s, rate of the mass matrix

    @staticmethod
    def fresh(n: int, components: int) -> "WrenchState":
        """Return the initial state of a filter with 3 wrench components (force) or 6 (force and moment)."""
        N = components + 2 * n
        joints = np.zeros((ROWS, n))
        joints[REST] = 1.0
        arrays = (
            np.zeros(ENTRIES),
            np.zeros((3, 3)),
            np.zeros(3),
            np.zeros(BODY),
            np.zeros((SLOTS, n)),
            np.zeros(3),
            np.zeros((6, n)),
            np.zeros((n, POSE)),
        )
        work = np.zeros((n, max(MOMENTUM_WORK, WORK)))
        counts = np.array([SLOTS, 0])
        return WrenchState(
            np.zeros(N), np.zeros((N, N)), joints, counts, *arrays, MomentumTerms.empty(n), work, np.zeros(N),
            np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n)),
        )  # fmt: skip
