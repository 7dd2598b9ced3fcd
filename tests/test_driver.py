"""Whatever a policy says, what reaches the arm is within its rules; and a good policy is left alone."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from conftest import conf
from hypothesis import given, settings
from hypothesis import strategies as st

from r2s.arm.clients import fr3_limits
from r2s.arm.clients.fr3 import within_fr3
from r2s.arm.drive_cycle import SPRING
from r2s.arm.driver import DEADLINE_S, Driver, DriverBatch
from r2s.arm.interface import ArmState, Reflexes
from r2s.arm.policy_runner import PolicyRunner
from r2s.arm.simulated import SimulatedArm
from r2s.learning.evaluate import fixed_episodes
from r2s.learning.policy import make_policy
from r2s.physics.actuation import Actuation, Motors
from r2s.physics.dynamics import nominal_dynamics
from r2s.physics.rigid_body import InverseInertia
from r2s.physics.robot import SIM_DT, load_robot
from r2s.physics.safety_filter import ALLOWED, BRAKE_S, Q_MARGIN
from r2s.physics.simulator import Simulator
from r2s.tasks.reach import ReachTask
from r2s.tasks.rollout import rollout

PANDA = load_robot(**conf("robot/panda"))
TASK = ReachTask(**{k: tuple(v) if isinstance(v, list) else v for k, v in conf("task/reach").items()})
TORQUE = TASK.torque_limit(PANDA)
FOLLOWS = np.array(conf("task/track")["torque_fraction"]) * PANDA.tau_max  # of a timed path: more of the wrist
LEVEL = nominal_dynamics(PANDA, **conf("friction/paper")).level
KINDS = ("nan", "inf", "huge", "flip", "silence", "full", "noise", "wrong shape of time", "held noise")


class Held:
    """Noise (m, 7) Nm of which each arm's is held for 5 to 50 ms: slow enough to move joints, too fast to be sane."""

    def __init__(self, m, rng):
        self._noise, self._until, self._rng = np.zeros((m, 7)), np.zeros(m), rng

    def __call__(self, k):
        """Return the noise of cycle k."""
        over = k >= self._until
        self._noise[over] = TORQUE * self._rng.normal(size=(over.sum(), 7))
        self._until[over] = k + self._rng.integers(5, 51, over.sum())
        return self._noise


def targets(kinds, k, rng, held):
    """Return (m, 7) Nm, what bad policies of these kinds say in cycle k; NaN is silence, to the driver."""
    m = len(kinds)
    noise, coin = TORQUE * rng.normal(size=(m, 7)), rng.random((m, 7)) < 0.5
    silence = np.full((m, 7), np.nan)
    said = {
        "nan": np.where(rng.random((m, 7)) < 0.3, np.nan, TORQUE),
        "inf": np.full((m, 7), np.inf if k % 2 else -np.inf),
        "huge": 1e9 * np.where(coin, -1.0, 1.0),
        "flip": np.tile(1e3 * TORQUE * (-1) ** k, (m, 1)),
        "silence": silence,
        "full": np.tile(TORQUE * np.where(np.arange(7) % 2, -1.0, 1.0), (m, 1)),
        "noise": noise,
        "wrong shape of time": noise if k % 37 == 0 else silence,
        "held noise": held(k),
    }
    return np.select([(kinds == i)[:, None] for i in range(len(KINDS))], [said[kind] for kind in KINDS])


class FR3Reflexes(Reflexes):
    """As those of the emulator: an FR3 allows less speed near position limits."""

    def within_limits(self, q, dq):
        """Return (m,), whether an FR3 would go on."""
        low, high = fr3_limits.velocity_bounds(q)
        over = np.maximum(low - dq, dq - high)
        at = np.maximum(fr3_limits.Q_MIN - q, q - fr3_limits.Q_MAX)
        return super().within_limits(q, dq) & (at <= 0).all(-1) & (over <= 0).all(-1)


