"""The hidden twin behaves as an arm does; recording on it goes through the calls that hardware has."""

from functools import cache

import numpy as np
import pytest

from r2s.arm import twin as hidden
from r2s.arm.interface import Arm, ArmStopped
from r2s.arm.tracking import record
from r2s.arm.twin import Twin
from r2s.arm.twins import twin
from r2s.engines.dart import DartEngine
from r2s.errors import UserError
from r2s.excitation.fourier import fourier
from r2s.excitation.motion import Excitation
from r2s.excitation.safety import check_limits
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

AS_DRAWN = {"friction": 1.0, "late": 0.0}


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
    """Push every joint about for some cycles; return what was read, (cycles, 3 n)."""
    arm.move_to(arm.robot.q_home)
    rows = []
    for k in range(cycles):
        s = arm.read()
        rows.append(np.concatenate([s.q, s.dq, s.tau_J]))
        arm.command(0.02 * arm.robot.tau_max * np.sin(2 * np.pi * k * 1e-3))
    return np.array(rows)


def ramp(arm, target):
    """Return the next command on the way to `target` Nm that the arm accepts."""
    now = arm.read().tau_J_d
    return now + np.clip(target - now, -0.4, 0.4)


def test_same_seed_is_bit_identical_and_another_is_another_robot():
    first, again, other = (drive(Twin(panda(), seed), 400) for seed in (3, 3, 4))
    assert np.array_equal(first, again)
    assert np.abs(first[-1, :7] - other[-1, :7]).max() > 1e-3


def test_an_episode_does_not_depend_on_the_one_before():
    """After `move_to` nothing of the last motion is left; only the noise is another stream."""
    a, b = Twin(panda(), 2), Twin(panda(), 2)
    drive(a, 50)
    drive(b, 700)
    second, same = drive(a, 200), drive(b, 200)
    assert np.array_equal(second, same)
    assert not np.array_equal(second, drive(Twin(panda(), 2), 200))


def test_two_recordings_of_a_robot_have_noise_of_their_own():
    """The robot and its motion are those of the seed; the sensors' noise of another stream is another one."""
    first, second = (drive(Twin(panda(), 2, noise=k), 200)[:, :14] for k in (0, 1))
    assert np.array_equal(first, drive(Twin(panda(), 2), 200)[:, :14])
    off = (first - second).reshape(len(first), 2, 7)
    assert np.all(off.std(0) > 0)
    assert np.abs(off[:, 0]).max() < 2e-4  # encoders


def push(arm, target, cycles):
    for _ in range(cycles):
        arm.command(ramp(arm, target))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_holds_still(seed):
    """No creep under zero command, nor under half the breakaway torque in either direction."""
    arm = Twin(panda(), seed)
    arm.move_to(panda().q_home)
    for _ in range(300):
        arm.command(np.zeros(7))
    assert np.abs(arm._q - panda().q_home).max() < 1e-6
    p, carried = arm._hidden, arm._state[hidden.FRICTION].copy()
    for sign, coulomb in ((1, p[hidden.C_POS]), (-1, p[hidden.C_NEG])):
        target = 0.5 * sign * coulomb * p[hidden.BREAK] - carried
        push(arm, target, 600)
        here = arm._q.copy()
        for _ in range(400):
            arm.command(target)
        assert np.abs(arm._q - here).max() < 1e-4
        assert np.abs(arm._q - panda().q_home).max() < 5e-3  # bristles give a little


def test_breaks_away():
    """Well beyond the breakaway torque every joint slides."""
    arm = Twin(panda(), 0)
    arm.move_to(panda().q_home)
    p, carried = arm._hidden, arm._state[hidden.FRICTION].copy()
    load = p[hidden.MU] * np.abs(arm._nominal.gravity_torque(panda().q_home))
    target = 1.3 * (p[hidden.C_POS] * p[hidden.BREAK] + load) - carried
    push(arm, target, 250)
    assert np.all(arm._q - panda().q_home > 5e-3)


@pytest.mark.parametrize("seed", range(5))
def test_answers_after_2_to_5_ms(seed):
    """Two equal arms differ for the first time so long after their commands do (they share the noise)."""
    idle, pushed = Twin(panda(), seed), Twin(panda(), seed)
    for arm in (idle, pushed):
        arm.move_to(panda().q_home)
    begun = -1
    while np.array_equal(idle.read().tau_J, pushed.read().tau_J):
        begun += 1  # the command of cycle 0 acts in cycle `begun`
        idle.command(np.zeros(7))
        pushed.command(np.full(7, 0.5))
    assert 2 <= begun <= 5


