"""Late signals of link-side torque: what was injected is identified, and a log without lateness keeps its result."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import conf
from test_identify import TORQUE, run
from test_motor import late, recorded
from test_scaling import NOISE, arm, truth_of  # noqa: F401 (a fixture)

from r2s.identification.parameter_file import load_parameters, save_parameters
from r2s.identification.prediction import prediction_errors
from r2s.physics.dynamics import nominal_dynamics

LINKS = [f"link_{name}" for name in ("alpha", "d1", "d2", "d3", "s12", "s13", "s23", "t1", "t2", "t3")]


@pytest.fixture(scope="module")
def robot(arm):  # noqa: F811
    return arm(1.0)


@pytest.fixture(scope="module")
def motion(robot):
    return recorded(robot, truth_of(robot), 8.0, "measured", noise=NOISE * robot.tau_max)


def found_in(robot, recording, *terms):
    start = nominal_dynamics(robot, **conf("friction/uniform"))
    return run(robot, start, recording, [TORQUE], family="coulomb", terms=["offset", "link", *terms])


@pytest.mark.long
@pytest.mark.parametrize("lateness", [{"dq_s": 0.01}, {"tau_rows": 8}, {"dq_s": 0.01, "tau_rows": 8}])
def test_what_is_late_does_not_go_into_the_links(robot, motion, lateness):
    """With dq behind a filter of 10 ms and torque 8 ms late, links and delay are within their intervals.

    The nominal links are the true ones. Half intervals: of 31 at 95 %, one in 300 is off by 1.5 of them. The inertia
    of link 1 about its axis, as exp(2 alpha), is 1.5 and 0.65 times the true one if dq or torque is taken as it is.
    """
    found = found_in(robot, late(motion, **lateness), "signal_delay")
    at = np.concatenate([found.space.where(name) for name in ("signal_delay", *LINKS)])
    true = found.space.start[at].copy()
    true[0] = 1e-3 * lateness.get("tau_rows", 0)
    half = 0.5 * (found.found.high - found.found.low)[at]
    off = np.abs(found.x[at] - true) / half
    assert off[0] < 1.5 or abs(found.x[at[0]] - true[0]) < 1e-4  # s: a tenth of the log's step
    assert np.all(off[1:] < 1.5)
    assert np.all(np.abs(found.x[found.space.where("link_alpha")]) < 0.05)
    assert half[0] < 2e-3  # a quarter of what is late


@pytest.mark.long
def test_a_log_without_lateness_keeps_its_other_values(robot, motion):
    """The delay's interval is shorter than a step and holds 0; nothing moves by a tenth of its half interval."""
    with_term, without = (found_in(robot, motion, *terms) for terms in (["signal_delay"], []))
    (at,) = with_term.space.where("signal_delay")
    low, high = with_term.found.low[at], with_term.found.high[at]
    assert low < 0.0 < high < low + 1e-3
    for name in without.space.blocks:
        ours, theirs = (f.x[f.space.where(name)] for f in (with_term, without))
        half = 0.5 * (without.found.high - without.found.low)[without.space.where(name)]
        assert np.all(np.abs(ours - theirs) <= 0.1 * half + 1e-9)


@pytest.mark.long
def test_a_known_delay_is_kept(robot, motion):
    """An identification that starts at a delay of 8 ms finds the same one again."""
    start = replace(nominal_dynamics(robot, **conf("friction/uniform")), signal_delay=8e-3)
    how = {"family": "coulomb", "terms": ["offset", "link", "signal_delay"]}
    found = run(robot, start, late(motion, tau_rows=8), [TORQUE], **how)
    assert found.dynamics.signal_delay == pytest.approx(8e-3, abs=1e-4)  # s: a tenth of the log's step


EQUAL = {"dq_s": 0.0025, "tau_rows": 2}  # behind a filter of 2.5 ms, dq is late by 2 ms, as torque is


@pytest.mark.long
def test_equal_lateness_that_a_fit_is_sure_of_is_corrected(robot, motion):
    """Torque and dq are 2 ms late. With dq alone corrected, link 1 has 0.9 of its inertia about the axis."""
    found = found_in(robot, late(motion, **EQUAL), "signal_delay")
    assert not found.dynamics.late_alike
    assert found.dynamics.signal_delay == pytest.approx(2e-3, abs=1e-4)  # s: a tenth of the log's step
    assert np.all(np.abs(found.x[found.space.where("link_alpha")]) < 0.02)


@pytest.mark.long
def test_equal_lateness_that_no_fit_is_sure_of_stays(robot, tmp_path):
    """In twenty times the noise, dq is used as logged, which predicts better, and the file keeps the choice."""
    noisy = recorded(robot, truth_of(robot), 8.0, "measured", noise=20 * NOISE * robot.tau_max)
    recording = late(noisy, **EQUAL)
    found = found_in(robot, recording, "signal_delay")
    assert found.dynamics.late_alike
    assert found.dynamics.signal_delay == 0.0
    how = {"window_s": 0.2, "cutoff_hz": 10.0}
    other = replace(found.dynamics, late_alike=False)
    own, corrected = (prediction_errors(robot, other, d, recording, **how) for d in (found.dynamics, other))
    assert np.sum(own["torque_rmse_Nm"]) < np.sum(corrected["torque_rmse_Nm"])
    save_parameters(tmp_path / "parameters.yaml", *found.saved, {})
    space, x = load_parameters(tmp_path, robot)
    assert space.dynamics(x).late_alike
