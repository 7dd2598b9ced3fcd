"""Stop an arm whose tip presses on a surface: hold the contact force, release the tip, or retreat.

If a stop only removed the command, the arm could recoil or keep pressing. A contact force F on a surface of stiffness
k can push the tip back by F / k, with the elastic energy F^2 / 2k. Joint friction can sustain a contact force of up
to `hidden` (push_limit.py). The driver therefore has three kinds of stop:

- hold: the arm rests with the target torque J^T R; J is the tip's Jacobian, and R is the push limit's estimate of the
  contact force at the stop's start.
- release: the tip moves outward at the speed LEAVE until the contact force F vanishes. A velocity loop tracks the
  joint velocity -LEAVE m M^-1 J^T, with the mass matrix M and the tip's effective mass m. Of all joint velocities
  with the tip speed LEAVE, this velocity has the least kinetic energy. The feedforward contains the present estimate
  R and the modeled joint friction, which corresponds to a force h at the tip. If the arm has more friction than the
  model, an integral term adds a force of at most h. While the tip moves outward, joint friction exerts the inward
  force h on the tip, so the estimate R is F - h. The release ends when R falls to RELEASED - SLIDES h. If the true
  friction is at most SLIDES h, the remaining contact force is at most RELEASED. If the true friction is at most h,
  the remaining force is at most RELEASED + (1 - SLIDES) h.
- retreat: the arm releases the tip, then moves the tip RETREAT_M farther outward.

Every stop obeys the limits of push, speed and acceleration, and every outward motion ends after LEAVES_S.
"""

import numpy as np

from r2s.compiled import njit
from r2s.physics.linear_algebra import factor, packed_element, solve, unpack
from r2s.physics.push_limit import FELT, HEIGHT, HOLD, LEAVE, PHASE, PULL, RESISTED, RETREAT, STOP, tip_motion
from r2s.physics.robot import SIM_DT
from r2s.physics.safety_filter import DQ_ALLOWED, FRICTION_WIDTH, RATE

RELEASED = 0.5  # N, largest contact force of a released tip
SLIDES = 0.25  # friction in slow sliding / breakaway torque; 0.35 with conf/friction/paper
RETREAT_M = 0.01  # m; this path is free, because the tip came from `task.clearance` = 15 mm above the plane
# s, longest outward motion; 0.1 s of the driver's 0.5 s remains for braking. A force of 20 N presses the tip 10 mm
# into the softest surface of conf/dr/contact.yaml
LEAVES_S = 0.4
MOST = 0.25  # largest ratio of a joint's speed in the outward motion to the joint's allowed speed
GAIN = 0.5 * RATE  # 1/s, gain of the velocity loop: half of the latency budget remains for the estimate R
BEGINS, PRESSES, CLEAR, OVER = range(4)  # values of PHASE


@njit(cache=True, error_model="numpy")
def stop_torque(limit, arm, kinematics, friction, limits, held, target):
    """Write a stop's target torque (n,) Nm for a cycle; return the largest ratio of requested to allowed joint speed.

    Args:
        limit, arm, kinematics, friction: see `push_bound`. limits: see `filter_limits`.
        held: (n,) Nm, adapter torque that holds a load; `stop_torque` subtracts the load's force from the estimate R.
    """
    n = len(target)
    root, row, lever, ddq = np.empty((n, n)), np.empty(n), np.empty(n), np.zeros(n)
    height, speed, _, _ = tip_motion(limit, kinematics, arm.dq, row)
    lever[:] = row
    unpack(arm.mass, 1.0, ddq, root)
    factor(root, root)
    solve(root, lever)
    mobility, behind, share, kept = 0.0, 0.0, 0.0, 0.0  # behind: N, the force h of the module's docstring
    for j in range(n):
        mobility += row[j] * lever[j]
        kept += lever[j] * held[j]
    felt = limit[RESISTED] - kept / mobility
    if limit[PHASE] == BEGINS:  # a tip above the highest possible true plane touches nothing
        limit[FELT] = max(felt, 0.0) if height < 0.0 else 0.0
        limit[PHASE] = OVER if limit[STOP] == HOLD or height >= 0.0 else PRESSES
    target[:] = 0.0
    if limit[PHASE] == OVER:
        if limit[STOP] == HOLD:
            target[:] = limit[FELT] * row
        return 0.0
    for j in range(n):
        share = max(share, LEAVE / mobility * abs(lever[j]) / limits[j, DQ_ALLOWED])
    for j in range(n):
        asked = -LEAVE / mobility * min(1.0, MOST / share) * lever[j]  # rad/s
        ahead = friction[j] * np.tanh(asked / FRICTION_WIDTH)
        target[j] = arm.bias[j] + max(felt, 0.0) * row[j] + ahead
        behind -= lever[j] * ahead / mobility
        ddq[j] = GAIN * (asked - arm.dq[j])
    pull = limit[PULL] + SIM_DT * GAIN**2 / mobility * (LEAVE * min(1.0, MOST / share) + speed)
    limit[PULL] = min(max(pull, 0.0), behind)
    for j in range(n):
        target[j] -= limit[PULL] * row[j]
        for k in range(n):
            target[j] += packed_element(arm.mass, j, k) * ddq[k]
    if limit[PHASE] == PRESSES and speed < -0.2 * LEAVE and felt <= RELEASED - SLIDES * behind:
        limit[PHASE], limit[HEIGHT] = (CLEAR if limit[STOP] == RETREAT else OVER), height
    if limit[PHASE] == CLEAR and height >= limit[HEIGHT] + RETREAT_M:
        limit[PHASE] = OVER
    return min(share, MOST)
