"""Compile the code of the 1 kHz loop before a motion, because compilation takes up to 1 s and a cycle only 1 ms."""

import copy
from contextlib import suppress

import numpy as np

from r2s.adaptation.adapter import Adapter
from r2s.arm.command_loop import CommandLoop
from r2s.arm.driver import Driver
from r2s.arm.interface import ArmState, ArmStopped
from r2s.arm.policy_runner import as_state, episode_driver
from r2s.arm.ramp import ramp
from r2s.arm.recorder import record
from r2s.excitation.motion import Excitation
from r2s.physics.rigid_body import Kinematics
from r2s.physics.robot import SIM_DT, Robot
from r2s.tasks.task import Task

CYCLES = 200  # number of cycles at rest, and then in motion: ten spans of the momentum residual
SWING_RAD, SWING_HZ = 0.05, 1.0  # up to 0.3 rad/s: every joint slides
RAMP_NM = 0.02  # Nm, largest torque of the ramps; it is so low that each ramp ends at once


class _Puppet:
    """A mock `Arm` that ignores commands; it first rests, then each joint oscillates with amplitude `swing`, rad."""

    def __init__(self, robot: Robot, swing: float):
        self.robot, self._swing, self._cycle = robot, swing, 0
        self._last = np.zeros(robot.n)

    def move_to(self, q: np.ndarray) -> ArmState:
        self._cycle, self._last = 0, np.zeros(self.robot.n)
        return self.read()

    def read(self) -> ArmState:
        w = 2 * np.pi * SWING_HZ
        phase = w * SIM_DT * max(0, self._cycle - CYCLES)
        q, dq = self.robot.q_home + self._swing * np.sin(phase), np.zeros(self.robot.n)
        if phase:
            dq += self._swing * w * np.cos(phase)
        return ArmState(self._cycle * SIM_DT, q, dq, self._last.copy(), self._last.copy())

    def command(self, tau: np.ndarray) -> None:
        self._cycle, self._last = self._cycle + 1, tau.copy()

    def stop(self) -> None:
        self._last = np.zeros(self.robot.n)


def warm_up(robot: Robot, task: Task | None = None, adapter: Adapter | None = None) -> None:
    """Run the code of the 1 kHz loop on a mock arm, so that numba compiles the code.

    Call this function in the process that will drive the arm, before opening the arm. The mock arm runs recordings
    and ramps. If there is a task, the mock arm also runs an episode with a copy of the adapter.

    Raises:
        Exception: any exception that the adapter raises.
    """
    rest = np.zeros((CYCLES, robot.n))
    still = Excitation(SIM_DT * np.arange(CYCLES), robot.q_home + rest, rest, rest)
    for loaded in (False, True):
        record(_Puppet(robot, 0.0), still, loaded=loaded)
    ramp(_Puppet(robot, 0.0), robot.q_home[None], largest=RAMP_NM)
    CommandLoop(_Puppet(robot, SWING_RAD), Driver(robot, robot.tau_max, np.ones(robot.n))).damp(np.zeros(robot.n))
    if task is None:
        return
    driver = episode_driver(robot, task, 0.0, np.ones(robot.n))
    loop = CommandLoop(_Puppet(robot, SWING_RAD), driver, adapter=copy.deepcopy(adapter))
    state = loop.place(robot.q_home)
    as_state(Kinematics(robot), state, driver.effort, False, 0.0)
    command = np.zeros(task.control(robot).command_size)
    with suppress(ArmStopped):
        for _ in range(2 * CYCLES):
            loop(command)
        while True:  # without commands the driver stops the arm
            loop(None)
