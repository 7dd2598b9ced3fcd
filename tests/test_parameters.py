"""Parameters keep their values on the way through the unit cube and the file; randomized arms stay physical."""

from dataclasses import fields, replace

import numpy as np
import pytest
import yaml
from conftest import conf
from hypothesis import given, settings
from hypothesis import strategies as st

from r2s.errors import UserError
from r2s.identification.link_inertia import CHOLESKY, LINK, inertia_scale, links, log_cholesky, pseudo_inertia
from r2s.identification.parameter_file import load_parameters, load_posterior, save_parameters
from r2s.identification.parameters import WHOLE_ARM, ParameterEstimate, parameter_space, torque_like, units
from r2s.learning.randomization import PosteriorRandomization, UniformRandomization, physical
from r2s.physics.dynamics import nominal_dynamics, with_family
from r2s.physics.friction import FAMILIES, STRIBECK
from r2s.physics.robot import load_robot

ALL = {k: np.multiply(v, 20.0 if k in torque_like() else 1.0) for k, v in conf("identify/default")["bounds"].items()}
EDGES = {"breakaway_positive": [0.0, 1.5], "breakaway_negative": [-1.5, 0.0]}
PAPER = {k: ALL[k] for k in ("phi1", "phi2", "phi3", "inertia_scale", "offset")}
REST = {k: ALL[k] for k in ("offset", *LINK, "delay", "lag", "load", "drag_sin", "drag_cos", "gain")}


@pytest.fixture(scope="module")
def paper(panda):
    return nominal_dynamics(panda, **conf("friction/paper"), inertia_scale=conf("inertia/paper")["scale"])


@pytest.fixture(scope="module")
def space(panda, paper):
    """What the paper searches, and the edges of the dead zone."""
    return parameter_space(panda, paper, PAPER | EDGES)


@pytest.fixture(scope="module")
def whole(panda, paper):
    """Everything that can be searched at once: another family, whole links, blocks of one value."""
    stribeck = with_family(paper, "stribeck")
    friction = {k: ALL[k] for k in STRIBECK.names if k not in STRIBECK.optional}
    return parameter_space(panda, stribeck, friction | REST | EDGES)


@pytest.fixture(params=["space", "whole"])
def either(request):
    return request.getfixturevalue(request.param)


def some(space, seed, count=None):
    """Return random vectors within the bounds."""
    shape = len(space.start) if count is None else (count, len(space.start))
    return space.from_unit(np.random.default_rng(seed).random(shape))


def same(a, b, rtol):
    """Assert that two dynamics agree, field by field."""
    assert (a.family, a.stiction_model) == (b.family, b.stiction_model)
    for name in (f.name for f in fields(a) if f.name not in ("family", "stiction_model")):
        if getattr(a, name) is None:
            assert getattr(b, name) is None, name
            continue
        atol = max(rtol * 1e-3, 1e-12)
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=rtol, atol=atol, err_msg=name)


@settings(deadline=None, max_examples=50)
@given(data=st.data())
def test_unit_cube_and_si_are_inverse(space, whole, data):
    """from_unit and to_unit undo each other for every point of the cube, corners included, and keep the bounds."""
    one = data.draw(st.sampled_from([space, whole]))
    edge = np.array(data.draw(st.lists(st.floats(0, 1), min_size=8, max_size=8)))
    u = np.resize(edge, len(one.start))
    x = one.from_unit(u)
    np.testing.assert_allclose(one.to_unit(x), u, atol=1e-12)
    assert np.all(x >= one.lower - 1e-12)
    assert np.all(x <= one.upper * (1 + 1e-12) + 1e-12)
    np.testing.assert_allclose(one.from_unit(one.to_unit(x)), x, rtol=1e-12, atol=1e-12)


def test_outside_of_the_cube_is_its_edge(either):
    """A search that steps out of the cube gets the bound."""
    count = len(either.start)
    np.testing.assert_allclose(either.from_unit(np.full(count, -0.5)), either.lower, rtol=1e-12)
    np.testing.assert_allclose(either.from_unit(np.full(count, 1.5)), either.upper, rtol=1e-12)


