"""Many simulated arms behind the driver's law: of the environment, of evaluations and predictions."""

from collections.abc import Mapping

import numpy as np

from r2s.physics.actuation import Actuation
from r2s.physics.dynamics import Dynamics
from r2s.physics.limits import limits
from r2s.physics.robot import Robot
from r2s.physics.simulator import Simulator
from r2s.tasks.task import State, Task

ALL = slice(None)


class ArmBatch:
    """`width` arms, each with its own dynamics; the `Arms` of `r2s.tasks.episode.rollout`.

    A step, each ms of a control period: target torque -> low-pass, clip, rate limit -> the driver's law -> delay and
    lag -> physics; then kinematics. Speeds are the truth, with what sensors would add to them beside it.

    Attributes:
        speeds: None, they need no smoothing.

    Args:
        robot, task: the arm, and what rates and torques are asked of it.
        dynamics: of `width` arms, or of one for all.
        nthread: 0 is all.
        soft_start_s: s, over which the torque of an episode fades in.
        seed: of the sensors' noise, which begins anew wherever all arms are placed.
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
    ):
        self.robot, self.width = robot, width
        self._torque, self._substeps, self._period = task.torque(robot), task.substeps, 1 / task.ctrl_hz
        self.sim = Simulator(robot, dynamics, width, nthread)
        self.sim.drive(limits(robot, self._torque))
        self.actuation = Actuation(robot, width, cutoff_hz=task.cutoff_hz, soft_start_s=soft_start_s)
        self.speeds = None
        self._told: np.ndarray | None = None
        self._from = np.zeros(width)  # s, when it is told
        self._limited = np.zeros(width)  # cycles before the last step
        self._steps, self._stopped = np.zeros(width, dtype=np.int64), np.zeros(width, dtype=bool)
        self.seed(seed)
        self._sigma, self._noise = np.zeros((2, width, robot.n))
        self._sigma[:] = dynamics.speed_noise

    def set_dynamics(self, dynamics: Dynamics, ids: np.ndarray) -> None:
        """Give the arms `ids` new dynamics, delay and lag."""
        self.sim.set_dynamics(dynamics, ids)
        self._sigma[ids] = dynamics.speed_noise

    def tell(self, told: np.ndarray, from_s: np.ndarray, ids: np.ndarray | None = None) -> None:
        """Tell policies told (m, c) of the arms `ids` (all by default) from from_s (m,) s of their episodes on."""
        if self._told is None:
            self._told = np.zeros((self.width, told.shape[1]))
        at = slice(None) if ids is None else ids
        self._told[at], self._from[at] = told, from_s

    def push(self, tau: np.ndarray) -> None:
        """Let something else push the joints with tau (width, n) Nm from now on."""
        self.sim.push(tau)

    def place(self, starts: np.ndarray, first: int = 0, ids: np.ndarray | None = None) -> State:
        """Put the arms `ids` (all by default) at rest at starts (m, n) rad; return the state of all."""
        self.sim.reset(starts, np.zeros_like(starts), ids)
        self.actuation.reset(ids)
        at = slice(None) if ids is None else ids
        self._steps[at], self._limited[at] = 0, 0.0
        if ids is None:
            self.seed(self._seed)
        self._sense(at)
        return self.read()

    def seed(self, seed: int | np.random.SeedSequence) -> None:
        """Begin the sensors' noise anew, from this seed."""
        self._seed, self._rng = seed, np.random.default_rng(seed)

    def _sense(self, at: np.ndarray | slice = ALL) -> None:
        """Draw what the sensors of these arms add to the speeds of this moment."""
        if self._sigma.any():
            sigma = self._sigma[at]
            self._noise[at] = sigma * self._rng.standard_normal(sigma.shape)

    def read(self) -> State:
        """Return the present state of all arms; its arrays are views."""
        sim, effort, t = self.sim, self.actuation.last, self._steps * self._period
        limited = (sim.limited - self._limited) / self._substeps
        told = None if self._told is None else np.where((t >= self._from)[:, None], self._told, 0.0)
        noise = self._noise if self._sigma.any() else None
        return State(t, sim.q, sim.dq, sim.ee, sim.jacobian, sim.tau, effort, self._stopped, limited, told, noise)

    def step(self, target: np.ndarray) -> State:
        """Go on for one control period with the target torques (width, n) Nm; return the state then.

        Raises:
            FloatingPointError: a target is not finite.
        """
        check_finite("action", target, self._steps)
        within = np.minimum(np.maximum(target, -self._torque), self._torque)  # np.clip takes its time
        self._limited[:] = self.sim.limited
        self.sim.rollout(self.actuation(within, self._substeps), record=())
        self.sim.kinematics()
        self._steps += 1
        self._sense()
        return self.read()

    def end(self) -> np.ndarray:
        """Return (width,), which arms have stopped: none, nothing stops them here."""
        return self._stopped

    def state(self) -> dict:
        """Return copies of all that the next steps depend on, for `set_state`."""
        parts = {name: getattr(self, name).state() for name in ("sim", "actuation")}
        told = {} if self._told is None else {"_told": self._told.copy(), "_from": self._from.copy()}
        own = {name: getattr(self, name).copy() for name in ("_steps", "_limited", "_sigma", "_noise")}
        return parts | own | {"_rng": self._rng.bit_generator.state} | told

    def set_state(self, state: Mapping) -> None:
        """Go back to what `state` returned; the same targets then lead to the same states, bit for bit."""
        for name in ("sim", "actuation"):
            getattr(self, name).set_state(state[name])
        self._steps[:], self._limited[:] = state["_steps"], state["_limited"]
        if "_rng" in state:  # checkpoints of before sensors had noise lack it
            self._sigma[:], self._noise[:] = state["_sigma"], state["_noise"]
            self._rng.bit_generator.state = state["_rng"]
        if "_told" in state:
            self.tell(state["_told"], state["_from"])


def check_finite(what: str, rows: np.ndarray, steps: np.ndarray) -> None:
    """Raise FloatingPointError where a row of (m, k) has a value that is not finite; `steps` (m,) of the episodes."""
    finite = np.isfinite(rows)
    if not finite.all():
        arm = int((~finite.all(-1)).argmax())
        value = rows[arm][~finite[arm]][0]
        raise FloatingPointError(f"{what} of arm {arm} is {value} at step {steps[arm]} of its episode")
