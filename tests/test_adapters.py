"""Adapters: no torque if the arm equals its model, the missing torque otherwise, always through the safety filter."""

import pickle
from dataclasses import replace
from functools import cache, partial

import numpy as np
import pandas as pd
import pytest
from conftest import ROOT, conf
from omegaconf import OmegaConf

from r2s.adaptation.adapters import AdapterContext, observer, rls
from r2s.adaptation.arm_model import make_arm_model
from r2s.adaptation.feedforward import plausible_payload, shrinkage_weights
from r2s.adaptation.kalman import Filter
from r2s.adaptation.momentum import BODY
from r2s.adaptation.momentum_residual import MomentumResidual
from r2s.adaptation.noise_model import default_noise
from r2s.adaptation.observer import Observer
from r2s.adaptation.tuning import ACCELERATION_S, SPAN
from r2s.arm.command_loop import CommandLoop
from r2s.arm.driver import ADDED, DEADLINE_S, Driver, DriverBatch
from r2s.arm.interface import ArmStopped, Reflexes
from r2s.arm.realtime_process import RealtimeRunner
from r2s.arm.simulated import SimulatedArm
from r2s.errors import UserError
from r2s.override_checks import check_overrides
from r2s.physics.dynamics import nominal_dynamics
from r2s.physics.inverse_dynamics import InverseDynamics
from r2s.physics.payload import dynamics_with_payload, mass_and_moment, payload_of
from r2s.physics.robot import SIM_DT, load_robot
from r2s.stages.adapter_factory import free_recordings, make_adapter
from r2s.tasks.reach import ReachTask

PAYLOAD = payload_of({"mass": 1.0, "centre": [0.02, -0.01, 0.05]}, (3.0, 0.15))
PANDA = load_robot(**conf("robot/panda"))
TORQUE = 0.3 * PANDA.tau_max
SPRING = np.array([60, 120, 60, 60, 10, 10, 5.0])
FILTER_S = conf("adapt/observer")["filter_s"]
MAKES = partial(observer, filter_s=FILTER_S), rls


@cache
def truth():
    """Return dynamics with friction, a delay, and no stiction that could hide a torque."""
    found = nominal_dynamics(PANDA, **conf("friction/paper"))
    return replace(found, delay=3e-3, lag=1e-3, breakaway=np.zeros((7, 2)), offset=np.zeros(7))


@cache
def context():
    return AdapterContext(PANDA, truth())


class Logged:
    """An adapter that logs the torque of another."""

    def __init__(self, adapter):
        self.adapter, self.added = adapter, []

    def begin(self):  # noqa: D102
        self.adapter.begin()

    def __call__(self, q, dq, tau):  # noqa: D102
        self.added.append(np.array(self.adapter(q, dq, tau)))
        return self.added[-1]


def swing(adapter, *, seconds=2.0, rate=1.0, payload=None, declared=None, push=0.0, noise=0.0):
    """Return q, dq, commands (T, 7) of a known arm under a spring to a swinging goal, with the adapter."""
    sensors = {"position_noise": 1e-2 * noise, "velocity_noise": noise}
    arm = SimulatedArm(PANDA, truth(), **sensors, payload=payload and replace(payload), declared_payload=declared)
    arm.external[1] = push
    loop = CommandLoop(arm, Driver(PANDA, TORQUE, truth().level), adapter=adapter)
    loop.place(PANDA.q_home)
    rows, phase = [], np.arange(7.0)
    for k in range(round(seconds / SIM_DT)):
        s, t = loop.state, k * SIM_DT
        goal = PANDA.q_home + 0.4 * np.sin(rate * t + phase) * np.sin(0.5 * rate * t) ** 2
        loop(SPRING * (goal - s.q) - 0.15 * SPRING * s.dq)
        rows.append((s.q, s.dq, loop.sent))
    return (np.array(x) for x in zip(*rows, strict=True))