def test_logarithmic_coordinates_have_their_geometric_mean_in_the_middle(space, whole):
    """What spans decades is searched by ratio, the rest by difference; `width` is the width in that coordinate."""
    middle = space.from_unit(np.full(len(space.start), 0.5))
    np.testing.assert_allclose(space.block(middle, "phi1"), np.sqrt(ALL["phi1"].prod()))
    np.testing.assert_allclose(space.block(middle, "inertia_scale"), np.sqrt(0.3 * 3.0))
    np.testing.assert_allclose(space.block(middle, "phi3"), 0.0, atol=1e-15)
    middle = whole.from_unit(np.full(len(whole.start), 0.5))
    np.testing.assert_allclose(whole.block(middle, "stribeck_velocity"), np.sqrt(0.01 * 0.5))
    np.testing.assert_allclose(whole.block(middle, "delay"), [0.005])
    np.testing.assert_allclose(whole.block(whole.width, "coulomb"), np.log(ALL["coulomb"][1] / ALL["coulomb"][0]))
    np.testing.assert_allclose(whole.block(whole.width, "drag_sin"), np.ptp(ALL["drag_sin"]))


def test_the_start_is_the_nominal_arm(space, whole, paper):
    """Dynamics of the start vector are the nominal ones, block by block."""
    same(space.dynamics(space.start), paper, rtol=1e-12)
    assert len(space.names) == len(space.start) == 49
    assert space.names[0] == "phi1[1]"
    found = whole.dynamics(whole.start)
    for name in ("load", "drag", "gain"):
        assert not getattr(found, name).any()
    same(found, whole.nominal, rtol=1e-9)


def test_blocks_of_the_whole_arm_are_one_value(whole):
    """Delay and lag are named without a joint, take one place each and become one number of the dynamics."""
    assert len(whole.names) == len(whole.start) == 7 * (len(whole.blocks) - 2) + 2
    assert len(set(whole.names)) == len(whole.names)
    x = np.arange(len(whole.start), dtype=float)
    for k, name in enumerate(whole.names):
        block, _, joint = name.partition("[")
        assert whole.block(x, block)[int(joint[:-1]) - 1 if joint else 0] == k
        assert (not joint) == (block in WHOLE_ARM)
    many = whole.dynamics(some(whole, 0, 3))
    assert many.delay.shape == many.lag.shape == (3,)
    assert np.ndim(whole.dynamics(whole.start).delay) == 0
    out = whole.expand({"delay": 1.0, "offset": 2.0}, -1.0)
    assert whole.block(out, "delay").tolist() == [1.0]
    assert whole.block(out, "offset").tolist() == [2.0] * 7
    assert np.count_nonzero(out == -1.0) == len(x) - 8


def test_a_batch_of_vectors_is_a_batch_of_arms(either, panda):
    """Dynamics of (C, P) are those of each row."""
    x = some(either, 0, 4)
    many = either.dynamics(x)
    assert many.inertia.shape == (4, 7, 3, 3)
    for k in range(4):
        same(many.one(k), either.dynamics(x[k]), rtol=1e-12)
    if "inertia_scale" in either.blocks:
        np.testing.assert_allclose(inertia_scale(many.inertia, panda.inertia), either.block(x, "inertia_scale"))


def test_blocks_that_are_not_searched_keep_their_nominal_values(panda, paper):
    """With bounds for offsets alone, everything else is the nominal arm; so with one number of the links alone."""
    small = parameter_space(panda, paper, {"offset": [-2.0, 2.0]})
    found = small.dynamics(np.full(7, 0.25))
    same(replace(found, offset=paper.offset), paper, rtol=0)
    assert np.array_equal(found.offset, np.full(7, 0.25))
    heavier = parameter_space(panda, paper, {"link_alpha": [-1.0, 1.0]})
    found = heavier.dynamics(heavier.start + np.log(1.5) / 2)
    np.testing.assert_allclose(found.mass, 1.5 * panda.mass)
    np.testing.assert_allclose(found.inertia, 1.5 * paper.inertia, atol=1e-9)


