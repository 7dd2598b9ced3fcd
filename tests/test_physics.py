"""The friction law inside MuJoCo's step is the one written in NumPy, at any thread count, and stays stable."""

import subprocess
import sys

import mujoco
import numpy as np
import pytest

from r2s.actuation import SoftLimits
from r2s.friction import friction_slope, friction_torque, passive_torque
from r2s.robot import load_robot
from r2s.simulator import Dynamics, Simulator

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
      <joint name="j1" axis="0 0 1" range="-2 2" damping="0.3" armature="0.05" actuatorfrcrange="-20 20"/>
      <body pos="0 0 0.2"><inertial pos="0.02 0 0.1" mass="1" fullinertia="0.01 0.01 0.004 0.001 0 0"/>
        <joint name="j2" axis="0 1 0" range="-2 2" damping="0.1" actuatorfrcrange="-10 10"/>
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


def some_dynamics(robot, nsim, seed=0):
    """Return dynamics with every part of the law active, other ones in every simulation."""
    rng = np.random.default_rng(seed)
    shape = (nsim, robot.n)
    phi = np.stack([rng.uniform(0.3, 4, shape), rng.uniform(2, 30, shape), rng.uniform(-0.06, 0.06, shape)], -1)
    breakaway = np.stack([-rng.uniform(0.2, 1.5, shape), rng.uniform(0.2, 1.5, shape)], -1)
    inertia = np.broadcast_to(robot.inertia, (*shape, 3, 3))
    return Dynamics(phi, rng.uniform(-0.6, 0.6, shape), breakaway, 0.02, inertia)


def some_motion(robot, nsim, steps, seed=1):
    """Return start states well inside the limits (every other joint at rest) and torques (nsim, steps, n)."""
    rng = np.random.default_rng(seed)
    middle, half = 0.5 * (robot.q_min + robot.q_max), 0.25 * (robot.q_max - robot.q_min)
    q = middle + half * rng.uniform(-1, 1, (nsim, robot.n))
    dq = rng.uniform(-0.5, 0.5, q.shape) * (rng.random(q.shape) < 0.5)
    wave = np.sin(np.arange(steps)[:, None] * rng.uniform(0.05, 0.5, robot.n))
    return q, dq, rng.uniform(-3, 3, (nsim, 1, robot.n)) * wave


def oracle(robot, dynamics, k, q, dq, tau, soft=None):
    """Return (steps, n) angles and velocities of simulation k, and how often a joint was held, in a Python loop."""
    model = robot.model(gravity=False)
    data = mujoco.MjData(model)
    base = model.dof_damping.copy()
    data.qpos[:], data.qvel[:] = q[k], dq[k]
    phi, offset, breakaway, dq_min = dynamics.phi[k], dynamics.offset[k], dynamics.breakaway[k], dynamics.dq_min
    qs, dqs, held = [], [], 0
    for torque in tau[k]:
        slope = friction_slope(data.qvel, phi)
        passive = passive_torque(data.qvel, torque, phi, offset, breakaway, dq_min)
        held += int(np.sum(np.isclose(passive + friction_torque(data.qvel, phi), -torque, atol=1e-12)))
        if soft is not None:
            passive = passive + soft(data.qpos, data.qvel)
            slope = slope + soft.dq_gain * (np.abs(data.qvel) > soft.dq_soft)
        data.qfrc_applied[:] = torque + passive + slope * data.qvel
        model.dof_damping[:] = base + slope
        mujoco.mj_step(model, data)
        qs.append(data.qpos.copy())
        dqs.append(data.qvel.copy())
    return np.array(qs), np.array(dqs), held


@pytest.mark.parametrize("which", ["panda", "damped"])
def test_native_friction_is_the_numpy_law(which, request):
    """Sigmoid, offset and dead zone agree to 1e-12 over 60 steps, each simulation with parameters of its own."""
    robot = request.getfixturevalue(which)
    nsim, steps = 6, 60
    dynamics = some_dynamics(robot, nsim)
    q, dq, tau = some_motion(robot, nsim, steps)
    sim = Simulator(robot, dynamics, nsim, 1)
    sim.reset(q, dq)
    out = sim.rollout(tau, record=("qpos", "qvel"))
    held = 0
    for k in range(nsim):
        qs, dqs, count = oracle(robot, dynamics, k, q, dq, tau)
        held += count
        np.testing.assert_allclose(out["qpos"][k], qs, rtol=0, atol=1e-12)
        np.testing.assert_allclose(out["qvel"][k], dqs, rtol=0, atol=1e-11)
    assert 0.02 < held / tau.size < 0.98  # the dead zone took part, and so did the rest


