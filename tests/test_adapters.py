"""Adapters: nothing where the arm equals its model, what lacks where it does not, and always through the law."""

import pickle
from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
from conftest import conf
from omegaconf import OmegaConf

from r2s.adaptation.adapters import Known, history, observer, rls
from r2s.adaptation.balance import SPAN, Balance
from r2s.adaptation.believed import believed
from r2s.adaptation.compensation import RATE_S, thing, weigh
from r2s.adaptation.history import SPANS, History, Network, Seen, inputs
from r2s.adaptation.kalman import BODY, Filter
from r2s.adaptation.network_file import NETWORK, load_network, save_network
from r2s.adaptation.noise import noise_of
from r2s.adaptation.observer import Observer
from r2s.arm.driven import Driven
from r2s.arm.driver import ADDED, DEADLINE_S, Driver, Drivers
from r2s.arm.interface import ArmStopped, Reflexes
from r2s.arm.live import LiveArm
from r2s.arm.simulated import SimulatedArm
from r2s.errors import UserError
from r2s.learning.history import Lessons, fit
from r2s.physics.dynamics import nominal_dynamics
from r2s.physics.payload import FARTHEST_M, MOST_KG, loaded, payload_of
from r2s.physics.robot import SIM_DT, load_robot
from r2s.stages.adapting import make_adapter
from r2s.tasks.model_torque import ModelTorque
from r2s.tasks.reach import ReachTask
from r2s.typed import check_overrides

THING = payload_of({"mass": 1.0, "centre": [0.02, -0.01, 0.05]})
PANDA = load_robot(**conf("robot/panda"))
TORQUE = 0.3 * PANDA.tau_max
SPRING = np.array([60, 120, 60, 60, 10, 10, 5.0])
FILTER_S = conf("adapt/observer")["filter_s"]
MAKES = partial(observer, filter_s=FILTER_S), rls


@cache
def truth():
    """Return friction without a dead zone, which no model hides anything behind, and a delay."""
    found = nominal_dynamics(PANDA, **conf("friction/paper"))
    return replace(found, delay=3e-3, lag=1e-3, breakaway=np.zeros((7, 2)), offset=np.zeros(7))


@cache
def known():
    return Known(PANDA, truth())


class Heard:
    """An adapter that remembers what another says."""

    def __init__(self, adapter):
        self.adapter, self.added = adapter, []

    def begin(self):  # noqa: D102
        self.adapter.begin()

    def __call__(self, q, dq, tau):  # noqa: D102
        self.added.append(np.array(self.adapter(q, dq, tau)))
        return self.added[-1]


def swing(adapter, *, seconds=2.0, rate=1.0, payload=None, push=0.0, noise=0.0):
    """Return q, dq, commands (T, 7) of an arm of known truth, swinging on a spring, with the adapter at work."""
    arm = SimulatedArm(
        PANDA, truth(), position_noise=1e-2 * noise, velocity_noise=noise, payload=payload and replace(payload)
    )
    arm.external[1] = push
    driven = Driven(arm, Driver(PANDA, TORQUE, truth().level), adapter=adapter)
    driven.place(PANDA.q_home)
    rows, phase = [], np.arange(7.0)
    for k in range(round(seconds / SIM_DT)):
        s, t = driven.state, k * SIM_DT
        goal = PANDA.q_home + 0.4 * np.sin(rate * t + phase) * np.sin(0.5 * rate * t) ** 2
        driven(SPRING * (goal - s.q) - 0.15 * SPRING * s.dq)
        rows.append((s.q, s.dq, driven.sent))
    return (np.array(x) for x in zip(*rows, strict=True))


@pytest.mark.parametrize("make", MAKES)
def test_an_adapter_on_an_arm_that_equals_its_model_changes_nothing(make):
    """To 1e-3 Nm, in calm motion: a step of 1 ms is wrong by half of what the torque changes by in it."""
    heard = Heard(make(known()))
    _, dq, _ = swing(heard, rate=0.6, seconds=2.5)
    assert np.abs(dq).max() > 0.05  # it does move
    assert np.abs(heard.added).max() < 1e-3