def test_a_searched_viscous_term_extends_the_sigmoid(panda, paper):
    """A block that the nominal friction does not have starts at zero and is then part of it."""
    space = parameter_space(panda, paper, {"viscous": [0.0, 2.0], "phi1": [0.1, 10.0]})
    assert not space.block(space.start, "viscous").any()
    found = space.dynamics(np.concatenate([np.full(7, 0.7), paper.phi[:, 0]]))
    assert found.phi.shape == (7, 4)
    dq = np.linspace(-1, 1, 7)
    np.testing.assert_allclose(found.friction(dq), paper.friction(dq) + 0.7 * dq)


@pytest.mark.parametrize("name", [f.name for f in FAMILIES])
def test_the_arm_of_another_family_has_the_same_level(panda, paper, name):
    """with_family and friction.family keep the mean friction at 1 rad/s and everything else."""
    found, one = with_family(paper, name), np.ones(7)
    np.testing.assert_allclose(found.family.level(found.phi, one), paper.family.level(paper.phi, one), rtol=1e-7)
    same(replace(found, phi=paper.phi, family=paper.family), paper, rtol=0)
    settings = conf("friction/paper") | {"family": name}
    same(nominal_dynamics(panda, **settings, inertia_scale=conf("inertia/paper")["scale"]), found, rtol=1e-12)
    space = parameter_space(panda, found, {k: ALL[k] for k in found.family.names})
    assert space.dynamics(space.start).family.name == name


def test_measured_edges_of_the_dead_zone_move_with_the_offset(panda, paper):
    """The command at which a joint let go was seen: edge = command + offset, on its own side of zero."""
    command = np.stack([np.full(7, -0.4), np.full(7, 0.6)], -1)
    space = replace(parameter_space(panda, paper, {"offset": [-2.0, 2.0]}), breakaway_command=command)
    x = np.array([[0.0] * 7, [0.1] * 7, [-0.25] * 7, [0.9] * 7, [-0.9] * 7])
    edges = space.dynamics(x).breakaway
    np.testing.assert_allclose(edges[:, 0], [[-0.4, 0.6], [-0.3, 0.7], [-0.65, 0.35], [0.0, 1.5], [-1.3, 0.0]])
    assert np.array_equal(edges, np.broadcast_to(edges[:, :1], edges.shape))
    own = parameter_space(panda, paper, {"offset": [-2.0, 2.0], "breakaway_positive": [0.0, 1.0]})
    own = replace(own, breakaway_command=command)
    edges = own.dynamics(np.repeat([0.1, 0.25], 7)).breakaway
    np.testing.assert_allclose(edges, np.tile([-0.3, 0.25], (7, 1)))


# --- links ----------------------------------------------------------------------------------------------------


def test_zero_is_the_nominal_link(panda):
    """Theta = 0 gives masses, centres and tensors of the robot back; alpha alone scales all of them."""
    mass, com, inertia = links(panda, np.zeros((7, 10)))
    np.testing.assert_allclose(mass, panda.mass, rtol=1e-12)
    np.testing.assert_allclose(com, panda.com, atol=1e-14)
    np.testing.assert_allclose(inertia, panda.inertia, atol=1e-14)
    mass, com, inertia = links(panda, np.log(2.0) / 2 * (np.arange(10) == CHOLESKY.index("alpha")) * np.ones((7, 10)))
    np.testing.assert_allclose(mass, 2 * panda.mass)
    np.testing.assert_allclose(com, panda.com, atol=1e-12)
    np.testing.assert_allclose(inertia, 2 * panda.inertia, atol=1e-12)


