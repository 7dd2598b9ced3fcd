"""Randomized arms stay physical and within their ranges, and a seed decides them."""

# ruff: noqa: F811 (the arguments are fixtures of test_parameters.py)

import numpy as np
import pytest
from conftest import conf
from test_parameters import paper  # noqa: F401 (a fixture)

from r2s.learning.randomization import UniformRandomization, physical


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
