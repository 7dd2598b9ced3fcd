"""A user's own ramps come from files of any format; what cannot be ramps of this arm is named in one line."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from test_breakaway import message, simulated, truth  # noqa: F401 (truth is a fixture)
from test_breakaway_by_hand import by_hand

from r2s.arm.ramp import ramp
from r2s.identification.checks import check_ramps
from r2s.identification.friction.breakaway import estimate_breakaway
from r2s.recordings.ramps import Ramps, read_ramps


def own_ramps(each=0.35, hz=500):
    """Return a user's columns: five ramps of three joints, t from 0 in each."""
    t = np.arange(0, each, 1 / hz)
    ramps = []
    for joint, sign in ((1, 1), (2, 1), (2, -1), (3, 1), (2, 1)):
        made = by_hand(t, 0.2, flip=sign, seed=joint)
        order = np.roll(np.arange(3), joint - 2)  # made of joint 2
        rows = {"t": made.t, "q": made.q[:, order], "dq": made.dq, "tau_J_d": made.tau[:, order]}
        ramps.append(rows | {"joint": np.full(len(made.t), joint), "sign": np.full(len(made.t), sign)})
    return {k: np.concatenate([r[k] for r in ramps]) for k in ramps[0]}


def in_file(path, columns):
    """Write the columns as a user would: .npz, or one column a joint."""
    if path.suffix == ".npz":
        np.savez(path, **columns)
        return path
    flat = {}
    for name, x in columns.items():
        flat |= {name: x} if x.ndim == 1 else {f"{name}{j + 1}": x[:, j] for j in range(x.shape[1])}
    frame = pd.DataFrame(flat)
    frame.to_csv(path, index=False) if path.suffix == ".csv" else frame.to_parquet(path)
    return path


@pytest.mark.long
@pytest.mark.parametrize("suffix", [".csv", ".npz", ".parquet"])
def test_ramps_of_a_users_own(tmp_path, suffix):
    """Columns of any format, with and without dq; the third ramp of joint 2 is its second repeat upwards."""
    columns = own_ramps()
    for some in (columns, {k: v for k, v in columns.items() if k != "dq"}):
        ramps = read_ramps(in_file(tmp_path / f"ramps{suffix}", some), n_joints=3)
        assert ramps.joint.tolist() == [0, 1, 1, 2, 1]
        assert ramps.sign.tolist() == [1, 1, -1, 1, 1]
        assert ramps.pose.tolist() == [0, 0, 0, 0, 1]
        np.testing.assert_allclose(estimate_breakaway(ramps).value, [0.4, 0.4, -0.4, 0.4, 0.4], atol=4e-3)


def test_joints_of_a_log_are_put_in_the_order_of_the_robot(tmp_path):
    """A file that names its joints may list them in any order; `joint` counts in the robot's order."""
    columns, names, order = own_ramps(), ["shoulder", "elbow", "wrist"], [1, 2, 0]
    mixed = {k: x[:, order] if x.ndim == 2 else x for k, x in columns.items()}
    path = in_file(tmp_path / "ramps.npz", mixed | {"joint_names": np.array(names)[order]})
    ramps = read_ramps(path, n_joints=3, model_joints=names)
    plain = read_ramps(in_file(tmp_path / "plain.npz", columns), n_joints=3, joints=names)  # names of a recording
    np.testing.assert_array_equal(ramps.recording.q, plain.recording.q)
    np.testing.assert_array_equal(ramps.recording.tau, plain.recording.tau)
    assert ramps.joint.tolist() == plain.joint.tolist()


def test_where_a_ramp_ends(tmp_path):
    """At a clock that starts anew, a trajectory, a pause; joint and sign may be given once per ramp."""
    columns = own_ramps()
    back = np.flatnonzero(np.diff(columns["t"]) < 0) + 1
    edges = [0, *back, len(columns["t"])]
    labels = {k: columns[k][edges[:-1]] for k in ("joint", "sign")}
    each = np.repeat(np.arange(5), np.diff(edges))
    one = {k: np.ones(len(each)) for k in ("joint", "sign")} | {
        k: np.concatenate([columns[k][: back[0]]] * 5) for k in ("q", "tau_J_d")
    }
    rows = np.tile(np.arange(back[0]), 5)
    clock = columns["t"][: back[0]]
    for change in (
        labels,
        labels | {"t": np.arange(len(each)) * 2e-3, "trajectory": 7 - each},
        {k: v[: len(rows)] for k, v in one.items()} | {"t": np.tile(clock, 5)},
        {k: v[: len(rows)] for k, v in one.items()} | {"t": np.concatenate([clock + 2 * k for k in range(5)])},
    ):
        some = {k: v for k, v in (columns | change).items() if k != "dq"}
        assert len(read_ramps(in_file(tmp_path / "ramps.npz", some)).joint) == 5