@settings(deadline=None, max_examples=50)
@given(seed=st.integers(0, 10_000), size=st.sampled_from([0.1, 0.5, 1.0, 2.0]))
def test_every_theta_is_a_physical_link_and_comes_back(panda, paper, seed, size):
    """Mass positive, tensor positive definite with the triangle inequality; one to one where links stay solid."""
    theta = np.random.default_rng(seed).uniform(-size, size, (3, 7, 10))
    mass, com, inertia = links(panda, theta)
    assert np.all(mass > 0)
    assert physical(inertia).all()
    assert np.all(np.linalg.eigvalsh(pseudo_inertia(mass, com, inertia)) > 0)
    for k in range(3 if size < 1 else 0):  # beyond, a link may be flatter than pseudo_inertia lets it be
        d = replace(paper, mass=mass[k], com=com[k], inertia=inertia[k])
        np.testing.assert_allclose(log_cholesky(panda, d), theta[k], atol=1e-6)


def test_the_pseudo_inertia_is_the_sum_over_point_masses():
    """[[Sigma, h], [h^T, m]] = sum m p p^T with p = (x, y, z, 1), for mass, centre and tensor of those points."""
    rng = np.random.default_rng(0)
    points, m = rng.normal(size=(12, 3)), rng.uniform(0.1, 1, 12)
    com = m @ points / m.sum()
    away = points - com
    square = (away**2).sum(-1)[:, None, None] * np.eye(3) - away[:, :, None] * away[:, None]
    tensor = np.einsum("k,kij->ij", m, square)
    p = np.concatenate([points, np.ones((12, 1))], 1)
    np.testing.assert_allclose(pseudo_inertia(m.sum()[None], com[None], tensor[None])[0], p.T * m @ p, atol=1e-12)


def test_an_unphysical_tensor_becomes_a_flat_one(panda):
    """A published tensor that breaks the triangle inequality is a start nevertheless, and nearly kept."""
    broken = panda.inertia.copy()
    broken[2] = np.diag([0.01, 0.01, 0.025])
    assert not physical(broken[2])
    mass, com, inertia = links(replace(panda, inertia=broken), np.zeros((7, 10)))
    assert physical(inertia).all()
    np.testing.assert_allclose(mass, panda.mass)
    np.testing.assert_allclose(com, panda.com, atol=1e-9)
    np.testing.assert_allclose(np.delete(inertia, 2, 0), np.delete(panda.inertia, 2, 0), atol=1e-9)
    assert np.abs(inertia[2] - broken[2]).max() < 0.006


# --- the file -------------------------------------------------------------------------------------------------


def write(path, space, x, samples=None):
    draws = x + 0.01 * np.random.default_rng(0).normal(size=(5, len(x))) if samples is None else samples
    found = ParameterEstimate(x, x - 0.01, x + 0.01, np.arange(len(x)) % 2 == 0, draws)
    save_parameters(path, space, found, {"recording": "test"}, {"remark": ["kept"]})


@pytest.mark.parametrize("blocks", [["phi1", "phi2", "phi3", "inertia_scale", "offset"], ["phi2", "offset"], [*REST]])
def test_parameters_come_back_from_their_file(tmp_path, panda, paper, blocks):
    """What save_parameters writes, load_parameters reads: the same arm to 1e-5, from the folder or the file."""
    space = parameter_space(panda, paper, {b: ALL[b] for b in blocks})
    x = some(space, 1)
    write(tmp_path / "parameters.yaml", space, x)
    for place in (tmp_path, tmp_path / "parameters.yaml", str(tmp_path)):
        loaded, values = load_parameters(place, panda)
        assert loaded.names == space.names
        np.testing.assert_allclose(values, x, rtol=1e-5)
        same(loaded.dynamics(values), space.dynamics(x), rtol=1e-5)


def test_everything_at_once_comes_back_from_its_file(tmp_path, panda, whole):
    """Another family, whole links, delay and lag, searched edges, and nominal values of what is optional."""
    nominal = replace(whole.nominal, gain=np.linspace(0, 0.1, 7), delay=0.003, lag=0.001)
    nominal = replace(nominal, drag=np.ones((7, 2)), load=np.full(7, 0.01))
    keep = {k: (ALL | EDGES)[k] for k in whole.blocks if k not in ("gain", "delay", "drag_sin", "load")}
    for space in (whole, replace(whole, nominal=nominal), parameter_space(panda, nominal, keep)):
        x = some(space, 2)
        write(tmp_path / "parameters.yaml", space, x)
        loaded, values = load_parameters(tmp_path, panda)
        same(loaded.dynamics(values), space.dynamics(x), rtol=1e-5)
        same(loaded.nominal, space.nominal, rtol=1e-12)


