"""What the Panda and the FR3 have in common: the `Arm` protocol on a libfranka client, hardware or emulated.

libfranka knows no "go there" in torque control, so `move_to` follows a slow joint path, checked before, with the
recorder's tracking controller, through the same 1 kHz torque loop that everything else uses: the model of the client
package is not needed, and what brings the arm to its place on hardware is what the emulator has tested.
"""

import importlib
import socket
import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any, Protocol

import numpy as np

from r2s.arm import fci
from r2s.arm.driven import STILL, Driven
from r2s.arm.driver import Driver
from r2s.arm.interface import ArmState, ArmStopped, NotCleared, Reflexes
from r2s.arm.tracking import CUTOFF_HZ, Tracker
from r2s.errors import UserError, check_number
from r2s.excitation.minimum_jerk import minimum_jerk
from r2s.excitation.motion import Excitation
from r2s.excitation.paths import approach
from r2s.excitation.safety import Space, friction_margin
from r2s.physics.robot import SIM_DT, Robot

SPEED = 0.2  # of dq_max, on the way to a place
ACCELERATION = 0.2  # of ddq_max
SETTLE_S = 3.0  # at most, at the end of the way
TORQUE_SHARE = (
    0.2  # of tau_max, the most that the way may take: what somebody who holds a link meets (docs/safety.md)
)
ASTRAY = 0.1  # rad off the way, at which it is given up
PULL = 15.0  # of tau_max per rad and s, of the integral that then overcomes breakaway
PULL_SHARE = 0.15  # of tau_max, at most
NEAR = 2e-3  # rad: there
ACCEPTED = 1e-2  # rad: near enough when the time is over; friction of a real wrist
DESK = 443  # port of the control box's own pages
ANSWERS_S = 3.0  # a control box is at the other end of a cable
MODES = {fci.GUIDING: "guiding", fci.USER_STOPPED: "user stopped"}


@dataclass(frozen=True)
class Collision:
    """At which external force the arm stops itself, as libfranka's setCollisionBehavior; contact at the same.

    Attributes:
        torque: (7,) Nm of each joint. force: (6,) N and Nm at the hand.

    Raises:
        UserError: not so many numbers above 0.
    """

    torque: Sequence[float]
    force: Sequence[float]

    def __post_init__(self):
        for name, values, count in (("torque", self.torque, 7), ("force", self.force, 6)):
            if len(values) != count:
                raise UserError(f"collision_{name}: {len(values)} numbers, allowed are {count}")
            for value in values:
                check_number(f"collision_{name}", value, "(0, inf)")


# those of libfranka's own motion examples, its most cautious
CAUTIOUS = Collision(torque=(20.0, 20.0, 18.0, 18.0, 16.0, 14.0, 12.0), force=(20.0, 20.0, 20.0, 25.0, 25.0, 25.0))


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

    def watch_for(self, collision: Collision) -> None:
        """Set at which external force the arm stops itself."""
        ...

    def close(self) -> None:
        """Drop the connection."""
        ...


