"""An arm behind its driver: the only place in r2s from which an arm is commanded.

Episodes, recordings, ramps and the clients' own ways to a place all pass their targets through here; what the driver
makes of them is sent, and nothing else. tests/test_driven.py holds that there is no other call.
"""

import time
from collections import deque
from contextlib import suppress

import numpy as np

from r2s.adaptation.adapter import Adapter, Tells
from r2s.arm.driver import Driver
from r2s.arm.interface import Arm, ArmState, ArmStopped, Operated
from r2s.physics.rigid_body import InverseInertia
from r2s.physics.robot import SIM_DT

REST_S = 0.5  # at most, to bring an arm to rest that is told to
REST_RATE = 15.0  # 1/s, of that damping
REST_SHARE = 0.2  # of tau_max
STILL = 0.02  # rad/s


class Driven:
    """One motion after the other of one arm.

    Attributes:
        arm, driver: which. state: of the current cycle. sent: (n,) Nm, the last command.
        told: (c,), what the adapter tells the policy, the newest; None: it tells nothing.
        clock: s, perf_counter before and after the driver's last decision, and after the adapter's.

    Args:
        arm: at 1 kHz. driver: whose settings say what the targets of these motions may ask for.
        log: gets (state, command) of every cycle before it is sent.
        adapter: hears every cycle, and adds to the targets from the next on. Where it raises, the driver stops the
            arm, as one whose policy is silent, before its exception goes on.
    """

    def __init__(
        self,
        arm: Arm,
        driver: Driver,
        log: deque[tuple[ArmState, np.ndarray]] | None = None,
        adapter: Adapter | None = None,
    ):
        self.arm, self.driver = arm, driver
        self._adapter, self._hears = adapter, False
        self._added: np.ndarray | None = None
        self._tells = adapter if isinstance(adapter, Tells) else None
        self._log, self._over = log, False
        self._inverse = InverseInertia(arm.robot)
        self.state: ArmState
        self.sent, self.clock = np.zeros(arm.robot.n), (0.0, 0.0, 0.0)

    @property
    def told(self) -> np.ndarray | None:
        """What the adapter tells."""
        return None if self._tells is None else self._tells.told

    def place(self, q: np.ndarray) -> ArmState:
        """Bring the arm to rest at q (n,) rad and begin a motion there; raises ArmStopped as `Arm.move_to`."""
        self._reset()
        try:
            self.state = self.arm.move_to(q)
        except ArmStopped:
            self.state = self.arm.read()
            raise
        return self.state

    def begin(self) -> None:
        """Begin a motion where the arm is."""
        self._reset()
        self.state = self.arm.read()

    def __call__(self, target: np.ndarray | None) -> ArmState:
        """Go on for one cycle with the target (n,) Nm, None where nothing was said; return the state after it.

        Raises:
            ArmStopped: the arm has stopped itself, or the driver has brought it to rest; then there is no next cycle.
        """
        if self._over:
            raise ArmStopped("the motion is over")
        began = time.perf_counter()
        self.sent = self.driver(self.state, target, self._added)
        decided = time.perf_counter()
        if self._adapter is not None and self._hears:
            self._hear(self._adapter)
        self.clock = began, decided, time.perf_counter()
        if self._log is not None:
            self._log.append((self.state, self.sent))
        try:
            self.arm.command(self.sent)
        except ArmStopped:
            self._over = True
            raise
        self.state = self.arm.read()
        if self.driver.done:
            self._stopped(str(self.driver.stopping))
        return self.state

    def rest(self) -> None:
        """Take speed out of the arm and torque out of the command, for at most half a second."""
        damping = REST_RATE / np.diag(self._inverse(self.state.q[None])[0])
        most, step = REST_SHARE * self.arm.robot.tau_max, self.arm.robot.dtau_max * SIM_DT
        for _ in range(round(REST_S / SIM_DT)):
            s = self.state
            if np.abs(s.dq).max() < STILL and (np.abs(s.tau_J_d) <= step).all():
                return
            self(np.clip(-damping * s.dq, -most, most))

    def halt(self, reason: str) -> None:
        """Bring the arm to rest because of `reason`, and raise ArmStopped with it."""
        self.rest()
        self._stopped(reason)

    def end(self) -> str | None:
        """Stop the arm; return why it was being brought to rest when the end came, or None."""
        reason = None if self._over else self.driver.stopping
        if reason is not None:
            self._block(reason)
        self._over = True
        self.arm.stop()
        return reason

    def _reset(self) -> None:
        self.driver.reset()
        self._over = False
        if self._adapter is not None:
            self._adapter.begin()
            self._hears, self._added = True, np.zeros(self.arm.robot.n)

    def _hear(self, adapter: Adapter) -> None:
        """Let the adapter hear this cycle; where it raises, say nothing until the driver has stopped the arm."""
        try:
            self._added = np.asarray(adapter(self.state.q, self.state.dq, self.sent), dtype=float)
            if self._added.shape != self.sent.shape:
                raise ValueError(f"an adapter of {len(self.sent)} joints returned {self._added.shape}")
        except Exception:
            self._hears, self._added = False, None
            with suppress(ArmStopped):
                self.arm.command(self.sent)
                self.state = self.arm.read()
                while True:
                    self(None)
            raise

    def _stopped(self, reason: str) -> None:
        self._over = True
        self._block(reason)
        raise ArmStopped(reason)

    def _block(self, reason: str) -> None:
        if isinstance(self.arm, Operated):
            self.arm.blocked = reason
