"""Simulate an arm in Gazebo Classic 11, in a separate process, with ODE (the default) or DART.

`gzserver` loads the world plugin gazebo_classic.cc, which waits for a command over a pipe before each step. Debian 11
and Ubuntu up to 22.04 have a package of Gazebo Classic. On other systems, `gzserver` runs from the root directory
that gazebo_classic_root.sh creates and that the environment variable R2S_GAZEBO_ROOT names. `gzserver` needs no
display.
"""

import os
import re
import select
import shutil
import socket
import subprocess
import tempfile
import weakref
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import mujoco
import numpy as np

from r2s.errors import UserError, choices, nearest
from r2s.physics.description import chain, write_world
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import SIM_DT, Robot
from r2s.physics.simulator import single_arm

PHYSICS = ("ode", "dart")
PLUGIN = Path(__file__).with_name("libr2s_gazebo_classic.so")
ROOT = "R2S_GAZEBO_ROOT"  # environment variable: a root directory with Gazebo
FOLDERS = (".", "blas", "lapack", "pulseaudio", "..")  # library folders, relative to Debian's folder for the CPU type
NAME = "simulator=gazebo_classic"
HELP = "docs/how_to/gazebo.md installs it; simulator=dart needs nothing more"
START_S = 60.0  # s, longest wait for the server; a start takes 0.5 s
SDF = "1.7"  # newest SDF version that Gazebo 11 reads