@pytest.mark.parametrize("late", [1, 5, 20])
def test_commands_come_so_many_cycles_later(late):
    """The same answer, `late` cycles later; the arm says at once what it was told."""
    begun = {}
    for cycles in (0, late):
        idle, pushed = (Twin(panda(), 1, late=cycles * 1e-3) for _ in range(2))
        for arm in (idle, pushed):
            arm.move_to(panda().q_home)
        begun[cycles] = -1
        while np.array_equal(idle.read().tau_J, pushed.read().tau_J):
            begun[cycles] += 1
            idle.command(np.zeros(7))
            pushed.command(np.full(7, 0.5))
            assert np.array_equal(pushed.read().tau_J_d, np.full(7, 0.5))
    assert begun[late] - begun[0] == late


def test_no_command_of_one_motion_waits_for_the_next():
    """What an arm that comes later does after `move_to` does not depend on the motion before."""
    short, long = (Twin(panda(), 2, late=0.01) for _ in range(2))
    drive(short, 50)
    drive(long, 333)
    assert np.array_equal(drive(short, 100), drive(long, 100))


@pytest.mark.parametrize("make", [1, 2])
def test_friction_and_delay_as_drawn_change_nothing(make):
    """Typed or not, bit for bit."""
    bare, typed = (drive(twin(panda(), make=make, seed=3, **given), 400) for given in ({}, AS_DRAWN))
    assert np.array_equal(bare, typed)


@pytest.mark.parametrize("make", [1, 2])
def test_of_less_friction_more_motion_comes(make):
    """The same pushes move an arm of 0.8 of its friction farther, one of 1.2 less."""
    far = {}
    for share in (0.8, 1.0, 1.2):
        arm = twin(panda(), make=make, seed=3, friction=share)
        arm.move_to(panda().q_home)
        push(arm, np.array([4.0, 0, 0, 0, 0, 0, 0]), 250)
        far[share] = abs(arm._q[0] - panda().q_home[0])
    assert far[0.8] > far[1.0] > far[1.2]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"friction": -0.5}, r"arm.friction: -0.5 is not allowed; a number in \[0.1, 3\] is"),
        ({"friction": float("nan")}, "arm.friction: nan is not allowed"),
        ({"late": -0.001}, r"arm.late: -0.001 is not allowed; a number in \[0, 0.02\] is"),
        ({"late": float("nan")}, "arm.late: nan is not allowed"),
        ({"late": 5}, "arm.late: 5 is not allowed"),
        ({"late": 0.0015}, "arm.late: 0.0015 is not allowed; whole milliseconds from 0 to 0.02 s are"),
    ],
)
@pytest.mark.parametrize("make", [1, 2])
def test_a_wrong_friction_or_delay_is_said(make, given, message):
    with pytest.raises(UserError, match=message):
        twin(panda(), make=make, **given)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({2: np.nan}, "joint 3: commanded torque is nan"),
        ({4: 12.5}, "joint 5: commanded torque 12.5"),
        ({1: -1.5}, "joint 2: commanded torque steps by -1.5"),
    ],
)
def test_refuses_a_bad_command_and_names_the_joint(change, reason):
    arm = Twin(panda(), 0)
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
    """A torque that is kept on ends at a velocity or position limit, not beyond."""
    arm = Twin(panda(), 0)
    arm.move_to(panda().q_home)
    target = np.array([0, 0, 0, 0, 6.0, 0, 0])
    with pytest.raises(ArmStopped, match=r"joint \d: (velocity|position)"):
        push(arm, target, 3000)


def test_any_serial_arm(small):
    """Two light joints: friction in proportion to their torque, a motion that stays finite, a recording."""
    arm: Arm = Twin(small, 1)
    rows = drive(arm, 500)
    assert np.all(np.isfinite(rows))
    assert np.abs(rows[:, :2]).max() < 1
    assert np.all(arm._hidden[hidden.C_POS] < 0.1 * small.tau_max)
    excitation = fourier(small, duration=4.0, seed=0)
    assert np.abs(record(arm, excitation).q - excitation.q).max() < 0.1


