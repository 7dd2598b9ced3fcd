"""No arm touches itself or the table: plans leave room for deviations, and the driver stops an arm in time."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import conf
from omegaconf import OmegaConf

import r2s
from r2s.arm.clients.emulated import emulated_arm
from r2s.arm.clients.franka import SPEED, _slow_path
from r2s.arm.driver import DQ_INSIDE, Driver, DriverBatch
from r2s.arm.interface import ArmState
from r2s.arm.policy_runner import PolicyRunner
from r2s.arm.recorder import record
from r2s.arm.simulated import SimulatedArm
from r2s.arm.tracking_controller import MAX_DEVIATION, TrackingController
from r2s.errors import UserError
from r2s.excitation.deviation import DeviationLimits, deviation_weights
from r2s.excitation.minimum_jerk import minimum_jerk
from r2s.excitation.motion import Excitation
from r2s.excitation.motion_checks import CLEARANCE_M, DEVIATION, Space, check_space
from r2s.learning.evaluate import fixed_episodes
from r2s.learning.model_based import Oracle
from r2s.physics.actuation import Motors
from r2s.physics.collision import CollisionCheck
from r2s.physics.dynamics import nominal_dynamics
from r2s.physics.fence import FENCE_M, first_breaches
from r2s.physics.robot import SIM_DT, load_robot
from r2s.physics.safety_filter import DQ_ALLOWED, DQ_MAX, filter_limits
from r2s.physics.simulator import Simulator
from r2s.stages.transfer import predict
from r2s.tasks.reach import ReachTask
from r2s.tasks.rollout import gap, rollout

PANDA = load_robot(**conf("robot/panda"))
TASK = ReachTask(**{k: tuple(v) if isinstance(v, list) else v for k, v in conf("task/reach").items()})
TORQUE = TASK.torque_limit(PANDA)
DYNAMICS = nominal_dynamics(PANDA, **conf("friction/paper"), inertia_scale=conf("inertia/paper")["scale"])
GEOMETRY = CollisionCheck(PANDA, table=None)
JOINT = np.eye(7)
LOW = np.array([0.0, 0.6, 0, -2.0, 0, 2.86, 0.8])  # the hand out in front, a little above the table


def hostile(m, seed, *, fence=None, speed_share=1.0, cycles=1500, torque=TORQUE):
    """Drive m simulated arms from anywhere clear with full or held random torque, half of them each.

    Return the least distances (m,) m until each rests, the largest speeds (m, 7) rad/s, and why arms were stopped.
    """
    rng = np.random.default_rng(seed)
    sim, motors = Simulator(PANDA, DYNAMICS, m, 1), Motors(m, 7, 4e-3, 1e-3)
    drivers = DriverBatch(PANDA, torque, m, friction=DYNAMICS.level, fence=fence, speed_share=speed_share)
    q = rng.uniform(PANDA.q_min + 0.15, PANDA.q_max - 0.15, (20 * m, 7))
    sim.reset(q[GEOMETRY.distances(q).min(1) > 2 * FENCE_M][:m], np.zeros((m, 7)))
    tau, least, fastest, runs = np.zeros((m, 7)), np.full(m, np.inf), np.zeros((m, 7)), np.ones(m, dtype=bool)
    full = torque * rng.choice([-1, 1], (m, 7))
    for k in range(cycles):
        if k % 100 == 0:
            full[::2] = torque * rng.choice([-1, 1], full[::2].shape)
        q, dq = sim.q + 2e-5 * rng.normal(size=(m, 7)), sim.dq + 3e-3 * rng.normal(size=(m, 7))
        tau = drivers(q, dq, tau, full)
        sim.rollout(motors(tau[:, None]), record=())
        runs &= ~drivers.done
        least = np.where(runs, np.minimum(least, GEOMETRY.distances(sim.q).min(1)), least)
        fastest = np.maximum(fastest, np.abs(sim.dq))
    return least, fastest, [reason for reason in drivers.stopping if reason is not None]


def still(q, dq=None):
    return ArmState(t=0.0, q=q, dq=np.zeros(7) if dq is None else dq, tau_J=np.zeros(7), tau_J_d=np.zeros(7))


def way(a, b, seconds, rest=0.5):
    """Return an excitation from a to b (n,) rad that rests there."""
    t = SIM_DT * np.arange(round((seconds + rest) / SIM_DT) + 1)
    return Excitation(t, *minimum_jerk(a, b, seconds, t[:, None]))


# --- the fence of the driver


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_no_torque_drives_an_arm_into_itself_or_the_table(seed):
    """Without the fence some of the same arms touch."""
    least, _, stops = hostile(60, seed, fence=GEOMETRY)
    assert least.min() > 0
    near = r"link 'link\d' and .* are \d\.\d{3} m apart and would come too near"
    assert sum(re.fullmatch(near, reason) is not None for reason in stops) > 5
    assert hostile(60, seed)[0].min() <= 0


def test_an_arm_that_starts_near_may_leave_but_not_come_nearer():
    q = LOW + 0.02 * JOINT[1]
    while GEOMETRY.distances(q[None]).min() > 0.4 * FENCE_M:
        q[1] += 1e-3
    driver, up = Driver(PANDA, TORQUE, DYNAMICS.level, fence=GEOMETRY), -0.3 * JOINT[1]
    for k in range(500):
        driver(still(q, up * (k > 10)), np.zeros(7))
        q = q + SIM_DT * up * (k > 10)
    assert driver.stopping is None
    driver(still(q, -up), np.zeros(7))
    assert driver.stopping is None
    for _ in range(600):
        q = q - SIM_DT * up
        driver(still(q, -up), np.zeros(7))
        if driver.stopping is not None:
            break
    assert driver.stopping is not None
    assert "and the table are 0.0" in driver.stopping
    assert GEOMETRY.distances(q[None]).min() > FENCE_M


def test_a_predicted_episode_that_the_driver_would_stop_is_found():
    """A fast way down breaches the fence, the same way at rest above does not."""
    plan = way(LOW - 0.5 * JOINT[1], LOW + 0.34 * JOINT[1], 0.8)
    limits = filter_limits(PANDA, TORQUE)
    found = first_breaches(
        GEOMETRY, limits, np.stack([plan.q, plan.q[:1] + 0 * plan.q]), np.stack([plan.dq, 0 * plan.dq])
    )
    assert GEOMETRY.names[found[0]].endswith("and the table")
    assert found[1] == -1


def test_every_driver_has_a_fence():
    sources = [p.read_text() for p in (Path(r2s.__file__).parent / "arm").rglob("*.py")]
    made = [line for text in sources for line in re.findall(r"^.*[ (]Driver\(.*$", text, re.MULTILINE)]
    made = [line for line in made if "class" not in line and "_Puppet(" not in line]  # warm_up moves no arm
    assert len(made) == 4
    assert all("fence=" in line or "**how" in line for line in made)


# --- clearance of plans


@pytest.mark.long
def test_the_allowed_deviation_touches_nothing():
    """Whatever joints do within it: at its bound in a thousand directions, of all joints and of single ones."""
    rng, space = np.random.default_rng(0), Space(PANDA, z_min=-np.inf)
    q = rng.uniform(PANDA.q_min, PANDA.q_max, (400, 7))
    q = q[(space.gaps(q) >= 0).all(1)]
    tight, largest = 0, []
    for posture, weights in zip(q, deviation_weights(space, q, MAX_DEVIATION), strict=True):
        directions = rng.choice([-1.0, 1.0], (1000, 7)) * rng.choice([1.0, rng.random()], (1000, 7))
        directions[500:] *= rng.random((500, 7)) ** 8  # a few joints deviate, most do not
        e = directions / (np.abs(directions) @ weights.T).max(1, keepdims=True)
        least = GEOMETRY.distances(posture + e).min()
        assert least > 0
        tight += least < 2 * CLEARANCE_M
        largest.append(np.abs(e).max(0))
        assert (DEVIATION * weights.sum(1) <= 1 + 1e-9).all()
    assert len(q) > 50
    assert tight > 0
    assert np.min(largest, axis=0)[6] == pytest.approx(MAX_DEVIATION)  # the last joint turns what is round


def test_a_plan_that_a_deviation_brings_to_the_table_is_refused():
    """3 cm above it with the arm stretched is not enough: 0.05 rad in three joints are more."""
    down = LOW.copy()
    while GEOMETRY.distances(down[None]).min() > CLEARANCE_M + 2e-3:
        down[1] += 1e-3
    assert GEOMETRY.distances(down[None]).min() > CLEARANCE_M
    with pytest.raises(UserError, match=r"link 'link7' is 0\.0\d\d m above the table at .*, allowed 0\.0[4-9]\d* m"):
        check_space(PANDA, way(PANDA.q_home, down, 3.0), z_min=-np.inf)


def test_a_recording_may_deviate_less_near_the_table():
    """0.1 rad of the joints that lower the stretched arm end it where they cost the clearance, and not higher up."""
    space = Space(PANDA, z_min=-np.inf)
    down = LOW.copy()
    while space.gaps((down + 1e-3 * JOINT[1])[None]).min() > 0:
        down[1] += 1e-3
    plan = way(down - 0.3 * JOINT[1], down, 1.5)
    follow = TrackingController(PANDA, plan, DeviationLimits.along(space, plan, MAX_DEVIATION))
    last, lower = len(plan.t) - 1, 0.1 * (JOINT[1] - JOINT[3] - JOINT[5])
    near, high = (follow.deviation(k, still(plan.q[k] + lower)) for k in (last, 0))
    assert near is not None
    assert re.match(r"joint 2 is 0\.100 rad off its path, allowed 0\.0[5-9]\d* rad", near)
    assert high is None
    # joints that move the arm along the table, or its wrist, may deviate by all that any joint may
    along = 0.99 * MAX_DEVIATION * (JOINT[0] + JOINT[6])
    assert follow.deviation(last, still(plan.q[-1] + along)) is None


# --- the operator's speed cap


@pytest.mark.long
def test_the_speed_share_bounds_every_speed():
    """With the torque of an episode, full or changing: below the share of each limit; without it most are above."""
    _, free, _ = hostile(60, 5)
    for share in (0.3, 0.1):
        _, fastest, _ = hostile(60, 5, speed_share=share)
        assert (fastest <= 1.1 * DQ_INSIDE * share * PANDA.dq_max).all()
        assert (free.max(0) > share * PANDA.dq_max).any()


def test_ways_and_recordings_keep_the_speed_share():
    path, _ = _slow_path(PANDA, PANDA.q_home, PANDA.q_home + 0.5, 0.3)
    assert np.abs(path.dq / PANDA.dq_max).max() <= 0.3 * SPEED + 1e-9
    arm = SimulatedArm(PANDA, DYNAMICS, position_noise=0, velocity_noise=0)
    arm.speed_share = 0.3
    fast = way(PANDA.q_home, PANDA.q_home + 0.5 * JOINT[0], 1.0)
    with pytest.raises(UserError, match=r"velocity of joint 1 is .* by arm.speed_share=0.3"):
        record(arm, fast)
    out = record(arm, way(PANDA.q_home, PANDA.q_home + 0.5 * JOINT[0], 2.0))
    assert np.abs(out.dq / PANDA.dq_max).max() < 0.3


def test_the_prediction_of_a_transfer_keeps_the_speed_share():
    """An arm with the model's dynamics moves as predicted; its links are nominal, as in the driver's filter."""
    task, same, share = replace(TASK, episode_s=1.0), nominal_dynamics(PANDA, **conf("friction/paper")), 0.3
    starts, goals = fixed_episodes(PANDA, task, 1)
    cfg = OmegaConf.create({"threads": 1, "arm": {"speed_share": share}})
    policy = Oracle(PANDA, task, same)
    request = SimpleNamespace(task=task, center=same, policy=policy, starts=starts, goals=goals, soft_start_s=0.0)
    predicted = predict(cfg, request, PANDA)
    arm = SimulatedArm(PANDA, same, position_noise=0, velocity_noise=0)
    arm.speed_share = share
    done = rollout(policy, PolicyRunner(arm, task, same.level, rotors=same.armature), task, starts, goals)
    assert gap(done, predicted)["ee_path_rmse_mm"] < 1e-6
    assert (np.abs(predicted.dq) <= share * PANDA.dq_max).all()
    limits = filter_limits(PANDA, task.torque_limit(PANDA), share)
    assert (limits[:, [DQ_ALLOWED, DQ_MAX]] <= share * PANDA.dq_max[:, None]).all()


@pytest.mark.parametrize("share", [0.0, 1.5])
def test_a_speed_share_outside_its_range_is_refused(share):
    with pytest.raises(UserError, match=r"speed_share: expected a number in \(0, 1\], got"):
        emulated_arm(PANDA, client="panda", operator=None, speed_share=share)
