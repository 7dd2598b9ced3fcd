"""Simulate an arm in Gazebo (gz-sim Harmonic, Ionic or Jetty), in this process, through the Python bindings.

Each step of 1 ms is one blocking call of `server.run`. The world contains only an arm, without sensors or graphics;
r2s/physics/description.py describes the arm. OSRF's packages and conda-forge contain the bindings, but PyPI does not.
"""

import importlib
import os
import tempfile
import uuid
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from xml.etree import ElementTree as ET

import numpy as np

from r2s.errors import UserError
from r2s.physics.description import chain, write_world
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import SIM_DT, Robot

RELEASES = ("gz.sim", "gz.sim9", "gz.sim8")  # Jetty, Ionic, Harmonic
PHYSICS = {"filename": "gz-sim-physics-system", "name": "gz::sim::systems::Physics"}


class GazeboEngine:
    """An arm in a Gazebo server.

    Each command acts for one step of 1 ms. The bindings can set a joint state only within an update, and this update
    also integrates the state. Therefore `reset` only stores q and dq, and the next `step` starts exactly from q and
    dq.

    Args:
        robot: the arm. dynamics: masses, centers, tensors and armatures of the arm; `FrictionTorque` adds friction.
        sim: the Python bindings; None: the installed bindings.

    Raises:
        UserError: the bindings are not installed, or cannot load the world.
    """

    def __init__(self, robot: Robot, dynamics: Dynamics, sim: ModuleType | None = None):
        self._sim = bindings() if sim is None else sim
        os.environ.setdefault("GZ_IP", "127.0.0.1")
        os.environ.setdefault("GZ_PARTITION", f"r2s-{uuid.uuid4().hex}")  # isolates this server
        self._robot = robot
        # SDF has no rotors, so damping and a torque represent the armature, as in r2s/engines/dart.py
        self._counter = dynamics.armature / SIM_DT
        self._names = [link.joint for link in chain(robot, dynamics)[0]]
        self._joints: list = []
        self._error: BaseException | None = None
        self._start: tuple[np.ndarray, np.ndarray] | None = None
        self._tau = np.zeros(robot.n)
        self._q, self._dq = robot.q_home.copy(), np.zeros(robot.n)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "world.sdf"
            write_world(path, robot, dynamics, ET.Element("plugin", PHYSICS))
            self._fixture = self._sim.TestFixture(str(path))
            self._fixture.on_pre_update(self._guarded(self._before))
            self._fixture.on_post_update(self._guarded(self._after))
            self._fixture.finalize()
            self._server = self._fixture.server()
            self._run()  # the first update finds the joints and enables their measurements
        if not self._joints:
            raise UserError("simulator=gazebo: the server did not load the arm; see its messages above")

    def reset(self, q: np.ndarray, dq: np.ndarray) -> None:
        """Store the positions q (n,) rad and velocities dq (n,) rad/s from which the next step starts."""
        self._start = np.array(q, dtype=float), np.array(dq, dtype=float)
        self._q, self._dq = self._start

    def step(self, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Apply tau (n,) Nm for 1 ms; return the new (q, dq), (n,) rad, rad/s."""
        self._tau = tau
        self._run()
        return self._q, self._dq

    def _run(self) -> None:
        self._server.run(True, 1, False)
        if self._error is not None:
            raise self._error

    def _guarded(self, update):
        """Return a callback that runs `update` and stores exceptions for `_run`; the bindings ignore exceptions."""

        def call(info, ecm):
            try:
                update(ecm)
            except Exception as error:
                self._error = error

        return call

    def _before(self, ecm) -> None:
        if not self._joints:
            sim = self._sim
            model = sim.Model(sim.World(sim.world_entity(ecm)).model_by_name(ecm, self._robot.name))
            self._joints = [sim.Joint(model.joint_by_name(ecm, name)) for name in self._names]
            for joint in self._joints:
                joint.enable_position_check(ecm, True)
                joint.enable_velocity_check(ecm, True)
            return
        if self._start is not None:
            for joint, q, dq in zip(self._joints, *self._start, strict=True):
                joint.reset_position(ecm, [float(q)])
                joint.reset_velocity(ecm, [float(dq)])
            self._start = None
        limit = self._robot.tau_max
        force = np.clip(self._tau, -limit, limit) + self._counter * self._dq
        for joint, torque in zip(self._joints, force, strict=True):
            joint.set_force(ecm, [float(torque)])

    def _after(self, ecm) -> None:
        measured = [(joint.position(ecm), joint.velocity(ecm)) for joint in self._joints]
        if all(q is not None and dq is not None for q, dq in measured):
            self._q = np.array([q[0] for q, _ in measured])
            self._dq = np.array([dq[0] for _, dq in measured])


def gazebo(robot: Robot) -> Callable[[Dynamics], GazeboEngine]:
    """Return the function that creates a Gazebo engine from the dynamics of an arm.

    Raises:
        UserError: Gazebo is not installed.
    """
    sim = bindings()
    return lambda d: GazeboEngine(robot, d, sim)


def bindings() -> ModuleType:
    """Return the Python module of the newest installed release of gz-sim."""
    for name in RELEASES:
        try:
            return importlib.import_module(name)
        except ModuleNotFoundError:
            continue
        except ImportError as error:
            raise UserError(f"simulator=gazebo needs {name}, which does not import ({error})") from None
    raise UserError(
        "simulator=gazebo: gz-sim's Python bindings (gz.sim, gz.sim9 or gz.sim8) are not installed; install Gazebo "
        "from OSRF's apt repository or conda-forge, or use simulator=dart, the same physics engine"
    )
