"""Track a planned motion with PD control, nominal feedforward, and adaptive friction and offset compensation."""

import numpy as np

from r2s.arm.interface import ArmState
from r2s.excitation.deviation import DeviationLimits
from r2s.excitation.motion import Excitation
from r2s.excitation.motion_checks import friction_margin
from r2s.physics.newton_euler import WORK, equations, links_of
from r2s.physics.payload import USUAL, Payload, sphere_inertia, with_payload
from r2s.physics.rigid_body import mass_matrix, nominal_torque
from r2s.physics.robot import SIM_DT, Robot

CUTOFF_HZ = 100.0  # low-pass of the driver during tracking, libfranka's default
# Gains, chosen so that the loop has stability margins at a delay of a few ms
BANDWIDTH = 20.0  # rad/s, natural frequency of the critically damped tracking loop
ADAPTATION_RATE = 0.8  # 1/s, ratio of adaptation to proportional gain; leaves half of the loop's stability margin
FRICTION_DQ = 0.03  # rad/s, scale of the tanh that replaces the sign of the speed in the friction estimate
MASS_EVERY = 10  # cycles between two updates of the mass matrix
# Limits
OFFSET_SHARE = 0.1  # share of tau_max, limit of the estimated offset: balances an undeclared 1 kg at a Panda's reach
CORRECTION_SHARE = 0.3  # share of tau_max, limit of the total torque added to the feedforward
MAX_DEVIATION = 0.2  # rad; a larger deviation indicates an obstacle or a wrong model of the arm
# For an arm with an undeclared payload
LOADED_FACTOR = 2.0  # factor on OFFSET_SHARE and CORRECTION_SHARE
LOADED_DEVIATION = 0.5  # rad


class TrackingController:
    """PD control with the nominal model's feedforward torque and an adaptive estimate of friction and offset.

    For each joint, the vector theta contains offset, Coulomb friction and viscous friction. At the reference speed
    dq_ref, the estimated torque is theta^T (1, tanh(dq_ref / 0.03), dq_ref / dq_max). The controller adapts theta
    during the motion, within limits, as in Slotine and Li (IJRR 6(3), 1987). Light wrist joints need the estimate,
    because their small PD gains may not overcome friction. The PD gains are BANDWIDTH^2 M and 2 BANDWIDTH M with the
    nominal mass matrix M. Gains proportional to M suit any arm; separate gains per joint would be unstable if joint
    axes are nearly parallel.

    Args:
        robot: the nominal model. excitation: the motion to track.
        allowed: limits of the deviation from the excitation; if None, MAX_DEVIATION for each joint.
    """

    def __init__(self, robot: Robot, excitation: Excitation, allowed: DeviationLimits | None = None):
        self._plan, self._allowed = excitation, allowed or DeviationLimits.uniform(robot.n, MAX_DEVIATION)
        dq = excitation.dq
        self._feedforward = nominal_torque(robot, excitation.q, dq, excitation.ddq, gravity=False)
        self._mass = mass_matrix(robot, excitation.q[::MASS_EVERY])
        basis = np.array([np.ones_like(dq), np.tanh(dq / FRICTION_DQ), dq / robot.dq_max])
        self._regressor = basis.transpose(1, 0, 2)  # (T, 3, n)
        self._theta = np.zeros((3, robot.n))
        friction = friction_margin(robot)
        self._theta_max = np.array([OFFSET_SHARE * robot.tau_max, friction, friction])
        # inertia of each joint while the others are free to move; the estimate of a light joint must adapt slowly
        inertia = 1 / np.diagonal(np.linalg.inv(self._mass), axis1=1, axis2=2)
        self._gain = ADAPTATION_RATE * SIM_DT * BANDWIDTH**2 * inertia  # Nm per rad/s, see `__call__`
        self._correction = CORRECTION_SHARE * robot.tau_max

    def __call__(self, k: int, state: ArmState) -> np.ndarray:
        """Return the target torque (n,) Nm for the state of cycle k, and adapt the friction and offset estimate."""
        e = self._plan
        error, rate = e.q[k] - state.q, e.dq[k] - state.dq
        self._theta += self._gain[k // MASS_EVERY] * (rate + 0.5 * BANDWIDTH * error) * self._regressor[k]
        self._theta = np.minimum(np.maximum(self._theta, -self._theta_max), self._theta_max)
        pd = self._mass[k // MASS_EVERY] @ (BANDWIDTH**2 * error + 2 * BANDWIDTH * rate)
        added = pd + (self._theta * self._regressor[k]).sum(0)
        return self._feedforward[k] + np.minimum(np.maximum(added, -self._correction), self._correction)

    @property
    def offset(self) -> np.ndarray:
        """(n,) Nm, the estimated offset, which at rest balances the weight of an undeclared payload."""
        return self._theta[0]

    def deviation(self, k: int, state: ArmState) -> str | None:
        """Return a message if a joint deviates too far from the excitation in cycle k, else None."""
        deviation = np.abs(self._plan.q[k] - state.q)
        share = self._allowed.share(k, deviation)
        total = share.sum(1)
        if (total <= 1).all():
            return None
        worst = int(total.argmax())
        i = int(share[worst].argmax())
        off = deviation[i]
        return (
            f"joint {i + 1} is {off:.3f} rad off its path, allowed {off / total[worst]:.3g} rad: an obstacle "
            "blocks it, or it cannot follow"
        )


class LoadedTrackingController(TrackingController):
    """Tracking controller for an arm with an undeclared payload of up to half of the arm's largest payload mass.

    The gains are for a payload of a quarter of the largest payload mass. With the smaller gains of an arm without
    payload, the payload's weight would make a strong joint sag, and this motion would swing the wrist. The limits of
    deviation, offset and correction are larger than in `TrackingController`.
    """

    def __init__(self, robot: Robot, excitation: Excitation, allowed: DeviationLimits | None = None):
        super().__init__(robot, excitation, allowed or DeviationLimits.uniform(robot.n, LOADED_DEVIATION))
        half = np.array(0.5 * USUAL * robot.payload_max[0])
        payload = Payload(half, np.zeros(3), sphere_inertia(half))
        links = with_payload(robot, payload, (robot.mass, robot.com, robot.inertia))
        mass, bias, work = np.empty((robot.n, robot.n)), np.empty(robot.n), np.empty((robot.n, WORK))
        arm = links_of(robot, *links)
        for k, q in enumerate(excitation.q[::MASS_EVERY]):
            equations(arm, robot.gravity, q, np.zeros(robot.n), mass, bias, work)
            self._mass[k] = mass + np.diag(robot.armature)
        self._theta_max[0] *= LOADED_FACTOR
        self._correction = LOADED_FACTOR * self._correction