@pytest.mark.long
@pytest.mark.parametrize("make", MAKES)
def test_an_adapter_on_an_arm_that_equals_its_model_changes_nothing(make):
    """To 1e-3 Nm, in slow motion: a time step of 1 ms has an error of half the change of torque."""
    logged = Logged(make(context()))
    _, dq, _ = swing(logged, rate=0.6, seconds=2.5)
    assert np.abs(dq).max() > 0.05  # the arm moves
    assert np.abs(logged.added).max() < 1e-3


def test_the_observer_cancels_a_push():
    """Through a low-pass: after 8 time constants within 1e-3 of a constant push, and zero on other joints."""
    logged = Logged(observer(context(), FILTER_S))
    swing(logged, push=-3.0, seconds=1.5)
    added = np.array(logged.added)[-500:]
    assert abs(added[:, 1].mean() - 3.0) < 0.05
    assert np.abs(np.delete(added, 1, axis=1)).max() < 0.05


@pytest.mark.long
@pytest.mark.parametrize(("make", "latency"), zip(MAKES, (FILTER_S + SPAN * SIM_DT, ACCELERATION_S), strict=True))
def test_a_payload_s_torque_is_added(make, latency):
    """The torque of the payload for the same motion, one second after it was attached.

    With the latency of the low-passes, and within a tenth for noise and uncertainty.
    """
    logged = Logged(make(context()))
    q, dq, _ = swing(logged, payload=PAYLOAD, seconds=2.0, rate=3.0, noise=1e-3)
    heavy = InverseDynamics(PANDA, dynamics_with_payload(PANDA, truth(), PAYLOAD))
    kernel = np.ones(100) / 100  # accelerations have noise
    ddq = np.apply_along_axis(np.convolve, 0, np.gradient(dq, SIM_DT, axis=0), kernel, "same")
    needed = heavy.rigid(q, dq, ddq) - InverseDynamics(PANDA, truth()).rigid(q, dq, ddq)
    now = slice(1000, -100)
    rms = lambda x: np.sqrt((x[now] ** 2).mean())  # noqa: E731
    assert rms(needed[:, 1]) > 2.0
    error = rms(np.array(logged.added) - needed)
    assert error < latency * rms(np.gradient(needed, SIM_DT, axis=0)) + 0.1 * rms(needed)


@pytest.mark.long
@pytest.mark.parametrize("make", MAKES)
@pytest.mark.parametrize("share", [1.0, 0.5, 1.5])
def test_the_weight_of_a_declared_payload_is_not_added_again(make, share):
    """An adapter adds what the arm's own compensation lacks, whatever share of the payload was declared."""
    declared = replace(PAYLOAD, mass=share * PAYLOAD.mass)
    known = replace(truth(), declared_payload=mass_and_moment(PANDA, declared))
    logged = Logged(make(AdapterContext(PANDA, known)))
    q, _, _ = swing(logged, payload=PAYLOAD, declared=declared, seconds=2.0, noise=1e-3)
    zero = np.zeros_like(q)
    weight = InverseDynamics(PANDA, dynamics_with_payload(PANDA, truth(), PAYLOAD)).rigid(q, zero, zero)
    weight -= InverseDynamics(PANDA, truth()).rigid(q, zero, zero)
    error = (np.array(logged.added) - (1.0 - share) * weight)[1000:, 1]  # slow motion: hardly any acceleration
    assert np.sqrt((error**2).mean()) < 0.1 * np.abs(weight[:, 1]).mean()


def test_a_new_estimate_enters_over_a_span():
    """The estimated torque steps at a detected payload; the added torque follows through a low-pass."""
    adapter, estimated = rls(context()), []

    class Logging(Logged):
        def __call__(self, q, dq, tau):
            added = super().__call__(q, dq, tau)
            estimated.append(adapter._torque.copy())
            return added

    logged = Logging(adapter)
    swing(logged, payload=replace(PAYLOAD, on_s=0.7), seconds=1.2, rate=3.0)
    steps = [np.abs(np.diff(x, axis=0)).max() for x in (estimated, logged.added)]
    assert steps[0] > 1.0  # Nm
    assert steps[1] < 2 / SPAN * steps[0]  # 1 / SPAN of the step, and as much again for the motion


