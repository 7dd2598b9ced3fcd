"""Several recordings make one posterior, what is known beforehand counts as it is worth, and drift is found."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import conf
from test_identify import ARM

from r2s.errors import UserError
from r2s.identification.contributions import contradictions, contributions, validated
from r2s.identification.identify import identify
from r2s.identification.known import BODY, Known, block_of, drift_table
from r2s.identification.search.least_squares import LeastSquares
from r2s.identification.settings import Settings
from r2s.physics.dynamics import nominal_dynamics, with_family
from r2s.physics.friction import COULOMB
from r2s.physics.payload import Payload, with_payload
from r2s.physics.rigid_body import mujoco_inverse_dynamics, set_links
from r2s.physics.robot import load_robot
from r2s.recordings.joined import joined
from r2s.recordings.recording import Recording

IDENTIFY = conf("identify/default")
PHI = np.array([[3.0, 0.0, 0.8], [2.5, 0.0, 0.6], [1.2, 0.0, 0.3]])  # Nm, 1, Nm s/rad
OFFSET = np.array([0.4, -0.3, 0.2])
NOISE = 0.3  # Nm
TOOL = Payload(np.array(0.8), np.array([0.03, 0.0, 0.05]), np.zeros((3, 3)))
SEARCH = LeastSquares(level="torque", max_evaluations=12, ftol=1e-4)


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    path = tmp_path_factory.mktemp("arm") / "arm.xml"
    path.write_text(ARM)
    return load_robot(str(path), ddq_max=15.0)


@pytest.fixture(scope="module")
def nominal(robot):
    return nominal_dynamics(robot, **conf("friction/uniform"))


@pytest.fixture(scope="module")
def truth(nominal):
    return replace(nominal, family=COULOMB, phi=PHI, offset=OFFSET)


def log(robot, truth, seed, torque="motor", seconds=4.0, payload=None):
    """Return a recording by MuJoCo's own inverse dynamics along six sines per joint, not through r2s."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, seconds, 1e-3)
    w, phase, size = (
        2 * np.pi * rng.uniform(0.1, 0.9, (6, 3)),
        *(rng.uniform(0.5, 1, (2, 6, 3)) * [[[2 * np.pi]], [[0.25]]]),
    )
    angle = t[:, None, None] * w + phase
    q, dq, ddq = (x.sum(1) for x in (size * np.sin(angle), size * w * np.cos(angle), -size * w**2 * np.sin(angle)))
    model = robot.model(gravity=True)
    set_links(model, *with_payload(robot, payload, (truth.mass, truth.com, truth.inertia)), np.zeros(3))
    tau = mujoco_inverse_dynamics(model, q, dq, ddq) + truth.friction(dq) - truth.offset
    tau += NOISE * rng.standard_normal(tau.shape)
    return Recording(t=t, q=q, dq=dq, tau=tau, torque=torque, name=f"log{seed}")


def found_in(robot, nominal, recording, **change):
    own = {k: IDENTIFY[k] for k in ("bounds", "cutoff_hz")} | {"prior": IDENTIFY["prior"][recording.torque]}
    how = own | {"terms": ["offset"], "family": "coulomb", "breakaway": None, "nthread": 1} | change
    return identify(robot, nominal, recording, [SEARCH], Settings(**how))


@pytest.fixture(scope="module")
def motion(robot, truth):
    return log(robot, truth, 0)


@pytest.fixture(scope="module")
def found(robot, nominal, motion):
    return found_in(robot, nominal, motion)


def value(found, name):
    """Return a value, its interval and whether it is identifiable."""
    k, f = found.space.names.index(name), found.found
    return f.x[k], f.low[k], f.high[k], f.identifiable[k]


def halves(recording):
    """Return the two halves as recordings, and the whole with a new trajectory between them."""
    first = np.arange(len(recording.t)) < len(recording.t) // 2
    a, b = (recording.rows(np.flatnonzero(rows), recording.trajectory[rows]) for rows in (first, ~first))
    return (a, b), replace(recording, trajectory=(~first).astype(float))


def test_two_recordings_of_one_kind_are_the_joined_one(robot, nominal, motion):
    """Exactly: each keeps its clock, and the trajectories number on."""
    parts, whole = halves(motion)
    both = joined(parts)
    for name in ("t", "q", "dq", "tau", "trajectory"):
        np.testing.assert_array_equal(getattr(both, name), getattr(whole, name))
    one, two = (found_in(robot, nominal, r).found for r in (whole, both))
    np.testing.assert_array_equal(one.x, two.x)
    np.testing.assert_array_equal(one.samples, two.samples)