def hostile(cycles, seed, robot=PANDA, check=None, m=125):
    """Drive m simulated arms by one bad policy after the other; return cycles, reflexes that fired, orderly stops.

    The reflexes are those of libfranka: torque range, torque rate, position and velocity limits, of the arm as it is
    and as its sensors see it.
    """
    rng, check = np.random.default_rng(seed), check or Reflexes(PANDA)
    dynamics = nominal_dynamics(PANDA, **conf("friction/paper"), inertia_scale=conf("inertia/paper")["scale"])
    sim, motors = Simulator(PANDA, dynamics, m, 1), Motors(m, 7, 4e-3, 1e-3)
    drivers = DriverBatch(robot, TORQUE, m, friction=LEVEL, cutoff_hz=TASK.cutoff_hz)
    reflexes, stops, count = [], [], 0

    def sensed():
        return sim.q + 2e-5 * rng.normal(size=(m, 7)), sim.dq + 3e-3 * rng.normal(size=(m, 7))

    while count < cycles:
        kinds = rng.integers(len(KINDS), size=m)
        sim.reset(rng.uniform(robot.q_min + 0.15, robot.q_max - 0.15, (m, 7)), np.zeros((m, 7)))
        motors.reset()
        drivers.reset()
        tau, (q, dq), runs, held = np.zeros((m, 7)), sensed(), np.ones(m, dtype=bool), Held(m, rng)
        for k in range(2000):
            if not runs.any():
                break
            count += int(runs.sum())
            last, tau = tau, drivers(q, dq, tau, targets(kinds, k, rng, held))
            assert check.accepts(tau, last)[runs].all()  # torque range and rate
            sim.rollout(motors(tau[:, None]), record=())
            q, dq = sensed()
            fired = runs & ~(check.within_limits(sim.q, sim.dq) & check.within_limits(q, dq))
            reflexes += [f"{KINDS[kinds[i]]}: {sim.q[i]} {sim.dq[i]}" for i in np.flatnonzero(fired)]
            done = runs & ~fired & drivers.done
            stops += [f"{KINDS[kinds[i]]}: {drivers.stopping[i]}" for i in np.flatnonzero(done)]
            runs &= ~(fired | done)
    return count, reflexes, stops


@pytest.mark.long
@pytest.mark.parametrize("least", [100_000, pytest.param(1_000_000, marks=pytest.mark.slow)])
def test_a_hostile_policy_never_breaks_a_rule(least):
    """NaN, infinities, 1e9, sign flips, silence, full torque, anywhere: no reflex of the arm, only orderly stops."""
    cycles, reflexes, stops = hostile(least, seed=1)
    assert cycles >= least
    assert not reflexes
    assert any("no finite action" in s for s in stops)


@pytest.mark.long
@pytest.mark.parametrize("least", [100_000, pytest.param(1_000_000, marks=pytest.mark.slow)])
def test_nor_those_of_an_fr3(least):
    """Which allows less speed the closer a joint is to a position limit, and none just before it."""
    cycles, reflexes, _ = hostile(least, seed=1, robot=within_fr3(PANDA), check=FR3Reflexes(PANDA), m=100)
    assert cycles >= least
    assert not reflexes


def test_a_stop_does_not_throw_a_stretched_elbow():
    """At full speed with the elbow near its end: torque comes off by the rate limit, late; no joint may be faster.

    With allowed speeds that fell to nothing in 0.1 s joint 4 went from 0.4 to 1.3 rad/s, beyond what an FR3 allows.
    """
    dynamics = nominal_dynamics(PANDA, **conf("friction/paper"), inertia_scale=conf("inertia/paper")["scale"])
    sim, motors = Simulator(PANDA, dynamics, 1, 1), Motors(1, 7, 4e-3, 1e-3)
    driver = DriverBatch(within_fr3(PANDA), TORQUE, 1, friction=LEVEL, cutoff_hz=TASK.cutoff_hz)
    dq = np.array([1.38, 0.52, 1.21, 0.72, 0.06, -0.07, 0.29])
    sim.reset(np.array([[-0.62, 1.51, -1.5, -0.55, 2.82, 2.26, -0.76]]), dq[None])
    tau, fastest = np.array([[1.3, -3.2, -0.2, 0.4, 0.2, 0.3, 0.1]]), np.zeros(7)
    for _ in range(1000):
        tau = driver(sim.q.copy(), sim.dq.copy(), tau, np.full((1, 7), np.nan))
        sim.rollout(motors(tau[:, None]), record=())
        fastest = np.maximum(fastest, np.abs(sim.dq[0]))
        assert FR3Reflexes(PANDA).within_limits(sim.q, sim.dq).all()
    assert driver.done.all()
    assert fastest[3] < 1.1 * dq[3]


def state_of(q, dq, tau):
    return ArmState(t=0.0, q=q, dq=dq, tau_J=tau, tau_J_d=tau)


numbers = st.floats(allow_nan=True, allow_infinity=True, width=64)