def test_the_observer_adds_what_a_push_takes():
    """Through a low-pass of its constant: after 8 of them within 1e-3 of a constant push, and of nothing else."""
    heard = Heard(observer(known(), FILTER_S))
    swing(heard, push=-3.0, seconds=1.5)
    lacks = np.array(heard.added)[-500:]
    assert abs(lacks[:, 1].mean() - 3.0) < 0.05
    assert np.abs(np.delete(lacks, 1, axis=1)).max() < 0.05


@pytest.mark.parametrize(("make", "late"), zip(MAKES, (FILTER_S + SPAN * SIM_DT, RATE_S), strict=True))
def test_a_payload_s_torque_is_added(make, late):
    """What an arm with the payload needs more for the same motion, a second after it was put on.

    As late as the low-passes are, and but for a tenth, of noise and of what is not sure.
    """
    heard = Heard(make(known()))
    q, dq, _ = swing(heard, payload=THING, seconds=2.0, rate=3.0, noise=1e-3)
    heavy = ModelTorque(PANDA, loaded(PANDA, truth(), THING))
    kernel = np.ones(100) / 100  # accelerations have noise
    ddq = np.apply_along_axis(np.convolve, 0, np.gradient(dq, SIM_DT, axis=0), kernel, "same")
    more = heavy.rigid(q, dq, ddq) - ModelTorque(PANDA, truth()).rigid(q, dq, ddq)
    now = slice(1000, -100)
    rms = lambda x: np.sqrt((x[now] ** 2).mean())  # noqa: E731
    assert rms(more[:, 1]) > 2.0
    assert rms(np.array(heard.added) - more) < late * rms(np.gradient(more, SIM_DT, axis=0)) + 0.1 * rms(more)


def test_a_new_estimate_comes_in_over_a_span():
    """What is told of a payload steps when it is seen; what is added does not: a low-pass is between them."""
    adapter, told = rls(known()), []

    class Asked(Heard):
        def __call__(self, q, dq, tau):
            added = super().__call__(q, dq, tau)
            told.append(adapter._says.copy())
            return added

    heard = Asked(adapter)
    swing(heard, payload=replace(THING, on_s=0.7), seconds=1.2, rate=3.0)
    steps = [np.abs(np.diff(x, axis=0)).max() for x in (told, heard.added)]
    assert steps[0] > 1.0  # Nm
    assert steps[1] < 2 / SPAN * steps[0]  # 1 / SPAN of the step, and as much again that the motion asks for


def test_what_holds_an_arm_at_rest_is_left_to_hold_it():
    """A command within the edges that moves nothing says nothing of what lacks; beyond them it is what is beyond."""
    arm = believed(PANDA, truth())._replace(edge=np.ones(7))
    adapter, still = Observer(arm, FILTER_S), np.zeros(7)
    for _ in range(1000):
        added = adapter(PANDA.q_home, still, np.full(7, 0.9))
    assert not added.any()
    for _ in range(1000):
        added = adapter(PANDA.q_home, still, np.full(7, 1.5))
    np.testing.assert_allclose(added, 0.5, atol=1e-3)


def test_nothing_is_added_of_what_is_not_known():
    """As much as one standard deviation is nothing; the better it is known, the more of it is added, up to all."""
    added = []
    for share in (3.0, 1.0, 0.3, 0.01):
        prior = noise_of(known().arm)
        start, sigma = prior.start.copy(), prior.prior.copy()
        start[0], sigma[:] = 1.0, 1e-9
        sigma[0] = share
        noise = prior._replace(start=start, prior=sigma, creeping=0.0, resting=0.0)
        balance, weight = Balance.empty(7), np.zeros(7)
        balance.payload[:, 0] = [0.0, 5, 1, 3, 0, 1, 0]
        weigh(Filter.fresh(noise), balance, np.eye(BODY)[0], weight)
        added.append(weight[1])
    assert added[0] == added[1] == 0.0
    np.testing.assert_allclose(added[2:], [1 - 0.3**2, 1 - 0.01**2])


