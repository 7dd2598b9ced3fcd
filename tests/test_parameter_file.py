"""parameters.yaml and posterior.npz give back the arm that was written; a wrong file is named in one line."""

# ruff: noqa: F402, F811 (the arguments are fixtures of test_parameters.py)

from dataclasses import replace

import numpy as np
import pytest
import yaml
from test_parameters import ALL, EDGES, REST, paper, same, some, space, whole  # noqa: F401 (fixtures)

from r2s.errors import UserError
from r2s.identification.parameter_file import load_parameters, load_posterior, save_parameters
from r2s.identification.parameters import WHOLE_ARM, ParameterEstimate, parameter_space, units
from r2s.learning.randomization import PosteriorRandomization, physical
from r2s.physics.robot import load_robot


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