class GazeboClassicEngine:
    """An arm in a `gzserver` process, which ends when this object is deleted.

    Each command acts for one step. ODE solves the joint constraints iteratively, so the motion with ODE differs from
    MuJoCo's by about 1e-4 m after 1 s. The motion with DART agrees with MuJoCo's to round-off.

    Args:
        robot: the arm. dynamics: masses, centers, tensors and armatures of the arm; `FrictionTorque` adds friction.
        physics: "ode" or "dart".

    Raises:
        UserError: Gazebo or the plugin is missing, or the server did not load the arm.
    """

    def __init__(self, robot: Robot, dynamics: Dynamics, physics: str = "ode"):
        self._n, self._limit = robot.n, robot.tau_max
        # SDF has no rotors. For DART, damping and a torque represent the armature, as in r2s/engines/dart.py.
        # ODE's damping is not implicit. For ODE, r2s therefore adds the torque -A ddq of the armature A;
        # MuJoCo computes the acceleration ddq of the arm with rotors.
        self._rotors = None
        if physics == "ode" and dynamics.armature.any():
            self._rotors = single_arm(robot, dynamics)
            self._rotors.jnt_user[:] = 0.0  # no friction from r2s
            self._rotors.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
            self._data = mujoco.MjData(self._rotors)
            dynamics = replace(dynamics, armature=np.zeros(robot.n))
        self._counter = dynamics.armature / SIM_DT
        names = [link.joint for link in chain(robot, dynamics)[0]]
        commands, self._commands = os.pipe()
        self._states, states = os.pipe()
        plugin = ET.Element("plugin", name="r2s", filename=str(PLUGIN))
        for tag, value in (("model", robot.name), ("commands", commands), ("states", states)):
            ET.SubElement(plugin, tag).text = str(value)
        for name in names:
            ET.SubElement(plugin, "joint").text = name
        folder = tempfile.TemporaryDirectory(prefix="r2s_gazebo_", ignore_cleanup_errors=True)
        world, self._log = Path(folder.name) / "r2s.world", Path(folder.name) / "log"
        write_world(world, robot, dynamics, plugin, version=SDF, physics=physics)
        with open(self._log, "wb") as log:
            server = subprocess.Popen(
                [*gzserver(), "--lockstep", str(world)],
                env=_environment(folder.name),
                pass_fds=(commands, states),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
            )
        os.close(commands)
        os.close(states)
        self._server = server
        weakref.finalize(self, _end, server, (self._commands, self._states), folder)
        loaded, _, _ = select.select([self._states], [], [], START_S)
        if not loaded:
            raise UserError(f"{NAME}: gzserver did not load the plugin in {START_S:g} s: {self._last_line()}")
        self._q, self._dq = self._read()
        self._start = False  # whether the next step begins at the state of `reset`

    def reset(self, q: np.ndarray, dq: np.ndarray) -> None:
        """Store the positions q (n,) rad and velocities dq (n,) rad/s from which the next step starts."""
        self._q, self._dq, self._start = np.array(q, dtype=float), np.array(dq, dtype=float), True

    def step(self, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Apply tau (n,) Nm for 1 ms; return the new (q, dq), (n,) rad, rad/s."""
        force = np.clip(tau, -self._limit, self._limit) + self._counter * self._dq
        if self._rotors is not None:
            data = self._data
            data.qpos[:], data.qvel[:], data.qfrc_applied[:] = self._q, self._dq, force
            mujoco.mj_forward(self._rotors, data)
            force -= self._rotors.dof_armature * data.qacc
        command = np.concatenate([[self._start], force, self._q, self._dq])
        with suppress(BrokenPipeError):  # `_read` then raises UserError
            os.write(self._commands, command.tobytes())
        self._start = False
        self._q, self._dq = self._read()
        return self._q, self._dq

    def _read(self) -> tuple[np.ndarray, np.ndarray]:
        state = np.frombuffer(os.read(self._states, 16 * self._n))
        if len(state) < 2 * self._n:
            raise UserError(f"{NAME}: gzserver ended: {self._last_line()}")
        return state[: self._n], state[self._n :]

    def _last_line(self) -> str:
        lines = [line for line in self._log.read_text(errors="replace").splitlines() if line.strip()]
        return lines[-1].strip() if lines else "without a message"


def gazebo_classic(robot: Robot, physics: str = "ode") -> Callable[[Dynamics], GazeboClassicEngine]:
    """Return the function that creates a Gazebo Classic engine from the dynamics of an arm.

    Raises:
        UserError: `physics` is not in PHYSICS, Gazebo is missing, or the plugin is missing.
    """
    if physics not in PHYSICS:
        raise UserError(f"simulator.physics: expected {choices(PHYSICS)}, got '{physics}'{nearest(physics, PHYSICS)}")
    gzserver()
    return lambda d: GazeboClassicEngine(robot, d, physics)


def gzserver() -> list[str]:
    """Return the command that starts `gzserver`.

    If R2S_GAZEBO_ROOT is set, the dynamic loader in that root directory starts `gzserver`, because chroot would need
    administrator rights.

    Raises:
        UserError: `gzserver` or the plugin is missing.
    """
    root, server = os.environ.get(ROOT), shutil.which("gzserver")
    if root:
        loader = next(iter(sorted(Path(root).glob("usr/lib/*-linux-gnu/ld-*.so"))), None)
        server = f"{root}/usr/bin/gzserver"
        if loader is None or not Path(server).is_file():
            raise UserError(f"{NAME}: {ROOT}={root} is no root directory with gzserver; {HELP}")
        libraries = ":".join(str(loader.parent / name) for name in FOLDERS)
        found = [str(loader), "--library-path", libraries, server]
    elif server is None:
        raise UserError(f"{NAME}: gzserver is not on the PATH, and {ROOT} is not set; {HELP}")
    else:
        found = [server]
    if not PLUGIN.is_file():
        raise UserError(f"{NAME}: its plugin is not built: make gazebo-classic{f' {ROOT}={root}' if root else ''}")
    return found


def version() -> str:
    """Return the version of `gzserver`, such as "11.1.0"."""
    done = subprocess.run([*gzserver(), "--version"], capture_output=True, text=True)
    words = re.findall(r"version (\S+)", done.stdout)
    if not words:
        raise UserError(f"{NAME}: gzserver does not start: {(done.stderr or done.stdout).strip()[-200:]}")
    return words[0]


def _environment(folder: str) -> dict[str, str]:
    """Return environment variables for `gzserver`: settings in `folder`, a free port, no model database."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        master = f"http://127.0.0.1:{free.getsockname()[1]}"
    root = os.environ.get(ROOT, "")
    own = {"HOME": folder, "GAZEBO_MASTER_URI": master, "GAZEBO_MODEL_DATABASE_URI": ""}
    if root:
        own |= {"GAZEBO_RESOURCE_PATH": f"{root}/usr/share/gazebo-11"}
    return os.environ | own


def _end(server: subprocess.Popen, pipes: tuple[int, int], folder: tempfile.TemporaryDirectory) -> None:
    server.kill()  # an orderly end takes more than 10 s
    server.wait()
    for pipe in pipes:
        os.close(pipe)
    folder.cleanup()
