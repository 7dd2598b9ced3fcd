"""The control seam: one law per controller, the same in the physics step, in the driver and in engines."""

import numpy as np
import pytest
from conftest import conf
from numba import njit

from r2s.arm.driver import Driver
from r2s.arm.interface import ArmState
from r2s.arm.policy_runner import PolicyRunner
from r2s.arm.simulated import SimulatedArm
from r2s.control.computed_torque import computed_torque
from r2s.control.controller import Controller
from r2s.control.torque import torque
from r2s.errors import UserError
from r2s.learning.vector_arms import VectorArms
from r2s.physics.dynamics import nominal_dynamics
from r2s.physics.robot import load_robot
from r2s.physics.user_laws import control_address, friction_address
from r2s.tasks.reach import ReachTask
from r2s.tasks.track import TrackTask

PANDA = load_robot(**conf("robot/panda"))
NEW = nominal_dynamics(PANDA, **conf("friction/paper"))  # nominal links: the driver's model is the arm
REACH = ReachTask()
TRACK = TrackTask(pool=2).with_model(PANDA, NEW)
N = PANDA.n


@njit
def spring(q, dq, command, parameters, memory, out):
    memory[0] += 1.0
    for j in range(len(q)):
        out[j] = parameters[0] * (command[j] - q[j]) - parameters[1] * dq[j]


def joint_spring(stiffness=60.0, damping=6.0):
    """Return a joint impedance whose action is a joint angle within 0.3 rad of home."""
    gains = np.array([stiffness, damping])
    return Controller("spring", spring, np.full(N, 0.3), PANDA.q_home, "joint angle", "rad", gains, memory_size=1)


MAKES = {
    "torque": lambda: torque(PANDA, TRACK),
    "computed_torque": lambda: TRACK.control(PANDA),
    "a user's law": joint_spring,
}


def motion(task, arms, controller, plans, steps=20):
    """Return q (steps, n) of one arm under random actions at the given plan."""
    rng, rows = np.random.default_rng(1), []
    state = arms.place(task.begin(np.zeros((1, N)), plans), 0)
    for _ in range(steps):
        action = rng.uniform(-1, 1, (1, controller.action_dim))
        state = arms.step(controller.command(action, task, state.t, plans))
        rows.append(state.q[0].copy())
    return np.array(rows)


@pytest.fixture(scope="module")
def plans():
    return TRACK.goals(PANDA, np.random.default_rng(0), 1)


@pytest.mark.parametrize("make", MAKES.values(), ids=MAKES)
def test_the_physics_step_and_the_driver_run_the_same_law(make, plans):
    """One arm in MuJoCo's callback, and the same arm behind the driver: the same motion.

    The two solve the safety filter with inertias that agree to round-off (1e-12 of 0.1 kg m^2); in 0.2 s errors grow
    by less than 1e4.
    """
    controller = make()
    task = TRACK.controlled_by(controller)
    quiet = SimulatedArm(PANDA, NEW, position_noise=0.0, velocity_noise=0.0)
    inside = motion(task, VectorArms(PANDA, task, NEW, 1, 1), controller, plans)
    behind = motion(task, PolicyRunner(quiet, task, NEW.level, rotors=NEW.armature), controller, plans)
    assert np.abs(inside - plans[0, 0, 6 : 6 + N]).max() > 1e-3  # it moves
    np.testing.assert_allclose(behind, inside, atol=1e-8)


def test_a_command_is_the_action_in_si_units_and_the_setpoint(plans):
    controller, track = joint_spring(), TRACK.control(PANDA)
    assert (controller.action_dim, controller.command_size) == (N, N)
    command = controller.command(np.ones((2, N)), REACH, np.zeros(2), np.zeros((2, 3)))
    np.testing.assert_array_equal(command, np.tile(PANDA.q_home + 0.3, (2, 1)))
    command = track.command(np.zeros((1, N)), TRACK, np.zeros(1), plans)
    assert command.shape == (1, track.command_size)
    np.testing.assert_array_equal(command[0, 2 * N : 3 * N], plans[0, 0, 6 : 6 + N])  # q_d is the plan's


