"""Parameters keep their values on the way through the unit cube and the file; randomized arms stay physical."""

from dataclasses import replace

import numpy as np
import pytest
import yaml
from conftest import conf
from hypothesis import given, settings
from hypothesis import strategies as st

from r2s.errors import UserError
from r2s.parameters import UNITS, inertia_scale, load_parameters, nominal_dynamics, parameter_space, save_parameters
from r2s.randomization import draw, physical
from r2s.robot import load_robot

BOUNDS = conf("config")["identify"]["bounds"]
EDGES = {"breakaway_positive": [0.0, 1.5], "breakaway_negative": [-1.5, 0.0]}
TENSORS = ("xx", "yy", "zz", "xy", "xz", "yz")


@pytest.fixture(scope="module")
def paper(panda):
    return nominal_dynamics(panda, **conf("friction/paper"), inertia_scale=conf("inertia/paper")["scale"])


@pytest.fixture(scope="module")
def space(panda, paper):
    return parameter_space(panda, paper, BOUNDS | EDGES)


def same(a, b, rtol):
    for name in ("phi", "offset", "breakaway", "inertia", "dq_min"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=rtol, atol=1e-12)


@settings(deadline=None, max_examples=50)
@given(data=st.data())
def test_unit_cube_and_si_are_inverse(space, data):
    """from_unit and to_unit undo each other for every point of the cube, corners included, and keep the bounds."""
    u = np.array(data.draw(st.lists(st.floats(0, 1), min_size=49, max_size=49)))
    x = space.from_unit(u)
    np.testing.assert_allclose(space.to_unit(x), u, atol=1e-12)
    assert np.all(x >= space.lower - 1e-12)
    assert np.all(x <= space.upper * (1 + 1e-12) + 1e-12)
    np.testing.assert_allclose(space.from_unit(space.to_unit(x)), x, rtol=1e-12, atol=1e-12)


def test_outside_of_the_cube_is_its_edge(space):
    """A search that steps out of the cube gets the bound."""
    count = len(space.start)
    np.testing.assert_allclose(space.from_unit(np.full(count, -0.5)), space.lower, rtol=1e-12)
    np.testing.assert_allclose(space.from_unit(np.full(count, 1.5)), space.upper, rtol=1e-12)


def test_logarithmic_coordinates_have_their_geometric_mean_in_the_middle(space):
    """phi1, phi2 and inertia scales are searched by ratio, the others by difference."""
    middle = space.from_unit(np.full(len(space.start), 0.5))
    np.testing.assert_allclose(space.block(middle, "phi1"), np.sqrt(0.05 * 10.0))
    np.testing.assert_allclose(space.block(middle, "inertia_scale"), np.sqrt(0.3 * 3.0))
    np.testing.assert_allclose(space.block(middle, "phi3"), 0.0, atol=1e-15)


def test_the_start_is_the_nominal_arm(space, paper):
    """Dynamics of the start vector are the nominal ones, block by block."""
    same(space.dynamics(space.start), paper, rtol=1e-12)
    assert len(space.names) == len(space.start) == 49
    assert space.names[0] == "phi1[1]"


def test_a_batch_of_vectors_is_a_batch_of_arms(space, panda):
    """Dynamics of (C, P) are those of each row."""
    x = space.from_unit(np.random.default_rng(0).random((4, len(space.start))))
    many = space.dynamics(x)
    assert many.inertia.shape == (4, 7, 3, 3)
    for k in range(4):
        one = space.dynamics(x[k])
        for name in ("phi", "offset", "breakaway", "inertia"):
            assert np.array_equal(getattr(many, name)[k], getattr(one, name))
    np.testing.assert_allclose(inertia_scale(many.inertia, panda.inertia), space.block(x, "inertia_scale"))


def test_blocks_that_are_not_searched_keep_their_nominal_values(panda, paper):
    """With bounds for offsets alone, everything else is the nominal arm."""
    small = parameter_space(panda, paper, {"offset": [-2.0, 2.0]})
    found = small.dynamics(np.full(7, 0.25))
    same(replace(found, offset=paper.offset), paper, rtol=0)
    assert np.array_equal(found.offset, np.full(7, 0.25))


def write(path, robot, space, x):
    low, high = x - 0.01, x + 0.01
    save_parameters(path, robot, space, x, (low, high), np.arange(len(x)) % 2 == 0, {"recording": "test"})


