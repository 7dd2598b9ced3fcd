"""What the Panda and the FR3 have in common: the `Arm` protocol on a libfranka client, hardware or emulated.

libfranka knows no "go there" in torque control, so `move_to` follows a slow joint path with the recorder's tracking
controller, through the same 1 kHz torque loop that everything else uses: the model of the client package is not
needed, and what brings the arm to its place on hardware is what the emulator has tested.
"""

import importlib
from collections.abc import Callable
from types import ModuleType
from typing import Any, Protocol

import numpy as np

from r2s.arm import fci
from r2s.arm.interface import ArmState, ArmStopped, Reflexes
from r2s.arm.tracking import Tracker
from r2s.errors import UserError
from r2s.excitation.motion import Excitation
from r2s.physics.rigid_body import InverseInertia
from r2s.physics.robot import SIM_DT, Robot

SPEED = 0.2  # of dq_max, on the way to a place
ACCELERATION = 0.2  # of ddq_max
SETTLE_S = 3.0  # at most, at the end of the way
PULL = 15.0  # of tau_max per rad and s, of the integral that then overcomes breakaway
PULL_SHARE = 0.15  # of tau_max, at most; the tracking controller takes 0.8
NEAR = 2e-3  # rad: there
ACCEPTED = 1e-2  # rad: near enough when the time is over; friction of a real wrist
STILL = 0.02  # rad/s
REST_S = 0.5  # at most, to damp a motion that ends
REST_RATE = 15.0  # 1/s, of that damping
REST_SHARE = 0.3  # of tau_max
RATE_SHARE = 0.95  # of dtau_max
MODES = {fci.GUIDING: "guiding", fci.USER_STOPPED: "user stopped"}


class Client(Protocol):
    """One of libfranka's two Python packages. RobotState has the same names in both.

    Every method raises ArmStopped with libfranka's own words.
    """

    def idle(self) -> Any:
        """Return a fresh RobotState while no motion runs."""
        ...

    def start(self) -> Any:
        """Start a torque motion; return the RobotState that waits for the first command."""
        ...

    def exchange(self, tau: np.ndarray) -> Any:
        """Send tau (7,) Nm for this cycle, wait for the next one and return its RobotState."""
        ...

    def finish(self) -> None:
        """End the motion that runs."""
        ...

    def recover(self) -> None:
        """Clear a reflex."""
        ...

    def close(self) -> None:
        """Drop the connection."""
        ...


