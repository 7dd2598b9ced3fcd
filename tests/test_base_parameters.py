"""Base parameters and the friction file of crisp_controllers: what other programs read of an identified arm."""

from dataclasses import replace

import numpy as np
import pytest
import yaml
from conftest import conf

from r2s.identification.base_parameters import base_parameters, base_table
from r2s.identification.parameters import ParameterEstimate, parameter_space
from r2s.physics.crisp import fit_sigmoid, sigmoid_law, write_crisp
from r2s.physics.dynamics import Dynamics, nominal_dynamics
from r2s.physics.friction import COULOMB, SIGMOID, STRIBECK
from r2s.physics.rigid_body import LinkInertia, regressor
from r2s.physics.robot import load_robot


@pytest.mark.parametrize(("name", "count"), [("panda", 43), ("ur10e", 36)])
def test_their_number_is_the_published_one(name, count):
    """43 of a Panda's links (Gaz et al., RA-L 4(4), 2019), 36 of six joints like UR's, without rotors."""
    robot = load_robot(**conf(f"robot/{name}"))
    assert len(base_parameters(robot, rotors=False).names) == count


def test_torque_is_theirs(panda):
    """Torque at other states is a product of some columns and the base values, whatever the links and rotors."""
    base, rng = base_parameters(panda, rotors=True), np.random.default_rng(1)
    q = rng.uniform(panda.q_min, panda.q_max, (20, 7))
    dq, ddq = rng.normal(size=(2, 20, 7))
    y = regressor(panda, q, dq, ddq, panda.gravity).reshape(140, -1)
    y = np.concatenate([y, (ddq[..., None] * np.eye(7)).reshape(140, 7)], 1)
    plain = Dynamics.of(panda, np.zeros((7, 3)), SIGMOID)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        d = replace(plain, mass=panda.mass * rng.uniform(0.5, 2.0, 7), armature=rng.uniform(0.0, 0.2, 7))
        d = replace(d, com=panda.com + 0.05 * rng.normal(size=(7, 3)))
        whole = y @ np.concatenate([LinkInertia(d.mass, d.com, d.inertia).standard().ravel(), d.armature])
        columns = np.linalg.lstsq(base.matrix.T, y.T, rcond=None)[0].T
        np.testing.assert_allclose(columns @ base.values(d), whole, atol=1e-9 * np.abs(whole).max())


def test_intervals_come_from_the_draws(panda):
    """A scale of one tensor moves its base parameters alone, by the quantiles of the draws."""
    nominal = Dynamics.of(panda, np.zeros((7, 3)), SIGMOID)
    space = parameter_space(panda, nominal, {"inertia_scale": [0.3, 3.0]})
    draws = np.ones((2000, 7))
    draws[:, 4] += 0.1 * np.random.default_rng(0).normal(size=2000)
    x = np.ones(7)
    table = base_table(space, ParameterEstimate(x, x, x, x > 0, draws), rotors=False).set_index("parameter")
    np.testing.assert_allclose(table["value"], table["nominal"], rtol=1e-9, atol=1e-15)
    wide = table["interval95_high"] - table["interval95_low"]
    moved = wide > 1e-9
    low, high = np.percentile(draws[:, 4], [2.5, 97.5])
    assert wide["xy[5]"] == pytest.approx(abs(panda.inertia[4, 0, 1]) * (high - low), rel=1e-6)
    assert all("[5]" in table["combination"][name] for name in table.index[moved])


def crisp(path, dq):
    """Return the friction that crisp_controllers compute from a file: their friction_model.hpp in numpy."""
    document = yaml.safe_load(path.read_text())["/**"]["ros__parameters"]
    assert document["use_friction"] is True
    fp1, fp2, fp3 = (np.array(document["friction"][k]) for k in ("fp1", "fp2", "fp3"))
    return fp1 / (1 + np.exp(-fp2 * (dq + fp3))) - fp1 / (1 + np.exp(-fp2 * fp3))


def test_the_sigmoid_is_the_law_of_crisp_controllers(panda, tmp_path):
    """The paper's friction arrives to all written digits, without an error of a fit."""
    d = nominal_dynamics(panda, **conf("friction/paper"))
    write_crisp(tmp_path / "friction.yaml", panda, d)
    dq = np.linspace(-2.0, 2.0, 81)[:, None] * np.ones(7)
    np.testing.assert_allclose(crisp(tmp_path / "friction.yaml", dq), d.friction(dq), rtol=1e-6, atol=1e-8)
    assert (fit_sigmoid(panda, d)[1] == 0).all()


@pytest.mark.parametrize("family", [COULOMB, STRIBECK], ids=["coulomb", "stribeck"])
def test_other_families_are_fitted_with_their_error(panda, tmp_path, family):
    """The stated error is that of the written law, and no simple choice of parameters is better."""
    level = np.array([1.0, 0.8, 0.65, 1.15, 0.65, 0.35, 0.5])
    columns = {"coulomb": level, "asymmetry": 0.05, "viscous": 0.2 * level, "rise": 0.3, "stribeck_velocity": 0.05}
    names = [n for n in family.names if n in columns]
    phi = np.stack([np.broadcast_to(columns[n], 7) for n in names], -1)
    d = Dynamics.of(panda, phi, family)
    write_crisp(tmp_path / "friction.yaml", panda, d)
    stated = fit_sigmoid(panda, d)[1]
    share = np.geomspace(0.01, 1.0, 100)
    dq = np.concatenate([-share[::-1], share])[:, None] * panda.dq_max
    true = d.friction(dq, np.sign(dq))
    seen = np.sqrt(np.mean((crisp(tmp_path / "friction.yaml", dq) - true) ** 2, axis=0))
    np.testing.assert_allclose(seen, stated, rtol=1e-3)
    for steep in (2.0, 10.0, 50.0, 100.0):
        phi = np.stack([2 * np.abs(true).mean(0), np.full(7, steep), np.zeros(7)], -1)
        assert (stated <= np.sqrt(np.mean((sigmoid_law(dq, phi) - true) ** 2, axis=0))).all()
    assert f"{stated[0]:.3g} (" in (tmp_path / "friction.yaml").read_text()