def test_stiction_holds_an_arm_at_rest():
    """A command within breakaway without motion shows no disturbance; beyond it the excess is one."""
    arm = make_arm_model(PANDA, truth())._replace(breakaway=np.ones(7))
    adapter, still = Observer(arm, FILTER_S), np.zeros(7)
    for _ in range(1000):
        added = adapter(PANDA.q_home, still, np.full(7, 0.9))
    assert not added.any()
    for _ in range(1000):
        added = adapter(PANDA.q_home, still, np.full(7, 1.5))
    np.testing.assert_allclose(added, 0.5, atol=1e-3)


def test_an_uncertain_torque_is_not_added():
    """A torque of one standard deviation gets weight 0; the weight grows with certainty, up to 1."""
    added = []
    for share in (3.0, 1.0, 0.3, 0.01):
        default = default_noise(context().arm)
        mean, sigma = default.mean.copy(), default.prior.copy()
        mean[0], sigma[:] = 1.0, 1e-9
        sigma[0] = share
        noise = default._replace(mean=mean, prior=sigma, payload_drift=0.0, rest_drift=0.0)
        residual, weight = MomentumResidual.empty(7), np.zeros(7)
        residual.payload[:, 0] = [0.0, 5, 1, 3, 0, 1, 0]
        shrinkage_weights(Filter.fresh(noise), residual, np.eye(BODY)[0], np.zeros(7), weight)
        added.append(weight[1])
    assert added[0] == added[1] == 0.0
    np.testing.assert_allclose(added[2:], [1 - 0.3**2, 1 - 0.01**2])


def test_a_compensated_payload_is_plausible():
    """For any estimate: mass and centre within the arm's limits, a physical body; 3 kg at 15 cm are what they are."""
    rng, out = np.random.default_rng(0), np.zeros(BODY)
    for _ in range(100):
        x = rng.normal(size=10) * [2, *[0.3] * 3, *[0.1] * 6]
        plausible_payload(x, np.array([3.0, 0.15]), out)
        assert 0.0 <= out[0] <= 3.0
        assert np.linalg.norm(out[1:4]) <= out[0] * 0.15 * (1 + 1e-12)
        xx, yy, zz, xy, xz, yz = out[4:]
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        second = 0.5 * np.trace(tensor) * np.eye(3) - tensor
        j = np.block([[second, out[1:4, None]], [out[None, 1:4], out[None, :1]]])
        assert np.linalg.eigvalsh(j).min() > -1e-12
    plausible_payload(np.array([3.0, 0.45, *[0.0] * 8]), np.array([3.0, 0.15]), out)
    np.testing.assert_allclose(out[:4], [3.0, 0.45, 0.0, 0.0])


def test_an_adapter_of_zero_changes_no_bit():
    rng, m = np.random.default_rng(1), 50
    one, two = (DriverBatch(PANDA, TORQUE, m, friction=truth().level, soft_start_s=0.02) for _ in range(2))
    sent = np.zeros((m, 7))
    for k in range(60):
        q = rng.uniform(PANDA.q_min, PANDA.q_max, (m, 7))
        dq, target = PANDA.dq_max * rng.normal(size=(m, 7)), rng.normal(size=(m, 7)) * TORQUE
        target = target if k % 10 == 0 else None
        first, second = one(q, dq, sent, target), two(q, dq, sent, target, np.zeros((m, 7)))
        assert np.array_equal(first, second)
        sent = first


