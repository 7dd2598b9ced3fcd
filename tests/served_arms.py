"""Arms that a process of their own serves: it imports this file, and no torch."""

import time
from pathlib import Path

import mujoco
import numpy as np
import yaml

from r2s.arm.interface import ArmState, Reflexes
from r2s.arm.simulated import SimulatedArm
from r2s.physics.dynamics import Dynamics, nominal_dynamics
from r2s.physics.payload import payload_of
from r2s.physics.robot import Robot

PACE_S = 4e-3  # s per millisecond of the arm, so that a loaded machine does not look like a stalled policy


def paper(robot: Robot) -> Dynamics:
    """Return an arm of nominal links with the friction of conf/friction/paper.yaml."""
    friction = yaml.safe_load((Path(__file__).parent.parent / "conf/friction/paper.yaml").read_text())
    return nominal_dynamics(robot, **friction)


class Bare:
    """A minimal `Arm`: the nominal model in MuJoCo, which starts at once."""

    # ruff: noqa: D102

    def __init__(self, robot):
        self.robot, self._reflexes = robot, Reflexes(robot)
        self._model = robot.model(gravity=False)
        self._data = mujoco.MjData(self._model)
        self.commands = []
        self.move_to(robot.q_home)

    def move_to(self, q):
        mujoco.mj_resetData(self._model, self._data)
        self._data.qpos, self._last = q, np.zeros(7)
        return self.read()

    def read(self):
        return ArmState(0.0, self._data.qpos.copy(), self._data.qvel.copy(), self._last, self._last)

    def command(self, tau):
        self._reflexes.command(tau, self._last)
        self.commands.append(tau)
        self._last = self._data.qfrc_applied[:] = tau
        mujoco.mj_step(self._model, self._data)
        self._reflexes.state(self._data.qpos, self._data.qvel)

    def stop(self):
        pass


def holdable(robot):
    """Return a simulated arm, which supports the fault 'hold'."""
    return SimulatedArm(robot, paper(robot), position_noise=0, velocity_noise=0)


def loaded(robot, payload=None, declared=None):
    """Return a simulated arm with a payload, which its gravity compensation may know."""
    friction = paper(robot)
    still = {"position_noise": 0, "velocity_noise": 0}
    carried, declared = (payload_of(x, (3.0, 0.15)) for x in (payload, declared))
    return SimulatedArm(robot, friction, payload=carried, declared_payload=declared, **still)


class Paced(SimulatedArm):
    """An arm whose clock does not wait; it writes t, q, dq and tau of every cycle to a file."""

    def __init__(self, robot, path):
        super().__init__(robot, paper(robot), position_noise=0.0, velocity_noise=0.0)
        self._file = open(path, "ab", buffering=0)  # noqa: SIM115 (as long as the arm)
        self._due = 0.0

    def command(self, tau):
        """Advance one millisecond in PACE_S."""
        state = self.read()
        self._file.write(np.concatenate([[state.t], state.q, state.dq, tau]).tobytes())
        self._due = max(self._due, time.perf_counter() - PACE_S) + PACE_S
        time.sleep(max(0.0, self._due - time.perf_counter()))
        super().command(tau)
