"""Implement the `Arm` protocol through libfranka, as the base class of Panda and FR3.

libfranka has no point-to-point motion in torque control. Therefore, `move_to` follows a slow, checked joint path with
the recorder's tracking controller, in the same 1 kHz torque loop as all other motions. `move_to` needs no robot model
from libfranka, and the same code moves the hardware and, in tests, an emulated arm.
"""

import weakref
from contextlib import ExitStack
from dataclasses import replace
from typing import Any, Self

import numpy as np

from r2s.arm.clients import fci
from r2s.arm.clients.collision_thresholds import CAUTIOUS, CollisionThresholds
from r2s.arm.clients.connection_check import Connection, Finding, check_joints, refuse
from r2s.arm.clients.consent import Operator
from r2s.arm.clients.libfranka import Client
from r2s.arm.command_loop import REST_SHARE, STILL, CommandLoop
from r2s.arm.driver import ADDED, Driver
from r2s.arm.interface import ArmState, ArmStopped, NotCleared, Reflexes
from r2s.arm.realtime import realtime_section
from r2s.arm.tracking_controller import CUTOFF_HZ, TrackingController
from r2s.errors import UserError, check_number
from r2s.excitation.deviation import DeviationLimits
from r2s.excitation.minimum_jerk import minimum_jerk
from r2s.excitation.motion import Excitation
from r2s.excitation.motion_checks import Space, friction_margin
from r2s.excitation.paths import approach
from r2s.physics.collision import CollisionCheck
from r2s.physics.robot import SIM_DT, Robot
from r2s.recordings.recording import SIGNALS

# move_to: slow and weak, so that a person who blocks a link meets a bounded force (docs/explanation/safety.md)
SPEED = 0.2  # share of dq_max
ACCELERATION = 0.2  # share of ddq_max
TORQUE_SHARE = 0.2  # share of tau_max that the driver allows
MAX_DEVIATION = 0.1  # rad, largest deviation from the path of `move_to`; near obstacles, this limit is lower
SETTLE_S = 3.0  # s, longest time to settle at the end of the path
INTEGRAL_GAIN = 15.0  # share of tau_max per rad s; overcomes breakaway torque at the end of the path
INTEGRAL_SHARE = 0.15  # share of tau_max, limit of the integral's torque
ARRIVED = 2e-3  # rad, distance from the target at which the motion ends
ACCEPTED = 1e-2  # rad, accepted distance from the target after SETTLE_S: friction may hold a real wrist there
# share of tau_max that the driver allows in `stop`: the largest `hold` of a load plus the damping torque
STOP_SHARE = ADDED + REST_SHARE
MODES = {fci.GUIDING: "guiding", fci.USER_STOPPED: "user stopped"}


