"""A recording in other units, of another sign or in another joint order is refused by name; what is right passes."""

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from conftest import REAL

from r2s.errors import UserError
from r2s.identification.checks import check_recording
from r2s.identification.unit_checks import check_units
from r2s.physics.robot import load_robot
from r2s.recordings.readers import read
from r2s.recordings.recording import Recording

DATA = Path(__file__).parents[2] / "shared/data"
ARMS = sorted((DATA / "independent_arms").glob("*/*n.npz"))  # train and validation
KINOVA = DATA / "kinova_gen3"
RATIO = [2.0, 2.2, 1.7, 2.6, 2.9, 2.3, 3.1]  # rad/s
SWING = [0.5, 0.4, 0.5, 0.4, 0.5, 0.5, 0.6]  # rad


def moved(robot, torque, seconds=8.0, still=(), load=0.0, friction=1.0, noise=1.0, seed=0):
    """Return a recording of sines about home: inverse dynamics, Coulomb and viscous friction, offsets, noise.

    A `load`, kg, in the hand is not in the nominal model: a command has its gravity torque, too.
    """
    t, n, rng = np.arange(0, seconds, 2e-3), robot.n, np.random.default_rng(seed)
    swing = np.array(SWING) * [j not in still for j in range(n)]
    phase = np.outer(t, RATIO) + np.arange(n)
    q = robot.q_home + swing * np.sin(phase)
    dq, ddq = swing * RATIO * np.cos(phase), -swing * np.square(RATIO) * np.sin(phase)
    tau = np.empty_like(q)
    nominal, true = robot.model(gravity=True), robot.model(gravity=True)
    hand = true.jnt_bodyid[-1]
    true.body_mass[hand] += load
    data = {id(m): mujoco.MjData(m) for m in (nominal, true)}
    for k in range(len(t)):
        needed = []
        for model, speed in ((true, 1.0), (nominal, 0.0)):
            d = data[id(model)]
            d.qpos, d.qvel, d.qacc = q[k], speed * dq[k], speed * ddq[k]
            mujoco.mj_inverse(model, d)
            needed.append(d.qfrc_inverse.copy())
        tau[k] = needed[0] - (needed[1] if torque == "commanded" else 0.0)
    level = friction * np.array([1.5, 1.2, 1.2, 1.2, 0.6, 0.5, 0.5])
    tau += level * (np.tanh(dq / 0.02) + 0.3 * dq) + 0.3 * level
    q, dq, tau = (x + noise * s * rng.standard_normal(x.shape) for x, s in ((q, 2e-5), (dq, 3e-3), (tau, 0.05)))
    return Recording(t, q, dq, tau, torque)


@pytest.fixture(scope="module")
def recordings(panda):
    return {torque: moved(panda, torque) for torque in ("measured", "commanded")}


def turned(x, order):
    return x[:, order]


SHIFT, SWAP = np.roll(np.arange(7), 1), np.array([0, 3, 2, 1, 4, 5, 6])
SIGNS = np.array([1, 1, -1, 1, 1, 1, 1])
MISTAKES = {
    "tau in mNm": (lambda r: {"tau": 1e3 * r.tau}, "is 1000 times what panda needs for this motion: mNm, not Nm?"),
    "tau in kNm": (lambda r: {"tau": 1e-3 * r.tau}, "is 0.001 times what panda needs for this motion: kNm"),
    "-tau": (lambda r: {"tau": -r.tau}, "has the other sign in all joints"),
    "-tau of one joint": (lambda r: {"tau": SIGNS * r.tau}, "has the other sign in joint 3: negated, it fits"),
    "tau shifted": (
        lambda r: {"tau": turned(r.tau, SHIFT)},
        "another order than q: columns 2, 3, 4, 5, 6, 7, 1 of tau fit joints 1, 2, 3, 4, 5, 6, 7",
    ),
    "tau of two joints": (lambda r: {"tau": turned(r.tau, SWAP)}, "columns 4, 2 of tau fit joints 2, 4"),
    "dq in deg/s": (lambda r: {"dq": np.degrees(r.dq)}, "is 57.3 times the slope of its q: deg/s, not rad/s?"),
    "dq in mrad/s": (lambda r: {"dq": 1e3 * r.dq}, "is 1000 times the slope of its q: mrad/s, not rad/s?"),
    "dq of one joint in deg/s": (
        lambda r: {"dq": r.dq * np.where(SIGNS < 0, 57.3, 1.0)},
        "dq of joint 3 is 57.3 times the slope of its q",
    ),
    "q in degrees": (lambda r: {"q": np.degrees(r.q)}, "or degrees?"),
    "q in mrad, a little": (
        lambda r: {"q": r.q.mean(0) + 0.1 * (r.q - r.q.mean(0))},
        "is 10 times the slope of its q",
    ),
    "-dq of one joint": (
        lambda r: {"dq": SIGNS * r.dq},
        "dq of joint 3 is of the other sign than the slope of its q",
    ),
    "dq of nothing": (lambda r: {"dq": 0 * r.dq}, "dq of joints 1, 2, 3, 4, 5, 6, 7 is 0 rad/s in every row"),
    "dq of something else": (
        lambda r: {"dq": np.where(SIGNS < 0, np.sin(5.1 * r.t)[:, None], r.dq)},
        "dq of joint 3 does not follow the slope of its q",
    ),
    "dq shifted": (
        lambda r: {"dq": turned(r.dq, SHIFT)},
        "dq and q have their joints in another order: columns 2, 3, 4, 5, 6, 7, 1 of dq",
    ),
}


