"""Our own equations of motion are MuJoCo's."""

import mujoco
import numpy as np
import pytest

from r2s.physics.newton_euler import WORK, equations, links_of
from r2s.physics.robot import load_robot


@pytest.mark.parametrize("name", ["panda", "ur10e", "xarm7", "kinova_gen3"])
def test_mass_matrix_and_bias_are_mujocos(name):
    robot = load_robot(f"r2s:models/{name}.xml")
    links = links_of(robot, robot.mass, robot.com, robot.inertia)
    model, rng, n = robot.model(gravity=True), np.random.default_rng(0), robot.n
    model.dof_armature[:] = model.dof_damping[:] = 0
    data, whole = mujoco.MjData(model), np.empty((n, n))
    mass, bias, work = np.empty((n, n)), np.empty(n), np.empty((n, WORK))
    for _ in range(10):
        q, dq = rng.uniform(*robot.q_range), rng.normal(size=n)
        equations(links, robot.gravity, q, dq, mass, bias, work)
        data.qpos[:], data.qvel[:] = q, dq
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, whole)
        np.testing.assert_allclose(mass, whole, atol=1e-12)
        np.testing.assert_allclose(bias, data.qfrc_bias, atol=1e-12)