def test_the_law_is_the_formula(plans):
    """Computed torque at a state off the plan: feedforward + M (w^2 e + 2 w de), to rounding."""
    controller = TRACK.control(PANDA)
    t, rng = np.array([1.0]), np.random.default_rng(2)
    command = controller.command(rng.uniform(-1, 1, (1, N)), TRACK, t, plans)
    q, dq = (x + rng.normal(0, 0.01, (1, N)) for x in TRACK.trajectory(t, plans, 0.0)[:2])
    own, feedforward, q_d, dq_d = command[0, : 4 * N].reshape(4, N)
    mass, w = command[0, 4 * N :].reshape(N, N), controller.parameters[0]
    expected = own + feedforward + mass @ (w**2 * (q_d - q[0]) + 2 * w * (dq_d - dq[0]))
    np.testing.assert_allclose(controller.torque(q, dq, command)[0], expected, rtol=1e-12, atol=1e-12)


def test_feedback_runs_at_its_own_rate(plans):
    """Held for a control period the torque is constant; at 1 kHz it follows the speed in every cycle."""
    held, fast = (computed_torque(PANDA, TRACK, NEW, feedback_hz=hz) for hz in (None, 1000))
    command = held.command(np.zeros((1, N)), TRACK, np.zeros(1), plans)[0]
    for controller, same in ((held, True), (fast, False)):
        memory, out = np.zeros(controller.memory_size), np.empty((2, N))
        for k in range(2):
            controller.law(
                plans[0, 0, 6 : 6 + N], np.full(N, 0.01 * k), command, controller.parameters, memory, out[k]
            )
        assert np.array_equal(out[0], out[1]) == same


def test_a_law_that_is_not_finite_stops_the_arm():
    """The driver brings the arm to rest and says so, as it does for a silent policy."""
    controller = joint_spring(stiffness=np.nan)
    driver = Driver(PANDA, REACH.torque_limit(PANDA), NEW.level, control=controller)
    state = ArmState(0.0, PANDA.q_home, np.zeros(N), np.zeros(N), np.zeros(N))
    for _ in range(3):
        sent = driver(state, PANDA.q_home)
    assert driver.stopping == "the controller's torque is not finite"
    assert driver.done
    np.testing.assert_array_equal(sent, 0.0)


def test_no_law_runs_before_the_first_command():
    """A command of zeros would be a joint angle of zero: without a command there is no torque."""
    driver = Driver(PANDA, REACH.torque_limit(PANDA), NEW.level, control=joint_spring())
    state = ArmState(0.0, PANDA.q_home, np.zeros(N), np.zeros(N), np.zeros(N))
    assert not driver(state, None).any()
    assert driver(state, PANDA.q_home + 0.2).any()


def test_computed_torque_needs_a_trajectory():
    with pytest.raises(UserError, match=r"control: computed_torque needs a task with a reference trajectory; Re"):
        computed_torque(PANDA, REACH, NEW)
    for settings in ({"residual": 0.0}, {"bandwidth": -1.0}, {"feedback_hz": 2000}):
        with pytest.raises(UserError, match=next(iter(settings))):
            computed_torque(PANDA, TRACK, NEW, **settings)


def test_a_law_that_numba_cannot_compile_is_one_line():
    """The error names the law and numba's cause; a friction law also returns its slope."""

    def opens(q, dq, command, parameters, memory, out):
        open("file")  # noqa: SIM115

    def flat(p, v, h, memory):
        return p[0]

    for address, law, cause in ((control_address, opens, "global name 'open'"), (friction_address, flat, "unpack")):
        with pytest.raises(
            UserError, match=rf"^test_control\.{law.__name__}: numba cannot compile this law: .*{cause}"
        ):
            address(law)