@pytest.mark.long
@pytest.mark.parametrize("torque", ["measured", "commanded"])
@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_named(panda, recordings, torque, mistake):
    change, said = MISTAKES[mistake]
    r = recordings[torque]
    with pytest.raises(UserError) as caught:
        check_recording(panda, replace(r, **change(r)))
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith("the recording: ")
    assert said in str(caught.value)


def test_the_wrong_kind_of_torque_is_named(panda, recordings):
    """Gravity tells a sensor from a command."""
    measured, commanded = recordings["measured"], recordings["commanded"]
    with pytest.raises(UserError, match=r"commanded tau contains gravity \(\d+ % .*data.torque=measured"):
        check_units(panda, replace(measured, torque="commanded"))
    with pytest.raises(UserError, match=r"measured tau hardly contains gravity .*data.torque=commanded"):
        check_units(panda, replace(commanded, torque="measured"))


def test_all_columns_in_another_order_are_named(tmp_path):
    """An arm whose limits would allow it."""
    panda = load_robot(q_min=[-3.0] * 7, q_max=[3.5] * 7)
    r = moved(panda, "measured")
    order = np.roll(np.arange(7), -1)
    shuffled = {k: turned(getattr(r, k), order) for k in ("q", "dq", "tau")}
    with pytest.raises(
        UserError, match="and the motion fit panda only with the joints in another order: columns 7 1"
    ):
        check_recording(panda, replace(r, **shuffled))


def test_a_dead_sensor_is_named(panda, recordings):
    r = recordings["measured"]
    with pytest.raises(UserError, match="tau of joint 1 is 0 Nm in every row, though the joint moves"):
        check_units(panda, replace(r, tau=r.tau * [0, 1, 1, 1, 1, 1, 1]))
    over = replace(r, tau=r.tau * [1, 1, 1, 1, 1, 1, 700])
    with pytest.raises(UserError, match=r"reaches [\d.e+]+ Nm in joint 7, panda has at most 12"):
        check_units(panda, over)


@pytest.mark.parametrize(("field", "value"), [("dq", 1e308), ("tau", -1e200), ("dq", 60.0)])
def test_a_row_that_no_arm_has_is_named(panda, recordings, field, value):
    """A damaged file's: of the larger ones, squares are no numbers any more."""
    r = recordings["measured"]
    spoilt = getattr(r, field).copy()
    spoilt[1573, 4] = value
    with pytest.raises(UserError) as caught:
        check_recording(panda, replace(r, **{field: spoilt}))
    assert f"{field} of joint 5 is {value:.4g} " in str(caught.value)
    assert "at row 1573" in str(caught.value)


@pytest.mark.long
@pytest.mark.parametrize("torque", ["measured", "commanded"])
@pytest.mark.parametrize(
    "case",
    [
        {},
        {"seconds": 1.5},
        {"load": 2.0},
        {"friction": 3.0},
        {"friction": 0.0},
        {"noise": 5.0},
        {"still": (0, 1, 2, 4, 5, 6)},
        {"still": (0, 2, 3)},
    ],
)
def test_an_arm_that_is_only_wrongly_modelled_passes(panda, torque, case):
    """Loads, any friction, noise, short motion, joints that stand; sensors with gains of 0.7 and offsets of 5 %."""
    r = moved(panda, torque, **case)
    check_recording(panda, r)
    if torque == "measured":
        check_recording(panda, replace(r, tau=0.7 * r.tau + 0.05 * panda.tau_max))


@pytest.mark.skipif(not ARMS, reason="the independent arms are not here")
@pytest.mark.parametrize("path", ARMS, ids=lambda p: f"{p.parent.name}-{p.stem}")
def test_arms_of_another_simulator_pass(panda, path):
    check_recording(panda, read(path, torque="commanded", n_joints=7))


@pytest.mark.skipif(not REAL.is_file(), reason=f"the real recording is not here: {REAL}")
def test_a_real_panda_passes(panda):
    r = read(REAL, torque="measured", columns={"trajectory": "segment"}, n_joints=7)
    check_recording(panda, r)
    for k in range(4):  # and any two seconds of it
        check_recording(panda, r.select((r.t > r.t[0] + 1.1 * k) & (r.t < r.t[0] + 1.1 * k + 2.0)))


@pytest.mark.skipif(not KINOVA.is_dir(), reason=f"the recordings of a Kinova are not here: {KINOVA}")
def test_a_real_kinova_passes_but_for_the_recording_without_a_sensor():
    """Gains of 0.76 to 1, offsets of 2 Nm and a load pass; where a sensor is dead its joint is named."""
    gen3 = load_robot(str(KINOVA / "model.xml"))
    for name in ("optitraj1", "optitraj2"):
        check_recording(gen3, read(KINOVA / f"{name}.npz", torque="measured", n_joints=7))
    with pytest.raises(UserError, match="tau of joint 1 is 0 Nm in every row"):
        check_recording(gen3, read(KINOVA / "runtraj1.npz", torque="measured", n_joints=7))
