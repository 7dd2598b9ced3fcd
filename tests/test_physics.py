"""The friction law inside MuJoCo's step is the one written in NumPy, at any thread count, and stays stable."""

import subprocess
import sys
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from r2s.errors import UserError
from r2s.physics.dynamics import AXES, Dynamics
from r2s.physics.friction import BRISTLE, COULOMB, FAMILIES, PHI, SIGMOID, STRIBECK, WIDTH_DQ, family, presliding
from r2s.physics.inverse_dynamics import InverseDynamics
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


def arms_of(d, at):
    """Return the dynamics of some of the arms."""
    return replace(d, **{k: v[at] for k, axes in AXES.items() if np.ndim(v := getattr(d, k)) > axes})


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


def test_threads_do_not_change_a_bit(panda):
    """One thread and two give the same bits, also when arms are reset and rolled out in parts."""
    nsim, steps = 9, 80
    q, dq, tau = some_motion(panda, nsim, steps)
    some = np.array([1, 4, 8])
    results = []
    for nthread in (1, 2):
        sim = Simulator(panda, some_dynamics(panda, nsim), nsim, nthread)
        sim.reset(q, dq)
        sim.rollout(tau)
        sim.reset(q[some], dq[some], some)
        results.append(sim.rollout(tau, record=("qpos", "qvel")))
    for name in ("qpos", "qvel"):
        assert np.array_equal(results[0][name], results[1][name])


def test_a_reset_forgets_the_motion_before(panda):
    """The slope of the last step, kept in dof_damping, does not reach the next episode."""
    q, dq, tau = some_motion(panda, 3, 40)
    sim = Simulator(panda, some_dynamics(panda, 3), 3, 1)
    sim.reset(q, dq)
    first = sim.rollout(tau)["qpos"]
    sim.rollout(-tau)
    sim.reset(q, dq)
    assert np.array_equal(sim.rollout(tau)["qpos"], first)


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


@pytest.mark.parametrize("law", FAMILIES, ids=named)
def test_friction_takes_energy_out(law):
    """The torque has the sign of the velocity, whatever the asymmetry, and is zero at rest."""
    rng = np.random.default_rng(3)
    shape = (20000, 3)
    phi = some_phi(law, shape, rng)
    if law is SIGMOID:
        phi[..., 2] *= 5
    dq = rng.normal(size=shape) * 10.0 ** rng.uniform(-6, 1, shape)
    assert (law.torque(dq, phi) * dq).min() >= -1e-15
    assert np.array_equal(law.torque(np.zeros(shape), phi), np.zeros(shape))


@pytest.mark.parametrize("law", THREE, ids=named)
def test_a_free_arm_only_slows_down(panda, law):
    """Without command and offset the kinetic energy of the arm never rises; load makes it fall more."""
    d = some_dynamics(panda, 3, law=law)
    level = np.array([1.0, 1.0, 1.0, 1.0, 0.2, 0.2, 0.05])[:, None] ** (np.arange(len(law.names)) == 0)
    d = replace(d, phi=d.phi * level, offset=np.zeros_like(d.offset), load=np.full((3, 7), 0.02))
    sim = Simulator(panda, d, 3, 1)
    q, dq, _ = some_motion(panda, 3, 1)
    sim.reset(q, dq)
    model, full = panda.model(gravity=False), np.empty((7, 7))
    data = mujoco.MjData(model)
    out = sim.rollout(np.zeros((3, 100, 7)), record=("qpos", "qvel"))
    for k in range(3):
        energy = []
        for q_now, dq_now in zip(out["qpos"][k], out["qvel"][k], strict=True):
            data.qpos[:] = q_now
            mujoco.mj_forward(model, data)
            mujoco.mj_fullM(model, data, full)
            energy.append(0.5 * dq_now @ full @ dq_now)
        assert np.all(np.diff(energy) <= 1e-9)
        assert energy[-1] < 0.9 * energy[0]