def test_an_arm_accepts_any_adapter_torque():
    """Hostile torques too; at most ADDED of tau_max is added, and a torque that is not finite stops the arm."""
    rng, m = np.random.default_rng(2), 200
    drivers, reflexes = DriverBatch(PANDA, TORQUE, m, friction=truth().level), Reflexes(PANDA)
    sent = np.zeros((m, 7))
    for _ in range(50):
        q, dq = rng.uniform(PANDA.q_min, PANDA.q_max, (m, 7)), PANDA.dq_max * rng.normal(size=(m, 7))
        added = rng.choice([0, 1, -1e9, 1e9, np.inf, np.nan], (m, 7))
        now = drivers(q, dq, sent, rng.normal(size=(m, 7)) * TORQUE, added)
        assert reflexes.accepts(now, sent).all()
        sent = now
    driver = Driver(PANDA, TORQUE, truth().level)
    state = SimulatedArm(PANDA, truth(), position_noise=0.0, velocity_noise=0.0).read()
    for _ in range(400):
        tau = driver(state, np.zeros(7), np.full(7, 1e9) * (np.arange(7) == 1))
        state = replace(state, tau_J_d=tau)
    assert tau[1] == pytest.approx(ADDED * PANDA.tau_max[1])
    for _ in range(round(DEADLINE_S / SIM_DT) + 2):
        driver(state, np.zeros(7), np.full(7, np.nan))
    assert driver.stopping == "no finite action for 50 ms"


class Fails:
    """An adapter that raises after some cycles."""

    def __init__(self, error=ZeroDivisionError, after=300):
        self.error, self.after = error, after

    def begin(self):  # noqa: D102
        self.cycles = 0

    def __call__(self, q, dq, tau):  # noqa: D102
        self.cycles += 1
        if self.cycles > self.after:
            raise self.error("no more")
        return np.full(7, 0.3)


def run(loop, target):
    """Run for a second."""
    for _ in range(1000):
        loop(target)


def test_an_exception_of_an_adapter_stops_the_arm():
    """The arm comes to rest, then the exception propagates; the next motion has the adapter again."""
    arm, fails = SimulatedArm(PANDA, truth(), position_noise=0.0, velocity_noise=0.0), Fails()
    loop = CommandLoop(arm, Driver(PANDA, TORQUE, truth().level), adapter=fails)
    for _ in range(2):
        loop.place(PANDA.q_home)
        with pytest.raises(ZeroDivisionError):
            run(loop, 0.5 * TORQUE)
        assert fails.cycles == fails.after + 1
        assert np.abs(loop.state.dq).max() < 0.05
    wrong = CommandLoop(arm, Driver(PANDA, TORQUE, truth().level), adapter=Logged(lambda q, dq, tau: np.zeros(6)))
    wrong._adapter.begin = lambda: None
    wrong.place(PANDA.q_home)
    with pytest.raises(ValueError, match=r"expected a torque of shape \(7,\) from the adapter, got \(6,\)"):
        wrong(None)


def test_a_motion_begins_without_memory():
    """A pickled copy behaves the same."""
    for make in MAKES:
        adapter, first = make(context()), []
        for again in (adapter, adapter, pickle.loads(pickle.dumps(make(context())))):
            again.begin()
            added = [again(PANDA.q_home + 2e-4 * k, np.full(7, 0.2), np.full(7, 4.0)).copy() for k in range(200)]
            first = first or added
            assert np.array_equal(first, added)
            assert np.any(added)


