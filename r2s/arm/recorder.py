"""Record an excitation on any arm, through the same calls and with the same precautions that hardware needs."""

from collections.abc import Callable

import numpy as np

from r2s.arm.command_loop import CommandLoop
from r2s.arm.driver import Driver
from r2s.arm.interface import Arm, ArmStopped
from r2s.arm.tracking_controller import CUTOFF_HZ, LoadedTrackingController, TrackingController
from r2s.errors import UserError
from r2s.excitation.motion import Excitation
from r2s.excitation.motion_checks import TABLE_M, TOOL_M, check_limits, check_space, friction_margin
from r2s.physics.robot import SIM_DT, Robot
from r2s.recordings.recording import Recording, declared_torque

TORQUE_SHARE = 0.8  # of tau_max, torque limit of the driver; the same share as in excitation/motion_checks.py
PROGRESS_EVERY = 500  # cycles
MIN_ROWS = 100  # a stopped recording with fewer is discarded


def record(
    arm: Arm,
    excitation: Excitation,
    *,
    torque: str = "commanded",
    table: float = TABLE_M,
    z_min: float = TOOL_M,
    progress: Callable[[int, int], None] | None = None,
    loaded: bool = False,
) -> Recording:
    """Follow the excitation at 1 kHz and return the recorded motion.

    Row k holds the state read in cycle k and, for 'commanded', the command sent in that same cycle (it is tau_J_d of
    cycle k + 1): replaying tau[k : k + m] from state k predicts q[k + 1 : k + m + 1]. For 'measured', row k holds
    tau_J read together with q and dq, as robot logs do. t is the arm's clock.

    Args:
        arm: moved to the excitation's first posture, and always stopped at the end.
        excitation: on a 1 ms clock; inside the limits and clear of table and arm, otherwise nothing moves.
        torque: 'commanded' (tau_J_d, without gravity) or 'measured' (tau_J, includes gravity).
        table, z_min: m, see `r2s.excitation.motion_checks.check_motion`.
        progress: called every 0.5 s of motion with (cycles done, total).
        loaded: the arm may carry an undeclared payload; it is tracked by `LoadedTrackingController`.

    Raises:
        ArmStopped: the arm or the driver ended the motion, or the arm deviated from the plan; the exception's
            `recording` holds the rows so far.
        UserError: the excitation is not allowed.

    """
    declared_torque(torque)
    _check(arm.robot, excitation)
    check_space(arm.robot, excitation, table=table, z_min=z_min)
    controller = (LoadedTrackingController if loaded else TrackingController)(arm.robot, excitation)
    rows = len(excitation.t)
    t = np.empty(rows)
    q, dq, tau = (np.empty((rows, arm.robot.n)) for _ in range(3))
    loop = CommandLoop(
        arm, Driver(arm.robot, TORQUE_SHARE * arm.robot.tau_max, 2 * friction_margin(arm.robot), cutoff_hz=CUTOFF_HZ)
    )
    loop.place(excitation.q[0])

    def recorded(rows: int) -> Recording:
        return Recording(t=t[:rows], q=q[:rows], dq=dq[:rows], tau=tau[:rows], torque=torque, name=arm.robot.name)

    k = 0
    try:
        for k in range(rows):
            state = loop.state
            t[k], q[k], dq[k] = state.t, state.q, state.dq
            if (reason := controller.deviation(k, state)) is not None:
                loop.halt(reason)
            loop(controller(k, state))
            tau[k] = loop.sent if torque == "commanded" else state.tau_J
            if progress is not None and (k % PROGRESS_EVERY == 0 or k == rows - 1):
                progress(k + 1, rows)
    except ArmStopped as stop:
        if k >= MIN_ROWS:
            stop.recording = recorded(k)
        raise
    finally:
        loop.end()
    return recorded(rows)


def _check(robot: Robot, e: Excitation) -> None:
    if e.q.shape != (len(e.t), robot.n):
        raise UserError(f"excitation: expected {robot.n} joints, got {e.q.shape[1]} ({robot.name})")
    if not np.allclose(np.diff(e.t), SIM_DT, rtol=1e-6, atol=0):
        raise UserError(f"excitation: expected steps of {SIM_DT:g} s, got {np.diff(e.t).mean():g} s")
    check_limits(robot, e)
