"""The hidden twins behave as real arms; recording uses the same calls as on hardware."""

from functools import cache

import numpy as np
import pytest

from r2s.arm.interface import Arm, ArmStopped
from r2s.arm.recorder import record
from r2s.arm.twins import lugre_joints as lj
from r2s.arm.twins.make_twin import make_twin
from r2s.arm.twins.rigid_twin import RigidTwin
from r2s.engines.dart import DartEngine
from r2s.errors import UserError
from r2s.excitation.fourier import fourier
from r2s.excitation.motion import Excitation
from r2s.excitation.motion_checks import check_limits
from r2s.physics.rigid_body import Kinematics
from r2s.physics.robot import load_robot

SMALL_ARM = """
<mujoco model="small">
  <compiler angle="radian"/>
  <worldbody>
    <body pos="0 0 0.3"><inertial pos="0 0 0.1" mass="0.3" diaginertia="1e-3 1e-3 5e-4"/>
      <joint name="j1" axis="0 0 1" range="-2 2" actuatorfrcrange="-3 3" armature="0.01"/>
      <body pos="0 0 0.2"><inertial pos="0 0 0.1" mass="0.2" diaginertia="1e-3 1e-3 5e-4"/>
        <joint name="j2" axis="0 1 0" range="-1 1" actuatorfrcrange="-2 2"/>
        <site name="tip" pos="0 0 0.2"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""

AS_DRAWN = {"friction_scale": 1.0, "extra_delay_s": 0.0}


@cache
def panda():
    return load_robot(
        q_home=[0, -0.785, 0, -2.356, 0, 1.571, 0.785],
        dq_max=[2.175] * 4 + [2.61] * 3,
        ddq_max=[15, 7.5, 10, 12.5, 15, 20, 20],
        tau_max=[87] * 4 + [12] * 3,
    )


@pytest.fixture
def small(tmp_path):
    path = tmp_path / "small.xml"
    path.write_text(SMALL_ARM)
    return load_robot(str(path))


def drive(arm, cycles):
    """Command a sine wave on every joint; return q, dq and tau_J, (cycles, 3 n)."""
    arm.move_to(arm.robot.q_home)
    rows = []
    for k in range(cycles):
        s = arm.read()
        rows.append(np.concatenate([s.q, s.dq, s.tau_J]))
        arm.command(0.02 * arm.robot.tau_max * np.sin(2 * np.pi * k * 1e-3))
    return np.array(rows)


def ramp(arm, target):
    """Return the next rate-limited command towards `target` Nm."""
    now = arm.read().tau_J_d
    return now + np.clip(target - now, -0.4, 0.4)


def test_equal_seeds_are_bit_identical_and_other_seeds_differ():
    first, again, other = (drive(RigidTwin(panda(), seed), 400) for seed in (3, 3, 4))
    assert np.array_equal(first, again)
    assert np.abs(first[-1, :7] - other[-1, :7]).max() > 1e-3


def test_an_episode_does_not_depend_on_earlier_ones():
    """`move_to` resets everything but the noise stream."""
    a, b = RigidTwin(panda(), 2), RigidTwin(panda(), 2)
    drive(a, 50)
    drive(b, 700)
    second, same = drive(a, 200), drive(b, 200)
    assert np.array_equal(second, same)
    assert not np.array_equal(second, drive(RigidTwin(panda(), 2), 200))


def test_noise_streams_differ_and_the_robot_does_not():
    """The motion depends on the seed only; the sensors' noise also depends on the stream."""
    first, second = (drive(RigidTwin(panda(), 2, noise=k), 200)[:, :14] for k in (0, 1))
    assert np.array_equal(first, drive(RigidTwin(panda(), 2), 200)[:, :14])
    off = (first - second).reshape(len(first), 2, 7)
    assert np.all(off.std(0) > 0)
    assert np.abs(off[:, 0]).max() < 2e-4  # encoders


