"""The friction law and the dead zone inside MuJoCo's step are those written in NumPy, and stay stable."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from r2s.physics.dynamics import Dynamics
from r2s.physics.friction import COULOMB, PHI, SIGMOID, STRIBECK, WIDTH_DQ
from r2s.physics.robot import SIM_DT, load_robot
from r2s.physics.simulator import Simulator

ONE_JOINT = """
<mujoco model="light">
  <compiler angle="radian"/>
  <worldbody>
    <body><inertial pos="0 0 0" mass="0.5" diaginertia="0.005 0.005 0.005"/>
      <joint name="j" axis="0 0 1" range="-3 3" actuatorfrcrange="-12 12"/>
      <site name="tip" pos="0.1 0 0"/>
    </body>
  </worldbody>
</mujoco>
"""

DAMPED_ARM = """
<mujoco model="damped">
  <compiler angle="radian"/>
  <worldbody>
    <body pos="0 0 0.3"><inertial pos="0 0.02 0.1" mass="2" diaginertia="0.03 0.03 0.02"/>
      <joint name="j1" axis="0.6 0 0.8" pos="0.03 0 -0.05" range="-2 2" damping="0.3" armature="0.05"
        actuatorfrcrange="-20 20"/>
      <body pos="0 0 0.2"><inertial pos="0.02 0 0.1" mass="1" fullinertia="0.01 0.01 0.004 0.001 0 0"/>
        <joint name="j2" axis="0 1 0" pos="0 0.02 0.04" range="-2 2" damping="0.1" actuatorfrcrange="-10 10"/>
        <body pos="0.05 0 0.15"><inertial pos="0.01 0 0" mass="0.4" diaginertia="0.001 0.001 0.001"/></body>
        <site name="tip" pos="0 0 0.2"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def light(tmp_path_factory):
    path = tmp_path_factory.mktemp("light") / "light.xml"
    path.write_text(ONE_JOINT)
    return load_robot(str(path))


@pytest.fixture(scope="module")
def damped(tmp_path_factory):
    path = tmp_path_factory.mktemp("damped") / "damped.xml"
    path.write_text(DAMPED_ARM)
    return load_robot(str(path))


@pytest.fixture
def hanging(panda):
    """Return a Panda on a wall that leans over: gravity has a part along every axis of its base."""
    return replace(panda, gravity=np.array([6.0, -5.0, 5.9]))


RANGES = {
    "phi1": (0.3, 4.0), "phi2": (2.0, 30.0), "phi3": (-0.06, 0.06), "viscous": (0.0, 1.0), "coulomb": (0.2, 3.0),
    "asymmetry": (-0.5, 0.5), "rise": (0.0, 1.0), "stribeck_velocity": (0.02, 0.3), "presliding": (2e-4, 5e-3),
    "rise_asymmetry": (-0.9, 0.9), "viscous_asymmetry": (-0.6, 0.6),
}  # fmt: skip
THREE = (SIGMOID, COULOMB, STRIBECK)


def named(f):
    return f.name


def some_phi(law, shape, rng):
    """Return (*shape, K) parameters of a family."""
    return np.stack([rng.uniform(*RANGES[name], shape) for name in law.names], -1)


def some_dynamics(robot, nsim, seed=0, law=SIGMOID):
    """Return dynamics with the dead zone and offsets active, other ones in every simulation."""
    rng = np.random.default_rng(seed)
    shape = (nsim, robot.n)
    breakaway = np.stack([-rng.uniform(0.2, 1.5, shape), rng.uniform(0.2, 1.5, shape)], -1)
    arms = Dynamics.of(robot, some_phi(law, shape, rng), law, dq_min=0.02)
    inertia = np.broadcast_to(robot.inertia, (*shape, 3, 3))
    return replace(arms, offset=rng.uniform(-0.6, 0.6, shape), breakaway=breakaway, inertia=inertia)


def with_everything(robot, d, seed=7):
    """Return the dynamics with load, drag and links of other mass, centre and tensor as well."""
    rng = np.random.default_rng(seed)
    shape = d.offset.shape
    return replace(
        d,
        mass=robot.mass * rng.uniform(0.8, 1.2, shape),
        com=robot.com + rng.uniform(-0.02, 0.02, (*shape, 3)),
        inertia=d.inertia * rng.uniform(0.5, 2.0, shape)[..., None, None],
        load=rng.uniform(0, 0.05, shape),
        drag=rng.uniform(-0.3, 0.3, (*shape, 2)),
    )


