"""Tuning constants of the package adaptation, each with unit and source.

Constants without a named source are estimates of the order of magnitude. benchmarks/payload.py tested all constants
together on development twins (seeds 0 to 9). The argument NAME=VALUE of benchmarks/payload.py and of
benchmarks/wrench.py changes one constant for a test.
"""

import numpy as np
from scipy.stats import chi2

from r2s.physics.robot import SIM_DT
from r2s.physics.safety_filter import RATE

# friction tables (arm_model.py)
TABLE_END = 1.5  # share of dq_max: speed at the end of a friction table
BREAKAWAY_SPEED = 0.02  # rad/s, the friction at this speed replaces an unmeasured breakaway torque
LEVEL_SPEED = 0.1  # rad/s; the friction level is the friction at this speed

# momentum residual (momentum_residual.py)
SPAN = 20  # cycles; triangular weights over two spans remove 97.6 % of a gear vibration at 60 Hz
T = SPAN * SIM_DT  # s, duration of a span
SLIDING_DEFLECTION = 0.9  # share of the full presliding deflection; a joint with a larger deflection slides
SLIDING_SPEED = 0.02  # rad/s: stiction may hold a slower joint

# standard deviations of the model correction's priors (model_correction.py)
LINK_MASS_SHARE, LINK_CENTRE_M = 0.02, 0.002  # prior of link masses, as a share; of link centers, m
LOAD_FRICTION, CABLE_TORQUE = 0.01, 0.15  # prior of load-dependent friction, Nm per Nm; of cable torques, Nm
FRICTION_LAW_SHARE, ANGLE_FRICTION_SHARE = 0.2, 0.03  # priors of friction terms, as shares of the friction level
FRICTION_SHARE = OFFSET_NM = 0.3  # prior of friction, as a share; of offsets, Nm
ROTOR_INERTIA, LATENCY_S = 0.1, 0.002  # kg m^2; s
GEAR_COMPLIANCE = 1e-4  # rad/Nm, prior of the gears' compliance, for a stiffness of 10 kNm/rad
STRIBECK_SPEED = 0.03  # rad/s, speed at which the decreasing friction term is half of its value at rest
LEAST_SPANS = 50  # least number of spans with sliding for a fit
CORRELATED_SPANS = 15  # number of spans with about the same model error: 0.3 s, see CORRELATION_S

# noise model (noise_model.py)
# payload prior, relative to an arm's largest payload mass and distance
# mass: RMS of a uniform distribution up to 0.5; center: RMS per axis, uniform distribution in a ball of radius 0.5
# tensor: a 5 cm body of 0.87 kg, 5 cm from the frame, on an arm with a largest payload of 3 kg and distance of 0.15 m
PAYLOAD_MASS, PAYLOAD_CENTRE, PAYLOAD_TENSOR = 0.5 / np.sqrt(3), 0.5 / np.sqrt(5), 4e-3 / (3.0 * 0.15**2)
WARMED = 0.07  # standard deviation of the relative friction change by temperature since the identification
FRICTION_DRIFT = 0.007  # 1/sqrt(s): 7 % in 100 s
OFFSET_DRIFTED, OFFSET_DRIFT = 0.02, 0.003  # shares of friction level: change since identification; drift, 1/sqrt(s)
# 1/s, growth rate of the mass variance at rest / squared largest payload; 0.02 kg^2/s for a Panda (3 kg)
# After 1 s, the mass interval contains masses that stiction hides: breakaway torque / (lever arm g) = 0.1 to 0.25 kg
REST_DRIFT = 0.02 / 3.0**2
PAYLOAD_DRIFT = 0.003  # 1/sqrt(s), random walk of the payload, as a share of its prior
NOISE_ADAPTATION = 0.04  # per span: if innovations stay large, the white noise adapts within 0.5 s
CORRELATION_S = 0.3  # s, correlation time of the model error
PAYLOAD_FRICTION = 0.015  # Nm per Nm of payload torque: load-dependent friction
# without recordings: shares of friction level (WHITE, MODEL), momentum rate (MOMENTUM) and friction step (REVERSAL)
WHITE_SHARE, MOMENTUM_SHARE, MODEL_SHARE, REVERSAL_SHARE = 0.2, 0.1, 0.1, 0.1
LAGS = range(3, 16)  # spans, lags at which residuals no longer share the noise of measured speeds
FINEST_SHARE = 0.03  # share of the friction level: smallest model error that a fit may yield
SECOND_HALF = 0.7  # factor on noise that was fitted to half of the motion; benchmarks/payload.py part=events,quiet
LEAST_SCALE, MOST_SCALE, SCALINGS = 0.5, 1.5, 8  # noise scaling: bounds on one factor, most factors
OUTLIER = 3.0  # standard deviations at which innovations are clipped; the filter also weights larger innovations less

