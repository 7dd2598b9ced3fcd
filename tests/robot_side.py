"""What the robot sees: an emulated control box that records its cycles, and a process of a policy that moves it.

The robot's process writes one row per cycle to a file and sends signals at given cycles, so that the time from a
signal to the arm's rest is known to the cycle. The processes share a folder:

    robot        rows of float64, see `Log`
    policy.pid, arm.pid   of the policy's process and of the process that holds the arm
    aborted      why the arm stopped itself last
    result.json  how the motion ended for the policy's process
    output       what the policy's process printed
    asked        a line per question to the operator
"""

import json
import multiprocessing
import os
import signal
import socket
import stat
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import psutil

from r2s.arm import realtime_process
from r2s.arm.clients import fci
from r2s.arm.clients.collision_thresholds import CAUTIOUS, CollisionThresholds
from r2s.arm.clients.emulated import CLIENTS
from r2s.arm.clients.fr3 import within_fr3
from r2s.arm.clients.franka import Franka
from r2s.arm.emulator.control import MAX_MISSED, Control
from r2s.arm.emulator.robot_model import urdf
from r2s.arm.emulator.server import Server, open_port
from r2s.arm.interface import Arm
from r2s.arm.policy_runner import PolicyRunner
from r2s.arm.ramp import poses_about, ramp
from r2s.arm.realtime_process import RealtimeRunner
from r2s.arm.recorder import record
from r2s.arm.stop_request import handled_signals
from r2s.arm.twins.make_twin import make_twin
from r2s.arm.twins.rigid_twin import RigidTwin
from r2s.excitation.minimum_jerk import minimum_jerk
from r2s.excitation.motion import Excitation
from r2s.physics.robot import SIM_DT, Robot
from r2s.tasks.reach import ReachTask

CYCLE, MISSED, ENDED, ABORTED, SIGNALLED, STRAY = range(6)  # kinds of rows; STRAY: a command without a motion
WIDTH = 4 + 4 * 7 + 3
TASK = ReachTask(episode_s=1.5)
RATE = 0.3 * np.array([87.0, 87, 87, 87, 12, 12, 12])  # Nm/s, of ramps: fast, so that they move early
FAR = np.array([1.0, 0.2, 0.0, 0.2, 0.0, 0.0, 0.5])  # rad from home: an approach of 4 s


@dataclass(frozen=True)
class Kill:
    """A signal to the process 'policy' or 'arm' after a cycle of a motion of the robot."""

    motion: int
    cycle: int
    target: str
    number: int


