"""Record an excitation on any arm, through the same calls and with the same precautions that hardware needs."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from r2s.arm.command_loop import CommandLoop
from r2s.arm.driver import Driver
from r2s.arm.interface import Arm, ArmStopped, named_signals, signal_sizes, speed_share
from r2s.arm.realtime import Timing
from r2s.arm.tracking_controller import (
    CUTOFF_HZ,
    LOADED_DEVIATION,
    MAX_DEVIATION,
    LoadedTrackingController,
    TrackingController,
)
from r2s.errors import UserError
from r2s.excitation.motion import Excitation
from r2s.excitation.motion_checks import (
    TABLE_M,
    TOOL_M,
    Space,
    allowed_deviation,
    check_limits,
    check_space,
    friction_margin,
)
from r2s.physics.collision import CollisionCheck
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
    timing: Timing | None = None,
) -> Recording:
    """Follow the excitation at 1 kHz and return the recorded motion.

    Row k holds the state read in cycle k and, for 'commanded', the command sent in that same cycle (it is tau_J_d of
    cycle k + 1): replaying tau[k : k + m] from state k predicts q[k + 1 : k + m + 1]. For 'measured', row k holds
    tau_J read together with q and dq, as robot logs do. t is the arm's clock. Signals are those of the same state.

    Args:
        arm: moved to the excitation's first posture, and always stopped at the end.
        excitation: on a 1 ms clock; inside the limits and clear of table and arm, otherwise nothing moves.
        torque: 'commanded' (tau_J_d, without gravity) or 'measured' (tau_J, includes gravity).
        table, z_min: m, see `r2s.excitation.motion_checks.check_motion`.
        progress: called every 0.5 s of motion with (cycles done, total), in a cycle: it must return at once.
        loaded: the arm may carry an undeclared payload; it is tracked by `LoadedTrackingController`.
        timing: receives the durations of the cycles.

    Raises:
        ArmStopped: the arm or the driver ended the motion, the arm deviated from the plan by more than the
            `allowed_deviation`, or in real time it missed more than 1 % of the commands; the exception's `recording`
            holds the rows so far.
        UserError: the excitation is not allowed.

    """
    declared_torque(torque)
    share = speed_share(arm)
    _check(arm.robot, excitation, share)
    check_space(arm.robot, excitation, table=table, z_min=z_min)
    follow, most = (LoadedTrackingController, LOADED_DEVIATION) if loaded else (TrackingController, MAX_DEVIATION)
    room = allowed_deviation(Space(arm.robot, table=table, z_min=z_min), excitation, most)
    controller = follow(arm.robot, excitation, room)
    rows = len(excitation.t)
    t = np.empty(rows)
    q, dq, tau = (np.empty((rows, arm.robot.n)) for _ in range(3))
    signals = np.empty((rows, sum(signal_sizes(arm.robot.n).values())))
    limits = TORQUE_SHARE * arm.robot.tau_max, 2 * friction_margin(arm.robot)
    fence = CollisionCheck(arm.robot, table=table)
    loop = CommandLoop(arm, Driver(arm.robot, *limits, cutoff_hz=CUTOFF_HZ, fence=fence, speed_share=share))
    loop.place(excitation.q[0])

    def recorded(rows: int) -> Recording:
        known = named_signals(signals[:rows], arm.robot.n)
        return Recording(
            t=t[:rows], q=q[:rows], dq=dq[:rows], tau=tau[:rows], torque=torque, name=arm.robot.name, signals=known
        )

    k, timing = 0, timing or Timing()
    timing.begin()
    try:
        for k in range(rows):
            state = loop.state
            t[k], q[k], dq[k], signals[k] = state.t, state.q, state.dq, state.signals
            if (reason := controller.deviation(k, state)) is not None:
                loop.halt(reason)
            loop(controller(k, state), controller.offset)
            timing.cycle(loop.clock, loop.state)
            tau[k] = loop.sent if torque == "commanded" else state.tau_J
            if progress is not None and (k % PROGRESS_EVERY == 0 or k == rows - 1):
                progress(k + 1, rows)
        loop.end()
        timing.check(arm)
    except ArmStopped as stop:
        if k >= MIN_ROWS:
            stop.recording = recorded(k)
        raise
    finally:
        loop.end()
    return recorded(rows)


def _check(robot: Robot, e: Excitation, share: float) -> None:
    if e.q.shape != (len(e.t), robot.n):
        raise UserError(f"excitation: expected {robot.n} joints, got {e.q.shape[1]} ({robot.name})")
    if not np.allclose(np.diff(e.t), SIM_DT, rtol=1e-6, atol=0):
        raise UserError(f"excitation: expected steps of {SIM_DT:g} s, got {np.diff(e.t).mean():g} s")
    check_limits(robot, e)
    try:
        check_limits(replace(robot, dq_max=share * robot.dq_max), e)
    except UserError as fast:
        raise UserError(f"{fast} by arm.speed_share={share:g}") from None