@pytest.mark.long
@settings(max_examples=300, deadline=None)
@given(st.lists(st.lists(numbers, min_size=7, max_size=7), min_size=1, max_size=8), st.integers(0, 2**31))
def test_any_floats_give_a_command_that_the_arm_takes(targets, seed):
    """Any targets, from any state and any last command: finite, within torque range and rate."""
    rng, check = np.random.default_rng(seed), Reflexes(PANDA)
    driver = Driver(PANDA, TORQUE, LEVEL, soft_start_s=rng.choice([0.0, 0.5]))
    tau = rng.uniform(-1, 1, 7) * PANDA.tau_max
    for wanted in targets:
        q, dq = rng.uniform(PANDA.q_min, PANDA.q_max), rng.normal(size=7) * PANDA.dq_max
        if rng.random() < 0.2:
            q[rng.integers(7)] = np.nan
        new = driver(state_of(q, dq, tau), np.array(wanted))
        check.command(new, tau)
        tau = new


@pytest.mark.parametrize(("torque", "share"), [(TORQUE, 0.3), (FOLLOWS, 0.5)], ids=["reach", "track"])
def test_a_good_policy_is_left_alone(torque, share):
    """Away from limits the command is the low-passed, rate-limited target, bit for bit, as in training."""
    driver, plain = Driver(PANDA, torque, LEVEL, cutoff_hz=100.0), Actuation(PANDA, 1, cutoff_hz=100.0)
    tau = np.zeros(7)
    for k in range(400):
        wanted = share * torque * np.sin(0.01 * k + np.arange(7))
        tau = driver(state_of(PANDA.q_home, 0.5 * np.sin(0.01 * k + np.arange(7)), tau), wanted)
        np.testing.assert_allclose(tau, plain(wanted[None], 1)[0, 0], atol=1e-12)
        np.testing.assert_array_equal(driver.effort, plain.last[0])
    assert driver.stopping is None


def test_silence_is_damped_then_stopped():
    """Up to the deadline the last target holds; after it every joint is slowed, until the arm rests."""
    driver, tau = Driver(PANDA, TORQUE, LEVEL), np.zeros(7)
    driver(state_of(PANDA.q_home, np.zeros(7), tau), 0.2 * TORQUE)
    for _ in range(round(DEADLINE_S / SIM_DT)):
        tau = driver(state_of(PANDA.q_home, np.zeros(7), tau), None)
    assert driver.stopping is None
    np.testing.assert_allclose(tau, 0.2 * TORQUE, rtol=1e-6)
    speed = np.full(7, 0.5)
    for _ in range(200):
        tau = driver(state_of(PANDA.q_home, speed, tau), None)
    assert driver.stopping == "no finite action for 50 ms"
    model = PANDA.model(gravity=False)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = PANDA.q_home, speed
    mujoco.mj_forward(model, data)
    ddq = InverseInertia(PANDA)(PANDA.q_home[None])[0] @ (tau - data.qfrc_bias)
    np.testing.assert_array_less(ddq, 0)
    assert not driver.done
    driver(state_of(PANDA.q_home, np.zeros(7), tau), None)
    assert driver.done


def test_a_stop_leaves_a_light_joint_to_its_friction():
    """Joint 7 of a timed path, which may be asked for more than its inertia bears, gets no braking torque.

    From the end of the ramp of the allowed speed on it meets a spring; the others brake.
    """
    driver, tau, speed = Driver(PANDA, FOLLOWS, LEVEL), np.zeros(7), np.full(7, 0.5)
    for _ in range(400):
        tau = driver(state_of(PANDA.q_home, speed, tau), None)
    assert np.all(tau[:6] < 0)
    ramp = 0.5 / (ALLOWED * PANDA.dq_max).min() * BRAKE_S
    slid = 0.5 * (400 * SIM_DT - DEADLINE_S - ramp)  # rad, with the spring
    inertia = 1 / InverseInertia(PANDA)(PANDA.q_home[None])[0][6, 6]
    np.testing.assert_allclose(tau[6], -(SPRING**2) * inertia * slid, rtol=0.02)  # +- 2 cycles, and the low-pass


def test_torque_fades_in():
    """With a soft start of 1 s, a constant target is at about half of itself after half of that, and whole after."""
    driver, tau = Driver(PANDA, TORQUE, LEVEL, soft_start_s=1.0), np.zeros(7)
    for k in range(1200):
        tau = driver(state_of(PANDA.q_home, np.zeros(7), tau), 0.3 * TORQUE)
        if k == 500:
            np.testing.assert_allclose(tau, 0.15 * TORQUE, rtol=0.02)
    np.testing.assert_allclose(tau, 0.3 * TORQUE, rtol=1e-3)


