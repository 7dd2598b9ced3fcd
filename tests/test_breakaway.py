"""Ramps on an arm of known truth give its dead zone back; on a twin, what its friction lets go at."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import conf

from r2s.arm.interface import ArmStopped
from r2s.arm.ramp import POSE_MARGIN, ramp
from r2s.arm.simulated import SimulatedArm
from r2s.arm.twins import lugre_joints as lj
from r2s.arm.twins.rigid_twin import RigidTwin
from r2s.errors import UserError
from r2s.identification.friction.breakaway import estimate_breakaway
from r2s.physics.dynamics import nominal_dynamics
from r2s.recordings.ramps import read_ramps
from r2s.recordings.readers import read

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


def test_ramps_come_back_as_they_were(recorded, tmp_path):
    ramps, path = recorded[0], tmp_path / "ramps.npz"
    ramps = replace(ramps, recording=replace(ramps.recording, notes=("2 repeated rows are left out", "another note")))
    ramps.save(path)
    again = read_ramps(path)
    for field in ("joint", "sign", "pose"):
        np.testing.assert_array_equal(getattr(again, field), getattr(ramps, field))
    for field in ("t", "q", "dq", "tau", "trajectory"):
        np.testing.assert_array_equal(getattr(again.recording, field), getattr(ramps.recording, field))
        np.testing.assert_array_equal(getattr(read(path, torque="commanded"), field), getattr(ramps.recording, field))
    assert (again.recording.torque, again.recording.name) == ("commanded", ramps.recording.name)
    assert again.recording.notes == ramps.recording.notes
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
