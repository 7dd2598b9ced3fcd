"""Returns of eq. (2) without learning, for benchmarks/paper_reward.py: planned motions, a hold under noise."""

from functools import cached_property

import mujoco
import numpy as np
from common import NEW, ROBOT, default_task

from r2s.learning.evaluate import SELECTION, fixed_episodes
from r2s.learning.model_based import PEAK, Oracle
from r2s.learning.vector_arms import VectorArms
from r2s.physics.safety_filter import ALLOWED
from r2s.tasks import rewards

GAMMAS = (0.95, 0.97, 0.99, 0.995)
SHARES = (0.0, 0.02, 0.05, 0.1, 0.16, 0.3)  # of the initial distance, at which a motion stops
SLOWER = (1.0, 1.25, 1.5, 2.0, 3.0)  # duration over the shortest
JERK = 60 / 108**0.5  # peak acceleration of a minimum-jerk motion over A / T^2
SPEED, ACCELERATION = ALLOWED * ROBOT.dq_max, ROBOT.ddq_max
PROFILES = ("minimum jerk", "trapezoid of speed")


def discounted(reward: np.ndarray, gamma: float) -> float:
    """Return the mean over episodes of the discounted sum of `reward` (E, T), whose last value repeats for ever.

    Episodes are truncated and never terminate, so this is what a critic learns.
    """
    steps = reward.shape[1]
    return float((reward @ gamma ** np.arange(steps) + reward[:, -1] * gamma**steps / (1 - gamma)).mean())


class Motions:
    """Straight lines in joint space from the starts to the goals of the selection episodes.

    Args:
        count: episodes. points: of each line, on which distances are interpolated.
    """

    def __init__(self, count: int = 50, points: int = 201):
        task = default_task("reach")
        self.steps, self.hz = task.steps, task.ctrl_hz
        self._oracle = Oracle(ROBOT, task, NEW)
        self.starts, self._goals = fixed_episodes(ROBOT, task, count, SELECTION)
        self._at = np.linspace(0.0, 1.0, points)

    @cached_property
    def move(self) -> np.ndarray:
        """(E, n) rad, from the start to the posture of the inverse kinematics at the goal."""
        ends = [self._oracle.inverse_kinematics(q, goal) for q, goal in zip(self.starts, self._goals, strict=True)]
        return np.array(ends) - self.starts

    @cached_property
    def distance(self) -> np.ndarray:
        """(E, points) m, to the goal along the line."""
        model = ROBOT.model(gravity=False)
        data, site = mujoco.MjData(model), model.site(ROBOT.ee_site).id
        out = np.empty((len(self.starts), len(self._at)))
        for i, (q, move, goal) in enumerate(zip(self.starts, self.move, self._goals, strict=True)):
            for k, at in enumerate(self._at):
                data.qpos = q + at * move
                mujoco.mj_kinematics(model, data)
                out[i, k] = np.linalg.norm(goal - data.site_xpos[site])
        return out

    def where(self, share: float) -> np.ndarray:
        """Return (E,), the part of each line after which the distance is this share of the initial one."""
        reached = self.distance <= share * self.distance[:, :1]
        return np.where(reached.any(1), self._at[reached.argmax(1)], 1.0)

    def rewards(self, profile: str, start: np.ndarray, end: np.ndarray, slower: float) -> np.ndarray:
        """Return eq. (2) (E, T) of moving from the part `start` (E,) of each line to `end` (E,), and resting there.

        `slower`: duration over the shortest that keeps SPEED and ACCELERATION.
        """
        way = np.abs(self.move) * (end - start)[:, None]
        t = np.arange(self.steps + 1) / self.hz
        along = start[:, None] + _profile(profile, way, slower, t) * (end - start)[:, None]
        d = np.array([np.interp(x, self._at, y) for x, y in zip(along, self.distance, strict=True)])
        dq = (np.diff(along, axis=1) * self.hz)[:, :, None] * self.move[:, None]
        ddq = np.diff(dq, axis=1, prepend=0.0) * self.hz
        flat, scale = d[:, 1:].reshape(-1), np.repeat(self.distance[:, 0], self.steps)
        n = ROBOT.n
        terms = rewards.terms(flat, scale, dq.reshape(-1, n), ddq.reshape(-1, n), np.zeros(len(flat)))
        return (terms @ rewards.PAPER).reshape(-1, self.steps)

    def stopping(self, profile: str, share: float) -> dict[float, float]:
        """Return {gamma: discounted return of the best duration} of stopping at this share; key 1: over 4 s."""
        start, end = np.zeros(len(self.starts)), self.where(share)
        found = [self.rewards(profile, start, end, slower) for slower in SLOWER]
        best = {g: max(discounted(r, g) for r in found) for g in GAMMAS}
        return best | {1: max(float(r.sum(1).mean()) for r in found)}

    def going_on(self, share: float) -> dict[float, tuple[float, float]]:
        """Return {gamma: (returns of resting at this share, of the best motion from there to the goal)}."""
        start, end = self.where(share), np.ones(len(self.starts))
        found = [self.rewards(PROFILES[1], start, end, slower) for slower in (*SLOWER, 6.0, 12.0)]
        return {g: (-2.0 * share / (1 - g), max(discounted(r, g) for r in found)) for g in GAMMAS}