# Kalman filter (kalman.py)
MOMENTUM_CORRELATION = 5.0  # correlation time of the momentum-rate error, in units of CORRELATION_S
STICTION_S = 0.25  # s for which the torque that stiction balances stays constant
REST_SPANS = 5  # spans without sliding after which an arm is at rest
HUBER = 1.5  # standard deviations; beyond, an innovation gets less weight; benchmarks/payload.py part=events,quiet
MOST_SURPRISE = 9.0  # squared standard deviations; a larger innovation hints at a jump and adapts the noise no faster

# test for payload jumps (payload_jump.py, estimator.py)
ONSETS = 10  # number of last spans in which a jump may have begun: 0.2 s
THRESHOLD = np.log(36000.0 / T)  # log odds: one false alarm in ten hours (Markov's inequality)
NEW_PAYLOAD = 0.2  # standard deviation of a payload directly after a jump, as a share of its prior
SETTLING_SPANS = round(0.5 / T)  # spans after a rest in which r2s compares the payload with that before the rest
# squared distance that an hour of tests exceeds once by chance; doubled, because model errors persist
REPLACED = 2.0 * chi2.isf(T / 3600.0, 4)

# reported estimate (estimator.py)
LEAST_MASS = 0.02 / 3.0  # share of the largest payload, 0.02 kg for a Panda; no center is reported for a smaller mass
FRICTION_CURVE = 0.02  # error of the friction curve's shape, as a share of friction; a factor cannot correct it

# feedforward (feedforward.py)
BLENDING = -np.expm1(-SIM_DT / T)  # per cycle; the torque of a new estimate fades in with a time constant of one span
ACCELERATION_S = 1 / RATE  # s, low-pass of accelerations: a feedback loop of rate RATE tolerates an arm's latency