class Franka:
    """An `Arm` (r2s/arm/interface.py) that r2s commands through a libfranka `Client`; implements `Operated`.

    A motion begins with the caller's first `command`; from then on the arm needs one command per millisecond.

    Attributes:
        operator, blocked, hold: see `Operated` and `Holds`. `blocked` is set by a reflex, the stop button (even after
            its release), a stop by the driver, a rejected command, and a `move_to` that failed in motion. The method
            `stop` sets `blocked` only if an error occurs while the motion ends.
        findings: results of comparing the arm's properties with `connection`.
        realtime: whether motions run in a `realtime_section`. In real time, r2s rejects recordings and episodes in
            which less than 99 % of the commands arrive in time.

    Args:
        robot: limits and nominal model.
        client: connection to the arm through libfranka.
        operator: function that receives a stop's reason and returns whether the arm may move again. Without an
            operator (None), `move_to` raises NotCleared after a stop; further motion needs a new connection to a
            ready arm.
        collision: external torque and force at which the arm stops itself.
        connection: properties that the arm must have; if None, r2s does not check the arm.
        speed_share: factor on all allowed speeds in every motion.

    Raises:
        UserError: the arm does not match the model, or an argument is out of range. The arm has not moved.
    """

    def __init__(
        self,
        robot: Robot,
        client: Client,
        operator: Operator | None = None,
        collision: CollisionThresholds = CAUTIOUS,
        connection: Connection | None = None,
        realtime: bool = False,
        speed_share: float = 1.0,
    ):
        check_number("speed_share", speed_share, "(0, 1]")
        check_joints(robot)
        self.robot, self.operator, self.speed_share = robot, operator, speed_share
        self.blocked: str | None = None
        self.hold = np.zeros(robot.n)
        self.realtime, self._section = realtime, ExitStack()
        self._client, self._collision = client, collision
        self._reflexes = Reflexes(robot)
        self._moving, self._damping, self._closed, self._thresholds_set = False, False, False, False
        self._space: Space | None = None
        self._stopped: str | None = "no motion was started; call move_to first"
        self._read_idle()
        self._connection, self.findings = connection, self._compared(connection)
        # a strong reference to the arm would keep the arm and its connection alive after their last use
        arm, friction = weakref.proxy(self), 2 * friction_margin(robot)
        how = {"cutoff_hz": CUTOFF_HZ, "fence": CollisionCheck(robot, table=None), "speed_share": speed_share}
        self._loop, self._damping_loop = (
            CommandLoop(arm, Driver(robot, share * robot.tau_max, friction, **how))
            for share in (TORQUE_SHARE, STOP_SHARE)
        )

    def move_to(self, q: np.ndarray) -> ArmState:
        """Bring the arm to rest at q (7,) rad at up to a fifth of the speed limits.

        The arm follows the first path from r2s/excitation/paths.py that respects limits and clearances. An arm that
        is already within 2 mrad of q does not move.

        Raises:
            NotCleared: after an earlier stop, no operator agreed that the arm may move.
            StopRequested: a signal requested a stop, or the policy's process ended; the arm is at rest.
            ArmStopped: before the motion, q is outside the limits, the arm is not ready, or no path exists. During
                the motion, arm or driver stopped the motion, or the arm deviated from the path by 0.1 rad (less near
                obstacles) or came to rest over 10 mrad from q.

        """
        q = np.array(q, dtype=float)
        if q.shape != (self.robot.n,) or not np.isfinite(q).all():
            raise ArmStopped(f"move_to: expected {self.robot.n} finite joint angles, got {q}")
        self._reflexes.state(q, np.zeros(self.robot.n))
        self.stop()
        self._prepare()
        path = self._plan(q)
        self._stopped = None
        for posture in path:
            self._follow(posture)
        return self._state

    def read(self) -> ArmState:
        """Return the state of the current cycle; before the first `command`, return the state of the arm at rest."""
        return self._state

    def command(self, tau: np.ndarray) -> None:
        """Send tau (7,) Nm, without gravity, and wait for the next cycle; the first command starts the motion.

        Raises:
            ArmStopped: the arm stopped itself (libfranka's message), or the arm would reject the command. Instead of
                sending a command that the arm would reject, this method brings the arm to rest.

        """
        if self._stopped is not None:
            raise ArmStopped(f"the arm is stopped: {self._stopped}")
        tau = np.array(tau, dtype=float)
        try:
            self._reflexes.command(tau, self._state.tau_J_d)
        except ArmStopped as refused:
            self.blocked = self.blocked or str(refused)
            self.stop()
            self._stopped = str(refused)
            raise
        self._send(tau)

    def stop(self) -> None:
        """Damp the motion for at most 0.5 s, then end the motion; do not overwrite an earlier reason in `blocked`."""
        if self._damping:  # the command loop calls `stop` while it damps
            return
        for part in (self._damp, self._end):  # `_end` also runs if damping failed
            try:
                if self._moving:
                    part()
            except ArmStopped as reason:
                self._stopped = str(reason)
                self.blocked = self.blocked or self._stopped
        self._moving, self.hold = False, np.zeros(self.robot.n)
        self._section.close()
        if self._stopped is None:
            self._stopped = "stop was called"

    def watch(self, seconds: float) -> tuple[np.ndarray, np.ndarray]:
        """Read a resting arm's states for `seconds`; return their times (k,) s by arm clock and computer clock."""
        return self._client.watch(seconds)

    def close(self) -> None:
        """Stop the arm and close the connection."""
        self.stop()
        self._client.close()
        self._closed, self._stopped = True, "the connection was closed"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _send(self, tau: np.ndarray) -> None:
        try:
            if not self._moving:
                if self.realtime:
                    self._section.enter_context(realtime_section())
                self._begun = _ms(self._client.start())
                self._moving = True
            self._state = self._sample(self._client.exchange(tau))
        except ArmStopped as reason:
            self._section.close()
            self._moving, self._stopped = False, str(reason)
            self.blocked = self.blocked or self._stopped
            raise

    def _sample(self, s: Any) -> ArmState:
        t = (_ms(s) - self._begun) * SIM_DT
        known: dict[str, Any] = {name: np.array(getattr(s, name))[()] for name in SIGNALS}
        return ArmState(t, np.array(s.q), np.array(s.dq), np.array(s.tau_J), np.array(s.tau_J_d), **known)

    def _damp(self) -> None:
        if self._stopped is None:
            self._damping = True
            try:
                self._damping_loop.damp(self.hold)
            finally:
                self._damping = False

    def _end(self) -> None:
        self._moving = False
        try:
            self._client.finish()
        finally:
            self._section.close()
        self._read_idle()

    def _compared(self, connection: Connection | None) -> list[Finding]:
        if connection is None:
            return []
        found = connection.findings(self.robot, self._client.version, self._client.idle())
        try:
            refuse(found if connection.moves else [], f"arm={type(self).__name__.lower()}")
        except UserError:
            self._client.close()
            raise
        return found

    def _read_idle(self) -> None:
        """Read the state between motions; set tau_J_d to 0, because the arm's own controller sent this torque."""
        s = self._client.idle()
        self._begun = _ms(s)
        sample = self._sample(s)
        self._state = replace(sample, t=0.0, tau_J_d=np.zeros(self.robot.n))

    def _prepare(self) -> None:
        """Prepare a motion; ask the operator after a stop, and raise ArmStopped if the arm cannot move."""
        if self._closed:
            raise ArmStopped("the connection was closed")
        if self._connection is not None and not self._connection.moves:
            raise ArmStopped("the connection is only for a check; open it again to move the arm")
        s = self._client.idle()
        mode = int(s.robot_mode)
        if self.blocked is None and mode == fci.REFLEX:
            self.blocked = str(s.last_motion_errors) or "an earlier reflex"
        elif self.blocked is None and mode == fci.USER_STOPPED:
            self.blocked = "it is user stopped"
        if self.blocked is not None:
            if self.operator is None or not self.operator(self.blocked):
                raise NotCleared(f"the arm has stopped and no operator agreed that it may move: {self.blocked}")
            mode = int(self._client.idle().robot_mode)  # the stop button may have been released during the question
        if mode == fci.REFLEX:
            self._client.recover()
        elif mode != fci.IDLE:
            raise ArmStopped(f"the arm is not ready to move: it is {MODES.get(mode, f'in mode {mode}')}")
        self.blocked = None
        if not self._thresholds_set:
            self._client.set_collision_thresholds(self._collision)
            self._thresholds_set = True
        self._read_idle()

    def _plan(self, q: np.ndarray) -> np.ndarray:
        """Return the k postures (k, 7) rad of a joint path to q (7,) rad; k is 0 if the arm is already at q."""
        here = self._state.q
        if np.abs(here - q).max() <= ARRIVED:
            return q[:0, None]
        try:
            self._space = self._space or Space(self.robot)
            return approach(self.robot, here, q, what="the path of move_to", space=self._space)[1:]
        except UserError as no_path:
            self._stopped = f"{no_path}; guide the arm by hand to a posture that has one"
            raise ArmStopped(self._stopped) from None

    def _follow(self, q: np.ndarray) -> None:
        """Move along a straight line in joint space to q (7,) rad."""
        path, moving = _slow_path(self.robot, self._state.q, q, self.speed_share)
        assert self._space is not None  # set by `_plan`
        allowed = DeviationLimits.along(self._space, path, MAX_DEVIATION)
        controller, loop = TrackingController(self.robot, path, allowed), self._loop
        limit = INTEGRAL_SHARE * self.robot.tau_max
        integral, last_error = np.zeros(7), np.zeros(7)
        loop.begin()
        try:
            for k in range(len(path.t)):
                s = loop.state
                error = q - s.q
                if k >= moving and np.abs(error).max() < ARRIVED and np.abs(s.dq).max() < STILL:
                    break
                if (reason := controller.deviation(k, s)) is not None:
                    loop.halt(reason)
                if k >= moving:
                    # Clegg integrator (1958): the integral resets when the error changes sign.
                    # Without the reset, the torque that overcame stiction would move the joint past its target.
                    integral = np.clip(integral + INTEGRAL_GAIN * SIM_DT * self.robot.tau_max * error, -limit, limit)
                    integral = np.where(error * last_error < 0, 0, integral)
                    last_error = error
                loop(controller(k, s) + integral, controller.offset)
            loop.settle()
            self._end()
        except ArmStopped as reason:
            self.blocked = self.blocked or str(reason)
            raise
        finally:
            if self._moving:  # an exception ended the loop
                self.stop()
        distance = np.abs(self._state.q - q)
        if distance.max() > ACCEPTED:
            i = int(distance.argmax())
            self._stopped = f"joint {i + 1}: expected {q[i]:.4f} rad after move_to, got {self._state.q[i]:.4f} rad"
            self.blocked = self._stopped
            raise ArmStopped(self._stopped)


def _ms(state: Any) -> int:
    return round(state.time.to_sec() * 1e3)


def _slow_path(robot: Robot, start: np.ndarray, end: np.ndarray, share: float) -> tuple[Excitation, int]:
    """Return a minimum-jerk motion that ends with a rest of SETTLE_S, and the number of rows before this rest."""
    distance = np.abs(end - start)
    # peaks of minimum jerk: velocity 15/8 distance / T, acceleration 10/sqrt(3) distance / T^2
    duration = max(
        0.2,  # s
        (15 / 8 * distance / (SPEED * share * robot.dq_max)).max(),
        np.sqrt(10 / np.sqrt(3) * distance / (ACCELERATION * robot.ddq_max)).max(),
    )
    moving = int(np.ceil(duration / SIM_DT))
    t = SIM_DT * np.arange(moving + round(SETTLE_S / SIM_DT) + 1)
    return Excitation(t, *minimum_jerk(start, end, duration, t[:, None])), moving