def test_native_soft_limits_are_those_of_the_driver(panda):
    """Beyond their edges of position and speed arms are pushed as SoftLimits says, to 1e-12; inside not at all."""
    nsim, steps = 6, 40
    dynamics = some_dynamics(panda, nsim)
    q, dq, tau = some_motion(panda, nsim, steps)
    soft = SoftLimits.of(panda, 0.1 * panda.tau_max)
    q[:2], dq[2:4] = panda.q_max - 0.05, 0.95 * panda.dq_max * np.array([1, -1, 1, -1, 1, -1, 1])
    q[1, :3], dq[3] = panda.q_min[:3] + 0.05, -dq[3]
    sim = Simulator(panda, dynamics, nsim, 1)
    sim.reset(q, dq)
    free = sim.rollout(tau)["qpos"]
    sim.set_soft_limits(soft)
    sim.reset(q, dq)
    out = sim.rollout(tau)["qpos"]
    assert np.abs(out - free).max(axis=(1, 2))[:4].min() > 1e-6
    assert np.array_equal(out[4:, :5], free[4:, :5])
    for k in range(nsim):
        qs, _, _ = oracle(panda, dynamics, k, q, dq, tau, soft)
        np.testing.assert_allclose(out[k], qs, rtol=0, atol=1e-12)


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
    assert friction_slope(np.zeros(1), phi) == pytest.approx(10.0)
    still = Dynamics(phi, np.zeros(1), np.zeros((1, 2)), 0.01, light.inertia)
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
        data.qfrc_applied[:] = -friction_torque(data.qvel, phi)
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
        sim.rollout(np.repeat((drive - dynamics.offset)[:, None], 20, axis=1))
        return sim.q - panda.q_home

    assert np.array_equal(moved(0.98 * below), np.zeros((nsim, n)))
    above = 0.98 * below
    rows, joints = np.arange(nsim), np.arange(nsim) % n
    above[rows, joints] = 1.02 * below[rows, joints]
    shift = moved(above)[rows, joints]
    assert np.array_equal(np.sign(shift), np.where(rows < n, -1, 1))


def test_friction_takes_energy_out():
    """friction_torque has the sign of the velocity, whatever phi3, and is zero at rest."""
    rng = np.random.default_rng(3)
    shape = (20000, 3)
    phi = np.stack([rng.uniform(0, 10, shape), rng.uniform(0, 60, shape), rng.uniform(-0.3, 0.3, shape)], -1)
    dq = rng.normal(size=shape) * 10.0 ** rng.uniform(-6, 1, shape)
    assert (friction_torque(dq, phi) * dq).min() >= -1e-15
    assert np.array_equal(friction_torque(np.zeros(shape), phi), np.zeros(shape))


def test_a_free_arm_only_slows_down(panda):
    """Without command and offset the kinetic energy of the simulated arm never rises."""
    d = some_dynamics(panda, 4)
    d = Dynamics(d.phi, np.zeros_like(d.offset), d.breakaway, d.dq_min, d.inertia)
    sim = Simulator(panda, d, 4, 1)
    q, dq, _ = some_motion(panda, 4, 1)
    sim.reset(q, dq)
    model, full = panda.model(gravity=False), np.empty((7, 7))
    data = mujoco.MjData(model)
    out = sim.rollout(np.zeros((4, 150, 7)), record=("qpos", "qvel"))
    for k in range(4):
        energy = []
        for q_now, dq_now in zip(out["qpos"][k], out["qvel"][k], strict=True):
            data.qpos[:] = q_now
            mujoco.mj_forward(model, data)
            mujoco.mj_fullM(model, data, full)
            energy.append(0.5 * dq_now @ full @ dq_now)
        assert np.all(np.diff(energy) <= 1e-9)


