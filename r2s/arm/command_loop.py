"""Command an arm through its driver; outside the emulator, no other module of r2s commands an arm.

Episodes, recordings, ramps and the clients' `move_to` pass their commands through `CommandLoop`. The arm receives
only the driver's torques; tests/test_command_loop.py checks that no other code commands an arm. The loop checks for a
stop request (r2s/arm/stop_request.py) in every cycle. When the driver has brought the arm to rest, the loop calls
the arm's `stop` and raises ArmStopped with the reason.
"""

import time
from collections import deque
from contextlib import suppress

import numpy as np

from r2s.adaptation.adapter import Adapter
from r2s.arm.drive_cycle import ADDED, SPRING, resist
from r2s.arm.driver import Driver
from r2s.arm.interface import Arm, ArmState, ArmStopped, Holds, Operated, StopRequested
from r2s.arm.stop_request import begin_ending, requested, serve
from r2s.physics.rigid_body import InverseInertia
from r2s.physics.robot import SIM_DT

# Settings of `CommandLoop.rest`, which damps a moving arm; the values are our choice
REST_S = 0.5  # s, longest duration of `rest`
REST_RATE = 15.0  # 1/s, decay rate of the joint speeds under damping
REST_SHARE = 0.2  # share of tau_max, limit of the damping torque
STILL = 0.02  # rad/s, speed below which a joint is treated as at rest
SLIDING = 0.05  # rad/s, replaces STILL after SLIDES_S, as damping cannot stop a joint that friction does not hold
SLIDES_S = 0.04  # s, see SLIDING