@pytest.mark.parametrize("blocks", [["phi1", "phi2", "phi3", "inertia_scale", "offset"], ["phi2", "offset"]])
def test_parameters_come_back_from_their_file(tmp_path, panda, paper, blocks):
    """What save_parameters writes, load_parameters reads: the same dynamics to 1e-5, from the folder or the file."""
    space = parameter_space(panda, paper, {b: BOUNDS[b] for b in blocks})
    x = space.from_unit(np.random.default_rng(1).random(len(space.start)))
    write(tmp_path / "parameters.yaml", panda, space, x)
    for place in (tmp_path, tmp_path / "parameters.yaml", str(tmp_path)):
        same(load_parameters(place, panda), space.dynamics(x), rtol=1e-5)


def test_searched_breakaway_comes_back_from_its_file(tmp_path, panda, space):
    """Edges that were searched as blocks are read as they were found."""
    x = space.from_unit(np.random.default_rng(2).random(len(space.start)))
    write(tmp_path / "parameters.yaml", panda, space, x)
    same(load_parameters(tmp_path, panda), space.dynamics(x), rtol=1e-5)


def test_the_file_holds_what_a_reader_needs(tmp_path, panda, space):
    """Per block: unit, value, nominal, bounds, interval and identifiable, one number per joint."""
    x = space.from_unit(np.random.default_rng(3).random(len(space.start)))
    write(tmp_path / "parameters.yaml", panda, space, x)
    document = yaml.safe_load((tmp_path / "parameters.yaml").read_text())
    assert document["robot"] == "panda"
    assert set(document["parameters"]) == set(BOUNDS | EDGES)
    for name, entry in document["parameters"].items():
        assert entry["unit"] == UNITS[name]
        for key in ("value", "nominal", "lower_bound", "upper_bound", "interval95_low", "interval95_high"):
            assert len(entry[key]) == 7
        assert entry["identifiable"] == space.block(np.arange(49) % 2 == 0, name).tolist()
        np.testing.assert_allclose(entry["value"], space.block(x, name), rtol=1e-5)


OTHER = """
<mujoco model="other">
  <worldbody>
    <body><inertial pos="0 0 0.1" mass="1" diaginertia="0.01 0.01 0.01"/>
      <joint axis="0 0 1" range="-90 90" actuatorfrcrange="-9 9"/><site name="tip" pos="0 0 0.2"/>
    </body>
  </worldbody>
</mujoco>
"""


def test_another_robots_parameters_are_refused(tmp_path, panda, space):
    """One line names both arms; so does a missing file, with the nearest run, and a file of something else."""
    (tmp_path / "other.xml").write_text(OTHER)
    other = load_robot(str(tmp_path / "other.xml"))
    run = tmp_path / "run_one"
    run.mkdir()
    write(run / "parameters.yaml", panda, space, space.start)
    with pytest.raises(UserError, match=r"^calibration: .* is of 'panda' with 7 joints; this arm is 'other' with 1$"):
        load_parameters(run, other)
    with pytest.raises(UserError, match=r"^calibration: no parameters\.yaml at .*run_on; did you mean 'run_one'\?$"):
        load_parameters(tmp_path / "run_on", panda)
    (run / "parameters.yaml").write_text("robot: panda\njoints: 7\nparameters: {phi1: 3}\n")
    with pytest.raises(UserError, match=r"^calibration: .* is not a parameters\.yaml of r2s \(.*\)$"):
        load_parameters(run, panda)