# wrench (wrench_filter.py, wrench.py); tested by benchmarks/wrench.py on independent arms and on twins in contact
# rad/s, rad: sensors of a Panda, for arms without recordings; least share of this noise that an arm may have
SPEED_NOISE, ANGLE_NOISE, LEAST_NOISE = 3e-3, 2e-5, 0.1
ANGLE_RATE = 60.0  # 1/s, crossover: below it, speed is derived from angles; above it, from measured speeds
SLOW_RATE, FAST_RATE = 40.0, 200.0  # 1/s, low-passes of the speed (slow speed, fast speed)
LAG = SLOW_RATE / (FAST_RATE - SLOW_RATE)  # at constant acceleration, lag of the fast speed / (fast - slow speed)
# MOVES, RESTS, STILL_SPEED: in units of the speed noise. A joint moves if its slow speed exceeds MOVES (4 sigma).
# A joint rests if its fast speed is below STILL_SPEED, either for STILL cycles or with a slow speed below RESTS.
MOVES, RESTS, STILL_SPEED, STILL = 0.4, 0.2, 1.2, 25
REVERSES = 1.2  # in units of the speed noise; a larger speed determines the direction of friction (side)
# standard deviation of the speed that determines the direction of friction / speed noise
# SIDE_NOISE: noise of that speed, from the low-passes at 1 kHz: 0.36 for noise of dq, and for that of q.
# REVERSAL_NOISE: just after a reversal, for a gear that untwists at a few mrad/s; chosen on elastic twins 0 to 5.
SIDE_NOISE, REVERSAL_NOISE = 0.4, 1.0
# rad, motion over which the second value decays to the first: 1.5 Nm of friction twist a gear of 15 kNm/rad by 1e-4.
# With benchmarks/wrench.py, REVERSAL_PATH=3e-4 gives equal results on elastic twins 0 to 5.
REVERSAL_PATH = 1e-4
CREPT, CREEP_RATE = 1.5, 50.0  # displacement of a creeping joint / angle noise; 1/s, low-pass of this displacement
# friction variance / squared distance between the breakaway edges
# BRISTLES: a moving joint in the middle of presliding; BRISTLES_AT_REST: a joint at rest, for a family with bristles.
# With half of the latter, contact thresholds rise, and slow contacts are detected later.
BRISTLES, BRISTLES_AT_REST = 0.06, 0.02
MOMENTUM_NOISE = 1.33  # assumed noise of the speeds from which momenta are computed / their white noise
# 1/s, high-pass of momenta; 1/s, low-pass of the high-passed momentum's square; noise variance / low-passed square
SHAKE_BAND, SHAKE_RATE, SHAKE_SHARE = 150.0, 20.0, 2.0
FRICTION_NOISE_S = 0.02  # s, correlation time of the friction model's error
# friction error: a share of the friction level, plus a share of the smallest tau_max (3 mNm for 12 Nm on a Panda)
WRENCH_FRICTION, LEAST_FRICTION = 0.03, 3e-3 / 12.0
# slow friction beyond a model without Stribeck effect / (breakaway torque - model): mean and standard deviation;
# share of dq_max over which both decay with speed. Chosen on elastic twins 0 to 5.
EXCESS_MEAN, EXCESS_ERROR, EXCESS_SPEED = 0.5, 0.5, 0.01
INERTIA_SHARE = 0.05  # inertia error, as a share of a joint's net torque
STIFFNESS = 4e4  # N/m, assumed stiffness of the surroundings: force per motion of the tip
FORCE_RATE, FORCE_RATE_S = 25.0, 0.03  # N/s, largest force rate from STIFFNESS; s, correlation time of the force rate
# N/s, force rate while the low-passed squared innovations exceed TOUCH variances; gain of this low-pass
TOUCH_RATE, TOUCH, TOUCH_SHARE = 300.0, 3.0, 0.1
HAND_RATE = 0.3  # N/sqrt(s), random walk of the force, also on an arm at rest
# standard deviation of a breakaway edge / mean breakaway torque
# Identification underestimated the edges of joint 7 of elastic twins 1 and 5 by 12 %.
# With benchmarks/wrench.py, EDGE_ERROR=0.05 and EDGE_ERROR=0.2 give equal results on elastic twins 0 to 5.
EDGE_ERROR = 0.1
EDGE_SHARE = 0.7  # share of the friction beyond a breakaway edge that a cycle removes, for an exactly known edge
# process noise of the force on a creeping tip / force variance that the creep would cause on stiff surroundings
# The second value is for bristles, with which joints creep without breaking away (tested on a surface of 9e4 N/m).
CREEP_SHARE, BRISTLE_CREEP = 0.3, 5.0
MOMENT_ARM = 0.1  # m, moment per force that the filter assumes on an arm without a tool
FREE_FORCE = 0.1  # N, standard deviation of the force at the beginning of a motion
# N per kg of largest payload, per axis: force error beyond the filter's covariance; 0.25 N for a Panda (3 kg)
FORCE_FLOOR = 0.25 / 3.0
CONFIRMED, RELEASED = 15, 50  # cycles above the contact threshold until a contact begins, below RELEASE until it ends
RELEASE = 0.25  # share of the contact threshold: a smaller squared force ends a contact
# cycles for which the impact test uses the covariance before an impact: longer than stiff impacts
# 1/s, low-pass of the force in the impact test
IMPACT, IMPACT_RATE = 30, 100.0
SUDDEN, USUAL_RATE = 2.0, 1.0  # an impact exceeds this multiple of the mean squared innovation; 1/s, rate of the mean
BLOCK_S, TAIL = 0.5, 0.2  # s of motion per maximum; the tail fit uses this share of the maxima, the largest ones
ALARMS_PER_HOUR = 1.0
# m, path of the tip after which a force that points down is a payload's weight
# largest ratio of horizontal to downward force; factor on the path to subtract while the force does not point down
WEIGHT_PATH, WEIGHT_SHARE, WEIGHT_LOSS = 0.05, 0.3, 5.0
# without recordings: contact threshold / GAUSSIAN (wrench.py); with recordings, the ratio is 1.0 to 1.7 on rigid
# twins 0 to 6 and elastic twins 0 to 14
UNCALIBRATED = 2.4

# wrench with a surface (wrench_fusion.py)
DIFFERENCE_RATE, TEST_RATE, DEPTH_RATE = 50.0, 10.0, 100.0  # 1/s, low-passes: force difference, its test, depth rate
REFUSED = 3.5  # standard deviations; a larger tested difference rejects a surface. Momentum errors last for seconds.
# A tested difference T above INFLATED standard deviations multiplies the innovation's variance by
# 1 + INFLATION (T - INFLATED)^2. By hand, T is below 2 for 99 % of the time on the independent arms with the right
# surface. All three were chosen there.
INFLATED, INFLATION = 2.0, 10.0
SURFACE_DRAWS = 16  # largest number of posterior draws
SURFACE_SHARE, SURFACE_FLOOR = 0.02, 0.15  # error of the contact law on held-out presses: share of the force; N
