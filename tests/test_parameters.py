"""Parameters keep their values on the way through the unit cube; every vector within the bounds is a physical arm."""

from dataclasses import fields, replace

import numpy as np
import pytest
from conftest import conf
from hypothesis import given, settings
from hypothesis import strategies as st

from r2s.errors import UserError
from r2s.identification.link_inertia import CHOLESKY, LINK, inertia_scale, links, log_cholesky, pseudo_inertia
from r2s.identification.parameters import WHOLE_ARM, parameter_space, torque_like
from r2s.learning.randomization import physical
from r2s.physics.dynamics import nominal_dynamics, with_family
from r2s.physics.friction import FAMILIES, STRIBECK

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


# --- mistakes -------------------------------------------------------------------------------------------------


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
