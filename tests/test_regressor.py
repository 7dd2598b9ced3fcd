"""Torque is a product of a regressor and the links' standard parameters: MuJoCo's inverse dynamics, on any arm."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from r2s.identification.link_inertia import links
from r2s.physics.rigid_body import LinkInertia, joint_kinematics, regressor, rigid_body, tensor_elements
from r2s.physics.robot import load_robot

GRAVITY = np.array([0.0, 0.0, -9.81])  # m/s^2, an upright base


def numbers(values):
    return " ".join(f"{v:.12g}" for v in values)


def inertial(rng, size):
    """Return an MJCF inertial: mass, centre and tensor of eight random point masses."""
    points, m = size * rng.normal(size=(8, 3)), rng.uniform(0.05, 0.4, 8)
    com = m @ points / m.sum()
    p = points - com
    tensor = np.einsum("k,kij->ij", m, (p**2).sum(-1)[:, None, None] * np.eye(3) - p[:, :, None] * p[:, None])
    return f'<inertial pos="{numbers(com)}" mass="{m.sum():.12g}" fullinertia="{numbers(tensor_elements(tensor))}"/>'


def place(rng):
    return f'pos="{numbers(rng.uniform(-0.3, 0.3, 3))}" quat="{numbers(rng.normal(size=4))}"'


def random_arm(folder, seed, plain):
    """Return an arm of 2 to 6 joints: axes, frames and inertias any way, anchors off the body's origin.

    Unless `plain`, bodies are welded to links, with branches and between two joints, and joints have armature and
    damping.
    """
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 7))

    def welded():
        return f"<body {place(rng)}>{inertial(rng, 0.05)}<body {place(rng)}>{inertial(rng, 0.05)}</body></body>"

    inside = '<site name="tip"/>'
    for _ in range(n):
        extra = "" if plain else f'armature="{rng.uniform(0, 0.1):.12g}" damping="{rng.uniform(0, 0.5):.12g}"'
        joint = f'<joint axis="{numbers(rng.normal(size=3))}" pos="{numbers(rng.uniform(-0.1, 0.1, 3))}" {extra}/>'
        branch = "" if plain else welded()
        inside = f"<body {place(rng)}>{inertial(rng, 0.1)}{joint}{branch}{inside}</body>"
        if not plain and rng.random() < 0.5:  # a body between two joints
            inside = f"<body {place(rng)}>{inertial(rng, 0.05)}{inside}</body>"
    path = folder / "arm.xml"
    path.write_text(f'<mujoco><compiler angle="radian"/><worldbody>{inside}</worldbody></mujoco>')
    return load_robot(str(path), tau_max=[100.0] * n)


def motion(robot, seed, samples=12):
    """Return q, dq, ddq (T, n) within the limits."""
    rng = np.random.default_rng(seed)
    shape = (samples, robot.n)
    return rng.uniform(*robot.q_range, shape), rng.normal(size=shape), 5 * rng.normal(size=shape)


def inverse(model, q, dq, ddq):
    """Return (T, n) Nm by mj_inverse."""
    data, out = mujoco.MjData(model), np.empty_like(q)
    for t in range(len(q)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[t], dq[t], ddq[t]
        mujoco.mj_inverse(model, data)
        out[t] = data.qfrc_inverse
    return out


def nominal(robot):
    return LinkInertia(robot.mass, robot.com, robot.inertia).standard()


def torque(y, standard):
    return np.einsum("tjkc,kc->tj", y, standard)


@pytest.mark.parametrize("seed", range(6))
def test_the_regressor_is_mujocos_inverse_dynamics(tmp_path, seed):
    """On arms of nothing but links the product is mj_inverse to 1e-10: with gravity, without, with a tilted one."""
    robot = random_arm(tmp_path, seed, plain=True)
    q, dq, ddq = motion(robot, seed)
    still = robot.model(gravity=False)
    y = regressor(robot, q, dq, ddq)
    assert y.shape == (len(q), robot.n, robot.n, 10)
    np.testing.assert_allclose(torque(y, nominal(robot)), inverse(still, q, dq, ddq), rtol=0, atol=1e-10)
    for g in (GRAVITY, np.array([1.0, -2.0, 9.0])):
        model = robot.model(gravity=True)
        model.opt.gravity = g
        found = torque(regressor(robot, q, dq, ddq, g), nominal(robot))
        np.testing.assert_allclose(found, inverse(model, q, dq, ddq), rtol=0, atol=1e-10)


def test_the_panda_as_well(panda):
    """The embedded arm, with gravity: 1e-10, and nothing is left for the rest."""
    q, dq, ddq = motion(panda, 0)
    rest, y = rigid_body(panda, q, dq, ddq, GRAVITY)
    assert np.abs(rest).max() < 1e-10
    whole = inverse(panda.model(gravity=True), q, dq, ddq)
    np.testing.assert_allclose(torque(y, nominal(panda)), whole, rtol=0, atol=1e-10)


@pytest.mark.parametrize("gravity", [None, GRAVITY], ids=["compensated", "gravity"])
@pytest.mark.parametrize("seed", range(4))
def test_the_rest_is_what_no_link_of_a_joint_adds(tmp_path, seed, gravity):
    """With welded bodies, armature and damping: rest + regressor @ links is mj_inverse, whatever the links become."""
    robot = random_arm(tmp_path, seed, plain=False)
    q, dq, ddq = motion(robot, seed)
    rest, y = rigid_body(robot, q, dq, ddq, gravity)
    assert np.abs(rest).max() > 1e-3
    for theta in (np.zeros((robot.n, 10)), np.random.default_rng(seed).uniform(-0.5, 0.5, (robot.n, 10))):
        mass, com, inertia = links(robot, theta)
        model = robot.model(gravity=gravity is not None)
        for i, body in enumerate(model.jnt_bodyid):
            moments, axes = np.linalg.eigh(inertia[i])
            axes[:, 0] *= np.sign(np.linalg.det(axes))
            model.body_mass[body], model.body_ipos[body], model.body_inertia[body] = mass[i], com[i], moments
            mujoco.mju_mat2Quat(model.body_iquat[body], axes.ravel())
        expected = inverse(model, q, dq, ddq)
        np.testing.assert_allclose(rest + torque(y, LinkInertia(mass, com, inertia).standard()), expected, atol=1e-9)


def test_the_rest_does_not_know_the_joints_limits(tmp_path):
    """A recording that touches a limit is not pushed back: limits are no part of the rigid body."""
    robot = random_arm(tmp_path, 1, plain=True)
    q, dq, ddq = motion(robot, 1)
    tight = replace(robot, q_min=np.full(robot.n, -0.1), q_max=np.full(robot.n, 0.1))
    rest, _ = rigid_body(tight, q, dq, ddq)
    assert np.abs(rest).max() < 1e-9


def test_a_link_is_felt_by_the_joints_before_it(tmp_path):
    """The regressor is upper block triangular: no joint feels a link nearer to the base."""
    robot = random_arm(tmp_path, 3, plain=False)
    y = regressor(robot, *motion(robot, 3), GRAVITY)
    for joint in range(robot.n):
        assert not y[:, joint, :joint].any()
        assert np.abs(y[:, joint, joint:]).max() > 0


def test_the_power_of_the_links_is_the_change_of_their_energy(tmp_path):
    """Torque times velocity is d/dt of kinetic plus potential energy along a smooth motion."""
    robot = random_arm(tmp_path, 4, plain=True)
    w, h = np.random.default_rng(4).uniform(1, 3, robot.n), 1e-4
    t = h * np.arange(5)[:, None]
    q, dq, ddq = 0.5 * np.sin(w * t), 0.5 * w * np.cos(w * t), -0.5 * w**2 * np.sin(w * t)
    power = (torque(regressor(robot, q, dq, ddq, GRAVITY), nominal(robot)) * dq).sum(1)
    model = robot.model(gravity=True)
    model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    data, energy = mujoco.MjData(model), []
    for k in range(5):
        data.qpos[:], data.qvel[:] = q[k], dq[k]
        mujoco.mj_forward(model, data)
        energy.append(data.energy.sum())
    change = (energy[0] - 8 * energy[1] + 8 * energy[3] - energy[4]) / (12 * h)
    assert power[2] == pytest.approx(change, rel=1e-6, abs=1e-6)


def test_kinematics_are_those_of_mujoco(tmp_path):
    """Origins, frames, anchors and axes in the base frame, a row per sample."""
    robot = random_arm(tmp_path, 5, plain=False)
    q, _, _ = motion(robot, 5, 3)
    origin, frame, anchor, axis = joint_kinematics(robot, q)
    model = robot.model(gravity=False)
    data = mujoco.MjData(model)
    for t in range(3):
        data.qpos[:] = q[t]
        mujoco.mj_forward(model, data)
        np.testing.assert_array_equal(origin[t], data.xpos[model.jnt_bodyid])
        np.testing.assert_array_equal(frame[t].reshape(-1, 9), data.xmat[model.jnt_bodyid])
        np.testing.assert_array_equal(anchor[t], data.xanchor)
        np.testing.assert_array_equal(axis[t], data.xaxis)
    assert np.abs(anchor - origin).max() > 1e-3


def test_standard_parameters_are_about_the_links_origin():
    """m, m c and the tensor by parallel axes, for any leading batch shape; of point masses, their plain sums."""
    rng = np.random.default_rng(6)
    points, m = rng.normal(size=(2, 3, 8, 3)), rng.uniform(0.1, 1, (2, 3, 8))
    com = np.einsum("abk,abki->abi", m, points) / m.sum(-1)[..., None]

    def tensor(p):
        return np.einsum(
            "abk,abkij->abij", m, (p**2).sum(-1)[..., None, None] * np.eye(3) - p[..., None] * p[..., None, :]
        )

    out = LinkInertia(m.sum(-1), com, tensor(points - com[:, :, None])).standard()
    expected = [m.sum(-1)[..., None], np.einsum("abk,abki->abi", m, points), tensor_elements(tensor(points))]
    np.testing.assert_allclose(out, np.concatenate(expected, -1), atol=1e-12)
