"""Record an excitation on an arm; code and safety checks are the same for simulated and real arms."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from r2s.arm.command_loop import CommandLoop
from r2s.arm.driver import Driver
from r2s.arm.interface import Arm, ArmState, ArmStopped, named_signals, signal_sizes, speed_share
from r2s.arm.realtime import Timing
from r2s.arm.tracking_controller import (
    CUTOFF_HZ,
    LOADED_DEVIATION,
    MAX_DEVIATION,
    LoadedTrackingController,
    TrackingController,
)
from r2s.errors import UserError
from r2s.excitation.deviation import DeviationLimits
from r2s.excitation.motion import Excitation
from r2s.excitation.motion_checks import Space, check_limits, check_space, friction_margin
from r2s.physics.collision import CollisionCheck
from r2s.physics.robot import SIM_DT, Robot
from r2s.recordings.recording import Recording, declared_torque

TORQUE_SHARE = 0.8  # share of tau_max that the driver allows; equal to that in excitation/motion_checks.py
PROGRESS_EVERY = 500  # cycles
MIN_ROWS = 100  # a stopped recording with fewer rows is discarded


def record(
    arm: Arm,
    excitation: Excitation,
    *,
    torque: str = "commanded",
    progress: Callable[[int, int], None] | None = None,
    loaded: bool = False,
    added: np.ndarray | None = None,
    timing: Timing | None = None,
) -> Recording:
    """Follow the excitation at 1 kHz and return the recorded motion.

    Row k contains the arm's state in cycle k and the time t by the arm's clock. With torque='commanded', tau[k] is
    the command of cycle k, which the arm reports as tau_J_d in cycle k + 1. A simulation that starts in state k and
    applies tau[k : k + m] predicts q[k + 1 : k + m + 1]. With torque='measured', tau[k] is tau_J of cycle k, as in
    robot logs.

    Args:
        arm: the arm, which moves to the first posture of the excitation, and always stops after the recording.
        excitation: motion with a time step of 1 ms, checked for limits and clearance before the arm moves.
        torque: 'commanded' (tau_J_d, without gravity) or 'measured' (tau_J, includes gravity).
        progress: called every 0.5 s with (cycles done, total cycles); must return at once, because the arm is moving.
        loaded: whether the arm may carry an undeclared payload; if so, `LoadedTrackingController` tracks the motion.
        added: (T, n) Nm, torque added to that of the tracking controller; None: no torque.
        timing: receives the durations of the cycles.

    Raises:
        ArmStopped: the arm or the driver stopped the motion, the arm deviated from the excitation by more than the
            `DeviationLimits`, or more than 1 % of the commands did not reach a real-time arm in time. The
            exception's `recording` contains the rows recorded before the stop, if there are at least MIN_ROWS.
        UserError: the excitation does not fit the arm, exceeds its limits or leaves too little clearance.

    """
    declared_torque(torque)
    share = speed_share(arm)
    _check(arm.robot, excitation, share)
    space = Space(arm.robot)
    check_space(arm.robot, excitation, space=space)
    follow, most = (LoadedTrackingController, LOADED_DEVIATION) if loaded else (TrackingController, MAX_DEVIATION)
    allowed = DeviationLimits.along(space, excitation, most)
    controller = follow(arm.robot, excitation, allowed)
    limits = TORQUE_SHARE * arm.robot.tau_max, 2 * friction_margin(arm.robot)
    fence = CollisionCheck(arm.robot)
    loop = CommandLoop(arm, Driver(arm.robot, *limits, cutoff_hz=CUTOFF_HZ, fence=fence, speed_share=share))
    loop.place(excitation.q[0])
    rows, timing = _Rows(len(excitation.t), arm.robot, torque), timing or Timing()
    timing.begin()
    try:
        for k in range(len(excitation.t)):
            state = loop.state
            if (reason := controller.deviation(k, state)) is not None:
                loop.halt(reason)
            target = controller(k, state)
            loop(target if added is None else target + added[k], controller.offset)
            timing.cycle(loop.clock, loop.state)
            rows.add(state, loop.sent)
            if progress is not None and (k % PROGRESS_EVERY == 0 or k == len(excitation.t) - 1):
                progress(k + 1, len(excitation.t))
        loop.settle()
        loop.end()
        timing.check(arm)
    except ArmStopped as stop:
        if rows.filled >= MIN_ROWS:
            stop.recording = rows.recording()
        raise
    finally:
        loop.end()
    return rows.recording()


class _Rows:
    """The rows of a recording, allocated before the motion; `filled` is the number of rows written so far."""

    def __init__(self, rows: int, robot: Robot, torque: str):
        self._robot, self._torque = robot, torque
        self._t = np.empty(rows)
        self._q, self._dq, self._tau = (np.empty((rows, robot.n)) for _ in range(3))
        self._signals = np.empty((rows, sum(signal_sizes(robot.n).values())))
        self.filled = 0

    def add(self, state: ArmState, sent: np.ndarray) -> None:
        """Append a row from the state of a cycle and from the command `sent` (n,) Nm of the same cycle."""
        k = self.filled
        self._t[k], self._q[k], self._dq[k], self._signals[k] = state.t, state.q, state.dq, state.signals
        self._tau[k] = sent if self._torque == "commanded" else state.tau_J
        self.filled += 1

    def recording(self) -> Recording:
        """Return the rows recorded so far."""
        rows = self.filled
        t, q, dq, tau = (x[:rows] for x in (self._t, self._q, self._dq, self._tau))
        known = named_signals(self._signals[:rows], self._robot.n)
        return Recording(t=t, q=q, dq=dq, tau=tau, torque=self._torque, name=self._robot.name, signals=known)


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
