"""Serve the robot's side of the Franka Control Interface on loopback: requests by TCP, states and commands by UDP."""

import contextlib
import os
import select
import socket
import time

import numpy as np

from r2s.arm.clients import fci
from r2s.arm.emulator.control import Control
from r2s.arm.realtime import realtime_section
from r2s.errors import UserError
from r2s.physics.robot import SIM_DT

LOOPBACK = "127.0.0"
IDLE_MS = 20  # ms between states of an idle arm in lock-step; clients do not need 1 kHz at rest
ANSWER_S = 0.9 * SIM_DT  # s, least time between two states in real time; our choice (1 ms on a real control box)
BACKOFF_S = (1e-3, 0.4)  # s, range of the time between states, which doubles until the first answer; clients wait 1 s


class Server:
    """Serves one client at a time, in one thread.

    A motion begins when the client answers the newest state. Until the client's first answer, the arm stands still.
    The server continues to send states, because a client that starts may miss some. The server does not execute the
    command in the first answer. The first executed command answers the first state whose control_command_success_rate
    is above 0.
    """

    def __init__(self, server: socket.socket, control: Control, urdf: str, version: int, *, realtime: bool):
        self.address: str = server.getsockname()[0]
        self._socket, self._control, self._urdf = server, control, urdf.encode()
        self._version, self._realtime = version, realtime
        self._tcp: socket.socket | None = None
        self._udp: socket.socket | None = None
        self._reset()

    def serve(self, parent: int) -> None:
        """Serve clients until the file descriptor `parent` signals that the parent process has ended."""
        with realtime_section() if self._realtime else contextlib.nullcontext():
            self._serve(parent)

    def _serve(self, parent: int) -> None:
        while True:
            due = None if self._due is None else max(0.0, self._due - time.monotonic())
            watched = [x for x in (parent, self._socket, self._tcp, self._udp) if x is not None]
            ready = select.select(watched, [], [], due)[0]
            if parent in ready:
                return
            try:
                if self._tcp in ready:
                    self._requests()
                if self._socket in ready:
                    self._accept()
                if self._udp is not None and self._udp in ready:
                    self._commands()
                if self._due is not None and time.monotonic() >= self._due:
                    self._tick()
            except ConnectionError:
                self._disconnect()

    def _accept(self) -> None:
        tcp, _ = self._socket.accept()
        if self._tcp is not None and _is_closed(self._tcp):  # the client has reconnected
            self._disconnect()
        if self._tcp is not None:
            tcp.close()
            return
        tcp.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._tcp = tcp

    def _disconnect(self) -> None:
        self._control.end()
        for s in (self._tcp, self._udp):
            if s is not None:
                s.close()
        self._tcp = self._udp = None
        self._reset()

    def _reset(self) -> None:
        self._received = b""
        self._client: tuple[str, int] | None = None
        self._move: int | None = None  # id of the Move request whose motion is active
        self._started = False  # whether the active motion has received its first answer
        self._ahead = False  # in real time, whether the newest state was answered and its cycle has run
        self._due: float | None = None  # when the next state is sent; None: only after an answer
        self._message_id = 0

    # --- requests, by TCP

    def _requests(self) -> None:
        assert self._tcp is not None
        data = self._tcp.recv(65536)
        if not data:
            raise ConnectionResetError
        self._received += data
        while len(self._received) >= fci.HEADER.itemsize:
            command, number, size = np.frombuffer(self._received, fci.HEADER, 1)[0].tolist()
            if len(self._received) < size:
                return
            payload, self._received = self._received[fci.HEADER.itemsize : size], self._received[size:]
            names = fci.REQUESTS[self._version]
            if size < fci.HEADER.itemsize or command >= len(names):
                raise ConnectionResetError  # the client is not libfranka
            self._request(names[command], number, payload)

    def _request(self, name: str, number: int, payload: bytes) -> None:
        if name == "Connect":
            self._connect(number, payload)
        elif name == "Move":
            self._begin(number, payload)
        elif name == "StopMove":
            self._control.end()
            self._reply(name, number, fci.DONE)
            if self._move is not None:
                self._finish("Preempted")
        elif name == "AutomaticErrorRecovery":
            self._reply(name, number, fci.DONE if self._control.recover() else fci.EMERGENCY)
        elif name == "GetRobotModel":
            self._reply(name, number, fci.DONE, self._urdf)
        elif name in ("LoadModelLibrary", "GetCartesianLimit") or self._control.running:
            self._reply(name, number, fci.NOT_POSSIBLE)  # the emulator has no model library
        else:
            if name in fci.SETTINGS:  # the emulator ignores impedances
                self._control.set(name, np.frombuffer(payload, fci.SETTINGS[name], 1)[0].copy())
            self._reply(name, number, fci.DONE)

    def _connect(self, number: int, payload: bytes) -> None:
        assert self._tcp is not None
        version, port = np.frombuffer(payload, fci.CONNECT, 1)[0].tolist()
        ours = np.array(self._version, "<u2").tobytes()
        if version != self._version:
            self._reply("Connect", number, fci.NOT_POSSIBLE, ours)
            return
        self._client = self._tcp.getpeername()[0], port
        self._udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._udp.bind((self.address, 0))
        self._udp.setblocking(False)
        self._reply("Connect", number, fci.DONE, ours)
        self._due = time.monotonic()

    def _begin(self, number: int, payload: bytes) -> None:
        controller, generator = np.frombuffer(payload, fci.MOVE, 1)[0].tolist()
        status = fci.MOVE_STATUS[self._version]
        if (controller, generator) != (fci.EXTERNAL_CONTROLLER, fci.GENERATOR_REQUESTED[self._version]):
            self._reply("Move", number, status["InvalidArgument"])
        elif not self._control.can_move:
            self._reply("Move", number, status["NotPossible"])
        else:
            self._control.begin()
            self._move, self._started, self._ahead = number, False, False
            self._wait = BACKOFF_S[0]
            self._reply("Move", number, status["MotionStarted"])
            self._due = time.monotonic()

    def _reply(self, name: str, number: int, status: int, more: bytes = b"") -> None:
        assert self._tcp is not None
        command = fci.REQUESTS[self._version].index(name)
        size = fci.HEADER.itemsize + 1 + len(more)
        self._tcp.sendall(np.array((command, number, size), fci.HEADER).tobytes() + bytes([status]) + more)

    # --- the cycle, by UDP

    def _commands(self) -> None:
        """Process the client's commands; ignore every command that does not answer the newest state."""
        assert self._udp is not None
        kind = fci.COMMAND[self._version]
        with contextlib.suppress(BlockingIOError):
            while True:
                data, sender = self._udp.recvfrom(4096)
                if sender != self._client or len(data) != kind.itemsize or self._move is None:
                    continue
                command = np.frombuffer(data, kind, 1)[0]
                if command["message_id"] != self._message_id:
                    continue
                if command[fci.FINISHED[self._version]]:
                    self._control.end()
                    self._finish("Success")
                elif not self._started:
                    self._started = True
                    self._control.first_answer()
                    self._send()
                elif not self._realtime:
                    self._cycle(command["tau_J_d"].copy())
                elif not self._ahead:  # at once, because a real box also computes in parallel with the client
                    self._control.cycle(command["tau_J_d"].copy())
                    self._ahead = True

    def _cycle(self, tau: np.ndarray | None) -> None:
        """Run one cycle; in lock-step, also run the following cycles whose states a fault drops."""
        self._control.cycle(tau)
        while self._control.dropped and not self._realtime:
            self._message_id += 1
            self._control.cycle(None)
        self._report()

    def _report(self) -> None:
        """Send the state after a cycle; if the motion was aborted, report its end instead."""
        if self._control.running:
            self._send()
        else:
            self._finish(self._control.aborted_as)

    def _tick(self) -> None:
        """Send the state that is due, and schedule the next; in real time without an answer, first run the cycle."""
        assert self._due is not None
        if self._started and self._realtime:
            if not self._ahead:
                self._control.cycle(None)
            self._ahead = False
            self._report()
        else:
            self._send()
        if self._realtime:
            # this process, unlike a control box, may wake late; the client must still have time to answer
            self._due = max(self._due + SIM_DT, time.monotonic() + ANSWER_S)
        elif self._move is None:
            self._due = time.monotonic() + IDLE_MS * SIM_DT
        else:
            self._due = time.monotonic() + self._wait
            self._wait = min(2 * self._wait, BACKOFF_S[1])

    def _send(self) -> None:
        assert self._udp is not None
        assert self._client is not None
        passed = 1 if self._realtime or self._move is not None else IDLE_MS
        self._message_id += passed
        if self._move is None:
            self._control.idle(passed)
        if self._control.dropped:
            return
        if self._started and not self._realtime:
            self._due = None  # in lock-step only an answer advances time
        self._control.state["message_id"] = self._message_id
        with contextlib.suppress(BlockingIOError):  # a full socket drops a packet, as a network would
            self._udp.sendto(self._control.state.tobytes(), self._client)

    def _finish(self, status: str) -> None:
        """Report the end of the motion by TCP, and by UDP with the next state."""
        assert self._move is not None
        move, self._move, self._started = self._move, None, False
        self._due = time.monotonic()  # send the state of the arm at rest at once
        self._reply("Move", move, fci.MOVE_STATUS[self._version][status])


def open_port() -> socket.socket:
    """Open the FCI's fixed port on the first loopback address where this port is free; return the server socket.

    Raises:
        UserError: the port is in use on all loopback addresses.
    """
    for k in range(1, 255):
        try:
            return socket.create_server((f"{LOOPBACK}.{k}", fci.PORT))
        except OSError as error:
            reason = os.strerror(error.errno) if error.errno else str(error)
    raise UserError(f"emulator: port {fci.PORT} is not free on any loopback address ({reason})")


def _is_closed(tcp: socket.socket) -> bool:
    try:
        return tcp.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT) == b""
    except BlockingIOError:
        return False
    except OSError:
        return True
