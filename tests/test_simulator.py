"""The simulator of many arms: equal bits on any number of threads, dynamics of their own, MuJoCo's kinematics."""

import subprocess
import sys
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from test_physics import some_dynamics, some_motion, with_everything

from r2s.physics.dynamics import AXES, Dynamics
from r2s.physics.friction import STRIBECK
from r2s.physics.simulator import Simulator


def arms_of(d, at):
    """Return the dynamics of some of the arms."""
    return replace(d, **{k: v[at] for k, axes in AXES.items() if np.ndim(v := getattr(d, k)) > axes})


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


@pytest.mark.long
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
