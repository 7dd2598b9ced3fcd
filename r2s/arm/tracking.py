"""Record an excitation on any arm, through the same calls and with the same caution that hardware needs."""

from collections.abc import Callable

import mujoco
import numpy as np

from r2s.arm.driven import Driven
from r2s.arm.driver import Driver
from r2s.arm.interface import Arm, ArmState, ArmStopped
from r2s.errors import UserError
from r2s.excitation.motion import Excitation
from r2s.excitation.safety import TABLE_M, TOOL_M, check_limits, check_space, friction_margin
from r2s.physics.newton_euler import WORK, equations, links_of
from r2s.physics.payload import MOST_KG, Payload, ball, carrying
from r2s.physics.robot import SIM_DT, Robot
from r2s.recordings.recording import Recording, declared_torque

BANDWIDTH = 20.0  # rad/s, of the tracking loop: a few ms of delay leave it a wide margin
CUTOFF_HZ = 100.0  # of the driver's low-pass, as libfranka's
TORQUE_SHARE = 0.8  # of tau_max, the most that a recording asks for
LEARNING = 0.8  # of kp, in 1/s: with its three terms the loop keeps half its stability margin
UNBALANCED = (
    0.1  # of tau_max, what gravity compensation may leave: 1 kg at a Panda's full reach that it knows nothing of
)
CORRECTION = 0.3  # of tau_max, what tracking may add to the planned torque, all in all
ASTRAY = 0.2  # rad off the plan: something is in the way, or the arm is not the one that the plan was made for
LADEN = 2.0  # times what may be added to the plan for an arm that carries something
LADEN_ASTRAY = 0.5  # rad
FRICTION_DQ = 0.03  # rad/s, over which the friction estimate changes sign
PROGRESS_EVERY = 500  # cycles
LEAST = 100  # cycles that are worth keeping of a recording that was stopped
MASS_EVERY = 10  # cycles


def record(
    arm: Arm,
    excitation: Excitation,
    *,
    torque: str = "commanded",
    table: float = TABLE_M,
    z_min: float = TOOL_M,
    progress: Callable[[int, int], None] | None = None,
    laden: bool = False,
) -> Recording:
    """Follow the excitation at 1 kHz and return what the arm did.

    Row k holds the state read in cycle k and, for 'commanded', the command sent in that same cycle (it is
    tau_J_d of cycle k + 1): replaying tau[k : k + m] from state k predicts q[k + 1 : k + m + 1]. For
    'measured', row k holds tau_J read together with q and dq, as robot logs do. t is the arm's clock.

    Args:
        arm: brought to the excitation's first posture here, and stopped at the end whatever happens.
        excitation: on a clock of 1 ms; within the limits, and away from table and arm, or nothing moves.
        torque: 'commanded' (tau_J_d, without gravity) or 'measured' (tau_J, contains gravity).
        table, z_min: m, as in `r2s.excitation.safety.check_motion`.
        progress: called now and then with (cycles done, cycles in all).
        laden: the arm may carry what its model does not know of: it is followed loosely (`LadenTracker`).

    Raises:
        ArmStopped: the arm ended the motion, or the driver did, or the arm went astray; what was recorded until then
            is the exception's `recording`.
        UserError: what forbids the excitation.

    """
    declared_torque(torque)
    _check(arm.robot, excitation)
    check_space(arm.robot, excitation, table=table, z_min=z_min)
    controller = (LadenTracker if laden else Tracker)(arm.robot, excitation)
    rows = len(excitation.t)
    t = np.empty(rows)
    q, dq, tau = (np.empty((rows, arm.robot.n)) for _ in range(3))
    driven = Driven(
        arm, Driver(arm.robot, TORQUE_SHARE * arm.robot.tau_max, 2 * friction_margin(arm.robot), cutoff_hz=CUTOFF_HZ)
    )
    driven.place(excitation.q[0])

    def seen(rows: int) -> Recording:
        return Recording(t=t[:rows], q=q[:rows], dq=dq[:rows], tau=tau[:rows], torque=torque, name=arm.robot.name)

    k = 0
    try:
        for k in range(rows):
            state = driven.state
            t[k], q[k], dq[k] = state.t, state.q, state.dq
            if (reason := controller.astray(k, state)) is not None:
                driven.halt(reason)
            driven(controller(k, state))
            tau[k] = driven.sent if torque == "commanded" else state.tau_J
            if progress is not None and (k % PROGRESS_EVERY == 0 or k == rows - 1):
                progress(k + 1, rows)
    except ArmStopped as stop:
        if k >= LEAST:
            stop.recording = seen(k)
        raise
    finally:
        driven.end()
    return seen(rows)