def test_recordings_of_different_rates_meet_at_1_khz(motion):
    """A slower one is resampled as the filters do anyway; kinds of torque are not mixed."""
    slow = replace(motion.rows(np.arange(0, len(motion.t), 4), motion.trajectory[::4]), name="slow")
    both = joined([motion, slow])
    assert both.rate_hz == pytest.approx(1000)
    assert both.duration == pytest.approx(motion.duration + slow.duration, abs=2e-3)
    np.testing.assert_array_equal(both.tau[: len(motion.t)], motion.tau)
    with pytest.raises(UserError, match="expected torque motor as in log0, got measured in slow"):
        joined([motion, replace(slow, torque="measured")])


def test_a_fixed_value_stays_and_the_others_make_the_best_of_it(robot, nominal, motion, found):
    stated = {"coulomb": {"fixed": [None, 2.7, None]}}
    fixed = found_in(robot, nominal, motion, stated=stated)
    x, low, high, identifiable = value(fixed, "coulomb[2]")
    np.testing.assert_allclose([x, low, high], 2.7, rtol=1e-6)
    assert not identifiable
    assert value(fixed, "coulomb[1]")[0] == pytest.approx(value(found, "coulomb[1]")[0], rel=1e-3)
    assert value(fixed, "viscous[2]")[0] < value(found, "viscous[2]")[1]
    assert not fixed.at_bounds
    assert fixed.note["fixed_by_the_user"] == ["coulomb[2]"]


def test_a_narrow_prior_holds_where_data_say_little_and_hardly_moves_a_value_where_they_say_much(
    robot, nominal, motion, found
):
    """Joint 3 stands, so its friction is as stated; the same statement about joint 1, 10 % off, moves it by the share
    of information that the prior has.
    """
    q, dq = motion.q.copy(), motion.dq.copy()
    q[:, 2], dq[:, 2] = 0.0, 0.0
    still = replace(motion, q=q, dq=dq, tau=motion.tau * [1, 1, 0] + [0, 0, 1e-3])
    stated = {"coulomb": {"mean": [3.3, None, 1.7], "width": [0.33, None, 0.05]}}
    held = found_in(robot, nominal, still, stated=stated)
    x, low, high, _ = value(held, "coulomb[3]")
    assert x == pytest.approx(1.7, rel=0.01)
    assert (high - low) / 2 == pytest.approx(1.96 * 0.05, rel=0.1)
    own, both = (value(f, "coulomb[1]") for f in (found, found_in(robot, nominal, motion, stated=stated)))
    sigma = (own[2] - own[1]) / (2 * 1.96)
    pulled = (3.3 - own[0]) * sigma**2 / (sigma**2 + 0.33**2)  # of two normal distributions
    assert abs(both[0] - own[0]) < 3 * abs(pulled) < 0.2 * sigma + 1e-3


def test_an_earlier_identification_is_the_prior_of_the_next(robot, nominal, truth, motion, found):
    """Without drift, two in turn know what one fit to both recordings knows."""
    other = log(robot, truth, 1)
    known = Known.of(found.space, found.x, found.found.samples)
    second, both = found_in(robot, nominal, other, known=known), found_in(robot, nominal, joined([motion, other]))
    width = both.found.high - both.found.low
    assert (np.abs(second.x - both.x) < 0.3 * width).all()
    ratio = (second.found.high - second.found.low) / width
    assert 0.7 < np.median(ratio) < 1.4


def drift(robot, found, recording, share=0.3):
    known = Known.of(found.space, found.x, found.found.samples, share)
    new = found_in(robot, found.dynamics, recording, known=known)
    return drift_table(known, new.space, new.x, new.found.samples).set_index("parameter")


@pytest.mark.parametrize("warm", [False, True])
def test_drift_is_found_within_its_interval_and_none_where_none_is(robot, truth, found, warm):
    """12 intervals of 95 %: three or more misses have a probability of 2 %; a drift of ten widths is always seen."""
    now = (
        replace(truth, phi=PHI * [[1, 1, 1], [1.2, 1, 1], [1, 1, 1]], offset=OFFSET + np.array([0, 0, 0.3]))
        if warm
        else truth
    )
    table = drift(robot, found, log(robot, now, 3))
    true = np.concatenate([*(now.phi - truth.phi).T, now.offset - truth.offset])
    assert list(table.index) == found.space.names
    assert ((true < table["low"]) | (true > table["high"])).sum() <= 2
    changed = ["coulomb[2]", "offset[3]"]
    assert table.loc[changed, "changed"].all() == warm
    assert table.drop(index=changed)["changed"].sum() <= 2


def test_what_is_known_to_be_constant_does_not_drift(robot, found, motion):
    """The links of two dates are those of one arm; a marginal distribution keeps the correlations."""
    known = Known.of(found.space, found.x, found.found.samples, 0.3)
    some = known.where(lambda name: block_of(name) == "offset")
    assert some.names == ("offset[1]", "offset[2]", "offset[3]")
    np.testing.assert_array_equal(np.diag(some.covariance), np.diag(known.covariance)[-3:])
    assert (known.drift > 0).all()
    sure = Known.of(found.space, found.x, found.found.samples)
    assert not sure.drift.any()
    assert drift_table(sure, found.space, found.x, found.found.samples).empty