def test_draws_come_back_from_their_file(tmp_path, panda, whole):
    """posterior.npz holds the joint distribution; dr=identified draws whole rows of it, so correlations stay."""
    x = some(whole, 3)
    samples = some(whole, 4, 6)
    write(tmp_path / "parameters.yaml", whole, x, samples)
    space, _ = load_parameters(tmp_path, panda)
    for place in (tmp_path, tmp_path / "parameters.yaml"):
        assert np.array_equal(load_posterior(place, space), samples)
    drawn = PosteriorRandomization(space, samples)(np.random.default_rng(0), 40)
    rows = whole.dynamics(samples)
    assert drawn.offset.shape == (40, 7)
    which = np.abs(drawn.delay[:, None] - rows.delay).argmin(1)
    assert len(set(which)) > 3
    for name in ("phi", "offset", "breakaway", "inertia", "mass", "com", "load", "drag", "gain", "delay", "lag"):
        np.testing.assert_allclose(getattr(drawn, name), getattr(rows, name)[which], rtol=1e-12, atol=1e-15)
    assert physical(drawn.inertia).all()


def test_a_wrong_posterior_is_one_line(tmp_path, panda, space, whole):
    """No posterior.npz, one of other parameters or something else of that name: each is named."""
    write(tmp_path / "parameters.yaml", space, space.start)
    loaded, _ = load_parameters(tmp_path, panda)
    path = tmp_path / "posterior.npz"
    with pytest.raises(UserError, match=r"^dr=identified: .*posterior\.npz has other parameters"):
        load_posterior(tmp_path, whole)
    texts = [b"", b"just words", b"PK\x03\x04 torn"]
    for text in texts:
        path.write_bytes(text)
        with pytest.raises(UserError, match=r"^dr=identified: .* is not a posterior\.npz of r2s \(.*\)$"):
            load_posterior(tmp_path, loaded)
    for arrays in ({"a": 1}, {"names": loaded.names, "samples": np.zeros((3, 4))}, {"names": 3, "samples": 3}):
        np.savez(path, **arrays)
        with pytest.raises(UserError, match=r"^dr=identified: .* is not a posterior\.npz of r2s \(.*\)$"):
            load_posterior(tmp_path, loaded)
    path.unlink()
    with pytest.raises(UserError, match=r"^dr=identified: no posterior\.npz at .*stage=identify$"):
        load_posterior(tmp_path, loaded)