@pytest.mark.long
def test_a_missing_part_of_an_adapter_gets_one_line(tmp_path):
    (tmp_path / "config.yaml").write_text("calibration: null\n")
    arm = {"name": "twin"}
    cfg = OmegaConf.create({"adapt": {"name": "none"}, "arm": arm})
    assert make_adapter(cfg, PANDA, tmp_path) is None
    cfg.adapt = conf("adapt/rls") | {"_target_": "r2s.adaptation.adapters.rls"}
    with pytest.raises(UserError, match=r"^adapt=rls: the policy of .* has no identified model; give adapt\.calibr"):
        make_adapter(cfg, PANDA, tmp_path)
    with pytest.raises(UserError, match=r"^adapt=rls: an adapter needs an arm, got arm=none"):
        make_adapter(OmegaConf.merge(cfg, {"arm": {"name": "none"}}), PANDA, tmp_path)
    cfg.adapt.calibration = str(tmp_path)
    with pytest.raises(UserError, match=r"^adapt\.calibration: '.*' is no run folder of stage=identify"):
        make_adapter(cfg, PANDA, tmp_path)
    (tmp_path / "parameters.yaml").write_text("source: {torque: measured}\n")
    with pytest.raises(UserError, match=r"^adapt=rls: expected a model identified with data.torque=commanded, got m"):
        make_adapter(cfg, PANDA, tmp_path)
    with pytest.raises(UserError, match=r"^adapt: no option 'osi'; allowed: none, observer, rls"):
        check_overrides(["stage=transfer", "adapt=osi"], None)
    with pytest.raises(UserError, match=r"^adapt: no option 'obsever'; allowed: .* did you mean 'observer'"):
        check_overrides(["stage=transfer", "adapt=obsever"], None)
    with pytest.raises(UserError, match=r"^adapt: stage=train does not read it: adapters work on an arm"):
        check_overrides(["adapt=observer"], None)
    with pytest.raises(UserError, match=r"filter_s"):
        observer(context(), 0.0)


@pytest.mark.slow
def test_an_exception_in_the_process_of_the_arm_reaches_the_caller():
    task = ReachTask(**{k: v for k, v in conf("task/reach").items() if k in ("ctrl_hz", "episode_s")})
    opens = partial(SimulatedArm, PANDA, truth(), position_noise=0.0, velocity_noise=0.0)
    arms = RealtimeRunner(opens, PANDA, task, truth().level, adapter=Fails(after=5))
    with pytest.raises(ZeroDivisionError, match="no more"), arms:
        live(arms)


def live(arms):
    """Run for a second."""
    arms.place(PANDA.q_home[None], 0)
    for _ in range(50):
        arms.step(np.zeros((1, 7)))


def test_an_arm_that_stops_itself_stops_its_adapter():
    """The adapter gets no cycle after the end."""
    arm, fails = SimulatedArm(PANDA, truth(), position_noise=0.0, velocity_noise=0.0), Fails(after=10**6)
    loop = CommandLoop(arm, Driver(PANDA, TORQUE, truth().level), adapter=fails)
    loop.place(PANDA.q_home)
    with pytest.raises(ArmStopped):
        run(loop, None)
    assert fails.cycles < 1000


@pytest.mark.parametrize(
    ("rate", "seconds", "why"), [(500, 6, ""), (125, 6, "200 Hz, got 125 Hz"), (500, 3, "5 s of")]
)
def test_the_recordings_of_a_calibration_are_read_as_its_config_says(tmp_path, capsys, rate, seconds, why):
    """Named columns, joints in the order of the list; one too slow or too short is left out with a line."""
    t, joints = np.arange(0, seconds, 1 / rate), [f"arm_{name}" for name in "gfedcba"]
    q = PANDA.q_home + 0.2 * np.sin(t[:, None] + np.arange(7))
    table = {"time": t} | {f"q_{name}": q[:, j] for j, name in enumerate(joints)}
    table |= {f"tau_{name}": 1.0 + q[:, j] for j, name in enumerate(joints)}
    pd.DataFrame(table).to_csv(tmp_path / "log.csv", index=False)
    columns = {"t": "time"} | {x: [f"{x}_{name}" for name in joints] for x in ("q", "tau")} | {"dq": None}
    data = conf("data/recording") | {"path": str(tmp_path / "log.csv"), "torque": "commanded", "columns": columns}
    OmegaConf.save({"robot": OmegaConf.load(ROOT / "conf/robot/panda.yaml"), "data": data}, tmp_path / "config.yaml")
    free = free_recordings(tmp_path)
    assert len(free) == (not why)
    assert why in capsys.readouterr().out
    if free:
        np.testing.assert_allclose(free[0].q, q, atol=1e-9)