class Franka:
    """An `Arm` (r2s/arm/interface.py) behind a `Client`, with somebody beside it (`Operated`).

    The motion of a caller begins with its first `command`; from then on the arm wants one per millisecond.

    Attributes:
        operator, blocked: see `Operated`. Whatever ended a motion blocks the arm but `stop`: a reflex, a stop button,
            also one that was released since, a command that was refused, a way that was given up.

    Args:
        robot: the arm's limits and nominal model.
        client: the connection.
        operator: asked with the reason before the arm moves again after a stop. By default nobody is there:
            `move_to` refuses until another connection begins with an arm that is ready.
        collision: at which external force the arm stops itself.
    """

    def __init__(
        self,
        robot: Robot,
        client: Client,
        operator: Callable[[str], bool] | None = None,
        collision: Collision = CAUTIOUS,
    ):
        if robot.n != 7:
            raise UserError(f"a Franka arm has 7 joints; {robot.name} has {robot.n}")
        self.robot, self.operator = robot, operator
        self.blocked: str | None = None
        self._client, self._collision = client, collision
        self._reflexes = Reflexes(robot)
        self._moving, self._closed, self._watched = False, False, False
        self._space: Space | None = None
        self._stopped: str | None = "no motion was started; call move_to first"
        self._rest()
        # a cycle of references would keep an arm that nobody has any more, and its connection
        self._own = Driven(
            weakref.proxy(self),
            Driver(robot, TORQUE_SHARE * robot.tau_max, 2 * friction_margin(robot), cutoff_hz=CUTOFF_HZ),
        )

    def move_to(self, q: np.ndarray) -> ArmState:
        """Go to q (7,) rad at a fifth of the speed limits, unless the arm is within 2 mrad of it, and hold there.

        The way is the first of those of r2s/excitation/paths.py, from where the arm is, that keeps away from limits,
        table and arm.

        Raises:
            NotCleared: the arm has stopped before, and no operator agreed that it may move.
            ArmStopped: q is outside the limits, the arm is not ready, there is no way (it has not moved), it stops on
                the way, it is 0.1 rad off its way, or it does not come within 10 mrad.

        """
        q = np.array(q, dtype=float)
        if q.shape != (self.robot.n,) or not np.isfinite(q).all():
            raise ArmStopped(f"move_to needs {self.robot.n} finite joint angles; it got {q}")
        self._reflexes.state(q, np.zeros(self.robot.n))
        self.stop()
        self._ready()
        way = self._way(q)
        self._stopped = None
        for place in way:
            self._go(place)
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
            self._stopped = self.blocked = str(refused)
            raise
        self._send(tau)

    def stop(self) -> None:
        """Damp what still moves, for at most half a second, and end the motion."""
        for part in (self._damp, self._end):  # an arm whose driver gave up damping it is still to be stopped
            try:
                if self._moving:
                    part()
            except ArmStopped as reason:
                self._stopped = self.blocked = str(reason)
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
            self.blocked = self._stopped
            raise

    def _sample(self, s: Any) -> ArmState:
        t = (_ms(s) - self._begun) * SIM_DT
        return ArmState(t, np.array(s.q), np.array(s.dq), np.array(s.tau_J), np.array(s.tau_J_d))

    def _damp(self) -> None:
        if self._stopped is None:
            self._own.begin()
            self._own.rest()

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
        """Raise ArmStopped unless the arm can move; after a stop the operator has to agree before."""
        if self._closed:
            raise ArmStopped("the connection was closed")
        s = self._client.idle()
        mode = int(s.robot_mode)
        if self.blocked is None and mode == fci.REFLEX:
            self.blocked = str(s.last_motion_errors) or "a reflex from before"
        elif self.blocked is None and mode == fci.USER_STOPPED:
            self.blocked = "it is user stopped"
        if self.blocked is not None:
            if self.operator is None or not self.operator(self.blocked):
                raise NotCleared(f"the arm has stopped and no operator agreed that it may move: {self.blocked}")
            mode = int(self._client.idle().robot_mode)  # a stop button may have been released while he was asked
        if mode == fci.REFLEX:
            self._client.recover()
        elif mode != fci.IDLE:
            raise ArmStopped(f"the arm is not ready to move: it is {MODES.get(mode, f'in mode {mode}')}")
        self.blocked = None
        if not self._watched:
            self._client.watch_for(self._collision)
            self._watched = True
        self._rest()

    def _way(self, q: np.ndarray) -> np.ndarray:
        """Return the postures (k, 7) rad to go to, one after the other; none, where the arm is at q (7,) already."""
        here = self._state.q
        if np.abs(here - q).max() <= NEAR:
            return q[:0, None]
        try:
            self._space = self._space or Space(self.robot)
            return approach(self.robot, here, q, what="the way there", space=self._space)[1:]
        except UserError as forbidden:
            self._stopped = f"{forbidden}; guide the arm by hand to where there is one"
            raise ArmStopped(self._stopped) from None

    def _go(self, q: np.ndarray) -> None:
        path, moving = _slow_path(self.robot, self._state.q, q)
        follow, own = Tracker(self.robot, path, ASTRAY), self._own
        most = PULL_SHARE * self.robot.tau_max
        pull, before = np.zeros(7), np.zeros(7)
        own.begin()
        try:
            for k in range(len(path.t)):
                s = own.state
                left = q - s.q
                if k >= moving and np.abs(left).max() < NEAR and np.abs(s.dq).max() < STILL:
                    break
                if (reason := follow.astray(k, s)) is not None:
                    own.halt(reason)
                if k >= moving:
                    # Clegg (1958): an integral that restarts where the error changes sign, or what broke a joint
                    # loose would carry it past its place
                    pull = np.clip(pull + PULL * SIM_DT * self.robot.tau_max * left, -most, most)
                    pull = np.where(left * before < 0, 0, pull)
                    before = left
                own(follow(k, s) + pull)
            self._end()
        except ArmStopped as reason:
            self.blocked = str(reason)
            raise
        finally:
            if self._moving:  # interrupted, or given up
                self.stop()
        left = np.abs(self._state.q - q)
        if left.max() > ACCEPTED:
            i = int(left.argmax())
            self._stopped = f"joint {i + 1} stands at {self._state.q[i]:.4f} rad and was to go to {q[i]:.4f} rad"
            self.blocked = self._stopped
            raise ArmStopped(self._stopped)


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
    if not is_there(address):
        raise UserError(f"arm={extra}: no connection to {address}: nothing there answers; is its cable in?")
    try:
        return make()
    except Exception as error:
        raise UserError(f"arm={extra}: no connection to {address}: {words(error)}") from None


def is_there(address: str) -> bool:
    """Return whether a computer answers at the address, also where it refuses; libfranka would wait for a minute.

    The arm's own port comes last, where the other one is silent: who opens it is a client.
    """
    for port in (DESK, fci.PORT):
        try:
            socket.create_connection((address, port), ANSWERS_S).close()
        except TimeoutError:
            continue
        except OSError:
            pass  # refused; no such name, which libfranka says
        return True
    return False


def words(error: BaseException) -> str:
    """Return libfranka's message as one line."""
    return " ".join(str(error).split()) or type(error).__name__


def _ms(state: Any) -> int:
    return round(state.time.to_sec() * 1e3)


def _slow_path(robot: Robot, start: np.ndarray, end: np.ndarray) -> tuple[Excitation, int]:
    """Return a minimum-jerk path followed by rest, and how many rows move."""
    way = np.abs(end - start)
    # its peaks: velocity 15/8 way / T, acceleration 10/sqrt(3) way / T^2
    duration = max(
        0.2,
        (15 / 8 * way / (SPEED * robot.dq_max)).max(),
        np.sqrt(10 / np.sqrt(3) * way / (ACCELERATION * robot.ddq_max)).max(),
    )
    moving = int(np.ceil(duration / SIM_DT))
    t = SIM_DT * np.arange(moving + round(SETTLE_S / SIM_DT) + 1)
    return Excitation(t, *minimum_jerk(start, end, duration, t[:, None])), moving