def test_the_file_holds_what_a_reader_needs(tmp_path, panda, space, whole):
    """Per block: unit, value, nominal, bounds, interval and identifiable, one number per joint or one for the arm."""
    for one in (space, whole):
        x = some(one, 3)
        write(tmp_path / "parameters.yaml", one, x)
        document = yaml.safe_load((tmp_path / "parameters.yaml").read_text())
        assert document["robot"] == "panda"
        assert document["friction_family"] == one.nominal.family.name
        assert document["remark"] == ["kept"]
        assert list(document["parameters"]) == list(one.blocks)
        known = np.arange(len(x)) % 2 == 0
        for name, entry in document["parameters"].items():
            assert entry["unit"] == units()[name]
            shape = () if name in WHOLE_ARM else (7,)
            for key in ("value", "nominal", "lower_bound", "upper_bound", "interval95_low", "interval95_high"):
                assert np.shape(entry[key]) == shape
            np.testing.assert_allclose(entry["value"], one.block(x, name).reshape(shape), rtol=1e-5)
            assert np.array_equal(entry["identifiable"], one.block(known, name).reshape(shape))
    d = whole.dynamics(x)
    for key, value in zip(("mass_kg", "com_m", "inertia_about_com_kg_m2"), (d.mass, d.com, d.inertia), strict=True):
        np.testing.assert_allclose(document["links"][key], value, atol=1e-6)


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
    write(run / "parameters.yaml", space, space.start)
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
    with pytest.raises(UserError, match=r"^calibration: .* is not a parameters\.yaml of r2s \(.*\)$") as caught:
        load_parameters(tmp_path, panda)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"parameters": {"phi11": {"value": [1.0] * 7}}}, ["unknown parameter 'phi11'", "did you mean 'phi1'?"]),
        ({"parameters": {"phi1": {"value": [1.0] * 6}}}, ["phi1", "7 finite values"]),
        ({"parameters": {"phi1": {"value": [float("nan")] * 7}}}, ["phi1", "7 finite values"]),
        ({"parameters": {"phi1": {"value": "much"}}}, ["could not convert"]),
        ({"parameters": {"delay": {"value": [0.1, 0.2]}}}, ["delay", "1 finite value"]),
        ({"parameters": {"coulomb": {"value": [1.0] * 7}}}, ["bounds.coulomb", "'sigmoid' has phi1"]),
        ({"parameters": {}}, ["no parameter is named"]),
        ({"parameters": "none"}, []),
        ({"friction_family": "coulom"}, ["friction.family", "'coulom'", "did you mean 'coulomb'?"]),
        ({"fixed": {"phi": [[1.0, 2.0, 0.0]] * 6}}, ["phi", "7 finite values"]),
        ({"fixed": {"breakaway_positive": [1.0]}}, ["breakaway_positive", "7 finite values"]),
    ],
)
def test_a_file_that_was_edited_wrongly_is_one_line(tmp_path, panda, space, change, words):
    """Unknown blocks, numbers that do not fit, another family: one line that names the file and what is wrong."""
    path = tmp_path / "parameters.yaml"
    write(path, space, space.start)
    document = yaml.safe_load(path.read_text())
    change = {k: document[k] | v if k == "fixed" else v for k, v in change.items()}
    path.write_text(yaml.safe_dump(document | change))
    with pytest.raises(
        UserError, match=r"^calibration: .*parameters\.yaml is not a parameters\.yaml of r2s"
    ) as caught:
        load_parameters(tmp_path, panda)
    assert "\n" not in str(caught.value)
    assert all(word in str(caught.value) for word in words), str(caught.value)


@pytest.mark.parametrize(
    ("bounds", "words"),
    [
        ({"phi11": [0.1, 1.0]}, ["unknown parameter 'phi11'", "did you mean 'phi1'?"]),
        ({"phi1": [2.0, 1.0]}, ["bounds.phi1", "[2.0, 1.0]"]),
        ({"phi1": [0.0, 1.0]}, ["bounds.phi1", "low > 0"]),
        ({"offset": [1.0]}, ["bounds.offset", "[1.0]"]),
        ({"inertia_scale": [-1.0, 1.0]}, ["bounds.inertia_scale"]),
        ({"coulomb": [0.1, 1.0]}, ["bounds.coulomb", "'sigmoid'", "phi1, phi2, phi3"]),
        ({"inertia_scale": [0.5, 2.0], "link_d1": [-1.0, 1.0]}, ["inertia_scale", "link_", "one of the two"]),
        ({}, ["no parameter is named"]),
    ],
)
def test_wrong_bounds_are_named(panda, paper, bounds, words):
    """An unknown block, one of another family or bounds that do not rise are one line that names them."""
    with pytest.raises(UserError) as caught:
        parameter_space(panda, paper, bounds)
    assert "\n" not in str(caught.value)
    assert all(word in str(caught.value) for word in words)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"phi1": [1.0, 2.0]}, ["friction.phi1", "expected 7 values", "got 2"]),
        ({"phi2": -1.0}, ["friction.phi2", "got -1"]),
        ({"offset": float("nan")}, ["friction.offset", "finite"]),
        ({"inertia_scale": 0.0}, ["inertia.scale", "positive", "got 0"]),
        ({"breakaway_positive": -0.1}, ["friction.breakaway"]),
        ({"family": "colomb"}, ["friction.family", "'colomb'", "did you mean 'coulomb'?"]),
    ],
)
def test_impossible_dynamics_are_named(panda, change, words):
    """conf/friction and conf/inertia with a value out of its physical range are one line that names it."""
    with pytest.raises(UserError) as caught:
        nominal_dynamics(panda, **({"phi1": 1.0, "phi2": 10.0, "phi3": 0.0} | change))
    assert "\n" not in str(caught.value)
    assert all(word in str(caught.value) for word in words)


