"""Ramps on an arm of known truth give its dead zone back; on a twin, what its friction lets go at."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from conftest import conf
from scipy.stats import t as student

from r2s.arm.interface import ArmStopped
from r2s.arm.ramp import POSE_MARGIN, ramp
from r2s.arm.simulated import SimulatedArm
from r2s.arm.twins import lugre_joints as lj
from r2s.arm.twins.rigid_twin import RigidTwin
from r2s.errors import UserError
from r2s.identification.checks import check_ramps
from r2s.identification.friction.breakaway import Breakaway, Slide, estimate_breakaway
from r2s.identification.friction.repeatability import REPEATS, certainty
from r2s.physics.dynamics import nominal_dynamics
from r2s.recordings.ramps import Ramps, read_ramps
from r2s.recordings.readers import read
from r2s.recordings.recording import Recording

ELSEWHERE = np.array([0.4, 0.3, -0.4, 0.4, 0.5, 0.4, -0.5])  # rad from home


def message(call, *args, **kwargs):
    with pytest.raises(UserError) as caught:
        call(*args, **kwargs)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.fixture(scope="module")
def truth(panda):
    return nominal_dynamics(panda, **conf("friction/paper"), inertia_scale=conf("inertia/paper")["scale"])


@pytest.fixture(scope="module")
def poses(panda):
    return np.array([panda.q_home, panda.q_home + ELSEWHERE])


class Watched:
    """An arm whose torques come some cycles late; it keeps the time and how far it went."""

    def __init__(self, arm, late=0):
        self.arm, self.robot, self.late = arm, arm.robot, late
        self.cycles, self.far = 0, 0.0

    def move_to(self, q):  # noqa: D102
        self.pose, self.line = np.asarray(q), [np.zeros(self.robot.n)] * (self.late + 1)
        self.arm.move_to(q)
        return self.read()

    def read(self):  # noqa: D102
        return replace(self.arm.read(), tau_J_d=self.line[-1])

    def command(self, tau):  # noqa: D102
        self.line = [*self.line[1:], np.array(tau)]
        self.cycles += 1
        self.arm.command(self.line[0])
        self.far = max(self.far, np.abs(self.arm.read().q - self.pose).max())

    def stop(self):  # noqa: D102
        self.arm.stop()


def simulated(panda, dynamics, seed=0, late=0):
    return Watched(SimulatedArm(panda, dynamics, position_noise=2e-5, velocity_noise=3e-3, seed=seed), late)


def assert_edges(found, truth):
    error = np.abs(found.command + truth.offset[:, None] - truth.breakaway)
    allowed = np.maximum(0.02 * np.abs(truth.breakaway), 0.01)
    assert (error <= allowed).all(), f"{1e3 * error} mNm"


@pytest.fixture(scope="module")
def recorded(panda, truth, poses):
    arm = simulated(panda, truth)
    return ramp(arm, poses), arm


# --- an arm of known truth


@pytest.mark.long
def test_the_dead_zone_of_the_paper_is_found(recorded, truth):
    """All 14 edges of Table II within 2 % or 0.01 Nm, at two poses; repeatable, and fitted down to the noise."""
    found = estimate_breakaway(recorded[0])
    assert not np.isnan(found.value).any()
    assert_edges(found, truth)
    assert (found.count == 2).all()
    assert (found.spread < 0.025).all()
    assert found.misfit.max() < 4e-5


@pytest.mark.long
def test_a_late_torque_is_allowed_for(panda, truth, poses):
    """Commands that act 3 ms late shift every edge outwards by 3 ms of ramp, unless `delay` says so."""
    ramps = ramp(simulated(panda, truth, seed=1, late=3), poses)
    found = estimate_breakaway(ramps, delay=3e-3)
    assert_edges(found, truth)
    rate = np.where(panda.tau_max > 40, 2.2, 4.0)[:, None]
    shift = (estimate_breakaway(ramps).command - found.command) * [-1, 1]
    # a fit places a release anywhere within `resolution`, so a mean of fits is off by half of it at most
    assert (np.abs(shift - 3e-3 * rate) <= 0.5 * found.resolution).all()
    lagged = (estimate_breakaway(ramps, lag=3e-3).command - found.command) * [
        -1,
        1,
    ]
    np.testing.assert_allclose(lagged, 0, atol=4e-3)


def test_the_protocol_is_short_gentle_and_complete(recorded, panda, poses):
    """About 5 s a pose, never near the margin; each ramp pushes one joint one way, slowly, from 0, after a rest."""
    ramps, arm = recorded
    assert arm.cycles * 1e-3 / len(poses) < 5.6
    assert arm.far < 0.5 * POSE_MARGIN
    kinds = set(zip(ramps.pose.tolist(), ramps.joint.tolist(), ramps.sign.tolist(), strict=True))
    assert kinds == {(p, j, s) for p in range(2) for j in range(7) for s in (-1, 1)}
    assert len(ramps.recording.stretches) == len(ramps.joint) == 28
    for rows, j, sign in zip(ramps.recording.stretches, ramps.joint, ramps.sign, strict=True):
        tau = ramps.recording.tau[rows]
        pushed = sign * tau[:, j]
        assert not np.delete(tau, j, axis=1).any()
        assert not pushed[:10].any()
        assert (np.diff(pushed[10:]) > 0).all()
        assert np.diff(pushed).max() < 5e-3
        assert sign * (ramps.recording.q[rows.stop - 1, j] - ramps.recording.q[rows.start, j]) > 5e-3


@pytest.mark.long
def test_a_joint_that_does_not_move_or_does_not_rest_leaves_the_others_alone(panda, truth):
    """Joint 5 is held by more than is tried; joint 7 slides without command, and is ramped from what stops it."""
    breaks, offset = truth.breakaway.copy(), truth.offset.copy()
    breaks[4], offset[6] = (-9.0, 9.0), 0.45
    arm = simulated(panda, replace(truth, breakaway=breaks, offset=offset))
    found = estimate_breakaway(ramp(arm, [panda.q_home], largest=np.where(panda.tau_max > 40, 3.0, 1.0)))
    assert arm.far < POSE_MARGIN
    assert list(found.unknown) == ["joint 5, negative", "joint 5, positive"]
    assert np.isnan(found.command[4]).all()
    rest = [0, 1, 2, 3, 5, 6]
    np.testing.assert_allclose((found.command + offset[:, None] - breaks)[rest], 0, atol=0.02)


def test_an_arm_that_stops_says_so(panda, truth):
    """ArmStopped goes through, and the arm is stopped."""

    class Touchy(Watched):
        stops = 0

        def command(self, tau):
            if self.cycles == 300:
                raise ArmStopped("collision")
            super().command(tau)

        def stop(self):
            self.stops += 1

    arm = Touchy(SimulatedArm(panda, truth, position_noise=2e-5, velocity_noise=3e-3))
    with pytest.raises(ArmStopped, match="collision"):
        ramp(arm, [panda.q_home])
    assert arm.stops == 1


# --- the twin: another engine, bristles that creep by millirads before they let go


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, 1])
def test_the_twin_lets_go_where_its_friction_does(panda, poses, seed):
    """Level of the bristles at rest, less offset and drag: 15 % as a rule, and repeatable from pose to pose."""
    arm = RigidTwin(panda, seed)
    ramps = ramp(arm, poses)
    found = estimate_breakaway(ramps, delay=4e-3, lag=2e-3)
    assert not np.isnan(found.value).any()
    p = arm._hidden
    error = np.empty(len(ramps.joint))
    for k, (j, sign, pose) in enumerate(zip(ramps.joint, ramps.sign, poses[ramps.pose], strict=True)):
        nominal, true = arm._nominal.gravity_torque(pose), arm._engine.gravity_torque(pose)
        coulomb = p[lj.C_POS if sign > 0 else lj.C_NEG, j]
        level = p[lj.BREAK, j] * coulomb + p[lj.MU, j] * abs(nominal[j])
        left = nominal[j] - true[j] + p[lj.OFFSET, j] + lj.cable_drag(p, pose, j)
        error[k] = (sign * (found.value[k] + left) - level) / level
    assert np.sqrt(np.mean(error**2)) < 0.1
    assert np.mean(np.abs(error) < 0.15) > 0.8
    assert np.abs(error).max() < 0.35
    # what changes from pose to pose is the load's friction, cable drag and what gravity compensation leaves
    assert (found.spread < 0.3 * np.ptp(found.command, axis=1)[:, None]).all()
    assert (found.command[:, 0] < found.command[:, 1]).all()


# --- ramps made by hand


def by_hand(t, onset, creep=0.0, rate=2.0, far=0.012, noise=1e-5, seed=0, flip=1, wait=0.0):
    """One joint of three: it creeps as Dahl's until `onset` s, then accelerates by 2 + 6 (t - onset) rad/s^2."""
    since = np.maximum(t - onset, 0)
    x = 2 * since**2 / 2 + 6 * since**3 / 6
    left = np.maximum(onset - t, 1e-2)
    x += creep * (-np.log(left / onset) + np.maximum(t - onset + 1e-2, 0) / 1e-2)
    q = np.zeros((len(t), 3))
    q[:, 1] = 0.7 + flip * (x + noise * np.random.default_rng(seed).standard_normal(len(t)))
    tau = np.zeros((len(t), 3))
    tau[:, 1] = flip * rate * np.maximum(t - wait, 0)
    keep = x < far
    return Recording(t[keep], q[keep], np.zeros_like(q[keep]), tau[keep], "commanded")