def set_links(model, mass, com, inertia):
    """Give a compiled model's links these masses, centres and tensors."""
    for body, m, c, tensor in zip(model.jnt_bodyid, mass, com, inertia, strict=True):
        moments, axes = np.linalg.eigh(tensor)
        axes[:, 0] *= np.sign(np.linalg.det(axes))
        model.body_mass[body], model.body_ipos[body], model.body_inertia[body] = m, c, moments
        mujoco.mju_mat2Quat(model.body_iquat[body], axes.ravel())
    mujoco.mj_setConst(model, mujoco.MjData(model))


def weight(model, data, mass, com, gravity):
    """Return (n,) Nm that gravity pulls with at masses at `com` of the links, by Jacobians of those points."""
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    jacobian, out = np.empty((3, model.nv)), np.zeros(model.nv)
    for body, m, c in zip(model.jnt_bodyid, mass, com, strict=True):
        point = data.xpos[body] + data.xmat[body].reshape(3, 3) @ c
        mujoco.mj_jac(model, data, jacobian, None, point, body)
        out += m * gravity @ jacobian
    return out


def compiled_slope(law, v, phi, sharp=False):
    """Return (n,) Nm s/rad, the slope of a compiled law at v (n,) with phi (n, K); `sharp`: without its jump."""
    native = law.sharp if sharp and law.sharp else law.native
    padded = np.pad(phi, ((0, 0), (0, PHI - phi.shape[-1])))
    return np.array([native(p, x, SIM_DT, np.zeros(1))[1] for p, x in zip(padded, v, strict=True)])


def some_motion(robot, nsim, steps, seed=1):
    """Return start states well inside the limits (every other joint at rest) and torques (nsim, steps, n)."""
    rng = np.random.default_rng(seed)
    middle, half = 0.5 * (robot.q_min + robot.q_max), 0.25 * (robot.q_max - robot.q_min)
    q = middle + half * rng.uniform(-1, 1, (nsim, robot.n))
    dq = rng.uniform(-0.5, 0.5, q.shape) * (rng.random(q.shape) < 0.5)
    wave = np.sin(np.arange(steps)[:, None] * rng.uniform(0.05, 0.5, robot.n))
    return q, dq, rng.uniform(-3, 3, (nsim, 1, robot.n)) * wave


EPS = np.finfo(float).eps
# Every term of a step is the end of a chain of at most 200 roundings: rotations through 8 frames, 25 each, with exp
# and tanh good to 4 units in the last place. They go up as often as down, so that their sum grows with the square
# root (Higham and Mary, SIAM J. Sci. Comput. 41(5), 2019): 14; a few more for the largest of many.
ROUNDINGS = 20


def rounding(mass, forces, dq, stepped):
    """Return how far two correct ways to compute one step may be apart, rad/s.

    A step is dq + h A^-1 f. Each term of f (`forces`, (n,) Nm, the sum of their magnitudes) and each element of A
    (`mass` (n, n), what the implicit damping adds included) may be wrong by ROUNDINGS eps: the first moves the step
    by h |A^-1| |df|, the second by cond(A) |dA| / |A| times its own size (Golub and Van Loan, 2.6.2).
    """
    change = np.abs(stepped - dq).max()
    apart = np.abs(dq).max() + SIM_DT * np.linalg.norm(np.linalg.inv(mass), np.inf) * forces.max()
    return ROUNDINGS * EPS * (apart + np.linalg.cond(mass, np.inf) * change)