def test_the_papers_randomization_stays_in_its_ranges(panda, paper):
    """Phi within 10 %, tensor elements within 5 %, every tensor physical, each phi and link a draw of its own."""
    m = 400
    drawn = UniformRandomization(panda, paper, phi_relative=0.10, inertia_relative=0.05)(np.random.default_rng(0), m)
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


def test_tensors_are_uniform_over_what_is_physical(panda, paper):
    """What the docstring says of the Panda at 5 %: how alike elements are, and that each of them spans its range."""
    m = 4000
    drawn = UniformRandomization(panda, paper, phi_relative=0.0, inertia_relative=0.05)(np.random.default_rng(0), m)
    elements = (drawn.inertia / paper.inertia)[..., *np.triu_indices(3)]
    span = elements.std(0) / (0.05 / np.sqrt(3))  # of a uniform draw
    assert span.min() > 0.7
    assert np.all(elements.min(0) < 0.953)
    assert np.all(elements.max(0) > 1.047)
    alike = np.abs([np.corrcoef(link.T) - np.eye(6) for link in elements.transpose(1, 0, 2)])
    assert alike[0, 0, 3] == pytest.approx(0.97, abs=0.01)
    assert np.all(alike[[1, 2, 4, 5]].max((1, 2)) < 0.6 + 0.05)
    assert np.all(alike[[3, 6]].max((1, 2)) < 5 / np.sqrt(m))
    across = np.corrcoef(elements.reshape(m, -1).T).reshape(7, 6, 7, 6)
    assert max(np.abs(across[i, :, k]).max() for i in range(7) for k in range(i)) < 5 / np.sqrt(m)


@pytest.mark.parametrize("inertia", ["nominal", "paper"])
def test_the_centre_itself_is_physical(panda, inertia):
    """Both columns of Table III are positive definite and obey the triangle inequality."""
    assert physical(panda.inertia * np.reshape(conf(f"inertia/{inertia}")["scale"], (-1, 1, 1))).all()


def test_physical_tells_apart():
    """A rod and a ball are physical; a negative moment and a broken triangle inequality are not."""
    tensors = np.stack([np.diag(d) for d in ([1, 1, 1e-9], [1, 1, 1], [1, 1, -0.1], [1, 1, 2.1], [1.0, 1, 2.0])])
    assert physical(tensors).tolist() == [True, True, False, False, True]
    assert physical(np.array([[1.0, 2, 0], [2, 1, 0], [0, 0, 1]])).tolist() is False


def test_same_seed_same_draws(panda, paper):
    """A seed gives the same arms twice and another seed gives others."""
    first, again, other = (
        UniformRandomization(panda, paper, phi_relative=0.1, inertia_relative=0.05)(np.random.default_rng(s), 3)
        for s in (5, 5, 6)
    )
    assert np.array_equal(first.phi, again.phi)
    assert np.array_equal(first.inertia, again.inertia)
    assert not np.array_equal(first.phi, other.phi)


def test_zero_widths_give_the_centre(panda, paper):
    """conf/dr/none is m copies of the centre."""
    drawn = UniformRandomization(panda, paper, **conf("dr/none"))(np.random.default_rng(0), 5)
    assert np.array_equal(drawn.phi, np.broadcast_to(paper.phi, (5, 7, 3)))
    assert np.array_equal(drawn.inertia, np.broadcast_to(paper.inertia, (5, 7, 3, 3)))