def _profile(profile: str, way: np.ndarray, slower: float, t: np.ndarray) -> np.ndarray:
    """Return the part (E, T) of the ways (E, n) rad that is done at the times (T,) s."""
    if profile == PROFILES[0]:
        shortest = np.maximum(PEAK * way / SPEED, np.sqrt(JERK * way / ACCELERATION)).max(1)
        x = np.clip(t / (slower * np.maximum(shortest, 1e-3))[:, None], 0.0, 1.0)
        return 10 * x**3 - 15 * x**4 + 6 * x**5
    long = way > SPEED**2 / ACCELERATION  # reaches the speed limit
    shortest = np.where(long, way / SPEED + SPEED / ACCELERATION, 2 * np.sqrt(way / ACCELERATION)).max(1)
    seconds = slower * np.maximum(shortest, 1e-3)
    ramp = 0.5 - np.sqrt(0.25 - np.minimum((way / ACCELERATION).max(1) / seconds**2, 0.25))  # share of the time
    x, f = np.clip(t / seconds[:, None], 0.0, 1.0), np.maximum(ramp, 1e-3)[:, None]
    v = 1.0 / (1.0 - f)
    return np.where(x < f, v * x * x / (2 * f), np.where(x < 1 - f, v * (x - f / 2), 1 - v * (1 - x) ** 2 / (2 * f)))


def shaking(std: float, correlation: float, arms: int = 32, steps: int = 100) -> tuple[float, float]:
    """Return mean S = sum tanh|ddq| and share of limited cycles of arms that hold still under noise on the action.

    Args:
        std, correlation: of the noise on an action in [-1, 1], between two steps.
    """
    task, rng = default_task("reach"), np.random.default_rng(0)
    batch, torque = VectorArms(ROBOT, task, NEW, arms, 1), task.torque_limit(ROBOT)
    before, noise = batch.place(task.starts(ROBOT, rng, arms)).dq.copy(), rng.standard_normal((arms, ROBOT.n))
    total, limited = 0.0, 0.0
    for _ in range(steps):
        fresh = rng.standard_normal(noise.shape)
        noise = correlation * noise + np.sqrt(1 - correlation**2) * fresh
        state = batch.step(np.clip(std * noise, -1.0, 1.0) * torque)
        total += np.tanh(np.abs(state.dq - before) * task.ctrl_hz).sum(1).mean() / steps
        limited += state.limited.mean() / steps
        before = state.dq.copy()
    return float(total), float(limited)


def step_cost(d: np.ndarray, s: float) -> np.ndarray:
    """Return the cost of a step of eq. (2) at the distances d in [0, 1], for S = sum tanh|ddq| and slow joints."""
    return rewards.K1 * d + s * (rewards.K3 / (rewards.K4 - d) + rewards.K5 / (rewards.K6 + d))