def test_limits_push_back_and_stop():
    """Past the margin of a position limit the law pushes back; near the limit, or near top speed, the motion ends."""
    q = PANDA.q_home.copy()
    q[1] = PANDA.q_max[1] - 0.6 * Q_MARGIN
    driver, tau = Driver(PANDA, TORQUE, LEVEL), np.zeros(7)
    for _ in range(200):
        tau = driver(state_of(q, np.zeros(7), tau), 0.5 * TORQUE)
    assert tau[1] < 0
    assert driver.stopping is None
    q[1] = PANDA.q_max[1] - 0.01
    driver(state_of(q, np.zeros(7), tau), np.zeros(7))
    assert driver.stopping is not None
    assert driver.stopping.startswith("joint 2 is at ")
    driver.reset()
    driver(state_of(PANDA.q_home, 0.97 * PANDA.dq_max * np.eye(7)[4], tau), np.zeros(7))
    assert driver.stopping is not None
    assert "joint 5" in driver.stopping


def test_timing_counts_every_cycle():
    """Two episodes of 0.2 s: 10 policy steps, 200 commands and 198 periods each, without that of the start."""
    task = replace(TASK, episode_s=0.2)
    dynamics = nominal_dynamics(PANDA, **conf("friction/paper"))
    arm = SimulatedArm(PANDA, dynamics, position_noise=0.0, velocity_noise=0.0)
    starts, goals = fixed_episodes(PANDA, task, 2)
    policy = make_policy(PANDA, task, (8,))
    driven = PolicyRunner(arm, task, LEVEL)
    episodes, timing = rollout(policy, driven, task, starts, goals), driven.timing
    assert driven.stops == []
    assert episodes.q.shape == (2, 10, 7)
    rows = timing.table()
    assert [(row["what"], row["count"]) for row in rows] == [
        ("policy", 20), ("driver", 400), ("period", 396), ("robot", 400)
    ]  # fmt: skip
    assert all(0 < row["median_ms"] <= row["p99_ms"] <= row["p999_ms"] <= row["max_ms"] for row in rows)
    assert rows[-1]["lost"] == 0


def test_a_slow_policy_is_not_taken_for_a_silent_one():
    """At 10 Hz a target holds for 100 ms: no stop. The action is zero, so nothing else can stop the arm."""

    class Still:
        def action(self, observation):
            return torch.zeros(len(observation), 7)

    task = replace(TASK, ctrl_hz=10, episode_s=1.0)
    arm = SimulatedArm(PANDA, nominal_dynamics(PANDA, **conf("friction/paper")), position_noise=0, velocity_noise=0)
    driven = PolicyRunner(arm, task, LEVEL)
    rollout(Still(), driven, task, *fixed_episodes(PANDA, task, 1))
    assert driven.stops == []


def test_a_stop_that_has_just_begun_counts():
    """An episode that ends while the driver brings the arm to rest was stopped, and did not reach."""

    class Silent:
        def action(self, observation):
            return torch.full((len(observation), 7), torch.nan)

    task = replace(TASK, episode_s=0.08)  # the watchdog acts after 50 ms, the arm would rest later
    arm = SimulatedArm(PANDA, nominal_dynamics(PANDA, **conf("friction/paper")), position_noise=0, velocity_noise=0.1)
    driven = PolicyRunner(arm, task, LEVEL)
    episodes = rollout(Silent(), driven, task, *fixed_episodes(PANDA, task, 1))
    stops = driven.stops
    assert [str(stop) for stop in stops] == ["episode 1, 0.08 s: no finite action for 50 ms"]
    assert np.isinf(episodes.distance[0, -1])
    assert stops[0].log.shape == (80, 29)


def test_a_torque_that_is_not_finite_is_not_built_upon():
    """Where the arm does not say what it applied, the driver goes on from what it sent."""
    driver = Driver(PANDA, TORQUE, LEVEL)
    one = driver(state_of(PANDA.q_home, np.zeros(7), np.zeros(7)), 0.5 * TORQUE)
    two = driver(state_of(PANDA.q_home, np.zeros(7), np.full(7, np.nan)), 0.5 * TORQUE)
    Reflexes(PANDA).command(two, one)