@pytest.mark.long
@pytest.mark.parametrize("flip", [1, -1])
@pytest.mark.parametrize("hz", [250, 1000])
@pytest.mark.parametrize("onset", [0.06, 0.301])
def test_an_onset_that_is_known(onset, hz, flip):
    """No arm is needed: t, q, tau of any clock; what is seen 70 ms later is traced back to within 2 ms."""
    t = np.arange(0, 1, 1 / hz)
    t[1:] += 0.3 / hz * np.random.default_rng(1).uniform(-1, 1, len(t) - 1)
    # the ramp is smooth whatever the log's rate
    ramps = Ramps(replace(by_hand(t, onset, flip=flip), command_period=1e-3), joint=1, sign=flip)
    found = estimate_breakaway(ramps)
    assert found.value[0] == pytest.approx(flip * 2 * onset, abs=4e-3)
    assert found.count.tolist() == [[0, 0], [int(flip < 0), int(flip > 0)], [0, 0]]
    early = estimate_breakaway(ramps, delay=10e-3)
    assert flip * (found.value[0] - early.value[0]) == pytest.approx(0.02, abs=2e-3)


def test_creep_is_not_taken_for_letting_go():
    """2 mrad and more of creep over 0.6 s, faster and faster, shift the onset by a few percent of the ramp."""
    t = np.arange(0, 1.5, 1e-3)
    for creep in (2e-4, 5e-4):
        ramps = Ramps(by_hand(t, 0.6, creep), joint=1, sign=1)
        x = ramps.recording.q[:, 1] - ramps.recording.q[0, 1]
        assert t[np.argmax(x > 3e-4)] < 0.5  # where a threshold would see motion
        assert estimate_breakaway(ramps).value[0] == pytest.approx(1.2, rel=0.05)