def push(arm, target, cycles):
    for _ in range(cycles):
        arm.command(ramp(arm, target))


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_static_friction_holds_the_arm(seed):
    """No creep under zero command, nor under half the breakaway torque in either direction."""
    arm = RigidTwin(panda(), seed)
    arm.move_to(panda().q_home)
    for _ in range(300):
        arm.command(np.zeros(7))
    assert np.abs(arm._q - panda().q_home).max() < 1e-6
    p, carried = arm._hidden, arm._state[lj.FRICTION].copy()
    for sign, coulomb in ((1, p[lj.C_POS]), (-1, p[lj.C_NEG])):
        target = 0.5 * sign * coulomb * p[lj.BREAK] - carried
        push(arm, target, 600)
        here = arm._q.copy()
        for _ in range(400):
            arm.command(target)
        assert np.abs(arm._q - here).max() < 1e-4
        assert np.abs(arm._q - panda().q_home).max() < 5e-3  # presliding


def test_joints_slide_beyond_breakaway():
    """Every joint slides at 1.3 times its breakaway torque."""
    arm = RigidTwin(panda(), 0)
    arm.move_to(panda().q_home)
    p, carried = arm._hidden, arm._state[lj.FRICTION].copy()
    load = p[lj.MU] * np.abs(arm._nominal.gravity_torque(panda().q_home))
    target = 1.3 * (p[lj.C_POS] * p[lj.BREAK] + load) - carried
    push(arm, target, 250)
    assert np.all(arm._q - panda().q_home > 5e-3)


@pytest.mark.parametrize("seed", range(5))
def test_the_delay_is_2_to_5_ms(seed):
    """Two equal arms with equal noise first differ that long after their commands do."""
    idle, pushed = RigidTwin(panda(), seed), RigidTwin(panda(), seed)
    for arm in (idle, pushed):
        arm.move_to(panda().q_home)
    begun = -1
    while np.array_equal(idle.read().tau_J, pushed.read().tau_J):
        begun += 1  # the command of cycle 0 acts in cycle `begun`
        idle.command(np.zeros(7))
        pushed.command(np.full(7, 0.5))
    assert 2 <= begun <= 5


@pytest.mark.parametrize("late", [1, 5, 20])
def test_extra_delay_is_exact(late):
    """The response is `late` cycles later; tau_J_d is the command sent."""
    begun = {}
    for cycles in (0, late):
        idle, pushed = (RigidTwin(panda(), 1, extra_delay_s=cycles * 1e-3) for _ in range(2))
        for arm in (idle, pushed):
            arm.move_to(panda().q_home)
        begun[cycles] = -1
        while np.array_equal(idle.read().tau_J, pushed.read().tau_J):
            begun[cycles] += 1
            idle.command(np.zeros(7))
            pushed.command(np.full(7, 0.5))
            assert np.array_equal(pushed.read().tau_J_d, np.full(7, 0.5))
    assert begun[late] - begun[0] == late


def test_delayed_commands_do_not_reach_the_next_motion():
    """With an extra delay the motion after `move_to` does not depend on the one before."""
    short, long = (RigidTwin(panda(), 2, extra_delay_s=0.01) for _ in range(2))
    drive(short, 50)
    drive(long, 333)
    assert np.array_equal(drive(short, 100), drive(long, 100))


@pytest.mark.parametrize("variant", ["rigid", "elastic"])
def test_default_conditions_change_nothing(variant):
    """Explicit defaults give bit-identical motion."""
    bare, typed = (drive(make_twin(panda(), variant=variant, seed=3, **given), 400) for given in ({}, AS_DRAWN))
    assert np.array_equal(bare, typed)


