"""A friction family of one's own: one file, named by its dotted path, and everything that a built-in one can."""

import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from conftest import conf
from test_physics import compiled_slope

from r2s.arm.recorder import record
from r2s.arm.simulated import SimulatedArm
from r2s.errors import UserError
from r2s.excitation.fourier import fourier
from r2s.identification.identify import identify
from r2s.identification.parameter_file import load_parameters, save_parameters
from r2s.identification.parameters import parameter_space
from r2s.identification.search.least_squares import LeastSquares
from r2s.identification.settings import Settings
from r2s.identification.terms import search_space
from r2s.physics.dynamics import Dynamics, nominal_dynamics, with_family
from r2s.physics.friction import FAMILIES, SIGMOID, Family, family, family_path
from r2s.physics.rigid_body import InverseInertia
from r2s.physics.robot import load_robot
from r2s.physics.simulator import Simulator

MINE = '''
"""Friction with a parameter for the width of its sign change."""

import numpy as np
from numba import njit

from r2s.physics.friction import Family


def law(dq, p, sign):
    return p[0] * np.tanh(dq / p[1]) + p[2] * dq


@njit
def native(p, v, h, memory):
    turned = np.tanh(v / p[1])
    return p[0] * turned + p[2] * v, p[0] * (1 - turned**2) / p[1] + p[2]


def start(level):
    return [level, np.full_like(level, 0.05)]


TANH = Family(
    name="tanh",
    names=("level", "width", "viscous"),
    units=("Nm", "rad/s", "Nm s/rad"),
    logarithmic=("level", "width"),
    bounds=((0.05, 10.0), (0.005, 0.5), (0.0, 10.0)),
    optional=("viscous",),
    formula="level tanh(v / width) + viscous v",
    law=law,
    native=native,
    start=start,
)
'''
ARM = """
<mujoco model="twolink">
  <compiler angle="radian"/>
  <worldbody>
    <body pos="0 0 0.6"><inertial pos="0.02 0 0.1" mass="3" diaginertia="0.06 0.06 0.05"/>
      <joint name="yaw" axis="0 0 1" range="-2.6 2.6" actuatorfrcrange="-40 40"/>
      <body pos="0 0 0.2"><inertial pos="0 0 0.15" mass="2" diaginertia="0.05 0.05 0.01"/>
        <joint name="pitch" axis="0 1 0" range="-1.6 1.6" actuatorfrcrange="-40 40"/>
        <site name="tip" pos="0 0 0.25"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
SETTINGS = conf("identify/default")
BOUNDS = SETTINGS["bounds"]
PHI = np.array([[1.6, 0.08], [0.7, 0.03]])  # Nm, rad/s


@pytest.fixture(scope="module")
def own_family(tmp_path_factory):
    """The dotted path of a family in a file; its tests share a worker, because they share an identification."""
    folder = tmp_path_factory.mktemp("mine")
    (folder / "my_friction.py").write_text(MINE)
    sys.path.insert(0, str(folder))
    yield "my_friction.TANH"
    sys.path.remove(str(folder))


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    file = tmp_path_factory.mktemp("arm") / "arm.xml"
    file.write_text(ARM)
    return load_robot(str(file), ddq_max=15.0)


@pytest.fixture(scope="module")
def result(own_family, arm):
    """Return the identification of a short recording of an arm with that friction, started from the paper's law."""
    truth = replace(Dynamics.of(arm, PHI, family(own_family)), delay=2e-3)
    noise = {k: conf("data/simulated")[k] for k in ("position_noise", "velocity_noise")}
    motion = record(SimulatedArm(arm, truth, **noise, seed=0), fourier(arm, duration=8.0, seed=0, effort=0))
    return identify(
        arm,
        nominal_dynamics(arm, **conf("friction/uniform") | {"family": own_family}),
        motion,
        [LeastSquares(level="torque", max_evaluations=12), LeastSquares(max_evaluations=12, ftol=1e-3)],
        Settings(
            BOUNDS, SETTINGS["prior"]["commanded"], ["offset", "delay"], family=own_family, breakaway=None, nthread=1
        ),
    )


def test_a_family_is_found_by_its_dotted_path(own_family):
    """The same record each time; built-in ones keep their names, and only they are what auto compares."""
    own = family(own_family)
    assert isinstance(own, Family)
    assert family(own_family) is own
    assert family_path(own) == own_family
    assert [family_path(f) for f in FAMILIES] == [f.name for f in FAMILIES]
    assert own not in FAMILIES
    Settings(BOUNDS, {}, ["viscous", "offset"], family=own_family)


def test_its_native_form_is_its_numpy_form(own_family, arm):
    """One step from any state takes the torque and the slope of the law in NumPy, beside arms of other families."""
    rng = np.random.default_rng(0)
    phi = np.concatenate([PHI * rng.uniform(0.5, 2.0, (20, 2, 2)), rng.uniform(0, 1, (20, 2, 1))], -1)
    dynamics = Dynamics.of(arm, phi, family(own_family))
    q, dq = rng.uniform(-1, 1, (20, 2)), rng.uniform(-1, 1, (20, 2)) * 10.0 ** rng.uniform(-3, 0, (20, 2))
    sim = Simulator(arm, Dynamics.of(arm, np.array([[1.0, 10.0, 0.0]] * 2)), 21, 1)
    sim.set_dynamics(dynamics, np.arange(20))
    q, dq = np.vstack([q, q[:1]]), np.vstack([dq, dq[:1]])
    sim.reset(q, dq)
    out = sim.rollout(np.zeros((21, 1, 2)), record=("qvel",))["qvel"][:, 0]
    frictionless = Simulator(arm, Dynamics.of(arm, np.zeros((2, 3))), 21, 1)
    frictionless.reset(q, dq)
    free = frictionless.rollout(np.zeros((21, 1, 2)), record=("qvel",))["qvel"][:, 0]
    for k in range(21):
        law, own = (family(own_family), phi[k]) if k < 20 else (SIGMOID, np.array([[1.0, 10.0, 0.0]] * 2))
        mass = np.linalg.inv(InverseInertia(arm)(q[k : k + 1])[0])
        torque, slope = law.torque(dq[k], own), compiled_slope(law, dq[k], own)
        step = np.linalg.solve(mass + 1e-3 * np.diag(slope), mass @ (free[k] - dq[k]) - 1e-3 * torque)
        # of a few dozen operations, each within eps of the largest term, through a matrix of this condition
        bound = 100 * np.finfo(float).eps * np.linalg.cond(mass) * max(1.0, np.abs(dq[k]).max())
        np.testing.assert_allclose(out[k], dq[k] + step, rtol=0, atol=bound)