def test_a_joint_that_goes_before_its_command_rises_spoils_no_other_ramp(tmp_path):
    """It crept off under what held it: nothing contradicts its labels, and that ramp alone tells nothing."""
    columns = own_ramps()
    third = (columns["joint"] == 2) & (columns["sign"] == -1)
    t = columns["t"][third]
    columns["q"][third, 1] = -0.03 * t
    columns["tau_J_d"][third] = np.where(t < 0.3, 0.1, 0.1 + 0.2 * np.sin(50 * t))[:, None]  # then it is braked
    found = estimate_breakaway(read_ramps(in_file(tmp_path / "ramps.npz", columns), n_joints=3))
    assert np.flatnonzero(np.isnan(found.value)).tolist() == [
        np.flatnonzero((found.joint == 1) & (found.sign < 0))[0]
    ]
    np.testing.assert_allclose(found.value[[0, 1, 3, 4]], 0.4, atol=4e-3)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda c: {k: v for k, v in c.items() if k != "joint"}, "no column 'joint': ramps need 'joint' (from 1)"),
        (lambda c: {k: v for k, v in c.items() if k != "sign"} | {"sgn": c["sign"]}, "did you mean 'sgn'?"),
        (lambda c: {k: v for k, v in c.items() if k != "tau_J_d"} | {"tau_J": c["tau_J_d"]}, "tau_J is measured"),
        (lambda c: c | {"joint": c["joint"] - 1}, "expected joint 1 to 3, got 0 (ramp 1)"),
        (lambda c: c | {"joint": c["joint"] + 1}, "expected joint 1 to 3, got 4 (ramp 4)"),
        (lambda c: c | {"joint": 4 - c["joint"]}, "expected a rising command of joint 3, got a change of joint 1"),
        (lambda c: c | {"joint": c["joint"] + 0.5}, "expected joint 1 to 3, got 1.5 (ramp 1)"),
        (lambda c: c | {"sign": 2 * c["sign"]}, "expected sign -1 or 1, got 2 (ramp 0)"),
        (lambda c: c | {"sign": -c["sign"]}, "expected a falling command of joint 1, got the opposite"),
        (lambda c: c | {"sign": c["sign"][:9]}, "sign: expected 765 values (rows) or 5 (ramps), got (9,)"),
        (lambda c: c | {"t": 1e3 * c["t"]}, "t must be in seconds"),
        (
            lambda c: c | {"q": c["q"][:, :2], "tau_J_d": c["tau_J_d"][:, :2], "dq": c["dq"][:, :2]},
            "q: expected 3 joints, got 2",
        ),
    ],
)
def test_a_wrong_file_of_ramps_gets_one_line(tmp_path, change, said):
    path = in_file(tmp_path / "ramps.npz", change(own_ramps()))
    text = message(read_ramps, path, n_joints=3)
    assert text.startswith(str(path))
    assert said in text


def test_ramps_of_another_arm_or_in_other_units_are_refused(panda):
    motion = by_hand(np.arange(0, 0.4, 1e-3), 0.2)
    assert "the ramps: expected 7 joints of panda, got 3" in message(check_ramps, panda, Ramps(motion, 1, 1))
    at_home = {"q": panda.q_home + np.zeros((len(motion.t), 7)), "dq": np.zeros((len(motion.t), 7))}
    tau = np.zeros((len(motion.t), 7))
    tau[:, 3] = 1e3 * np.linspace(0, 0.8, len(tau))
    ramps = Ramps(replace(motion, **at_home, tau=tau), 3, 1)
    assert "command of joint 4 reaches 800 Nm, panda has at most 87; is it in mNm?" in message(
        check_ramps, panda, ramps
    )
    turned = Ramps(replace(motion, **at_home | {"q": np.degrees(at_home["q"])}, tau=1e-3 * tau), 3, 1)
    assert "degrees?" in message(check_ramps, panda, turned)


def test_bad_input_is_named_in_one_line(panda, truth):  # noqa: F811
    motion = by_hand(np.arange(0, 0.4, 1e-3), 0.2)
    assert "expected torque=commanded (a sensor does not show stiction), got measured" in message(
        Ramps, replace(motion, torque="measured"), 1, 1
    )
    assert "expected joint 0 to 2, got 3 (ramp 0)" in message(Ramps, motion, 3, 1)
    assert "expected sign -1 or 1, got 0 (ramp 0)" in message(Ramps, motion, 1, 0)
    assert "expected 1 values of joint, one per trajectory, got (2,)" in message(Ramps, motion, [1, 1], 1)
    ramps = Ramps(motion, 1, 1)
    assert "breakaway: delay: " in message(estimate_breakaway, ramps, delay=-0.1)
    assert "breakaway: lag: " in message(estimate_breakaway, ramps, lag=np.nan)
    arm, home = simulated(panda, truth), panda.q_home
    assert "pose 2 at 2.85 rad, allowed -2.7473 to 2.7473" in message(ramp, arm, [home, [2.85, *home[1:]]])
    assert "expected 7 joints, got shape (1, 3)" in message(ramp, arm, [home[:3]])
    assert "expected rows of 7 joint angles" in message(ramp, arm, [home, home[:3]])
    assert "rate of joint 2 is -1, allowed above 0" in message(ramp, arm, [home], rate=[1, -1, 1, 1, 1, 1, 1])
    assert "ramp.rate: expected 7 values, for 7 joints, got 3" in message(ramp, arm, [home], rate=[1, 1, 1])
    assert "largest of joint 5 is 20, allowed above 0 and up to 12" in message(ramp, arm, [home], largest=20)
    assert arm.cycles == 0
