"""Plan motions that reveal the gears' elasticity: one joint at a time slides slowly, excited by a multisine torque.

While a joint slides in one direction, its friction is nearly constant, so the response of the motor's angle to the
multisine is linear. The multisine repeats every PERIOD_S, so its spectrum has lines only at LINES_HZ (Pintelon and
Schoukens, System Identification, 2nd ed. 2012, chapter 2). Above the resonance of the gear, the motor moves without
the link, and the response reveals the gear's stiffness (r2s/identification/gears).
"""

import numpy as np
from scipy.integrate import cumulative_simpson

from r2s.excitation.minimum_jerk import minimum_jerk
from r2s.excitation.motion import Excitation
from r2s.physics.rigid_body import mass_matrix
from r2s.physics.robot import SIM_DT, Robot

PERIOD_S = 2.0  # s, of the multisine; also the time of steady sliding in each leg
LEGS = 4  # slides per joint, to and fro; an even number
# s, time to reach the sliding speed; time for the tracking loop to settle (5 time constants)
RAMP_S, SETTLE_S = 0.5, 0.25
LEG_S = 2 * RAMP_S + SETTLE_S + PERIOD_S
# Sliding speed / dq_max: 0.15 rad/s for a Panda's strong joints, above usual Stribeck velocities (0.01 to 0.1 rad/s)
SPEED = 0.07
SLOW_SHARE = 0.3  # largest sliding speed as a share of a reduced speed limit
# Lines spread over the resonances of arms, 10 to 80 Hz
LINES_HZ = np.unique(np.round(np.geomspace(6.0, 120.0, 24) * PERIOD_S)) / PERIOD_S
RIPPLE = 0.05  # velocity of each line / sliding speed; the sum of 24 lines then rarely reaches the sliding speed
RATE_SHARE, TORQUE_SHARE = 0.4, 0.05  # largest torque rate / dtau_max and torque / tau_max of the multisine
DRAWS = 200  # number of random sets of phases; r2s uses the set with the lowest peak torque rate
MARGIN = 0.15  # rad, distance kept to the position limits


def slide_speed(robot: Robot, joint: int, speed_share: float = 1.0) -> float:
    """Return the sliding speed, rad/s; `speed_share` scales the arm's speed limits, see `arm.speed_share`.

    The sliding speed is SPEED * dq_max, or SLOW_SHARE of the scaled speed limit if this product is lower. The sliding
    speed is not proportional to `speed_share`, because a joint that slides too slowly sticks.
    """
    return float(min(SPEED, SLOW_SHARE * speed_share) * robot.dq_max[joint])


def gear_motion(robot: Robot, joint: int, speed_share: float = 1.0) -> Excitation:
    """Return a motion of one joint: LEGS slides to and fro at `slide_speed` about home; other joints rest."""
    speed, t = slide_speed(robot, joint, speed_share), np.arange(round(LEG_S / SIM_DT)) * SIM_DT
    rise = minimum_jerk(np.zeros(1), np.full(1, speed), RAMP_S, t[:, None])  # speed, acceleration, jerk
    fall = minimum_jerk(np.zeros(1), np.full(1, speed), RAMP_S, t[:, None] - (LEG_S - RAMP_S))
    v, a = ((up - down)[:, 0] for up, down in zip(rise[:2], fall[:2], strict=True))
    way = cumulative_simpson(v, dx=SIM_DT, initial=0.0)
    half = 0.5 * speed * (LEG_S - RAMP_S)
    center = np.clip(robot.q_home[joint], robot.q_min[joint] + MARGIN + half, robot.q_max[joint] - MARGIN - half)
    forth = np.stack([center - half + way, v, a])
    back = np.stack([center + half - way, -v, -a])
    end = [[center - half], [0.0], [0.0]]
    legs = np.concatenate([np.tile(np.concatenate([forth, back], 1), LEGS // 2), end], 1)
    q, dq, ddq = np.zeros((3, legs.shape[1], robot.n))
    q[:] = robot.q_home
    q[:, joint], dq[:, joint], ddq[:, joint] = legs
    return Excitation(np.arange(len(q)) * SIM_DT, q, dq, ddq)


def slides() -> list[slice]:
    """Return the rows of each leg's steady slide: one period of the multisine, including the end point."""
    first, rows = round((RAMP_S + SETTLE_S) / SIM_DT), round(PERIOD_S / SIM_DT)
    return [slice(k, k + rows + 1) for k in (leg * round(LEG_S / SIM_DT) + first for leg in range(LEGS))]


def multisine(robot: Robot, joint: int, motion: Excitation) -> np.ndarray:
    """Return the multisine torque (T,) Nm for all rows of a `gear_motion`; the torque fades in and out with speed.

    All lines have the same velocity amplitude in light joints, and the same torque rate in heavy joints.
    """
    inertia = 1 / np.linalg.inv(mass_matrix(robot, robot.q_home[None])[0])[joint, joint]  # other joints free
    omega = 2 * np.pi * LINES_HZ
    speed = np.abs(motion.dq[:, joint]).max()
    rate = RATE_SHARE * robot.dtau_max[joint] / np.sqrt(len(omega) / 2)
    amplitude = np.minimum(RIPPLE * speed * inertia * omega, rate / omega)
    t = np.arange(round(PERIOD_S / SIM_DT)) * SIM_DT
    phases = np.random.default_rng(0).uniform(-np.pi, np.pi, (DRAWS, len(omega)))
    peaks = [np.abs((amplitude * omega) @ np.cos(np.outer(omega, t) + phase[:, None])).max() for phase in phases]
    phase = phases[int(np.argmin(peaks))]
    wave = amplitude @ np.sin(np.outer(omega, t) + phase[:, None])
    most = min(
        1.0,
        TORQUE_SHARE * robot.tau_max[joint] / np.abs(wave).max(),
        RATE_SHARE * robot.dtau_max[joint] / min(peaks),
    )
    start = round((RAMP_S + SETTLE_S) / SIM_DT)
    rows = (np.arange(len(motion.t)) % round(LEG_S / SIM_DT) - start) % len(t)
    return most * wave[rows] * np.abs(motion.dq[:, joint]) / speed