def mass_matrix(model, data):
    full = np.empty((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    return full


def passive_torque(dq, tau, friction, offset, breakaway, dq_min):
    """Return the torque (..., n) Nm on the joints beside the command `tau`, for stiction_model="command".

    It is offset - friction. In the dead zone (eq. 6 and Table II: |dq| < dq_min, command plus offset within the
    breakaway band) command and offset have no effect, and it is -tau - friction.
    """
    drive = tau + offset
    held = (np.abs(dq) < dq_min) & (drive > breakaway[..., 0]) & (drive < breakaway[..., 1])
    return np.where(held, -tau, offset) - friction


def agree_step_by_step(robot, dynamics, k, q, dq, tau, out):
    """Assert that each step of simulation k is that of the NumPy law from the same state; count the held joints.

    From the same state, because a step may amplify what the one before left by the dozen: Stribeck's falling branch
    pushes a light joint, and which bits it amplifies is the processor's choice.

    Args:
        q, dq: (nsim, n) start. tau: (nsim, steps, n). out: {"qpos", "qvel"}: (nsim, steps, n) after each step.
    """
    model, d = robot.model(gravity=False), dynamics.one(k)
    set_links(model, d.mass, d.com, d.inertia)
    data = mujoco.MjData(model)
    base = model.dof_damping.copy()
    qs, dqs = (np.vstack([start[k], out[name][k]]) for start, name in ((q, "qpos"), (dq, "qvel")))
    held = 0
    for i, torque in enumerate(tau[k]):
        data.qpos[:], data.qvel[:] = qs[i], dqs[i]
        v, sign = dqs[i], np.tanh(dqs[i] / WIDTH_DQ)
        friction, slope = d.friction(v), compiled_slope(d.family, v, d.phi)
        nominal = weight(model, data, robot.mass, robot.com, robot.gravity)
        actual = weight(model, data, d.mass, d.com, robot.gravity)
        pull = d.offset + d.drag[:, 0] * np.sin(data.qpos) + d.drag[:, 1] * np.cos(data.qpos) + actual - nominal
        friction = friction + d.load * np.abs(nominal) * sign
        slope = slope + d.load * np.abs(nominal) * (1 - sign**2) / WIDTH_DQ
        slope = np.maximum(slope, 0.0)
        passive = passive_torque(v, torque, friction, pull, d.breakaway, d.dq_min)
        held += int(np.sum(np.isclose(passive + friction, -torque, atol=1e-12)))
        data.qfrc_applied[:] = torque + passive + slope * v
        model.dof_damping[:] = base + slope
        mujoco.mj_step(model, data)
        forces = sum(map(np.abs, (torque, passive, friction, actual, nominal, (base + slope) * v, data.qfrc_bias)))
        implicit = mass_matrix(model, data) + SIM_DT * np.diag(base + slope)
        bound = rounding(implicit, forces, v, data.qvel)
        np.testing.assert_allclose(dqs[i + 1], data.qvel, rtol=0, atol=bound, err_msg=f"step {i}")
        bound = SIM_DT * bound + 4 * EPS * np.abs(data.qpos).max()
        np.testing.assert_allclose(qs[i + 1], data.qpos, rtol=0, atol=bound, err_msg=f"step {i}")
    return held


@pytest.mark.long
@pytest.mark.parametrize("law", THREE, ids=named)
@pytest.mark.parametrize(
    ("which", "everything"), [("panda", False), ("panda", True), ("damped", True), ("hanging", True)]
)
def test_native_friction_is_the_numpy_law(which, everything, law, request):
    """Family, offset and dead zone agree to round-off in 40 steps, each simulation with parameters of its own.

    With everything: load, drag, and what gravity compensation by nominal masses leaves, too.
    """
    robot = request.getfixturevalue(which)
    nsim, steps = 4, 40
    dynamics = some_dynamics(robot, nsim, law=law)
    dynamics = with_everything(robot, dynamics) if everything else dynamics
    q, dq, tau = some_motion(robot, nsim, steps)
    sim = Simulator(robot, dynamics, nsim, 1)
    sim.reset(q, dq)
    out = sim.rollout(tau, record=("qpos", "qvel"))
    held = sum(agree_step_by_step(robot, dynamics, k, q, dq, tau, out) for k in range(nsim))
    assert 0.02 < held / tau.size < 0.98  # the dead zone took part, and so did the rest


@pytest.mark.parametrize("law", THREE, ids=named)
def test_one_step_of_the_native_law(panda, law):
    """A single step from any state, joints at rest included, agrees with the NumPy law to round-off."""
    nsim = 12
    dynamics = with_everything(panda, some_dynamics(panda, nsim, seed=11, law=law))
    q, dq, _ = some_motion(panda, nsim, 1, seed=12)
    dq *= 10.0 ** np.random.default_rng(13).uniform(-4, 1, dq.shape)
    tau = np.random.default_rng(14).uniform(-3, 3, (nsim, 1, panda.n))
    sim = Simulator(panda, dynamics, nsim, 1)
    sim.reset(q, dq)
    out = sim.rollout(tau, record=("qpos", "qvel"))
    for k in range(nsim):
        agree_step_by_step(panda, dynamics, k, q, dq, tau, out)


@pytest.mark.parametrize("which", ["panda", "damped", "hanging"])
def test_errors_of_gravity_compensation(which, request):
    """A step is that of MuJoCo with the true links under gravity and the nominal arm's gravity torque commanded.

    What is welded to a link is part of both, so it is compensated.
    """
    robot, nsim = request.getfixturevalue(which), 4
    d = with_everything(robot, some_dynamics(robot, nsim))
    d = replace(d, phi=0 * d.phi, offset=0 * d.offset, breakaway=0 * d.breakaway, load=0 * d.load, drag=0 * d.drag)
    q, dq, _ = some_motion(robot, nsim, 1, seed=3)
    sim = Simulator(robot, d, nsim, 1)
    sim.reset(q, dq)
    out = sim.rollout(np.zeros((nsim, 1, robot.n)), record=("qvel",))["qvel"][:, 0]
    nominal, true = robot.model(gravity=True), robot.model(gravity=True)
    for k in range(nsim):
        compensated, arm = mujoco.MjData(nominal), mujoco.MjData(true)
        set_links(true, d.mass[k], d.com[k], d.inertia[k])
        compensated.qpos[:] = q[k]
        mujoco.mj_forward(nominal, compensated)  # at rest: the bias is gravity
        arm.qpos[:], arm.qvel[:], arm.qfrc_applied[:] = q[k], dq[k], compensated.qfrc_bias
        mujoco.mj_step(true, arm)
        forces = np.abs(compensated.qfrc_bias) + np.abs(arm.qfrc_bias) + np.abs(arm.qfrc_passive)
        bound = rounding(mass_matrix(true, arm), forces, dq[k], arm.qvel)
        np.testing.assert_allclose(out[k], arm.qvel, rtol=0, atol=bound)
        assert np.abs(out[k] - dq[k]).max() > 1e-4


def test_the_dead_zone_holds_what_gravity_compensation_misses(panda):
    """An arm with a mass error sinks, but not where its breakaway is wider than what that error pulls with."""
    heavy = replace(some_dynamics(panda, 2), mass=panda.mass * 1.1, offset=np.zeros((2, 7)))
    wide = np.broadcast_to([-50.0, 50.0], (7, 2))
    sim = Simulator(panda, replace(heavy, breakaway=np.stack([wide, 0 * wide])), 2, 1)
    sim.reset(np.tile(panda.q_home, (2, 1)), np.zeros((2, 7)))
    before = sim.ee.copy()
    sim.rollout(np.zeros((2, 100, 7)))
    sim.kinematics()
    assert np.array_equal(sim.q[0], panda.q_home)
    assert sim.ee[1, 2] < before[1, 2] - 1e-4


def test_a_stiff_light_joint_comes_to_rest_without_chatter(light):
    """10 Nm s/rad on 0.005 kg m^2 at 1 kHz: the velocity only decays, where the explicit form chatters."""
    phi = np.array([[1.0, 40.0, 0.0]])
    assert compiled_slope(SIGMOID, np.zeros(1), phi) == pytest.approx(10.0)
    still = Dynamics.of(light, phi)
    sim = Simulator(light, still, 1, 1)
    sim.reset(np.zeros((1, 1)), np.full((1, 1), 0.3))
    dq = sim.rollout(np.zeros((1, 200, 1)), record=("qvel",))["qvel"][0, :, 0]
    assert dq.min() >= -1e-15
    assert np.diff(dq).max() <= 1e-15
    assert dq[-1] < 1e-9

    model = light.model(gravity=False)
    data = mujoco.MjData(model)
    data.qvel[:] = 0.3
    explicit = []
    for _ in range(200):
        data.qfrc_applied[:] = -SIGMOID.torque(data.qvel, phi)
        mujoco.mj_step(model, data)
        explicit.append(float(data.qvel[0]))
    assert np.sum(np.diff(np.sign(explicit[-50:])) != 0) > 40
    assert np.abs(explicit[-50:]).max() > 1e-3


def test_dead_zone_holds_below_its_edges_and_lets_go_above(panda):
    """At rest 98 % of an edge moves nothing, 102 % moves that joint that way; each simulation has its own edges."""
    n = panda.n
    nsim = 2 * n
    dynamics = some_dynamics(panda, nsim)
    below = np.where(np.arange(nsim)[:, None] < n, dynamics.breakaway[..., 0], dynamics.breakaway[..., 1])
    sim = Simulator(panda, dynamics, nsim, 1)

    def moved(drive):
        sim.reset(np.tile(panda.q_home, (nsim, 1)), np.zeros((nsim, n)))
        sim.rollout(np.repeat((drive - dynamics.offset)[:, None], 5, axis=1))
        return sim.q - panda.q_home

    assert np.array_equal(moved(0.98 * below), np.zeros((nsim, n)))
    above = 0.98 * below
    rows, joints = np.arange(nsim), np.arange(nsim) % n
    above[rows, joints] = 1.02 * below[rows, joints]
    shift = moved(above)[rows, joints]
    assert np.array_equal(np.sign(shift), np.where(rows < n, -1, 1))