def falling(U=0.9, level=0.6, viscous=0.3, fall=0.04, inertia=0.8, rate=0.15):
    """One joint whose friction falls from U to level over `fall` rad/s, by steps of 0.02 ms; and how it slides."""
    fine, every = 2e-5, 50
    u = np.maximum(np.arange(0.0, U / rate + 2.5, fine) - 0.5, 0.0) * rate
    v, x = 0.0, 0.0
    angles = []
    for now in u:
        if now > U:
            v += fine * (now - level - (U - level) * np.exp(-((v / fall) ** 2)) - viscous * v) / inertia
            x += fine * v
        angles.append(x)
        if x > 0.012:
            break
    seen = np.array(angles)[::every]
    seen = np.round((seen + 2e-5 * np.random.default_rng(3).standard_normal(len(seen))) / 2e-5) * 2e-5
    t, q = 1e-3 * np.arange(len(seen)), np.zeros((len(seen), 2))
    q[:, 1] = -seen
    tau = np.zeros_like(q)
    tau[:, 1] = -u[::every][: len(seen)]
    known = Slide(*(np.array([k]) for k in (1.05 / inertia, level, viscous, fall, 1.0)))
    return Ramps(Recording(t, q, 0 * q, tau, "commanded"), joint=1, sign=-1), known


@pytest.mark.long
def test_friction_that_falls_slowly_is_let_go_of_in_time_once_the_slide_is_known():
    """An inertia that is 5 % off does not matter; a slide that hardly falls is not taken."""
    ramps, known = falling()
    alone = estimate_breakaway(ramps)
    known = replace(known, misfit=alone.misfit)
    known_slide = estimate_breakaway(ramps, slide=known)
    assert -alone.value[0] > 0.9 + 2e-3
    assert -known_slide.value[0] == pytest.approx(0.9, abs=5e-4)
    for other in (replace(known, level=known.level + 0.29), replace(known, kappa=np.array([np.nan]))):
        assert estimate_breakaway(ramps, slide=other).value[0] == alone.value[0]


def test_what_does_not_move_is_listed_and_the_rest_survives():
    t = np.arange(0, 0.4, 1e-3)
    parts = [
        by_hand(t, 0.2),
        by_hand(t, 9.0),  # nothing moves
        by_hand(t, 0.25),  # labelled the wrong way
        by_hand(t, 0.21),
        by_hand(t, 0.02, wait=0.04),  # gone before the command rises
        by_hand(np.arange(0, 0.4, 0.025), 0.1, far=0.06),  # too few rows
    ]
    whole = {f: np.concatenate([getattr(p, f) for p in parts]) for f in ("t", "q", "dq", "tau")}
    labels = np.repeat(np.arange(6), [len(p.t) for p in parts])
    motion = Recording(**whole, torque="commanded", trajectory=labels)
    found = estimate_breakaway(Ramps(motion, 1, [1, 1, -1, 1, 1, 1], [0, 1, 2, 3, 4, 5]))
    assert np.flatnonzero(np.isnan(found.value)).tolist() == [1, 2, 4, 5]
    np.testing.assert_allclose(found.value[[0, 3]], [0.4, 0.42], atol=4e-3)
    assert found.count[1].tolist() == [0, 2]
    assert found.command[1, 1] == pytest.approx(0.41, abs=3e-3)
    assert found.spread[1, 1] == pytest.approx(0.02 / np.sqrt(2), abs=3e-3)
    assert np.isnan(found.command[0]).all()