def test_friction_slope_is_the_derivative():
    """friction_slope equals the central difference of friction_torque."""
    rng = np.random.default_rng(4)
    shape = (500, 2)
    phi = np.stack([rng.uniform(0.1, 5, shape), rng.uniform(1, 30, shape), rng.uniform(-0.1, 0.1, shape)], -1)
    dq, h = rng.normal(size=shape), 1e-6
    numerical = (friction_torque(dq + h, phi) - friction_torque(dq - h, phi)) / (2 * h)
    np.testing.assert_allclose(friction_slope(dq, phi), numerical, rtol=1e-6, atol=1e-8)


def test_the_law_is_finite_at_any_speed(light):
    """Neither form overflows at a million rad/s."""
    phi = np.array([[2.0, 60.0, 0.1]])
    for v in (-1e6, 1e6):
        assert np.isfinite(friction_torque(np.array([v]), phi)).all()
    sim = Simulator(light, Dynamics(phi, np.zeros(1), np.zeros((1, 2)), 0.01, light.inertia), 1, 1)
    sim.reset(np.zeros((1, 1)), np.full((1, 1), 1e6))
    assert np.isfinite(sim.rollout(np.zeros((1, 1, 1)), record=("qvel",))["qvel"]).all()


UNTOUCHED = """
import mujoco, numpy as np
from r2s import friction
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


def test_tensors_of_set_dynamics_make_the_mass_matrix(panda):
    """Each arm's mass matrix is the nominal one plus what its tensors add, sum J^T R (I - I0) R^T J."""
    nsim, n = 5, panda.n
    rng = np.random.default_rng(5)
    d = some_dynamics(panda, nsim)
    inertia = random_tensors(rng, nsim * n).reshape(nsim, n, 3, 3)
    sim = Simulator(panda, d, nsim, 1)
    sim.set_dynamics(Dynamics(d.phi, d.offset, d.breakaway, d.dq_min, inertia))
    nominal = panda.model(gravity=False)
    data, jacobian = mujoco.MjData(nominal), np.empty((3, n))
    for k in range(nsim):
        q = rng.uniform(panda.q_min, panda.q_max)
        expected, found = np.empty((n, n)), np.empty((n, n))
        data.qpos[:] = q
        mujoco.mj_forward(nominal, data)
        mujoco.mj_fullM(nominal, data, expected)
        for i, body in enumerate(nominal.jnt_bodyid):
            mujoco.mj_jacBody(nominal, data, None, jacobian, body)
            local = data.xmat[body].reshape(3, 3).T @ jacobian
            expected += local.T @ (inertia[k, i] - panda.inertia[i]) @ local
        model = sim.batch.get_model(k)
        own = mujoco.MjData(model)
        own.qpos[:] = q
        mujoco.mj_forward(model, own)
        mujoco.mj_fullM(model, own, found)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10)


def test_dynamics_go_to_the_arms_that_are_named(panda):
    """set_dynamics with ids leaves the other arms alone, and with repeat serves blocks of consecutive arms."""
    six, three = some_dynamics(panda, 6), some_dynamics(panda, 3, seed=9)
    q, dq, tau = some_motion(panda, 6, 30)

    def run(change):
        sim = Simulator(panda, six, 6, 1)
        change(sim)
        sim.reset(q, dq)
        return sim.rollout(tau)["qpos"]

    base = run(lambda sim: None)
    two = Dynamics(three.phi[:2], three.offset[:2], three.breakaway[:2], three.dq_min, three.inertia[:2])
    part = run(lambda sim: sim.set_dynamics(two, np.array([1, 4])))
    assert np.array_equal(part[[0, 2, 3, 5]], base[[0, 2, 3, 5]])
    assert np.abs(part[[1, 4]] - base[[1, 4]]).max(axis=(1, 2)).min() > 1e-6
    whole = Dynamics(
        *(np.repeat(x, 2, 0) for x in (three.phi, three.offset, three.breakaway)),
        three.dq_min,
        np.repeat(three.inertia, 2, 0),
    )
    blocks = run(lambda sim: sim.set_dynamics(three, repeat=2))
    assert np.array_equal(blocks, run(lambda sim: sim.set_dynamics(whole)))


def test_a_command_excludes_gravity(panda):
    """The simulator has no gravity: at rest, without command and offset, the arm stays where it is to the bit."""
    phi = np.tile([1.0, 10.0, 0.02], (7, 1))
    sim = Simulator(panda, Dynamics(phi, np.zeros(7), np.zeros((7, 2)), 0.01, panda.inertia), 1, 1)
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