def test_a_payload_that_is_compensated_may_be_in_a_hand():
    """Whatever is estimated: a mass up to the most, a centre within reach of the hand, a body that exists."""
    rng, out = np.random.default_rng(0), np.zeros(BODY)
    for _ in range(100):
        x = rng.normal(size=10) * [2, *[0.3] * 3, *[0.1] * 6]
        thing(x, out)
        assert 0.0 <= out[0] <= MOST_KG
        assert np.linalg.norm(out[1:4]) <= out[0] * FARTHEST_M * (1 + 1e-12)
        xx, yy, zz, xy, xz, yz = out[4:]
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        second = 0.5 * np.trace(tensor) * np.eye(3) - tensor
        j = np.block([[second, out[1:4, None]], [out[None, 1:4], out[None, :1]]])
        assert np.linalg.eigvalsh(j).min() > -1e-12


def test_without_an_adapter_and_with_one_that_adds_nothing_every_bit_is_the_same():
    rng, m = np.random.default_rng(1), 50
    one, two = (Drivers(PANDA, TORQUE, m, friction=truth().level, soft_start_s=0.02) for _ in range(2))
    sent = np.zeros((m, 7))
    for k in range(60):
        q = rng.uniform(PANDA.q_min, PANDA.q_max, (m, 7))
        dq, target = PANDA.dq_max * rng.normal(size=(m, 7)), rng.normal(size=(m, 7)) * TORQUE
        target = target if k % 10 == 0 else None
        first, second = one(q, dq, sent, target), two(q, dq, sent, target, np.zeros((m, 7)))
        assert np.array_equal(first, second)
        sent = first


def test_whatever_an_adapter_adds_the_arm_takes():
    """Hostile torques too; up to ADDED of tau_max is added, and what is not finite stops the arm as silence does."""
    rng, m = np.random.default_rng(2), 200
    drivers, reflexes = Drivers(PANDA, TORQUE, m, friction=truth().level), Reflexes(PANDA)
    sent = np.zeros((m, 7))
    for _ in range(50):
        q, dq = rng.uniform(PANDA.q_min, PANDA.q_max, (m, 7)), PANDA.dq_max * rng.normal(size=(m, 7))
        added = rng.choice([0, 1, -1e9, 1e9, np.inf, np.nan], (m, 7))
        now = drivers(q, dq, sent, rng.normal(size=(m, 7)) * TORQUE, added)
        assert reflexes.takes(now, sent).all()
        sent = now
    quiet = Driver(PANDA, TORQUE, truth().level)
    state = SimulatedArm(PANDA, truth(), position_noise=0.0, velocity_noise=0.0).read()
    for _ in range(400):
        tau = quiet(state, np.zeros(7), np.full(7, 1e9) * (np.arange(7) == 1))
        state = replace(state, tau_J_d=tau)
    assert tau[1] == pytest.approx(ADDED * PANDA.tau_max[1])
    for _ in range(round(DEADLINE_S / SIM_DT) + 2):
        quiet(state, np.zeros(7), np.full(7, np.nan))
    assert quiet.stopping == "no finite action for 50 ms"


class Fails:
    """An adapter that does not go on."""

    def __init__(self, error=ZeroDivisionError, after=300):
        self.error, self.after = error, after

    def begin(self):  # noqa: D102
        self.heard = 0

    def __call__(self, q, dq, tau):  # noqa: D102
        self.heard += 1
        if self.heard > self.after:
            raise self.error("no more")
        return np.full(7, 0.3)


def on(driven, target):
    """Go on for a second."""
    for _ in range(1000):
        driven(target)


