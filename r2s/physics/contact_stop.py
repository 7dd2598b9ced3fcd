"""What the driver does with the contact force when it stops an arm whose tip presses: hold, release or retreat.

If a stop only removed the command, the surface would return its energy F^2 / 2k and throw the tip off by up to F / k,
and joint friction would hold up to `hidden` of the force (push_limit.py). So a stop has a target torque:

- hold: J^T R, with the force R that the push limit estimated when the stop began. Nothing moves.
- release: the tip moves outwards at LEAVE until the force is gone. A velocity loop follows the joint speeds of least
  kinetic energy, -LEAVE m M^-1 J^T. Resistance and joint friction are fed forward, and an integral adds up to the
  same friction again, for an arm with more of it. The friction h of joints that move outwards pushes inwards, so R =
  F - h. The motion ends at R = RELEASED - SLIDES h with the modelled h, that is at F <= RELEASED + (1 - SLIDES) h if
  friction is at most h; if friction is only SLIDES h, the tip is then in the air.
- retreat: as release, then RETREAT_M farther.

The limits of push, speed and acceleration apply to every stop, which ends after LEAVES_S.
"""

import numpy as np

from r2s.compiled import njit
from r2s.physics.linear_algebra import factor, packed_element, solve, unpack
from r2s.physics.push_limit import FELT, HEIGHT, HOLD, LEAVE, PHASE, PULL, RESISTED, RETREAT, STOP, tip_motion
from r2s.physics.robot import SIM_DT
from r2s.physics.safety_filter import DQ_ALLOWED, FRICTION_WIDTH, RATE

RELEASED = 0.5  # N, a smaller force counts as released
SLIDES = 0.25  # friction of slowly sliding joints over their breakaway level; 0.35 with conf/friction/paper
RETREAT_M = 0.01  # m; the tip has come from `task.clearance` = 15 mm above the plane
LEAVES_S = 0.4  # s; 0.1 s is left to brake, and 20 N on the softest surface of conf/dr/contact.yaml are 10 mm deep
MOST = 0.25  # largest share of its allowed speed at which a joint moves the tip outwards
GAIN = 0.5 * RATE  # 1/s, of the velocity loop: it leaves half of the latency budget to what resists
BEGINS, PRESSES, CLEAR, OVER = range(4)  # values of PHASE


@njit(cache=True, error_model="numpy")
def stop_torque(limit, arm, kinematics, friction, limits, held, target):
    """Write the target torque (n,) Nm in a cycle of a stop; return the share of the allowed speeds that it needs.

    Args:
        limit, arm, kinematics, friction: see `push_bound`. limits: see `filter_limits`.
        held: (n,) Nm that an adapter adds to hold a load; R counts them as resistance of the surface.
    """
    n = len(target)
    root, row, lever, ddq = np.empty((n, n)), np.empty(n), np.empty(n), np.zeros(n)
    height, speed, _, _ = tip_motion(limit, kinematics, arm.dq, row)
    lever[:] = row
    unpack(arm.mass, 1.0, ddq, root)
    factor(root, root)
    solve(root, lever)
    mobility, behind, share, kept = 0.0, 0.0, 0.0, 0.0  # behind: N, friction of the joints that move outwards
    for j in range(n):
        mobility += row[j] * lever[j]
        kept += lever[j] * held[j]
    felt = limit[RESISTED] - kept / mobility
    if limit[PHASE] == BEGINS:  # a tip above the highest place of the true plane touches nothing
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