class CommandLoop:
    """Runs the motions of one arm, one 1 kHz cycle per call.

    Attributes:
        arm, driver: the arguments.
        state: the arm's state in the current cycle. sent: (n,) Nm, the last torque command.
        clock: s, three perf_counter times of the last cycle: before the driver, after the driver, after the adapter.

    Args:
        arm: the arm. driver: the driver, which limits every torque that the loop sends.
        log: queue to which the loop appends (state, torque) in every cycle, before it sends the torque.
        adapter: called once per cycle; the driver adds the adapter's torque in the next cycle. If the adapter raises
            an exception, the loop sends the driver no more commands. The driver then stops the arm, and the loop
            raises the adapter's exception.
    """

    def __init__(
        self,
        arm: Arm,
        driver: Driver,
        log: deque[tuple[ArmState, np.ndarray]] | None = None,
        adapter: Adapter | None = None,
    ):
        self.arm, self.driver = arm, driver
        self._adapter, self._adapting = adapter, False
        self._added: np.ndarray | None = None
        self._log, self._ended, self._requested = log, False, False
        self._inverse = InverseInertia(arm.robot)
        self.state: ArmState
        self.sent, self.clock = np.zeros(arm.robot.n), (0.0, 0.0, 0.0)

    def place(self, q: np.ndarray) -> ArmState:
        """Bring the arm to rest at q (n,) rad and begin a motion there.

        Raises:
            StopRequested: a stop was requested. ArmStopped: the arm could not move to q, or stopped on the way to q.
        """
        self._check_request()
        self._reset()
        try:
            self.state = self.arm.move_to(q)
        except ArmStopped:
            self.state = self.arm.read()
            raise
        return self.state

    def begin(self) -> None:
        """Begin a motion at the arm's current posture; raise StopRequested if a stop was requested."""
        self._check_request()
        self._reset()
        self.state = self.arm.read()

    def damp(self, hold: np.ndarray) -> None:
        """Damp the arm to rest (see `rest`), even if a stop was requested.

        To hold the largest load while damping, the driver needs a torque limit of (ADDED + REST_SHARE) * tau_max.
        """
        self._reset(hold)  # start at `hold`: a low-pass that starts at zero would drop the load for 20 ms
        self.state = self.arm.read()
        self.rest(hold)

    def __call__(self, command: np.ndarray | None, hold: np.ndarray | None = None) -> ArmState:
        """Run one cycle and return the state of the next cycle.

        Args:
            command: (c,), input of the control law; if None, the last command still applies.
            hold: (n,) Nm, see `DriverBatch.__call__`.

        Raises:
            StopRequested: a stop was requested, and the driver has brought the arm to rest.
            ArmStopped: the arm stopped itself, or the driver brought the arm to rest; the motion has ended.
        """
        if self.driver.stopping is None and (reason := requested()) is not None:
            self._requested = True
            begin_ending()
            self.driver.stop(reason)
        return self._cycle(command, hold)

    def _cycle(self, command: np.ndarray | None, hold: np.ndarray | None = None) -> ArmState:
        """Run one cycle without checking for stop requests."""
        self._step(command, hold)
        if self.driver.done:
            self._raise(str(self.driver.stopping), self.driver.held)
        return self.state

    def _step(self, command: np.ndarray | None, hold: np.ndarray | None) -> None:
        """Run one cycle like `_cycle`, but do not raise ArmStopped when the driver has brought the arm to rest."""
        if self._ended:
            raise ArmStopped("the motion is over")
        began = time.perf_counter()
        self.sent = self.driver(self.state, command, self._added, hold)
        driven = time.perf_counter()
        if self._adapter is not None and self._adapting:
            self._adapt(self._adapter)
        self.clock = began, driven, time.perf_counter()
        if self._log is not None:
            self._log.append((self.state, self.sent))
        try:
            self.arm.command(self.sent)
        except ArmStopped:
            self._ended = True
            raise
        self.state = self.arm.read()

    def rest(self, hold: np.ndarray | None = None) -> None:
        """Damp the motion until the arm rests under the command `hold` (n,) Nm, for at most 0.5 s.

        Unless the arm is in contact, `resist` adjusts `hold` to brake the joints that continue to move. If `hold` is
        None (see `halt`), the final command is zero.
        """
        inertia, robot = 1 / np.diag(self._inverse(self.state.q[None])[0]), self.arm.robot
        limit, step, most = REST_SHARE * robot.tau_max, robot.step_max, ADDED * robot.tau_max
        held = np.zeros(robot.n) if hold is None else hold.copy()
        for k in range(round(REST_S / SIM_DT)):
            s, slow = self.state, STILL if k * SIM_DT < SLIDES_S else SLIDING
            if np.abs(s.dq).max() < slow and (np.abs(s.tau_J_d - held) <= step).all():
                return
            if hold is not None and not s.in_contact:
                resist(s.dq, SPRING**2 * inertia, most, held)
            self._cycle(held + np.clip(-REST_RATE * inertia * s.dq, -limit, limit))

    def settle(self) -> None:
        """If the driver is stopping the arm, complete the stop and raise ArmStopped with the reason.

        Raises:
            StopRequested, ArmStopped: as `__call__`.
        """
        while self.driver.stopping is not None:
            self._cycle(None)

    def halt(self, reason: str) -> None:
        """Damp the arm to rest under zero command, and raise ArmStopped with `reason`.

        Callers use `halt` when the arm deviates from its planned motion. If the driver is already stopping the arm,
        the stop explains the deviation, so `halt` does nothing.
        """
        if self.driver.stopping is not None:
            return
        self.rest()
        self._raise(reason, hold=np.zeros(self.arm.robot.n))

    def end(self) -> str | None:
        """Stop the arm; return the reason if the driver was stopping the arm or if the arm stops itself, else None.

        With a push limit, the driver first holds or ends a contact (r2s/physics/contact_stop.py).
        """
        reason = None if self._ended else self.driver.stopping
        if reason is not None:
            self._block(reason)
        elif not self._ended and self.driver.decides_contact:
            reason = self._leave()
        self._ended = True
        self._stop_arm(self.driver.held)
        return reason

    def _leave(self) -> str | None:
        """Bring the arm to rest after a motion; if the arm stops itself meanwhile, return the reason, else None."""
        self.driver.stop("the motion is over")
        try:
            while not self.driver.done:
                self._step(None, None)
        except ArmStopped as reason:
            return str(reason)
        return None

    def _check_request(self) -> None:
        if (reason := requested()) is not None:
            self.state = self.arm.read()  # a runner uses this state even if no motion begins
            serve()
            raise StopRequested(reason)

    def _reset(self, torque: np.ndarray | None = None) -> None:
        self.driver.reset(torque)
        self._ended = self._requested = False
        if self._adapter is not None:
            self._adapter.begin()
            self._adapting, self._added = True, np.zeros(self.arm.robot.n)

    def _adapt(self, adapter: Adapter) -> None:
        """Update the adapter's torque; if the adapter raises an exception, stop the arm and raise this exception."""
        try:
            self._added = np.asarray(adapter(self.state.q, self.state.dq, self.sent), dtype=float)
            if self._added.shape != self.sent.shape:
                raise ValueError(
                    f"expected a torque of shape {self.sent.shape} from the adapter, got {self._added.shape}"
                )
        except Exception:
            self._adapting, self._added = False, None
            with suppress(ArmStopped):
                self.arm.command(self.sent)
                self.state = self.arm.read()
                while True:
                    self._cycle(None)
            raise

    def _raise(self, reason: str, hold: np.ndarray) -> None:
        """Stop the arm; raise ArmStopped or StopRequested with `reason`, even if the arm reports another reason."""
        kind = StopRequested if self._requested else ArmStopped
        self._block(reason)
        self._stop_arm(hold)
        self._ended = True
        if kind is StopRequested:
            serve()
        raise kind(reason)

    def _stop_arm(self, hold: np.ndarray) -> None:
        if isinstance(self.arm, Holds):
            self.arm.hold = hold.copy()
        self.arm.stop()

    def _block(self, reason: str) -> None:
        if isinstance(self.arm, Operated):
            self.arm.blocked = self.arm.blocked or reason