class Franka:
    """An `Arm` (r2s/arm/interface.py) behind a `Client`.

    The motion of a caller begins with its first `command`; from then on the arm wants one per millisecond.

    Args:
        robot: the arm's limits and nominal model.
        client: the connection.
        clear: asked with the reason before a reflex is cleared; returns whether the operator agrees. By default
            nobody does: `move_to` refuses until the arm was cleared by other means.
    """

    def __init__(self, robot: Robot, client: Client, clear: Callable[[str], bool] | None = None):
        if robot.n != 7:
            raise UserError(f"a Franka arm has 7 joints; {robot.name} has {robot.n}")
        self.robot = robot
        self._client, self._clear = client, clear
        self._reflexes, self._inverse = Reflexes(robot), InverseInertia(robot)
        self._moving, self._closed = False, False
        self._stopped: str | None = "no motion was started; call move_to first"
        self._rest()

    def move_to(self, q: np.ndarray) -> ArmState:
        """Go to q (7,) rad at a fifth of the speed limits, unless the arm is within 2 mrad of it, and hold there.

        Raises:
            ArmStopped: q is outside the limits, the arm has stopped itself and nobody clears that, it stops on
                the way, or it does not come within 10 mrad.

        """
        q = np.array(q, dtype=float)
        if q.shape != (self.robot.n,) or not np.isfinite(q).all():
            raise ArmStopped(f"move_to needs {self.robot.n} finite joint angles; it got {q}")
        self._reflexes.state(q, np.zeros(self.robot.n))
        self.stop()
        self._ready()
        self._stopped = None
        if np.abs(self._state.q - q).max() > NEAR:
            self._go(q)
        return self._state

    def read(self) -> ArmState:
        """Return the state of the current cycle; before a motion's first command, of the arm at rest."""
        return self._state

    def command(self, tau: np.ndarray) -> None:
        """Send tau (7,) Nm without gravity and wait for the next cycle; the first one starts the motion.

        Raises:
            ArmStopped: in libfranka's words if the arm stopped itself; or the command is one that it would not
                take, which is not sent: the arm is brought to rest instead.

        """
        if self._stopped is not None:
            raise ArmStopped(f"the arm is stopped: {self._stopped}")
        tau = np.array(tau, dtype=float)
        try:
            self._reflexes.command(tau, self._state.tau_J_d)
        except ArmStopped as refused:
            self.stop()
            self._stopped = str(refused)
            raise
        self._send(tau)

    def stop(self) -> None:
        """Damp what still moves, for at most half a second, and end the motion."""
        try:
            if self._moving:
                self._damp()
                self._end()
        except ArmStopped as reason:
            self._stopped = str(reason)
        self._moving = False
        if self._stopped is None:
            self._stopped = "stop was called"

    def close(self) -> None:
        """Stop and drop the connection."""
        self.stop()
        self._client.close()
        self._closed, self._stopped = True, "the connection was closed"

    def _send(self, tau: np.ndarray) -> None:
        try:
            if not self._moving:
                self._begun = _ms(self._client.start())
                self._moving = True
            self._state = self._sample(self._client.exchange(tau))
        except ArmStopped as reason:
            self._moving, self._stopped = False, str(reason)
            raise

    def _sample(self, s: Any) -> ArmState:
        t = (_ms(s) - self._begun) * SIM_DT
        return ArmState(t, np.array(s.q), np.array(s.dq), np.array(s.tau_J), np.array(s.tau_J_d))

    def _end(self) -> None:
        self._moving = False
        self._client.finish()
        self._rest()

    def _rest(self) -> None:
        """Read the arm between motions; its own controller's torque is no command of ours."""
        s = self._client.idle()
        self._begun = _ms(s)
        seen = self._sample(s)
        self._state = ArmState(0.0, seen.q, seen.dq, seen.tau_J, np.zeros(self.robot.n))

    def _ready(self) -> None:
        """Raise ArmStopped unless the arm can move, after its reflex was cleared where there is one."""
        if self._closed:
            raise ArmStopped("the connection was closed")
        s = self._client.idle()
        mode = int(s.robot_mode)
        if mode == fci.REFLEX:
            reason = str(s.last_motion_errors) or str(self._stopped)
            if self._clear is None or not self._clear(reason):
                raise ArmStopped(f"the arm has stopped itself and nobody cleared that: {reason}")
            self._client.recover()
        elif mode != fci.IDLE:
            raise ArmStopped(f"the arm is not ready to move: it is {MODES.get(mode, f'in mode {mode}')}")
        self._rest()

    def _go(self, q: np.ndarray) -> None:
        path, moving = _slow_path(self.robot, self._state.q, q)
        follow = Tracker(self.robot, path)
        step, most = RATE_SHARE * self.robot.dtau_max * SIM_DT, PULL_SHARE * self.robot.tau_max
        pull, before = np.zeros(7), np.zeros(7)
        try:
            for k in range(len(path.t)):
                s = self._state
                left = q - s.q
                if k >= moving and np.abs(left).max() < NEAR and np.abs(s.dq).max() < STILL:
                    break
                tau = follow(k, s.q, s.dq, s.tau_J_d - pull)
                if k >= moving:
                    # Clegg (1958): an integral that restarts where the error changes sign, or what broke a joint
                    # loose would carry it past its place
                    pull = np.clip(pull + PULL * SIM_DT * self.robot.tau_max * left, -most, most)
                    pull = np.where(left * before < 0, 0, pull)
                    before = left
                self._send(s.tau_J_d + np.clip(tau + pull - s.tau_J_d, -step, step))
            self._end()
        finally:
            if self._moving:  # interrupted
                self.stop()
        left = np.abs(self._state.q - q)
        if left.max() > ACCEPTED:
            i = int(left.argmax())
            self._stopped = f"joint {i + 1} stands at {self._state.q[i]:.4f} rad and was to go to {q[i]:.4f} rad"
            raise ArmStopped(self._stopped)

    def _damp(self) -> None:
        """Take speed out, and torque back, before the arm's own controller takes over."""
        gain = REST_RATE / np.diag(self._inverse(self._state.q[None])[0])
        most, step = REST_SHARE * self.robot.tau_max, RATE_SHARE * self.robot.dtau_max * SIM_DT
        for _ in range(round(REST_S / SIM_DT)):
            s = self._state
            if np.abs(s.dq).max() < STILL and (np.abs(s.tau_J_d) <= step).all():
                return
            tau = np.clip(-gain * s.dq, -most, most)
            self._send(s.tau_J_d + np.clip(tau - s.tau_J_d, -step, step))


def package(name: str, extra: str) -> ModuleType:
    """Import a client package.

    Raises:
        UserError: it, or something it needs, is not installed.

    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        lacks = "" if error.name in (name, name.split(".")[0]) else f" ({error})"
        raise UserError(
            f"arm={extra} needs the package {name.split('.')[0]}{lacks}; allowed is what "
            f"`pip install 'r2s[{extra}]'` installs"
        ) from None


def connect(make: Callable[[], Any], extra: str, address: str) -> Any:
    """Return the client's robot, or raise UserError with libfranka's reason."""
    try:
        return make()
    except Exception as error:
        raise UserError(f"arm={extra}: no connection to {address}: {words(error)}") from None


def words(error: BaseException) -> str:
    """Return libfranka's message as one line."""
    return " ".join(str(error).split()) or type(error).__name__


def _ms(state: Any) -> int:
    return round(state.time.to_sec() * 1e3)


def _slow_path(robot: Robot, start: np.ndarray, end: np.ndarray) -> tuple[Excitation, int]:
    """Return a minimum-jerk path (Flash and Hogan, 1985) followed by rest, and how many rows move."""
    way = np.abs(end - start)
    # its peaks: velocity 15/8 way / T, acceleration 10/sqrt(3) way / T^2
    duration = max(
        0.2,
        (15 / 8 * way / (SPEED * robot.dq_max)).max(),
        np.sqrt(10 / np.sqrt(3) * way / (ACCELERATION * robot.ddq_max)).max(),
    )
    moving = int(np.ceil(duration / SIM_DT))
    t = SIM_DT * np.arange(moving + round(SETTLE_S / SIM_DT) + 1)
    u = np.minimum(t / duration, 1.0)[:, None]
    q = start + (end - start) * u**3 * (10 - 15 * u + 6 * u**2)
    dq = (end - start) * 30 * u**2 * (1 - u) ** 2 / duration
    ddq = (end - start) * 60 * u * (1 - u) * (1 - 2 * u) / duration**2
    return Excitation(t, q, dq, ddq), moving