@cache
def excited():
    return fourier(panda(), duration=6.0, seed=1)


@pytest.mark.parametrize(("torque", "seed"), [("commanded", 0), ("measured", 1)])
def test_record(torque, seed):
    """The recording follows the excitation, inside every limit, and holds the torque that it declares."""
    arm, seen = Twin(panda(), seed), []
    recording = record(arm, excited(), torque=torque, progress=lambda done, total: seen.append((done, total)))
    r = panda()
    assert recording.torque == torque
    assert recording.q.shape == excited().q.shape
    assert np.all((recording.q > r.q_min) & (recording.q < r.q_max))
    assert np.all(np.abs(recording.dq) < r.dq_max)
    assert np.sqrt(np.mean((recording.q - excited().q) ** 2)) < 0.05
    assert np.allclose(np.diff(recording.t), 1e-3)
    assert seen[-1] == (len(recording.t), len(recording.t))
    gravity = np.abs(recording.tau[:, 1]).max()
    assert gravity > 20 if torque == "measured" else gravity < 30
    if torque == "commanded":
        assert np.abs(np.diff(recording.tau, axis=0)).max() <= 1.0
    with pytest.raises(ArmStopped, match="stop was called"):
        arm.command(np.zeros(7))


def test_row_k_holds_the_command_of_cycle_k():
    arm, sent = Twin(panda(), 0), []
    command = arm.command
    arm.command = lambda tau: (sent.append((arm.read().q, tau)), command(tau))
    recording = record(arm, Excitation(*(x[:50] for x in vars(excited()).values())))
    assert np.array_equal(recording.q, [q for q, _ in sent])
    assert np.array_equal(recording.tau, [tau for _, tau in sent])


@pytest.mark.parametrize("seed", range(3))
def test_excitation_keeps_the_limits(seed):
    """Inside every limit on every sample, at rest at both ends, its derivatives consistent, slow and fast."""
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


def test_excitation_refuses_what_cannot_be():
    with pytest.raises(UserError, match="joint 4"):
        fourier(panda(), duration=5.0, seed=0, q_center=np.zeros(7))
    with pytest.raises(UserError, match="duration"):
        fourier(panda(), duration=0.1, seed=0)
    with pytest.raises(UserError, match="above the base plane"):
        fourier(panda(), duration=5.0, seed=0, z_min=2.0)


def test_a_payload_pulls_the_hand_down():
    """Friction holds the bare arm; 1 kg that nobody told it of does not stay up."""
    drop = {}
    for payload in (0.0, 1.0):
        twin = Twin(panda(), 0, payload)
        begin = twin.move_to(panda().q_home)
        for _ in range(200):
            twin.command(np.zeros(7))
        where = Kinematics(panda())
        drop[payload] = where(begin.q)[0][2] - where(twin.read().q)[0][2]
    assert abs(drop[0.0]) < 2e-3
    assert drop[1.0] > 0.01


def test_a_wrong_payload_is_said():
    with pytest.raises(UserError, match=r"arm.payload: -1.0 is not allowed"):
        Twin(panda(), 0, -1.0)


def test_gears_bend_under_the_load():
    """At rest the hand hangs lower than the motors say, by gravity over the stiffness; moving, they say nearly dq."""
    robot, seen = panda(), {}
    for stiffness in (None, 1e12, 1e4):
        twin = Twin(robot, 0, 0.0, stiffness)
        begin = twin.move_to(robot.q_home)
        np.testing.assert_allclose(begin.q, robot.q_home, atol=3e-4)
        link = twin._q
        for k in range(300):
            twin.command(np.sin(0.02 * k) * np.array([6, 6, 6, 6, 1, 1, 0.5]))
        seen[stiffness] = twin.read()
    np.testing.assert_allclose(seen[1e12].q, seen[None].q, atol=1e-4)
    np.testing.assert_allclose(seen[1e4].dq, seen[None].dq, atol=0.05)
    gravity = DartEngine(robot, gravity=True).gravity_torque(robot.q_home)
    bent = gravity * robot.tau_max.max() / robot.tau_max / 1e4
    np.testing.assert_allclose(robot.q_home - link, bent, atol=0.1 * np.abs(bent).max())
    with pytest.raises(UserError, match=r"arm.stiffness: -1 is not allowed"):
        Twin(robot, 0, 0.0, -1)