@pytest.mark.long
def test_it_is_identified(result):
    """From the uniform start the curves come within 5 % of the truth where the motion was."""
    found = result.dynamics
    assert found.family.name == "tanh"
    assert found.phi.shape == (2, 2)  # viscous is optional, and no term named it
    dq = np.linspace(0.05, 1.0, 20)[:, None] * np.ones(2)
    truth = found.family.torque(dq, PHI)
    np.testing.assert_allclose(found.friction(dq), truth, rtol=0.05)


@pytest.mark.long
def test_it_goes_through_the_file(result, own_family, arm, tmp_path):
    """parameters.yaml names the dotted path and the record's units, and loads again as the same arm."""
    save_parameters(tmp_path / "parameters.yaml", *result.saved, {})
    document = yaml.safe_load((tmp_path / "parameters.yaml").read_text())
    assert document["friction_family"] == own_family
    assert document["parameters"]["width"]["unit"] == "rad/s"
    space, x = load_parameters(tmp_path, arm)
    assert space.nominal.family is family(own_family)
    np.testing.assert_allclose(space.dynamics(x).phi, result.dynamics.phi, rtol=1e-5)


def test_scales_and_optional_parameters_are_the_records(own_family, arm):
    """Logarithmic ones have their geometric mean in the middle of the cube; a term brings the optional one in."""
    own = with_family(nominal_dynamics(arm, **conf("friction/uniform")), own_family)
    motion = SimpleNamespace(torque="commanded", tau=np.zeros((1, arm.n)))
    space = search_space(arm, own, BOUNDS, ["viscous"], motion)
    middle = space.from_unit(np.full(6, 0.5))
    np.testing.assert_allclose(space.block(middle, "width"), np.sqrt(0.005 * 0.5))
    np.testing.assert_allclose(space.block(middle, "viscous"), 0.5 * BOUNDS["viscous"][1] * arm.tau_max)
    narrow = search_space(arm, own, BOUNDS | {"width": [0.01, 0.1]}, ["viscous"], motion)
    np.testing.assert_allclose(narrow.block(narrow.upper, "width"), 0.1)
    for terms, blocks in ((["offset"], 3), (["viscous", "offset"], 4)):
        assert len(search_space(arm, own, BOUNDS, terms, motion).blocks) == blocks
    with pytest.raises(UserError, match=r"^bounds\.phi1: friction family 'tanh' has level, width, viscous$"):
        parameter_space(arm, own, {"phi1": BOUNDS["phi1"]})
    taken = replace(own, family=replace(own.family, names=("level", "lag", "viscous"), logarithmic=()))
    with pytest.raises(UserError, match=r"^friction\.family: lag of 'tanh' is taken; give it another name$"):
        parameter_space(arm, taken, {"level": [0.1, 1.0]})
    without = {k: v for k, v in BOUNDS.items() if k not in own.family.names}
    with pytest.raises(UserError, match=r"^identify\.bounds: none for level, width"):
        search_space(arm, replace(own, family=replace(own.family, bounds=())), without, ["offset"], motion)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("no_such_module.MINE", "cannot import 'no_such_module.MINE'"),
        ("my_friction.TAHN", "cannot import 'my_friction.TAHN'"),
        ("my_friction.law", "expected a Family, got 'my_friction.law' of type function"),
        (
            "my_friction.OTHER",
            "expected 'viscous' of 'my_friction.OTHER' to be Nm s/rad linear, as in 'sigmoid', got Nm linear",
        ),
        (
            "my_friction",
            "expected sigmoid, coulomb, stribeck, bristle, auto, or my_module.MY_FAMILY, got 'my_friction'",
        ),
    ],
)
def test_a_wrong_path_is_one_line(own_family, name, words):
    """A failed import, another type and a name with another unit are errors."""
    family(own_family)
    sys.modules["my_friction"].OTHER = replace(family(own_family), units=("Nm", "rad/s", "Nm"))
    with pytest.raises(UserError) as error:
        family(name)
    assert str(error.value).startswith(f"friction.family: {words}")
    assert "\n" not in str(error.value)


def test_a_record_that_does_not_fit_itself_is_one_line(own_family):
    """Units for every parameter, names that exist, optional ones last, and not more than the step has room for."""
    own = family(own_family)
    for change in (
        {"units": ("Nm",)},
        {"logarithmic": ("levle",)},
        {"optional": ("level",)},
        {"bounds": ((0.0, 1.0),)},
        {"names": tuple("abcdefghi"), "units": ("1",) * 9, "logarithmic": (), "optional": ()},
    ):
        with pytest.raises(UserError, match=r"^friction family 'tanh': "):
            replace(own, **change)