@pytest.mark.parametrize("variant", ["rigid", "elastic"])
def test_less_friction_gives_more_motion(variant):
    """The same torque moves an arm with 0.8 of its friction farther, with 1.2 less."""
    far = {}
    for share in (0.8, 1.0, 1.2):
        arm = make_twin(panda(), variant=variant, seed=3, friction_scale=share)
        arm.move_to(panda().q_home)
        push(arm, np.array([4.0, 0, 0, 0, 0, 0, 0]), 250)
        far[share] = abs(arm._q[0] - panda().q_home[0])
    assert far[0.8] > far[1.0] > far[1.2]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"friction_scale": -0.5}, r"arm.friction_scale: expected a number in \[0.1, 3\], got -0.5"),
        ({"friction_scale": float("nan")}, r"arm.friction_scale: expected .*, got nan"),
        ({"extra_delay_s": -0.001}, r"arm.extra_delay_s: expected a number in \[0, 0.02\], got -0.001"),
        ({"extra_delay_s": float("nan")}, r"arm.extra_delay_s: expected .*, got nan"),
        ({"extra_delay_s": 5}, r"arm.extra_delay_s: expected .*, got 5"),
        ({"extra_delay_s": 0.0015}, "arm.extra_delay_s: 0.0015; allowed: whole milliseconds from 0 to 0.02 s"),
    ],
)
@pytest.mark.parametrize("variant", ["rigid", "elastic"])
def test_wrong_conditions_are_refused(variant, given, message):
    with pytest.raises(UserError, match=message):
        make_twin(panda(), variant=variant, **given)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({2: np.nan}, "joint 3: commanded torque is nan"),
        ({4: 12.5}, "joint 5: commanded torque 12.5"),
        ({1: -1.5}, "joint 2: commanded torque steps by -1.5"),
    ],
)
def test_refuses_a_bad_command_and_names_the_joint(change, reason):
    arm = RigidTwin(panda(), 0)
    arm.move_to(panda().q_home)
    arm.command(np.zeros(7))
    tau = np.zeros(7)
    for i, value in change.items():
        tau[i] = value
    with pytest.raises(ArmStopped, match=reason):
        arm.command(tau)
    with pytest.raises(ArmStopped, match=f"the arm is stopped: {reason}"):
        arm.command(np.zeros(7))
    arm.move_to(panda().q_home)
    arm.command(np.zeros(7))


def test_stops_at_a_limit():
    """A constant torque ends at a velocity or position limit."""
    arm = RigidTwin(panda(), 0)
    arm.move_to(panda().q_home)
    target = np.array([0, 0, 0, 0, 6.0, 0, 0])
    with pytest.raises(ArmStopped, match=r"joint \d: (velocity|position)"):
        push(arm, target, 3000)


@pytest.mark.long
def test_any_serial_arm(small):
    """Two light joints: friction in proportion to tau_max, finite motion, a recording."""
    arm: Arm = RigidTwin(small, 1)
    rows = drive(arm, 500)
    assert np.all(np.isfinite(rows))
    assert np.abs(rows[:, :2]).max() < 1
    assert np.all(arm._hidden[lj.C_POS] < 0.1 * small.tau_max)
    excitation = fourier(small, duration=4.0, seed=0)
    assert np.abs(record(arm, excitation).q - excitation.q).max() < 0.1


@cache
def excited():
    return fourier(panda(), duration=6.0, seed=1)


@pytest.mark.long
@pytest.mark.parametrize(("torque", "seed"), [("commanded", 0), ("measured", 1)])
def test_record(torque, seed):
    """The recording follows the excitation inside every limit, with the declared kind of torque."""
    arm, measured = RigidTwin(panda(), seed), []
    recording = record(arm, excited(), torque=torque, progress=lambda done, total: measured.append((done, total)))
    r = panda()
    assert recording.torque == torque
    assert recording.q.shape == excited().q.shape
    assert np.all((recording.q > r.q_min) & (recording.q < r.q_max))
    assert np.all(np.abs(recording.dq) < r.dq_max)
    assert np.sqrt(np.mean((recording.q - excited().q) ** 2)) < 0.05
    assert np.allclose(np.diff(recording.t), 1e-3)
    assert measured[-1] == (len(recording.t), len(recording.t))
    gravity = np.abs(recording.tau[:, 1]).max()
    assert gravity > 20 if torque == "measured" else gravity < 30
    if torque == "commanded":
        assert np.abs(np.diff(recording.tau, axis=0)).max() <= 1.0
    with pytest.raises(ArmStopped, match="stop was called"):
        arm.command(np.zeros(7))