class Log(NamedTuple):
    """Rows of the robot: kind, motion, cycle, s of the monotonic clock, and (., 7) rad, rad/s, Nm.

    last: the torque that the arm applied before the command `tau` of the same row. force: (., 3) N on the surface.
    """

    kind: np.ndarray
    motion: np.ndarray
    cycle: np.ndarray
    time: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    last: np.ndarray
    tau: np.ndarray
    force: np.ndarray

    @staticmethod
    def read(folder: Path) -> "Log":
        """Return the rows so far; the last one may still be in writing."""
        path = folder / "robot"
        values = np.fromfile(path) if path.exists() else np.zeros(0)
        rows = values[: len(values) // WIDTH * WIDTH].reshape(-1, WIDTH)
        head, moving = rows[:, :4], rows[:, 4:-3].reshape(-1, 4, 7)
        return Log(head[:, 0].astype(int), head[:, 1].astype(int), head[:, 2].astype(int), head[:, 3],
                   *np.moveaxis(moving, 1, 0), rows[:, -3:])  # fmt: skip

    def after(self, row: int) -> "Log":
        """Return the rows from `row` on."""
        return self.between(row, len(self.kind))

    def between(self, first: int, end: int) -> "Log":
        """Return the rows from `first` to before `end`."""
        return Log(*(column[first:end] for column in self))

    @property
    def cycles(self) -> "Log":
        """The cycles with a command."""
        chosen = self.kind == CYCLE
        return Log(*(column[chosen] for column in self))


class RecordedControl(Control):
    """A control box that writes its cycles to a file, and sends signals."""

    def record_to(self, folder: Path, kills: Sequence[Kill] = ()) -> None:
        """Record from now on."""
        self._folder, self._kills = folder, list(kills)
        self._file = open(folder / "robot", "ab", buffering=0)  # noqa: SIM115 (as long as the control box)

    def cycle(self, tau: np.ndarray | None) -> None:
        """Run a cycle; signals follow it."""
        self.note(MISSED if tau is None else CYCLE, tau)
        super().cycle(tau)
        for kill in [k for k in self._kills if k.motion == self._motion and k.cycle <= self._cycle]:
            self._kills.remove(kill)
            self.note(SIGNALLED)
            with suppress(ProcessLookupError):
                os.kill(int((self._folder / f"{kill.target}.pid").read_text()), kill.number)

    def end(self) -> None:
        """End a motion at the client's request, or because its connection has ended."""
        if self.running:
            self.note(ENDED)
        super().end()

    def _stop(self, reason: str, mode: int) -> None:
        self.note(ABORTED)
        _put(self._folder / "aborted", reason)
        super()._stop(reason, mode)

    def note(self, kind: int, tau: np.ndarray | None = None) -> None:
        """Write a row."""
        s = self._arm.read()
        tau = np.full(7, np.nan) if tau is None else tau
        force = np.zeros(3) if s.O_F_ext_hat_K is None else s.O_F_ext_hat_K[:3]
        head = [kind, self._motion, self._cycle, time.monotonic()]
        self._file.write(np.concatenate([head, s.q, s.dq, s.tau_J_d, tau, force]).tobytes())


class RecordedServer(Server):
    """A server that notes commands which come while no motion runs."""

    def _commands(self) -> None:
        if self._move is None:
            assert self._udp is not None
            data, kind = b"", fci.COMMAND[self._version]
            with suppress(BlockingIOError):
                data = self._udp.recv(4096, socket.MSG_PEEK)
            if len(data) == kind.itemsize and not np.frombuffer(data, kind, 1)[0][fci.FINISHED[self._version]]:
                self._control.note(STRAY)  # type: ignore[attr-defined]
        super()._commands()


class RobotSide(NamedTuple):
    """Settings of a robot: how to make its arm, and what happens to it."""

    make_arm: Callable[[], Arm]
    client: str
    realtime: bool = False
    faults: tuple = ()
    kills: tuple[Kill, ...] = ()
    max_missed: int = MAX_MISSED


def _serve(pipe, settings: RobotSide, folder: Path) -> None:
    os.setsid()
    version = CLIENTS[settings.client].arm_type.version
    arm = settings.make_arm()
    arm.move_to(arm.robot.q_home)
    arm.command(np.zeros(7))  # compiles; a client would time out during it
    arm.stop()
    control = RecordedControl(settings.make_arm(), version, settings.faults, settings.max_missed)
    control.record_to(folder, settings.kills)
    server = RecordedServer(open_port(), control, urdf(arm.robot), version, realtime=settings.realtime)
    pipe.send(server.address)
    parent = multiprocessing.parent_process()
    assert parent is not None
    server.serve(parent.sentinel)  # type: ignore[arg-type]


def run_side(side: RobotSide, robot: Robot, motion: "Motion", folder: Path, longest_s: float) -> list[str]:
    """Run a motion against a robot, both forked from this process; return which processes had to be killed."""
    fork = multiprocessing.get_context("fork")
    local, remote = fork.Pipe()
    served = fork.Process(target=_serve, args=(remote, side, folder), name="robot")
    served.start()
    remote.close()
    policy = fork.Process(target=run_motion, args=(folder, robot, side.client, local.recv(), motion), name="policy")
    policy.start()
    try:
        deadline = time.monotonic() + longest_s
        while time.monotonic() < deadline and (left := _alive(folder, policy)):
            if motion.wakes and np.isin(Log.read(folder).kind, (ENDED, ABORTED)).any():
                _send(folder, left, signal.SIGCONT)
            policy.join(0.03)
    finally:
        left = _alive(folder, policy)
        _send(folder, left, signal.SIGKILL)
        policy.kill()
        policy.join()
        deadline = time.monotonic() + 1.0
        while time.monotonic() < deadline and not np.isin(Log.read(folder).kind[-1:], (ENDED, ABORTED)).any():
            time.sleep(0.02)  # the robot has yet to see that its connection has ended
        served.kill()
        served.join()
    return left


def _send(folder: Path, names: Sequence[str], number: int) -> None:
    for name in names:
        with suppress(OSError, ValueError):
            os.kill(int((folder / f"{name}.pid").read_text()), number)


def _alive(folder: Path, policy: Any) -> list[str]:
    """Return which of the two processes run."""
    found = ["policy"] if policy.is_alive() else []
    with suppress(OSError, ValueError, psutil.Error):
        pid = int((folder / "arm.pid").read_text())
        if pid != policy.pid and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE:
            found.append("arm")
    return found


def run_sides(line: Any, longest_s: float) -> None:
    """Run what comes on the line, as arguments of `run_side`, and answer with what it returns."""
    warm(line.recv())
    with suppress(EOFError):
        while True:
            line.send(run_side(*line.recv(), longest_s))


def warm(robot: Robot) -> None:
    """Import and compile what the forked processes use."""
    import panda_py.libfranka  # noqa: F401
    import pylibfranka  # noqa: F401

    for variant in ("rigid", "elastic"):
        twin = make_twin(robot, variant=variant, payload=0.5)
        twin.move_to(robot.q_home)
        twin.command(np.zeros(7))
    for own in (robot, within_fr3(robot)):
        arm: Any = RigidTwin(own, 0)
        record(arm, swing(own, 0.1))
        record(arm, swing(own, 0.1), loaded=True)
        ramp(arm, poses_about(own, 1), rate=60.0, largest=0.5)
        runner = PolicyRunner(arm, TASK, np.ones(7))
        state = runner.place(own.q_home[None], 0)
        runner.step(TASK.control(own).command(np.zeros((1, 7)), TASK, state.t, np.array([[0.4, 0.2, 0.4]])))
        runner.end()


class Refuses:
    """An operator who writes down each question, thinks for `seconds`, and does not agree."""

    def __init__(self, folder: Path, seconds: float = 0.0):
        self._path, self._seconds = folder / "asked", seconds

    def __call__(self, reason: str) -> bool:
        """Answer no."""
        with open(self._path, "a") as file:
            file.write(reason + "\n")
        time.sleep(self._seconds)
        return False


class Motion(NamedTuple):
    """A motion of the policy's process.

    Attributes:
        kind: 'approach', 'episode', 'record' or 'ramp', or 'idle': none runs while the process waits.
        live: whether the arm has a process of its own; recordings and ramps have none.
        policy: (step) -> action (7,) of an episode; it may stall. settings: of `PolicyRunner`.
        thinks_s: s for which the operator thinks. loaded: see `record`.
        far: share of FAR and 1.2 FAR, the lengths of an approach and of a recording. forks: see `fork_the_arm`.
        wakes: whether frozen processes go on after the motion. declared: kg of the load that the client expects.
        realtime: whether the client asks this computer for real time.
        task, goal, friction: of an episode; goal (k,), friction (7,) Nm. collision: of the arm's reflexes.
    """

    kind: str
    live: bool
    policy: Callable[[int], np.ndarray]
    settings: dict
    thinks_s: float = 0.0
    far: float = 1.0
    loaded: bool = False
    forks: bool = True
    wakes: bool = False
    declared: float | None = None
    realtime: bool = False
    task: Any = TASK
    goal: Any = (0.4, 0.2, 0.4)
    friction: Any = (1.0,) * 7
    collision: CollisionThresholds = CAUTIOUS


def fork_the_arm() -> None:
    """Let this process fork the process of its arm: the same code, without seconds of imports."""
    context, serve = multiprocessing.get_context("fork"), realtime_process._serve
    realtime_process.multiprocessing = SimpleNamespace(get_context=lambda _: context)  # type: ignore[attr-defined]

    def forked(line: Any, *arguments: Any) -> None:
        for fd in map(int, os.listdir("/proc/self/fd")):
            with suppress(OSError):  # the other end of the line would hide the parent's death
                if stat.S_ISSOCK(os.fstat(fd).st_mode) and fd != line.fileno():
                    os.close(fd)
        serve(line, *arguments)

    realtime_process._serve = forked


def run_motion(folder: Path, robot: Robot, client: str, address: str, motion: Motion) -> None:
    """Run the motion in this process, which is the policy's, and write how it ended."""
    os.setsid()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    output = os.open(folder / "output", os.O_WRONLY | os.O_CREAT)
    os.dup2(output, 1)
    os.dup2(output, 2)
    result: dict = {"stops": [], "halted": None, "error": None, "kind": None, "rows": 0}
    _put(folder / "policy.pid", os.getpid())
    if motion.forks:
        fork_the_arm()

    def idle() -> None:
        _put(folder / "idle", "")
        time.sleep(60)

    given = motion.task, np.array(motion.friction)
    open_arm = partial(_open, robot, client, address, Refuses(folder, motion.thinks_s), motion)
    try:
        with ExitStack() as stack:
            if motion.live:
                arms = stack.enter_context(RealtimeRunner(open_arm, robot, *given, **motion.settings))
                _put(folder / "arm.pid", arms._process.pid)
                idle() if motion.kind == "idle" else _run_policy(arms, motion, result)
            else:
                _put(folder / "arm.pid", os.getpid())
                stack.enter_context(handled_signals())
                arm = stack.enter_context(closing(open_arm()))
                if motion.kind == "idle":
                    idle()
                elif motion.kind in ("approach", "episode"):
                    _run_policy(PolicyRunner(arm, *given, **motion.settings), motion, result)
                else:
                    _measure(arm, motion)
    except (Exception, KeyboardInterrupt) as error:
        result |= {"error": str(error), "kind": type(error).__name__}
        if (recording := getattr(error, "recording", None)) is not None:
            result["rows"] = len(recording.t)
    _put(folder / "result.json", json.dumps(result))


def _open(robot: Robot, client: str, address: str, operator: Refuses, motion: Motion) -> Franka:
    thresholds = {"collision_torque": motion.collision.torque, "collision_force": motion.collision.force}
    arm = CLIENTS[client](robot, address, operator=operator, declared_payload=motion.declared, **thresholds)
    arm.realtime = motion.realtime  # without a real-time kernel, which the client's own option requires
    return arm


def _run_policy(arms: RealtimeRunner | PolicyRunner, motion: Motion, result: dict) -> None:
    """Approach and end there, or run an episode, and try another after a stop."""
    robot, goals, task = arms.robot, np.array([motion.goal]), motion.task
    controller, approaches = task.control(robot), motion.kind == "approach"
    start = robot.q_home + (motion.far * FAR if approaches else 0)
    for episode in range(1 if approaches else 2):
        state = arms.place(start[None], episode)
        for k in range(0 if approaches else task.steps):
            if state.stopped.all():
                break
            state = arms.step(controller.command(motion.policy(k)[None], task, state.t, goals))
        arms.end()
        result |= {"stops": [str(stop) for stop in arms.stops], "halted": arms.halted}
        if not arms.stops:
            return


def _measure(arm: Arm, motion: Motion) -> None:
    if motion.kind == "record":
        record(arm, swing(arm.robot, motion.far), loaded=motion.loaded)
    else:
        ramp(arm, poses_about(arm.robot, 1), rate=RATE)


def swing(robot: Robot, far: float) -> Excitation:
    """Return a fast motion from home, at up to 0.75 rad/s."""
    t = SIM_DT * np.arange(round(3.0 * far / SIM_DT) + 1)
    return Excitation(t, *minimum_jerk(robot.q_home, robot.q_home + 1.2 * far * FAR, t[-1], t[:, None]))


def _put(path: Path, text: object) -> None:
    path.with_suffix(".part").write_text(str(text))
    path.with_suffix(".part").rename(path)