class Tracker:
    """PD control about the nominal model's torque, and an estimate of what the model lacks: targets for the driver.

    The estimate is theta . (1, tanh(dq_ref / 0.03), dq_ref / dq_max) per joint: offset, Coulomb and viscous
    friction, adapted while moving as in Slotine and Li (IJRR 6(3), 1987), within what an arm can have of each.
    Without it a light wrist, whose gains must be small, would be held back by friction as large as all its PD torque.
    Gains are the nominal mass matrix times a bandwidth: they fit any arm, and joints with nearly parallel axes, which
    a gain per joint drives unstable.

    Args:
        robot: the nominal model. excitation: the plan.
        astray: rad, how far off the plan a joint may be.
    """

    def __init__(self, robot: Robot, excitation: Excitation, astray: float = ASTRAY):
        self._e, self._far = excitation, astray
        self._feedforward, self._mass = _nominal(robot, excitation)
        dq = excitation.dq
        drive = np.array([np.ones_like(dq), np.tanh(dq / FRICTION_DQ), dq / robot.dq_max])
        self._regressor = drive.transpose(1, 0, 2)  # (T, 3, n)
        self._theta = np.zeros((3, robot.n))
        friction = friction_margin(robot)
        self._most = np.array([UNBALANCED * robot.tau_max, friction, friction])
        # what a joint feels with the others free; Nm/s per (rad/s + BANDWIDTH rad) of error
        alone = 1 / np.diagonal(np.linalg.inv(self._mass), axis1=1, axis2=2)
        self._learn = LEARNING * SIM_DT * BANDWIDTH**2 * alone  # of each posture: a light one has to learn slowly
        self._correction = CORRECTION * robot.tau_max

    def __call__(self, k: int, state: ArmState) -> np.ndarray:
        """Return the target (n,) Nm of cycle k, from the state read in it."""
        e = self._e
        lag, slow = e.q[k] - state.q, e.dq[k] - state.dq
        self._theta += self._learn[k // MASS_EVERY] * (slow + 0.5 * BANDWIDTH * lag) * self._regressor[k]
        self._theta = np.minimum(np.maximum(self._theta, -self._most), self._most)
        pull = self._mass[k // MASS_EVERY] @ (BANDWIDTH**2 * lag + 2 * BANDWIDTH * slow)
        added = pull + (self._theta * self._regressor[k]).sum(0)
        return self._feedforward[k] + np.minimum(np.maximum(added, -self._correction), self._correction)

    def astray(self, k: int, state: ArmState) -> str | None:
        """Return which joint is too far off the plan in cycle k, in words; None: none is."""
        off = np.abs(self._e.q[k] - state.q)
        if (off <= self._far).all():
            return None
        i = int(off.argmax())
        return (
            f"joint {i + 1} is {off[i]:.3f} rad off its way, allowed are {self._far:g} rad: something is in the way, "
            "or it cannot follow"
        )


class LadenTracker(Tracker):
    """The same of an arm that may carry up to 1.5 kg nobody announced.

    Its gains reckon with half of that, or the sag of a strong joint would throw the wrist about; it may lag more, and
    be corrected more.
    """

    def __init__(self, robot: Robot, excitation: Excitation):
        super().__init__(robot, excitation, LADEN_ASTRAY)
        half = np.array(0.5 * MOST_KG)
        links = carrying(robot, Payload(half, np.zeros(3), ball(half)), (robot.mass, robot.com, robot.inertia))
        mass, bias, work = np.empty((robot.n, robot.n)), np.empty(robot.n), np.empty((robot.n, WORK))
        arm = links_of(robot, *links)
        for k, q in enumerate(excitation.q[::MASS_EVERY]):
            equations(arm, robot.gravity, q, np.zeros(robot.n), mass, bias, work)
            self._mass[k] = mass + np.diag(robot.armature)
        self._most[0] *= LADEN
        self._correction = LADEN * self._correction


def _nominal(robot: Robot, e: Excitation) -> tuple[np.ndarray, np.ndarray]:
    """Return torque without gravity (T, n) Nm and every MASS_EVERY-th mass matrix (., n, n) kg m^2."""
    model = robot.model(gravity=False)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)  # a limit's soft spring is no dynamics
    data = mujoco.MjData(model)
    tau = np.empty_like(e.q)
    mass = np.empty((-(-len(e.t) // MASS_EVERY), robot.n, robot.n))
    for k in range(len(e.t)):
        data.qpos[:], data.qvel[:], data.qacc[:] = e.q[k], e.dq[k], e.ddq[k]
        mujoco.mj_inverse(model, data)
        tau[k] = data.qfrc_inverse
        if k % MASS_EVERY == 0:
            mujoco.mj_fullM(model, data, mass[k // MASS_EVERY])
    return tau, mass


def _check(robot: Robot, e: Excitation) -> None:
    if e.q.shape != (len(e.t), robot.n):
        raise UserError(f"the excitation moves {e.q.shape[1]} joints, {robot.name} has {robot.n}")
    if not np.allclose(np.diff(e.t), SIM_DT, rtol=1e-6, atol=0):
        raise UserError(f"an arm is driven at {1 / SIM_DT:g} Hz; the excitation steps by {np.diff(e.t).mean():g} s")
    check_limits(robot, e)