@pytest.mark.long
def test_row_k_holds_the_command_of_cycle_k():
    arm, sent = RigidTwin(panda(), 0), []
    command = arm.command
    arm.command = lambda tau: (sent.append((arm.read().q, tau)), command(tau))
    recording = record(arm, Excitation(*(x[:50] for x in vars(excited()).values())))
    assert np.array_equal(recording.q, [q for q, _ in sent])
    assert np.array_equal(recording.tau, [tau for _, tau in sent])


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 2))])
def test_excitation_keeps_the_limits(seed):
    """Inside every limit, at rest at both ends, with consistent derivatives, slow and fast parts."""
    r, e = panda(), fourier(panda(), duration=20.0, seed=seed)
    check_limits(r, e)
    half = 0.5 * (r.q_max - r.q_min)
    assert np.all(np.abs(e.q - 0.5 * (r.q_min + r.q_max)) <= 0.8 * half + 1e-12)
    assert np.all(np.abs(e.dq) <= 0.7 * r.dq_max + 1e-12)
    assert np.abs(e.dq[[0, -1]]).max() < 1e-12
    assert np.abs(e.ddq[[0, -1]]).max() < 1e-12
    np.testing.assert_allclose(np.gradient(e.q, e.t, axis=0)[1:-1], e.dq[1:-1], atol=1e-4)
    np.testing.assert_allclose(np.gradient(e.dq, e.t, axis=0)[1:-1], e.ddq[1:-1], atol=0.1)
    for x in (e.dq / r.dq_max).T:
        for direction in (x, -x):
            assert np.mean((direction > 0.01) & (direction < 0.1)) > 0.02
            assert np.mean(direction > 0.2) > 0.01


def test_excitation_refuses_impossible_arguments():
    with pytest.raises(UserError, match="joint 4"):
        fourier(panda(), duration=5.0, seed=0, q_center=np.zeros(7))
    with pytest.raises(UserError, match="duration"):
        fourier(panda(), duration=0.1, seed=0)
    with pytest.raises(UserError, match="above the base plane"):
        fourier(panda(), duration=5.0, seed=0, z_min=2.0)


def test_an_undeclared_payload_pulls_the_hand_down():
    """Friction holds the arm without payload, but not with 1 kg."""
    drop = {}
    for payload in (0.0, 1.0):
        twin = RigidTwin(panda(), 0, payload=payload)
        begin = twin.move_to(panda().q_home)
        for _ in range(200):
            twin.command(np.zeros(7))
        where = Kinematics(panda())
        drop[payload] = where(begin.q)[0][2] - where(twin.read().q)[0][2]
    assert abs(drop[0.0]) < 2e-3
    assert drop[1.0] > 0.01


def test_a_wrong_payload_is_refused():
    with pytest.raises(UserError, match=r"arm.payload: expected .*, got -1.0"):
        RigidTwin(panda(), 0, payload=-1.0)


def test_gears_bend_under_load():
    """The links hang lower than the encoders show, by gravity over stiffness; dq is nearly unaffected."""
    robot, measured = panda(), {}
    for stiffness in (None, 1e12, 1e4):
        twin = RigidTwin(robot, 0, stiffness=stiffness)
        begin = twin.move_to(robot.q_home)
        np.testing.assert_allclose(begin.q, robot.q_home, atol=3e-4)
        link = twin._q
        for k in range(300):
            twin.command(np.sin(0.02 * k) * np.array([6, 6, 6, 6, 1, 1, 0.5]))
        measured[stiffness] = twin.read()
    np.testing.assert_allclose(measured[1e12].q, measured[None].q, atol=1e-4)
    np.testing.assert_allclose(measured[1e4].dq, measured[None].dq, atol=0.05)
    gravity = DartEngine(robot, gravity=True).gravity_torque(robot.q_home)
    bent = gravity * robot.tau_max.max() / robot.tau_max / 1e4
    np.testing.assert_allclose(robot.q_home - link, bent, atol=0.1 * np.abs(bent).max())
    with pytest.raises(UserError, match=r"arm.stiffness: expected .*, got -1"):
        RigidTwin(robot, 0, stiffness=-1)