@pytest.mark.long
def test_links_from_one_kind_of_torque_are_known_to_the_other(robot, nominal, truth):
    """Link-side torque gives the links, motor torque the friction: its links are then narrower, and as right."""
    stiff = replace(truth, phi=with_family(nominal, "coulomb").phi)  # a link-side sensor sees little friction
    links = found_in(robot, nominal, log(robot, stiff, 0, "measured"), terms=["offset", "link"])
    known = Known.of(links.space, links.x, links.found.samples).where(lambda name: block_of(name) in BODY)
    motor = log(robot, truth, 1)
    alone, both = (found_in(robot, nominal, motor, terms=["offset", "link"], known=k) for k in (None, known))
    at = [k for k, name in enumerate(both.space.names) if block_of(name) in BODY]
    widths = [(f.found.high - f.found.low)[at] for f in (alone, both)]
    assert np.median(widths[1] / widths[0]) < 0.8
    true = both.space.start[at]  # the nominal links
    assert ((true >= both.found.low[at]) & (true <= both.found.high[at])).mean() > 0.8
    np.testing.assert_allclose(both.dynamics.phi[:, 0], PHI[:, 0], rtol=0.05)


@pytest.fixture(scope="module")
def tools(robot, nominal, truth):
    """Three recordings, the last with 0.8 kg on the last link."""
    logs = [log(robot, truth, s, payload=TOOL if s == 2 else None) for s in range(3)]
    return {r.name: r for r in logs}


@pytest.mark.long
def test_what_each_recording_adds_is_in_the_table(robot, nominal, tools):
    good = dict(list(tools.items())[:2])
    found = found_in(robot, nominal, joined([*good.values()]))
    parts = contributions(found, good, 10.0)
    for p in parts:
        assert p.seconds == pytest.approx(4.0, abs=0.01)
        assert (p.left_out < 1.2 * p.rmse).all()
        assert 1.1 < np.median(p.narrower) < 2.2  # of two alike: the root of 2
    assert not contradictions(parts)
    (held,) = validated(found, {"other": tools["log1"]}, 10.0)
    np.testing.assert_allclose(held.rmse, parts[1].rmse, rtol=0.05)
    (alone,) = contributions(found_in(robot, nominal, good["log0"]), {"log0": good["log0"]}, 10.0)
    assert np.median(alone.narrower) > 5  # without it there is the prior


@pytest.mark.long
@pytest.mark.parametrize("terms", [["offset"], ["offset", "link"]])
def test_a_recording_with_another_tool_is_named_with_its_mass(robot, nominal, tools, terms):
    """Also where the parameters could take the tool for the arm's own links."""
    found = found_in(robot, nominal, joined([*tools.values()]), terms=terms)
    (line,) = contradictions(contributions(found, tools, 10.0))
    assert line.startswith("log2 contradicts the other recordings: a fit without it misses its torque in joint ")
    mass = float(line.split("; ")[1].split(" kg more")[0])
    assert mass == pytest.approx(0.8, rel=0.25)


@pytest.mark.parametrize(
    ("stated", "line"),
    [
        ({"coulom": {"mean": 1.0}}, "identify.prior: unknown parameter 'coulom'; .*did you mean 'coulomb'?"),
        ({"coulomb": {"sd": 1.0}}, r"identify.prior.coulomb: expected mean, width, fixed, got 'sd'"),
        (
            {"coulomb": {"mean": [1.0, 2.0]}},
            r"identify.prior.coulomb.mean: expected a positive number or a list of 3",
        ),
        ({"offset": {"width": -1.0}}, r"identify.prior.offset.width: expected a positive number .*, got -1.0"),
        ({"delay": {"mean": [1e-3, 2e-3]}}, r"identify.prior.delay.mean: expected a number, got 2 values"),
        ({"offset": {"mean": "big"}}, r"identify.prior.offset.mean: expected a number .*, got 'big'"),
        ({"offset": {"mean": 0.1, "fixed": [None, 0.2, None]}}, "a fixed value of joint 2 has no mean and no width"),
        ({"phi1": {"mean": 1.0}}, "identify.prior.phi1: friction family 'coulomb' has coulomb, asymmetry, viscous"),
        ({"offset": {"mean": 99.0}}, r"identify.prior.offset.mean: 99 is outside identify.bounds.offset"),
        ({"armature": {"fixed": 0.1}}, "identify.prior.armature: armature is not estimated here"),
        ({"coulomb": {"mean": 3.0}}, "identify.prior.coulomb.width: expected a number"),
    ],
)
def test_a_wrong_statement_is_one_line(robot, nominal, motion, stated, line):
    with pytest.raises(UserError, match=line) as caught:
        found_in(robot, nominal, motion, stated=stated)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith("identify.prior")