def test_an_adapter_that_raises_ends_as_a_policy_that_raises():
    """Its exception goes on, with the arm at rest before; and the next motion has an adapter again."""
    arm, fails = SimulatedArm(PANDA, truth(), position_noise=0.0, velocity_noise=0.0), Fails()
    driven = Driven(arm, Driver(PANDA, TORQUE, truth().level), adapter=fails)
    for _ in range(2):
        driven.place(PANDA.q_home)
        with pytest.raises(ZeroDivisionError):
            on(driven, 0.5 * TORQUE)
        assert fails.heard == fails.after + 1
        assert np.abs(driven.state.dq).max() < 0.05
    wrong = Driven(arm, Driver(PANDA, TORQUE, truth().level), adapter=Heard(lambda q, dq, tau: np.zeros(6)))
    wrong._adapter.begin = lambda: None
    wrong.place(PANDA.q_home)
    with pytest.raises(ValueError, match=r"an adapter of 7 joints returned \(6,\)"):
        wrong(None)


def test_a_motion_begins_as_if_nothing_had_been_heard():
    """And what goes to another process is the same there."""
    for make in MAKES:
        adapter, first = make(known()), []
        for again in (adapter, adapter, pickle.loads(pickle.dumps(make(known())))):
            again.begin()
            said = [again(PANDA.q_home + 2e-4 * k, np.full(7, 0.2), np.full(7, 4.0)).copy() for k in range(200)]
            first = first or said
            assert np.array_equal(first, said)
            assert np.any(said)


def test_what_an_adapter_lacks_is_said_in_one_line(tmp_path):
    (tmp_path / "config.yaml").write_text("calibration: null\n")
    arm = {"name": "twin"}
    cfg = OmegaConf.create({"adapt": {"name": "none"}, "arm": arm})
    assert make_adapter(cfg, PANDA, tmp_path) is None
    cfg.adapt = conf("adapt/rls") | {"_target_": "r2s.adaptation.adapters.rls"}
    with pytest.raises(UserError, match=r"^adapt=rls: the policy of .* has no identified model; give adapt\.calibr"):
        make_adapter(cfg, PANDA, tmp_path)
    with pytest.raises(UserError, match=r"^adapt=rls: an adapter acts on an arm"):
        make_adapter(OmegaConf.merge(cfg, {"arm": {"name": "none"}}), PANDA, tmp_path)
    cfg.adapt.calibration = str(tmp_path)
    with pytest.raises(UserError, match=r"^adapt\.calibration: '.*' is no run folder of stage=identify"):
        make_adapter(cfg, PANDA, tmp_path)
    (tmp_path / "parameters.yaml").write_text("source: {torque: measured}\n")
    with pytest.raises(UserError, match=r"^adapt=rls: .* was identified from measured torque"):
        make_adapter(cfg, PANDA, tmp_path)
    with pytest.raises(UserError, match=r"^adapt: no option 'obsever'; allowed: .* did you mean 'observer'"):
        check_overrides(["stage=transfer", "adapt=obsever"], None)
    with pytest.raises(UserError, match=r"^adapt: stage=train does not read it: adapters work on an arm"):
        check_overrides(["adapt=observer"], None)
    with pytest.raises(UserError, match=r"filter_s"):
        observer(known(), 0.0)


def test_the_history_s_network_is_shown_what_lacks():
    """One that says the last span's balance adds what a push takes; one that says nothing adds nothing."""
    n, seen = 7, Seen(known().arm)
    while (shown := seen(PANDA.q_home, np.zeros(n), np.zeros(n))) is None:
        pass
    d = len(shown)
    last = np.zeros((d, n))
    last[(SPANS - 1) * n : SPANS * n] = np.diag(known().arm.level)
    says = Network(np.zeros(d), np.ones(d), np.ones(n), (last, np.zeros(n)))
    heard = Heard(History(known().arm, says))
    swing(heard, push=-3.0, seconds=1.5)
    assert abs(np.array(heard.added)[-500:, 1].mean() - 3.0) < 0.05
    mute = Heard(History(known().arm, says._replace(size=np.zeros(n))))
    swing(mute, push=-3.0, seconds=0.1)
    assert not np.any(mute.added)