@pytest.mark.parametrize("law", THREE, ids=named)
def test_the_slope_is_the_derivative(law):
    """The compiled law's slope equals the central difference of Family.torque."""
    rng = np.random.default_rng(4)
    shape = (500,)
    phi = some_phi(law, shape, rng)
    dq, h = rng.normal(size=shape) * 10.0 ** rng.uniform(-2, 0, shape), 1e-7
    dq += np.sign(dq) * 1e-4  # asymmetric laws have a kink at rest
    numerical = (law.torque(dq + h, phi) - law.torque(dq - h, phi)) / (2 * h)
    np.testing.assert_allclose(compiled_slope(law, dq, phi), numerical, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("other", FAMILIES, ids=named)
@pytest.mark.parametrize("law", FAMILIES, ids=named)
def test_a_family_converted_has_the_same_level(law, other):
    """`matched_to` keeps the mean friction at plus and minus 1 rad/s, and the parameters of the same family."""
    phi = some_phi(law, (20, 7), np.random.default_rng(5))
    new, one = other.matched_to(law, phi), np.ones((20, 7))
    np.testing.assert_allclose(other.level(new, one), law.level(phi, one), rtol=1e-7)
    if law is other:
        assert np.array_equal(new, phi)
    else:
        assert new.shape == (20, 7, len(other.names) - len(other.optional))


def test_the_viscous_term_of_the_sigmoid_may_be_left_out():
    """Three parameters are four with a viscous term of zero; the fourth adds itself times the velocity."""
    rng = np.random.default_rng(6)
    phi, dq = some_phi(SIGMOID, (50, 2), rng), rng.normal(size=(50, 2))
    three = SIGMOID.torque(dq, phi[..., :3])
    np.testing.assert_allclose(SIGMOID.torque(dq, phi), three + phi[..., 3] * dq, rtol=1e-12)
    phi, dq = phi[:, 0], dq[:, 0]
    with_it, without = (compiled_slope(SIGMOID, dq, x) for x in (phi, phi[:, :3]))
    np.testing.assert_allclose(with_it, without + phi[:, 3], rtol=1e-12)


@pytest.mark.parametrize(("law", "at_rest"), [(COULOMB, 1.2), (STRIBECK, 1.2 * 1.5)], ids=("coulomb", "stribeck"))
def test_levels_follow_the_parameters(law, at_rest):
    """1 Nm with 20 % asymmetry and 50 % rise: both appear near zero speed, and the rise vanishes at high speed."""
    values = dict(coulomb=1.0, asymmetry=0.2, viscous=0.3, rise=0.5, stribeck_velocity=0.1)
    phi = np.array([values[name] for name in law.names if name in values])
    slow = np.array([0.06, -0.06])
    rise = at_rest / 1.2 - 1
    np.testing.assert_allclose(
        law.torque(slow, phi) - 0.3 * slow, [1.2 * (1 + rise * np.exp(-0.36)), -0.8 * (1 + rise * np.exp(-0.36))],
        rtol=1e-4,
    )  # fmt: skip
    np.testing.assert_allclose(law.torque(np.array([1.0, -1.0]), phi), [1.5, -1.1], rtol=1e-9)
    np.testing.assert_allclose(law.torque(np.zeros(2), phi, bristle=np.array([1.0, -1.0])), [at_rest, -at_rest / 1.5])


def test_load_dependent_friction_of_bristles_holds_at_rest(panda):
    """A joint holds its level and half of its load-dependent friction, within a few presliding distances; not 1.5."""
    n, phi = panda.n, np.tile([1.0, 0.0, 0.0, 0.0, 0.1, 5e-4, 0.0, 0.0], (panda.n, 1))
    d = replace(Dynamics.of(panda, phi, BRISTLE), load=np.full(n, 0.05))
    level = InverseDynamics(panda, d).load_friction(panda.q_home[None])[0]
    j = int(np.argmax(level))
    tau = np.zeros((2, 1500, n))
    tau[:, :, j] = 1.0 + level[j] * np.array([[0.5], [1.5]])
    sim = Simulator(panda, d, 2, 1)
    sim.reset(np.tile(panda.q_home, (2, 1)), np.zeros((2, n)))
    out = sim.rollout(tau, record=("qpos", "qvel"))
    moved, speed = np.abs(out["qpos"][:, -1, j] - panda.q_home[j]), np.abs(out["qvel"][:, -1, j])
    assert speed[0] < 1e-6
    assert moved[0] < 10 * 5e-4
    assert speed[1] > 0.01
    assert moved[1] > 100 * 5e-4


def test_presliding_goes_by_the_distance():
    """The sign changes as 1 - exp(-distance / scale), at any speed and step; after a reversal from 1 to -1."""
    for speed, dt in ((0.01, 1e-3), (0.1, 1e-3), (0.02, 5e-3)):
        path = np.full((200, 1), speed)
        z = presliding(path, dt, 1e-3)[:, 0]
        np.testing.assert_allclose(z, 1 - np.exp(-speed * dt * np.arange(1, 201) / 1e-3), rtol=0, atol=1e-12)
    wave = np.sin(0.01 * np.arange(2000))[:, None] * np.array([0.3, 1.0, 3.0])
    z = presliding(wave, 1e-3, 1e-3)
    assert np.abs(z).max() <= 1
    fast = np.abs(wave) > 0.9 * np.abs(wave).max(0)
    assert np.array_equal(np.sign(z[fast]), np.sign(wave[fast]))
    own = np.array([5e-4, 1e-3, 2e-3])  # joints of distances of their own
    alone = [presliding(wave[:, [j]], 1e-3, own[j])[:, 0] for j in range(3)]
    np.testing.assert_array_equal(presliding(wave, 1e-3, own), np.stack(alone, 1))
    assert not presliding(np.zeros((5, 2)), 1e-3, 1e-3).any()


def test_an_unknown_family_is_named():
    """One line with the nearest of those that exist."""
    assert all(family(f.name) is f for f in FAMILIES)
    with pytest.raises(UserError, match=r"^friction\.family: expected .*, got 'stribek'; did you mean 'stribeck'\?$"):
        family("stribek")


@pytest.mark.parametrize("law", FAMILIES, ids=named)
def test_the_law_is_finite_at_any_speed(light, law):
    """Neither form overflows at a million rad/s."""
    phi = np.array([[RANGES[name][1] for name in law.names]])
    for v in (-1e6, 1e6):
        assert np.isfinite(law.torque(np.array([v]), phi)).all()
        assert np.isfinite(compiled_slope(law, np.array([v]), phi)).all()
    sim = Simulator(light, Dynamics.of(light, phi, law), 1, 1)
    sim.reset(np.zeros((1, 1)), np.full((1, 1), 1e6))
    assert np.isfinite(sim.rollout(np.zeros((1, 1, 1)), record=("qvel",))["qvel"]).all()


@pytest.mark.parametrize("law", FAMILIES, ids=named)
def test_a_pushed_joint_reaches_the_speed_at_which_friction_balances(light, law):
    """Native laws end where command = Family.torque, with its asymmetry, in both directions and in every family."""
    phi = np.array([[{"viscous": 0.5, "coulomb": 1.0, "phi1": 2.0, "asymmetry": 0.2, "presliding": 1e-3}.get(
        name, 0.5 * sum(RANGES[name])) for name in law.names]])  # fmt: skip
    speed = np.array([[1.0], [-1.0]])
    push = law.torque(speed, np.broadcast_to(phi, (2, 1, phi.shape[-1])))
    sim = Simulator(light, Dynamics.of(light, phi, law), 2, 1)
    sim.reset(np.zeros((2, 1)), 0.9 * speed)
    dq = sim.rollout(np.repeat(push[:, None], 400, 1), record=("qvel",))["qvel"]
    np.testing.assert_allclose(dq[:, -1], speed, rtol=1e-6)


UNTOUCHED = """
import mujoco, numpy as np
from r2s.physics import mujoco_callback as friction
ARM = '''<mujoco>{size}<worldbody><body><joint axis="0 1 0" damping="0.1" {user}/><geom size="0.1" pos="0 0 -0.3"/>
<body pos="0 0 -0.3"><joint axis="0 1 0" {user}/><geom size="0.05" pos="0 0 -0.3"/></body></body>
</worldbody></mujoco>'''
zeros = 'user="' + ' '.join(['0.5'] * friction.WIDTH) + '"'
texts = [ARM.format(size='', user=''), ARM.format(size=f'<size nuser_jnt="{friction.WIDTH}"/>', user=zeros)]
def swing(text):
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    data.qpos[:] = 1.0, -0.5
    rows = []
    for _ in range(300):
        mujoco.mj_step(model, data)
        rows.append(np.concatenate([data.qpos, data.qvel, model.dof_damping]))
    return np.array(rows)
before = [swing(t) for t in texts]
friction.install()
after = [swing(t) for t in texts]
assert np.ptp(before[0][:, 0]) > 0.5
print(all(np.array_equal(a, b) for a, b in zip(before, after, strict=True)))
"""


def test_other_models_of_the_process_are_untouched():
    """A plain pendulum, and one with as many user numbers of its own, step to the same bits after `install`."""
    done = subprocess.run([sys.executable, "-c", UNTOUCHED], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "True"


def random_tensors(rng, count):
    """Return (count, 3, 3) valid inertia tensors: of ten random point masses each."""
    points = rng.normal(size=(count, 10, 3)) * rng.uniform(0.02, 0.2, (count, 1, 3))
    squares = (points**2).sum(-1)[..., None, None] * np.eye(3)
    return (squares - points[..., :, None] * points[..., None, :]).sum(1)


def test_links_of_set_dynamics_make_the_mass_matrix(panda):
    """Each arm's mass matrix is sum m Jc^T Jc + Jr^T R I R^T Jr of its own masses, centres and tensors."""
    nsim, n = 4, panda.n
    rng = np.random.default_rng(5)
    d = with_everything(panda, some_dynamics(panda, nsim))
    d = replace(d, inertia=random_tensors(rng, nsim * n).reshape(nsim, n, 3, 3))
    sim = Simulator(panda, some_dynamics(panda, nsim), nsim, 1)
    sim.set_dynamics(d)
    for k in range(nsim):
        model, q = sim.batch.get_model(k), rng.uniform(panda.q_min, panda.q_max)
        data, place, spin = mujoco.MjData(model), np.empty((3, n)), np.empty((3, n))
        expected, found = np.zeros((n, n)), np.empty((n, n))
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        for i, body in enumerate(model.jnt_bodyid):
            frame = data.xmat[body].reshape(3, 3)
            mujoco.mj_jac(model, data, place, spin, data.xpos[body] + frame @ d.com[k, i], body)
            expected += d.mass[k, i] * place.T @ place + spin.T @ frame @ d.inertia[k, i] @ frame.T @ spin
        mujoco.mj_fullM(model, data, found)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10)


def test_dynamics_go_to_the_arms_that_are_named(panda):
    """set_dynamics with ids leaves the other arms alone, and with repeat serves blocks of consecutive arms."""
    six = some_dynamics(panda, 6)
    three = with_everything(panda, some_dynamics(panda, 3, seed=9, law=STRIBECK))
    q, dq, tau = some_motion(panda, 6, 30)

    def run(change):
        sim = Simulator(panda, six, 6, 1)
        change(sim)
        sim.reset(q, dq)
        return sim.rollout(tau)["qpos"]

    base = run(lambda sim: None)
    part = run(lambda sim: sim.set_dynamics(arms_of(three, slice(2)), np.array([1, 4])))
    assert np.array_equal(part[[0, 2, 3, 5]], base[[0, 2, 3, 5]])
    assert np.abs(part[[1, 4]] - base[[1, 4]]).max(axis=(1, 2)).min() > 1e-6
    whole = arms_of(three, np.repeat(np.arange(3), 2))
    blocks = run(lambda sim: sim.set_dynamics(three, repeat=2))
    assert np.array_equal(blocks, run(lambda sim: sim.set_dynamics(whole)))
    assert np.array_equal(run(lambda sim: (sim.set_dynamics(three, repeat=2), sim.set_dynamics(six))), base)


def test_a_command_excludes_gravity(panda):
    """The simulator has no gravity: at rest, without command and offset, the arm stays where it is to the bit."""
    phi = np.tile([1.0, 10.0, 0.02], (7, 1))
    sim = Simulator(panda, Dynamics.of(panda, phi), 1, 1)
    assert np.array_equal(sim.model.opt.gravity, np.zeros(3))
    sim.reset(panda.q_home[None], np.zeros((1, 7)))
    sim.rollout(np.zeros((1, 500, 7)))
    assert np.array_equal(sim.q[0], panda.q_home)
    falling = panda.model(gravity=True)
    assert falling.opt.gravity[2] == pytest.approx(-9.81)


def test_kinematics_of_the_batch_are_those_of_mujoco(panda):
    """`ee` and `jacobian` equal the site position and mj_jacSite at the state after a rollout."""
    q, dq, tau = some_motion(panda, 3, 25)
    sim = Simulator(panda, some_dynamics(panda, 3), 3, 1)
    sim.reset(q, dq)
    sim.rollout(tau)
    sim.kinematics()
    model = panda.model(gravity=False)
    data, jacobian = mujoco.MjData(model), np.empty((3, 7))
    site = model.site(panda.ee_site).id
    for k in range(3):
        data.qpos[:] = sim.q[k]
        mujoco.mj_forward(model, data)
        mujoco.mj_jacSite(model, data, jacobian, None, site)
        np.testing.assert_allclose(sim.ee[k], data.site_xpos[site], atol=1e-12)
        np.testing.assert_allclose(sim.jacobian[k], jacobian, atol=1e-12)
