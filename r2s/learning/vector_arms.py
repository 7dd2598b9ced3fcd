"""Simulated arms in parallel, with controller and safety filter, for training, evaluation and prediction."""

from collections.abc import Mapping

import numpy as np

from r2s.errors import UserError
from r2s.physics.dynamics import Dynamics
from r2s.physics.robot import Robot
from r2s.physics.safety_filter import filter_limits
from r2s.physics.simulator import Simulator
from r2s.tasks.task import State, Task

ALL = slice(None)
NOISES = "_sigma", "_noise", "_pose_noise"


class VectorArms:
    """Simulate `width` arms, each with its own dynamics, for `r2s.tasks.rollout.rollout`.

    Every simulated millisecond consists of these stages: control law, soft start, low-pass, clip, rate limit, safety
    filter, delay and lag, physics. The simulator computes kinematics once per control period. `State` stores true
    speeds and sensor noise separately.

    Attributes:
        speeds: None, because simulated speeds are exact and need no smoothing.

    Args:
        robot, task: the arm, and the task with its controller.
        dynamics: dynamics of `width` arms, or of one arm for all arms.
        nthread: number of threads; 0: all cores.
        soft_start_s: s, time in which the torque fades in from 0 at the start of an episode.
        seed: seed of the sensor noise; the noise restarts when `place` resets all arms.
        speed_share: factor on the speed limits of the safety filter.
    """

    def __init__(
        self,
        robot: Robot,
        task: Task,
        dynamics: Dynamics,
        width: int,
        nthread: int = 0,
        soft_start_s: float = 0.0,
        seed: int | np.random.SeedSequence = 0,
        speed_share: float = 1.0,
    ):
        surface, named = dynamics.surface, type(task).__name__
        if task.touches and surface is None:
            raise UserError(f"dr: {named} touches a surface; dr={'box' if task.moves_box else 'contact'} draws one")
        if task.moves_box and surface.mass is None:  # type: ignore[union-attr]
            raise UserError(f"dr: {named} pushes a box; dr=box draws one")
        self.robot, self.width = robot, width
        torque, self._period = task.torque_limit(robot), 1 / task.ctrl_hz
        self.sim = Simulator(robot, dynamics, width, nthread, control=task.control(robot))
        limits = filter_limits(robot, torque, speed_share)
        self.sim.drive(limits, torque, task.cutoff_hz, soft_start_s, task.push_limit)
        self._substeps, self._none = task.substeps, np.zeros((width, task.substeps, robot.n))
        self.speeds = None
        self._limited = np.zeros(width)  # number of cycles that the safety filter changed before the last step
        self._steps, self._stopped = np.zeros(width, dtype=np.int64), np.zeros(width, dtype=bool)
        self.seed(seed)
        self._sigma, self._noise = np.zeros((2, width, robot.n))
        self._sigma[:] = dynamics.speed_noise
        # noise of the perceived pose of a box: x m, y m, yaw rad
        self._pose = (task.table, task.pose_noise) if task.moves_box else None  # type: ignore[attr-defined]
        self._pose_noise = np.zeros((width, 3))
        m, degrees = self._pose[1] if self._pose else (0.0, 0.0)
        self._pose_sigma = np.array([m, m, np.radians(degrees)])

    def set_dynamics(self, dynamics: Dynamics, ids: np.ndarray) -> None:
        """Replace the dynamics, delay and lag of the arms `ids`."""
        self.sim.set_dynamics(dynamics, ids)
        self._sigma[ids] = dynamics.speed_noise

    def push(self, tau: np.ndarray) -> None:
        """Apply external joint torques tau (width, n) Nm until the next call of `push`."""
        self.sim.push(tau)

    def place(self, starts: np.ndarray, first: int = 0, ids: np.ndarray | None = None) -> State:
        """Reset the arms `ids` (default: all) to rest at angles `starts` (m, n) rad; return the state of all arms."""
        self.sim.reset(starts, np.zeros_like(starts), ids)
        at = slice(None) if ids is None else ids
        self._steps[at], self._limited[at] = 0, 0.0
        if ids is None:
            self.seed(self._seed)
        self._sense(at)
        return self.read()

    def seed(self, seed: int | np.random.SeedSequence) -> None:
        """Restart the sensor noise from `seed`."""
        self._seed, self._rng = seed, np.random.default_rng(seed)

    def _sense(self, at: np.ndarray | slice = ALL) -> None:
        """Draw new sensor noise for the arms with the indices `at`."""
        if self._sigma.any():
            sigma = self._sigma[at]
            self._noise[at] = sigma * self._rng.standard_normal(sigma.shape)
        if self._pose is not None:
            self._pose_noise[at] = self._pose_sigma * self._rng.standard_normal(self._pose_noise[at].shape)

    def read(self) -> State:
        """Return the current state of all arms; its arrays are views of the simulator's arrays, not copies."""
        sim, t = self.sim, self._steps * self._period
        limited = (sim.limited - self._limited) / self._substeps
        noise = self._noise if self._sigma.any() else None
        force = None if self.robot.tool is None else -sim.contact_force
        arm = sim.q, sim.dq, sim.ee, sim.jacobian, sim.tau, sim.effort
        box = None if self._pose is None else self._pose[0].moved(sim.box, self._pose_noise)
        return State(t, *arm, self._stopped, limited, noise, force, box)

    def step(self, command: np.ndarray) -> State:
        """Run one control period with commands (width, c) of the controller; return the final state.

        Raises:
            FloatingPointError: a command is not finite.
        """
        check_finite("action", command, self._steps)
        self._limited[:] = self.sim.limited
        self.sim.command(command, self._noise)
        self.sim.rollout(self._none, record=())
        self.sim.kinematics()
        self._steps += 1
        self._sense()
        return self.read()

    def end(self) -> np.ndarray:
        """Return whether each arm has stopped, (width,) bool: always False, because simulated arms do not stop."""
        return self._stopped

    def state(self) -> dict:
        """Return a copy of the simulation state and the noise state for `set_state`."""
        own = {name: getattr(self, name).copy() for name in ("_steps", "_limited", *NOISES)}
        return {"sim": self.sim.state()} | own | {"_rng": self._rng.bit_generator.state}

    def set_state(self, state: Mapping) -> None:
        """Restore a result of `state`; equal commands then lead to equal arm states, bit for bit."""
        self.sim.set_state(state["sim"])
        self._steps[:], self._limited[:] = state["_steps"], state["_limited"]
        for name in NOISES:
            getattr(self, name)[:] = state[name]
        self._rng.bit_generator.state = state["_rng"]


def check_finite(what: str, rows: np.ndarray, steps: np.ndarray) -> None:
    """Raise FloatingPointError if a row of `rows` (m, k), one row per arm, is not finite.

    The message contains the index of the arm and the step of its episode. steps: (m,), step of each arm's episode.
    """
    finite = np.isfinite(rows)
    if not finite.all():
        arm = int((~finite.all(-1)).argmax())
        value = rows[arm][~finite[arm]][0]
        raise FloatingPointError(f"{what} of arm {arm} is {value} at step {steps[arm]} of its episode")
