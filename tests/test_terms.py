"""Terms earn their place, joints that stand do not spoil what moving ones say, and ramps tell friction at rest."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from conftest import conf
from test_identify import BOUNDS, NOISE, SETTINGS, TORQUE, arm, recorded, run  # noqa: F401

from r2s.arm.ramp import ramp
from r2s.arm.simulated import SimulatedArm
from r2s.identification.friction.static_friction import SIGMA
from r2s.identification.structure.cross_validation import held_out
from r2s.identification.structure.family_selection import CLOSE, simplest
from r2s.identification.structure.forward_selection import forward_selection
from r2s.identification.terms import add_terms
from r2s.physics.dynamics import Dynamics, nominal_dynamics
from r2s.physics.friction import COULOMB, SIGMOID, STRIBECK
from r2s.physics.rigid_body import set_links
from r2s.physics.robot import SIM_DT

EXTRA = conf("identify/default")["candidate_terms"]["commanded"]
PHI = np.array([[1.2, 0.05, 0.3], [0.9, -0.05, 0.2], [0.5, 0.1, 0.1]])


def coulomb_arm(robot) -> Dynamics:
    """Return an arm of hard stiction: it breaks away well above its Coulomb level."""
    edges = np.stack([-1.3 * PHI[:, 0], 1.25 * PHI[:, 0]], -1)
    hard = replace(Dynamics.of(robot, PHI, COULOMB, 1e-3), breakaway=edges, stiction_model="net")
    return replace(hard, offset=np.array([0.2, -0.1, 0.05]), delay=2e-3)


@pytest.fixture(scope="module")
def hard(arm):  # noqa: F811
    """Return what identification says of it, and the truth."""
    truth = coulomb_arm(arm)
    ramps = ramp(SimulatedArm(arm, truth, **NOISE, seed=5), [arm.q_home, arm.q_home + 0.3])
    start = nominal_dynamics(arm, **conf("friction/uniform") | {"family": "coulomb"})
    motion = recorded(arm, truth, 12.0, seed=0)
    how = {"family": "coulomb", "candidate_terms": EXTRA, "ramps": ramps}
    return run(arm, start, motion, [TORQUE], **how), truth, motion


@pytest.mark.long
def test_hard_stiction_does_not_spoil_friction_or_delay(hard):
    """Friction minus offset, which is what motion tells, within 2 % of its level; the delay within 0.2 ms."""
    found, truth, motion = hard
    top = np.quantile(np.abs(motion.dq), 0.95, axis=0)
    speeds = np.concatenate([np.linspace(0.05, 1, 20), -np.linspace(0.05, 1, 20)])[:, None] * np.maximum(top, 0.1)
    off, right = ((d.friction(speeds) - d.offset) for d in (found.dynamics, truth))
    assert np.abs(off - right).max() < 0.02 * np.abs(truth.friction(speeds)).mean(0).min()
    assert abs(float(found.dynamics.delay) - 2e-3) < 2e-4


@pytest.mark.long
def test_no_term_enters_that_is_not_there(hard):
    assert not {"viscous_asymmetry", "load", "drag_sin", "link_d1", "armature"} & set(hard[0].space.blocks)


@pytest.mark.long
def test_stiction_is_found_to_be_of_the_net_torque(hard):
    """The rule that replays its stops better, and edges as commands within 30 mNm."""
    found, truth, _ = hard
    assert found.dynamics.stiction_model == "net"
    edges = found.dynamics.breakaway - found.dynamics.offset[:, None]
    np.testing.assert_allclose(edges, truth.breakaway - truth.offset[:, None], rtol=0, atol=0.03)


@pytest.mark.long
def test_a_term_that_is_there_enters(arm):  # noqa: F811
    """Cable drag of a fifth of the friction is asked for by motion left out."""
    truth = replace(coulomb_arm(arm), drag=np.array([[0.25, 0.1], [0.2, -0.2], [0.1, 0.1]]))
    start = nominal_dynamics(arm, **conf("friction/uniform") | {"family": "coulomb"})
    found = run(arm, start, recorded(arm, truth, 12.0, seed=0), [TORQUE], family="coulomb", candidate_terms=EXTRA)
    assert "drag_sin" in found.space.blocks


@pytest.mark.long
def test_rotors_that_are_there_enter_and_leave_the_links_alone(arm):  # noqa: F811
    """A command feels them on the motor's side: no link has to stand in, whose inertia joints share.

    The inertia that each joint moves is right within 2 %. Rotors are within four standard deviations of their draws
    and a millisecond of viscous friction, which a step adds that takes it from its end; those that motion tells (the
    first joint's is a part of its link) are within a fifth.
    """
    rotors = np.array([0.15, 0.1, 0.03])
    truth = replace(coulomb_arm(arm), armature=rotors)
    start = nominal_dynamics(arm, **conf("friction/uniform") | {"family": "coulomb"})
    found = run(arm, start, recorded(arm, truth, 8.0, seed=0), [TORQUE], family="coulomb", candidate_terms=EXTRA)
    at = found.space.where("armature")
    assert np.all(np.abs(found.x[at] - rotors) < 4 * found.found.samples[:, at].std(0) + SIM_DT * PHI[:, 2])
    np.testing.assert_allclose(found.x[at][1:], rotors[1:], rtol=0.2)
    moved = []
    for d in (found.dynamics, truth):
        model = arm.model(gravity=False)
        set_links(model, d.mass, d.com, d.inertia, d.armature)
        moved.append(np.diag(whole_mass(model, arm.q_home)))
    np.testing.assert_allclose(*moved, rtol=0.02)


def whole_mass(model, q) -> np.ndarray:
    """Return MuJoCo's (n, n) kg m^2 of a compiled arm at q (n,) rad."""
    data, out = mujoco.MjData(model), np.empty((len(q), len(q)))
    data.qpos[:] = q
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_fullM(model, data, out)
    return out


@pytest.mark.long
def test_ramps_tell_the_rise_towards_standstill(arm):  # noqa: F811
    """Friction as sliding begins is the breakaway's, in either direction, within three times SIGMA."""
    phi = np.concatenate([PHI, np.tile([0.4, 0.03, 0.3], (3, 1))], 1)
    truth = replace(Dynamics.of(arm, phi, STRIBECK, 1e-3), stiction_model="net", delay=2e-3)
    truth = replace(truth, breakaway=STRIBECK.at_rest(phi))
    ramps = ramp(SimulatedArm(arm, truth, **NOISE, seed=5), [arm.q_home, arm.q_home + 0.3])
    start = nominal_dynamics(arm, **conf("friction/uniform") | {"family": "stribeck"})
    terms = ["offset", "inertia_scale", "delay", "rise_asymmetry"]
    found = run(arm, start, recorded(arm, truth, 12.0, seed=1), [TORQUE], family="stribeck", terms=terms, ramps=ramps)
    net = [d.family.at_rest(d.phi) - d.offset[:, None] for d in (found.dynamics, truth)]
    np.testing.assert_allclose(*net, rtol=3 * SIGMA)


@pytest.mark.long
def test_replays_that_disagree_with_torque_are_refused(hard, arm):  # noqa: F811
    """A search that ends elsewhere on replays does not change what the torque says."""
    motion = hard[2]

    class Elsewhere:
        local = False

        def __call__(self, problem, start, report):
            return np.clip(start + 0.05, 0, 1)

    start = nominal_dynamics(arm, **conf("friction/uniform") | {"family": "coulomb"})
    both = run(arm, start, motion, [TORQUE, Elsewhere()], family="coulomb")
    alone = run(arm, start, motion, [TORQUE], family="coulomb")
    assert both.refused
    assert not alone.refused
    speeds = np.linspace(-1, 1, 20)[:, None] * np.ones(3)
    off = [r.dynamics.friction(speeds) - r.dynamics.offset for r in (both, alone)]  # what motion tells
    np.testing.assert_allclose(*off, rtol=0, atol=5e-3)


def test_an_uncertain_candidate_does_not_end_the_selection():
    """`link` lowers the mean error most, but only in two of 16 blocks; `load` lowers it a little in all of them."""
    link, load = np.zeros(16), np.full(16, 0.2) + 0.01 * np.arange(16)
    link[:2] = 4.0
    gains = {"link": link, "load": load, "drag": np.zeros(16)}
    assert link.mean() > load.mean()
    assert forward_selection(lambda chosen: np.full(16, 5.0) - sum(gains[c] for c in chosen), list(gains)) == ["load"]


@pytest.mark.parametrize(
    ("errors", "chosen"),
    [
        ((1.3, 1.0, 1.0), COULOMB),  # the sigmoid is clearly worse, although by less than CLOSE
        ((2.6, 1.3, 1.0), COULOMB),  # Stribeck friction is better by less than CLOSE
        ((1.6, 1.3, 1.0), COULOMB),
        ((2.0, 1.6, 1.0), STRIBECK),
        ((1.0, 1.0, 1.0), SIGMOID),
        ((1.0, 3.0, 3.0), SIGMOID),
    ],
)
def test_the_simplest_friction_family_that_predicts_as_well_is_selected(errors, chosen):
    """Only Stribeck friction needs an error that is smaller by CLOSE; every family must be clearly better."""
    families = (SIGMOID, COULOMB, STRIBECK)
    error, best = simplest(families, np.square(errors)[:, None] * np.linspace(0.8, 1.2, 40), CLOSE)
    assert families[best] is chosen
    np.testing.assert_allclose(error, np.array(errors) / min(errors), rtol=1e-12)


def test_a_link_takes_the_place_of_its_tensor():
    assert add_terms(["offset", "inertia_scale", "delay"], ["link", "drag"]) == ["offset", "delay", "link", "drag"]
    assert add_terms(["offset", "inertia_scale"], ["load"]) == ["offset", "inertia_scale", "load"]


@pytest.mark.long
def test_what_is_left_out_is_spread_over_the_recording(hard):
    """With several blocks a fold, each holds motion of all parts, and every row is left out once."""
    motion = hard[2]
    pairs = held_out(motion, 4, 3)
    assert sum(len(out.t) for _, out in pairs) >= len(motion.t)
    for rest, out in pairs:
        assert len(np.unique(out.trajectory)) == 3
        assert np.abs(rest.t[:, None] - out.t[::50]).min() > 0.09
