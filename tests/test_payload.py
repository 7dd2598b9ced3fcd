"""Payloads: one body with the last link in every engine, attached and removed at their times; errors."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import conf

from r2s.arm.simulated import SimulatedArm
from r2s.arm.twins.make_twin import make_twin
from r2s.engines.dart import DartEngine
from r2s.errors import UserError
from r2s.learning.randomization import UniformRandomization
from r2s.physics.dynamics import nominal_dynamics
from r2s.physics.newton_euler import WORK, equations, links_of
from r2s.physics.payload import dynamics_with_payload, payload_of, with_payload
from r2s.physics.rigid_body import mass_matrix
from r2s.physics.simulator import Simulator

PAYLOAD = {"mass": 1.2, "centre": [0.02, -0.03, 0.05], "inertia": [2e-3, 3e-3, 2.5e-3, 1e-4, 0.0, 2e-4]}
SWING = np.array([6, 6, 6, 6, 1, 1, 0.5])


def bare(robot):
    return robot.mass, robot.com, robot.inertia


def swung(arm, cycles=60):
    """Return where an arm gets to under the same commands."""
    arm.move_to(arm.robot.q_home)
    for k in range(cycles):
        arm.command(np.sin(0.02 * k) * SWING)
    return arm.read().q


def test_arm_and_payload_are_one_body(panda):
    """Kinetic energy and weight are those of the bare arm and of the body, each by itself, at any posture."""
    rng, payload = np.random.default_rng(0), payload_of(PAYLOAD, (3.0, 0.15))
    arm = links_of(panda, *with_payload(panda, payload, bare(panda)))
    alone = links_of(panda, *bare(panda))
    engine = DartEngine(panda, gravity=True)
    engine.relink(*(a[-1] for a in with_payload(panda, payload, bare(panda))))
    for _ in range(5):
        q = panda.q_home + rng.normal(size=7) * 0.3
        results = []
        for links in (arm, alone):
            mass, bias = np.empty((7, 7)), np.empty(7)
            equations(links, panda.gravity, q, np.zeros(7), mass, bias, np.empty((7, WORK)))
            results.append((mass, bias))
        (mass, weight), (own, own_weight) = results
        np.testing.assert_allclose(engine.mass_matrix(q), mass + np.diag(panda.armature), atol=1e-12)
        np.testing.assert_allclose(engine.gravity_torque(q), weight, atol=1e-11)
        np.testing.assert_allclose(mass_matrix(panda, q[None])[0], own + np.diag(panda.armature), atol=1e-12)
        added = np.linalg.eigvalsh(mass - own)
        assert added.min() > -1e-12 < added.max()  # a body takes kinetic energy from no motion
        assert np.abs(weight - own_weight).max() > 1


def test_a_payload_is_there_from_on_to_off(panda):
    """Before it is put on nothing differs, bit for bit; one that comes and goes leaves less than one that stays."""
    for variant in ("rigid", "elastic"):
        ends = {}
        for name, payload in (
            ("none", 0.0),
            ("later", {**PAYLOAD, "on_s": 0.06}),
            ("brief", {**PAYLOAD, "on_s": 0.02, "off_s": 0.03}),
            ("always", PAYLOAD),
        ):
            ends[name] = swung(make_twin(panda, variant=variant, seed=3, payload=payload))
        np.testing.assert_array_equal(ends["later"], ends["none"])
        far = {name: np.abs(q - ends["none"]).max() for name, q in ends.items()}
        assert 0 < far["brief"] < far["always"]


def test_training_physics_takes_a_payload_and_a_declared_one(panda):
    """A correctly declared payload leaves the arm at rest; a declared but missing payload accelerates it upwards."""
    nominal = nominal_dynamics(panda, **conf("friction/gaz2019"))
    free = replace(nominal, phi=np.zeros((7, 3)))
    payload, still = payload_of(PAYLOAD, (3.0, 0.15)), {"position_noise": 0.0, "velocity_noise": 0.0}

    def after(payload, load):
        arm = SimulatedArm(panda, free, payload=payload, declared_payload=load, **still)
        arm.move_to(panda.q_home)
        for _ in range(50):
            arm.command(np.zeros(7))
        return arm.read().q - panda.q_home

    np.testing.assert_allclose(after(payload, payload), 0.0, atol=1e-12)
    down, up = after(payload, None), after(None, payload)
    assert np.abs(down).max() > 1e-3
    assert (np.sign(down[[1, 3]]) == -np.sign(up[[1, 3]])).all()
    both = dynamics_with_payload(panda, free, payload)
    assert both.mass[-1] == pytest.approx(free.mass[-1] + 1.2)


def test_drawn_payloads_are_carried_by_arms_in_training(panda):
    """Every arm of a draw has its own, within the range, and the heavier ones sink lower."""
    center = nominal_dynamics(panda, **conf("friction/paper"))
    draw = UniformRandomization(panda, center, 0.1, 0.05, [0.5, 1.5])
    drawn = draw(np.random.default_rng(0), 16)
    added = drawn.mass[:, -1] - center.mass[-1]
    assert ((added >= 0.5) & (added <= 1.5)).all()
    assert len(np.unique(added)) == 16
    assert (drawn.mass[:, :-1] == center.mass[:-1]).all()
    still = UniformRandomization(panda, center, 0.1, 0.05)(np.random.default_rng(0), 16)
    assert (still.phi == drawn.phi).all()  # what else is drawn stays the same
    assert (np.linalg.eigvalsh(drawn.inertia)[..., 0] > 0).all()
    sim = Simulator(panda, drawn, 16, 1)
    sim.reset(np.tile(panda.q_home, (16, 1)), np.zeros((16, 7)))
    sim.rollout(np.zeros((16, 100, 7)), record=())
    sim.kinematics()
    assert np.corrcoef(added, sim.ee[:, 2])[0, 1] < -0.5
    for wrong in ([1.0, 0.5], [0.0, 4.0], 1.0):
        with pytest.raises(UserError, match=r"dr.payload"):
            UniformRandomization(panda, center, 0.1, 0.05, wrong)


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (-0.1, r"arm.payload: expected a number in \[0, 3\], got -0.1"),
        (3.1, r"arm.payload: expected .*, got 3.1"),
        ({"mass": 4}, r"arm.payload.mass: expected .*, got 4"),
        ({"centre": [0, 0, 0]}, "got no mass"),
        ({"mass": 1, "center": [0, 0, 0]}, "got 'center'.*did you mean 'centre'"),
        ({"mass": 1, "centre": [0, 0.12, 0.12]}, "at most 0.15 m from the end effector, got 0.17 m"),
        ({"mass": 1, "centre": [0, float("nan"), 0]}, "3 finite numbers"),
        ({"mass": 1, "inertia": [1e-3, 1e-3, 3e-3]}, "no moment above the sum of the others"),
        ({"mass": 1, "inertia": [1e-3, 1e-3, 1e-3, 2e-3, 0, 0]}, "expected positive moments"),
        ({"mass": 1, "inertia": [1, 1, 1]}, "moments of at most 0.27"),
        ({"mass": 1, "on_s": 2, "off_s": 1}, "a time after on_s, 2 s, got 1 s"),
    ],
)
def test_an_invalid_payload_is_an_error(value, expected):
    with pytest.raises(UserError, match=expected):
        payload_of(value, (3.0, 0.15))
