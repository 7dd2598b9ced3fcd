"""What a model says of many episodes on an arm, all at once: simulated arms behind the driver's law, in lock-step.

Each does to the last bit what `r2s.arm.simulated.SimulatedArm` without noise does behind `r2s.arm.driver.Driver`.
"""

from collections.abc import Callable

import numpy as np

from r2s.arm.deploy import LOGGED_S, Stop
from r2s.arm.driver import Drivers
from r2s.arm.interface import ArmStopped, Reflexes
from r2s.physics.actuation import Motors
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import SIM_DT, Robot
from r2s.physics.simulator import Simulator
from r2s.tasks.task import State, Task


class DrivenBatch:
    """`width` simulated arms at 1 kHz; the `Arms` of `r2s.tasks.episode.rollout`.

    Attributes:
        stops: why episodes ended early, where they did.

    Args:
        robot: the arm, as `Arm.robot` has its limits.
        dynamics: of `width` arms, or of one for all.
        task: rates and torques. width: episodes.
        soft_start_s: s, over which the torque of an episode fades in.
        nthread: 0 is all.
    """

    def __init__(
        self,
        robot: Robot,
        dynamics: Dynamics,
        task: Task,
        width: int,
        *,
        soft_start_s: float = 0.0,
        nthread: int = 0,
    ):
        self.robot, self.width, self._substeps = robot, width, task.substeps
        self._sim = Simulator(robot, dynamics, width, nthread)
        self._motors = Motors(width, robot.n, dynamics.delay, dynamics.lag)
        period = {"period_s": 1 / task.ctrl_hz, "cutoff_hz": task.cutoff_hz}
        self._drivers = Drivers(robot, task.torque(robot), width, **period, soft_start_s=soft_start_s)
        self._reflexes = Reflexes(robot)
        self.stops: list[Stop] = []
        self._log = np.empty((round(LOGGED_S / SIM_DT), width, 1 + 4 * robot.n))

    def place(self, starts: np.ndarray, first: int) -> State:
        """Put the arms at rest at starts (width, n) rad and begin the episodes `first` and following."""
        self._sim.reset(starts, np.zeros_like(starts))
        self._motors.reset()
        self._drivers.reset()
        self._first, self._now = first, 0
        self._t, self._tau = np.zeros(self.width), np.zeros_like(starts)
        self._stopped = np.zeros(self.width, dtype=bool)
        return self._read()

    def step(self, target: np.ndarray) -> State:
        """Go on for one control period with the target torques (width, n) Nm; arms that have stopped stay."""
        for ms in range(self._substeps):
            if not self._stopped.all():
                self._cycle(target if ms == 0 else None)
        return self._read()

    def end(self) -> np.ndarray:
        """Return (width,), which arms had stopped, or were being stopped, before."""
        for i in np.flatnonzero(~self._stopped):
            if (reason := self._drivers.stopping[i]) is not None:  # the end came before the arm was at rest
                self._stop(i, reason)
        self.stops.sort(key=lambda stop: stop.episode)
        return self._stopped

    def _cycle(self, target: np.ndarray | None) -> None:
        """Go on for 1 ms, in the order of `DrivenArm` and `SimulatedArm`."""
        sim, reflexes, tau_J_d = self._sim, self._reflexes, self._tau
        q, dq = sim.q.copy(), sim.dq.copy()
        wanted = self._drivers(q, dq, tau_J_d, target)
        self._log[self._now % len(self._log)] = np.concatenate([self._t[:, None], q, dq, tau_J_d, wanted], 1)
        self._now += 1
        for i in np.flatnonzero(~self._stopped & ~reflexes.takes(wanted, tau_J_d)):
            self._stop(i, _reason(reflexes.command, wanted[i], tau_J_d[i]))
        if self._stopped.all():
            return
        ids = np.flatnonzero(~self._stopped) if self._stopped.any() else None
        at = slice(None) if ids is None else ids
        self._tau = np.where(self._stopped[:, None], tau_J_d, wanted)
        sim.rollout(self._motors(self._tau[:, None])[at], record=(), ids=ids)
        for i in np.flatnonzero(~self._stopped & ~reflexes.inside(sim.q, sim.dq)):
            self._stop(i, _reason(reflexes.state, sim.q[i], sim.dq[i]))
            sim.q[i], sim.dq[i], self._tau[i] = q[i], dq[i], tau_J_d[i]  # it stays where it was last seen
        self._t[~self._stopped] = self._now * SIM_DT
        for i in np.flatnonzero(~self._stopped & self._drivers.done):
            self._stop(i, self._drivers.stopping[i])

    def _stop(self, i: int | np.integer, reason: object) -> None:
        cycles = np.arange(max(0, self._now - len(self._log)), self._now) % len(self._log)
        log = self._log[cycles, i]
        self.stops.append(Stop(self._first + int(i), f"{self._t[i]:.2f} s", str(reason), log))
        self._stopped[i] = True

    def _read(self) -> State:
        sim, effort = self._sim, self._drivers.effort
        sim.kinematics()
        return State(self._t, sim.q, sim.dq, sim.ee, sim.jacobian, self._tau, effort, self._stopped)


def _reason(check: Callable[[np.ndarray, np.ndarray], None], *row: np.ndarray) -> str:
    """Return what a reflex says of the arm that it stops."""
    try:
        check(*row)
    except ArmStopped as reason:
        return str(reason)
    raise AssertionError("a reflex and its mask disagree")