def test_a_network_is_kept_for_the_model_that_it_was_taught_for(tmp_path):
    rng = np.random.default_rng(0)
    d = inputs(7)
    layers = rng.normal(size=(d, 4)), rng.normal(size=4), rng.normal(size=(4, 7)), rng.normal(size=7)
    network = Network(rng.normal(size=d), np.ones(d), np.ones(7), layers)
    save_network(tmp_path / NETWORK, known().arm, network)
    kept, x = load_network(tmp_path / NETWORK, known().arm), rng.normal(size=d)
    assert np.array_equal(kept(x), network(x))
    with pytest.raises(UserError, match=r"was taught for another model; train it with this calibration="):
        load_network(tmp_path / NETWORK, believed(PANDA, nominal_dynamics(PANDA, **conf("friction/gaz2019"))))
    with np.load(tmp_path / NETWORK) as saved:
        np.savez(tmp_path / "old.npz", **{k: a for k, a in saved.items() if k != "hears"})
    with pytest.raises(UserError, match=r"was taught with other balances of momentum; train it again"):
        load_network(tmp_path / "old.npz", known().arm)
    good = (tmp_path / NETWORK).read_bytes()
    (tmp_path / NETWORK).write_bytes(good[: len(good) // 2])
    with pytest.raises(UserError, match=r"^network: .* cannot be read: "):
        load_network(tmp_path / NETWORK, known().arm)
    save_network(tmp_path / NETWORK, known().arm, network._replace(layers=layers[:2]))
    with pytest.raises(UserError, match=r"^network: .* cannot be read: "):
        load_network(tmp_path / NETWORK, known().arm)
    for wrong in (None, tmp_path / "nothing"):
        with pytest.raises(UserError, match=r"^network: '.*' is no run folder of stage=train adapt=history"):
            history(known(), wrong)
    with pytest.raises(UserError, match=r"dr\.payload: -1 is not allowed"):
        Lessons(payload=(-1, 1.5))


@pytest.mark.slow
def test_a_network_learns_what_there_is_to_learn():
    """A linear law, of arms that it was not taught with, and twice the same."""
    rng = np.random.default_rng(0)
    inputs = rng.normal(size=(30, 40, 6))
    lacks = inputs @ rng.normal(size=(6, 3)) * [1.0, 0.1, 5.0]
    (network, explained), (again, same) = (fit(inputs, lacks, Lessons(hidden=32, epochs=200), 0) for _ in range(2))
    assert explained > 0.95
    assert same == explained
    assert np.array_equal(network(inputs[0, 0]), again(inputs[0, 0]))


@pytest.mark.slow
def test_an_adapter_that_raises_in_the_arm_s_process_is_heard_of_here():
    task = ReachTask(**{k: v for k, v in conf("task/reach").items() if k in ("ctrl_hz", "episode_s")})
    opens = partial(SimulatedArm, PANDA, truth(), position_noise=0.0, velocity_noise=0.0)
    arms = LiveArm(opens, PANDA, task, truth().level, adapter=Fails(after=5))
    with pytest.raises(ZeroDivisionError, match="no more"), arms:
        live(arms)


def live(arms):
    """Go on for a second."""
    arms.place(PANDA.q_home[None], 0)
    for _ in range(50):
        arms.step(np.zeros((1, 7)))


def test_an_arm_that_stops_itself_stops_its_adapter_too():
    """No cycle is heard after the end."""
    arm, fails = SimulatedArm(PANDA, truth(), position_noise=0.0, velocity_noise=0.0), Fails(after=10**6)
    driven = Driven(arm, Driver(PANDA, TORQUE, truth().level), adapter=fails)
    driven.place(PANDA.q_home)
    with pytest.raises(ArmStopped):
        on(driven, None)
    assert fails.heard < 1000