@pytest.mark.parametrize("text", ["", "just words\n", "- a\n- list\n", "a: [1, 2\n", "robot: panda\n"])
def test_a_file_of_something_else_is_one_line(tmp_path, panda, text):
    """A parameters.yaml that is empty, no mapping, no YAML or incomplete is a UserError of one line."""
    (tmp_path / "parameters.yaml").write_text(text)
    with pytest.raises(UserError) as caught:
        load_parameters(tmp_path, panda)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("bounds", "words"),
    [
        ({"phi11": [0.1, 1.0]}, ["unknown parameter 'phi11'", "did you mean 'phi1'?"]),
        ({"phi1": [2.0, 1.0]}, ["bounds.phi1", "[2.0, 1.0]"]),
        ({"phi1": [0.0, 1.0]}, ["bounds.phi1", "low > 0"]),
        ({"offset": [1.0]}, ["bounds.offset", "[1.0]"]),
        ({"inertia_scale": [-1.0, 1.0]}, ["bounds.inertia_scale"]),
    ],
)
def test_wrong_bounds_are_named(panda, paper, bounds, words):
    """An unknown block or bounds that do not rise are one line that names them."""
    with pytest.raises(UserError) as caught:
        parameter_space(panda, paper, bounds)
    assert "\n" not in str(caught.value)
    assert all(word in str(caught.value) for word in words)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"phi1": [1.0, 2.0]}, ["friction.phi1", "2 values", "7 joints"]),
        ({"phi2": -1.0}, ["friction.phi2", "-1", "negative"]),
        ({"offset": float("nan")}, ["friction.offset", "not finite"]),
        ({"inertia_scale": 0.0}, ["inertia.scale", "not positive"]),
        ({"breakaway_positive": -0.1}, ["friction.breakaway"]),
    ],
)
def test_impossible_dynamics_are_named(panda, change, words):
    """conf/friction and conf/inertia with a value out of its physical range are one line that names it."""
    with pytest.raises(UserError) as caught:
        nominal_dynamics(panda, **({"phi1": 1.0, "phi2": 10.0, "phi3": 0.0} | change))
    assert "\n" not in str(caught.value)
    assert all(word in str(caught.value) for word in words)


def test_the_papers_randomization_stays_in_its_ranges(panda, paper):
    """Phi within 10 %, tensor elements within 5 %, every tensor physical, each element a draw of its own."""
    m = 400
    drawn = draw(np.random.default_rng(0), paper, m, phi_relative=0.10, inertia_relative=0.05)
    phi = drawn.phi / paper.phi
    assert phi.shape == (m, 7, 3)
    assert 0.9 <= phi.min() < 0.901
    assert 1.099 < phi.max() <= 1.1
    assert physical(drawn.inertia).all()
    np.testing.assert_allclose(drawn.inertia, drawn.inertia.transpose(0, 1, 3, 2), rtol=0, atol=1e-15)
    elements = (drawn.inertia / paper.inertia)[..., *np.triu_indices(3)].reshape(m, -1)
    assert elements.min() >= 0.95 - 1e-12
    assert elements.max() <= 1.05 + 1e-12
    free = elements.reshape(m, 7, 6)[:, [3, 6]].reshape(m, -1)  # no draw of links 4 and 7 is unphysical
    correlation = np.corrcoef(np.concatenate([phi.reshape(m, -1), free], 1).T) - np.eye(21 + 12)
    assert np.abs(correlation).max() < 0.25
    for name in ("offset", "breakaway", "dq_min"):
        assert np.array_equal(getattr(drawn, name), getattr(paper, name))


@pytest.mark.parametrize("inertia", ["nominal", "paper"])
def test_the_centre_itself_is_physical(panda, inertia):
    """Both columns of Table III are positive definite and obey the triangle inequality."""
    assert physical(panda.inertia * np.reshape(conf(f"inertia/{inertia}")["scale"], (-1, 1, 1))).all()


def test_physical_tells_apart():
    """A rod and a ball are physical; a negative moment and a broken triangle inequality are not."""
    tensors = np.stack([np.diag(d) for d in ([1, 1, 1e-9], [1, 1, 1], [1, 1, -0.1], [1, 1, 2.1], [1.0, 1, 2.0])])
    assert physical(tensors).tolist() == [True, True, False, False, True]
    assert physical(np.array([[1.0, 2, 0], [2, 1, 0], [0, 0, 1]])).tolist() is False


def test_same_seed_same_draws(paper):
    """A seed gives the same arms twice and another seed gives others."""
    first, again, other = (
        draw(np.random.default_rng(s), paper, 3, phi_relative=0.1, inertia_relative=0.05) for s in (5, 5, 6)
    )
    assert np.array_equal(first.phi, again.phi)
    assert np.array_equal(first.inertia, again.inertia)
    assert not np.array_equal(first.phi, other.phi)


def test_zero_widths_give_the_centre(paper):
    """conf/dr/none is m copies of the centre."""
    drawn = draw(np.random.default_rng(0), paper, 5, **conf("dr/none"))
    assert np.array_equal(drawn.phi, np.broadcast_to(paper.phi, (5, 7, 3)))
    assert np.array_equal(drawn.inertia, np.broadcast_to(paper.inertia, (5, 7, 3, 3)))