# --- how sure it is


def seen(value):
    """Return what ramps with these results (n, 2, K) Nm, NaN where a joint did not let go, say."""
    n, _, repeats = value.shape
    joint, side, pose = (x.ravel() for x in np.meshgrid(*(range(k) for k in value.shape), indexing="ij"))
    count = (~np.isnan(value)).sum(-1)
    spread = np.full((n, 2), np.nan)
    spread[count > 1] = np.nanstd(value[count > 1], -1, ddof=1)
    command = np.where(count > 0, np.nansum(value, -1) / np.maximum(count, 1), np.nan)
    blank = np.zeros((n, 2))
    ramped = np.full((n, 2), repeats)
    return Breakaway(command, spread, count, ramped, blank, blank, value.ravel(), 0 * pose, joint, 2 * side - 1, pose)


@pytest.mark.parametrize(("repeats", "unequal"), [(2, 0.0), (2, 0.5), (2, 0.8), (3, 0.5), (5, 0.5)])
def test_intervals_of_repeated_ramps_hold_what_they_promise(panda, repeats, unequal):
    """95 % of the intervals about the mean of a few ramps hold the truth, also where joints scatter unequally."""
    rng, held = np.random.default_rng(0), []
    for _ in range(400):
        sigma = 1e-3 * panda.tau_max[:, None] * np.exp(unequal * rng.standard_normal((7, 2)))
        found = seen(1.0 + sigma[..., None] * rng.standard_normal((7, 2, repeats)))
        error, freedom = certainty(found, panda.tau_max)
        held.append(np.abs(found.command - 1.0) < student.ppf(0.975, freedom) * error)
    assert 0.94 < np.mean(held) < 0.99  # 5600 intervals: +- 0.003


def test_one_ramp_is_not_a_certainty(panda):
    """Without a repeat the width is the stated one; where only some joints were repeated, theirs in proportion."""
    once = seen(np.ones((7, 2, 1)))
    error, _ = certainty(once, panda.tau_max)
    np.testing.assert_allclose(error, np.repeat(REPEATS * panda.tau_max[:, None], 2, 1))
    value = np.full((7, 2, 2), np.nan)
    value[..., 0] = 1.0
    value[0] = [[0.9, 1.1], [0.9, 1.1]]
    value[6, 1] = np.nan
    error, freedom = certainty(seen(value), panda.tau_max)
    assert np.isnan(error[6, 1])
    spread = 0.2 / np.sqrt(2)
    np.testing.assert_allclose(error[:4, 0], spread / np.sqrt([2, 1, 1, 1]))
    np.testing.assert_allclose(error[4, 0], spread * panda.tau_max[4] / panda.tau_max[0])
    assert freedom[:2, 0].tolist() == [3, 2]
    same = certainty(replace(seen(np.ones((7, 2, 2))), resolution=np.full((7, 2), 3e-3)), panda.tau_max)
    np.testing.assert_allclose(same.sigma, 3e-3 / np.sqrt(2))  # ramps that agree are as good as their fit


# --- files and mistakes


def test_ramps_come_back_as_they_were(recorded, tmp_path):
    ramps, path = recorded[0], tmp_path / "ramps.npz"
    ramps.save(path)
    again = read_ramps(path)
    for field in ("joint", "sign", "pose"):
        np.testing.assert_array_equal(getattr(again, field), getattr(ramps, field))
    for field in ("t", "q", "dq", "tau", "trajectory"):
        np.testing.assert_array_equal(getattr(again.recording, field), getattr(ramps.recording, field))
        np.testing.assert_array_equal(getattr(read(path, torque="commanded"), field), getattr(ramps.recording, field))
    assert (again.recording.torque, again.recording.name) == ("commanded", ramps.recording.name)
    assert [p.name for p in tmp_path.iterdir()] == ["ramps.npz"]
    assert "ending in .npz, got 'ramps.csv'" in message(ramps.save, tmp_path / "ramps.csv")
    assert "no file" in message(read_ramps, tmp_path / "ramp.npz")
    ramps.recording.save(tmp_path / "plain.npz")
    (tmp_path / "noise.npz").write_bytes(b"\x00\x01" * 99)
    for name, said in (
        ("plain.npz", "no column 'joint': ramps need 'joint' (from 1)"),
        ("noise.npz", "expected an .npz archive"),
    ):
        assert said in message(read_ramps, tmp_path / name)


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


def test_bad_input_is_named_in_one_line(panda, truth):
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
