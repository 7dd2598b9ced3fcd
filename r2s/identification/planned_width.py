"""Predict the 95 % interval widths of an identification from a planned motion, to choose the motion.

The prediction uses the parameters, bounds and prior of the identification, and linearizes the model of the nominal
arm.
"""

from collections.abc import Sequence

import numpy as np

from r2s.errors import UserError, nearest
from r2s.excitation.information import COARSE_HZ, NOISE
from r2s.identification.identify import STANDSTILL
from r2s.identification.posterior import FLAT, Z_95
from r2s.identification.problem import Problem
from r2s.identification.residuals.planned_motion import PlannedMotion
from r2s.identification.residuals.torque_residual import STEP, TorqueResidual
from r2s.identification.result import SHARPER
from r2s.identification.settings import Settings
from r2s.identification.terms import scaled_prior, search_space
from r2s.physics.dynamics import Dynamics, with_family
from r2s.physics.robot import Robot
from r2s.recordings.recording import Recording

MOST_ROWS = 200  # samples per motion in a search; more samples hardly change the ranking of motions


class PlannedWidths:
    """Expected 95 % interval widths from planned motions.

    Attributes:
        space: the parameters to identify. information: (P, P), summed information of all added motions, on the unit
            cube.

    Args:
        robot, nominal: the arm, and the dynamics at which the identification will start.
        settings: settings of the identification; family=auto means the nominal arm's friction family.
        torque: kind of torque that will be recorded.
        noise: standard deviation of torque noise / tau_max, for independent samples at COARSE_HZ.
        chosen: names of the parameters, such as "offset" or "offset[3]", that `score` considers; an empty sequence
            means all parameters.

    Raises:
        UserError: a name in `chosen` is not an estimated parameter.
    """

    def __init__(
        self,
        robot: Robot,
        nominal: Dynamics,
        settings: Settings,
        torque: str,
        noise: float = NOISE,
        chosen: Sequence[str] = (),
    ):
        nominal = nominal if settings.family == "auto" else with_family(nominal, settings.family)
        rest = np.zeros((10, robot.n))
        recording = Recording(np.arange(10.0), rest + robot.q_home, rest, rest, torque)
        self.robot, self.nominal, self.torque, self._noise = robot, nominal, torque, noise * robot.tau_max
        self.space = search_space(robot, nominal, settings.bounds, settings.terms, recording, settings.stated)
        self._slowest = STANDSTILL if torque == "commanded" else 0.0
        still = (recording.q[None], rest[None], rest[None])
        data = self._residual(recording.t, still)
        self._problem = Problem.of(data, data, scaled_prior(settings.prior, robot, recording, nominal))
        self._u = self._problem.start
        prior = self._problem.prior_information(self._u)
        self._prior = prior + np.diag(np.where(np.diag(prior) > 0, 0.0, FLAT))
        self._chosen = self._places(chosen)
        self.information = np.zeros_like(prior)

    def _places(self, chosen: Sequence[str]) -> np.ndarray:
        names, blocks = self.space.names, self.space.blocks
        places: list[int] = []
        for name in chosen:
            if name in blocks:
                places += self.space.where(name).tolist()
            elif name in names:
                places.append(names.index(name))
            else:
                near = nearest(name, [*blocks, *names])
                raise UserError(f"parameters: '{name}' is not estimated; allowed: {', '.join(blocks)}{near}")
        return np.unique(places) if places else np.arange(len(names))

    def _residual(self, t: np.ndarray, motions: tuple[np.ndarray, ...]) -> TorqueResidual:
        planned = PlannedMotion.of(self.robot, self.nominal, self.torque, t, motions)
        return TorqueResidual(self.space, planned, slowest=self._slowest)

    def of(self, t: np.ndarray, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
        """Return the information (B, P, P) of B motions q, dq, ddq (B, T, n), rad, rad/s, rad/s^2, at t (T,) s."""
        data = self._residual(t, (q, dq, ddq))
        j = data.jacobian(self._u) * np.broadcast_to(data.scale / self._noise, data.seen.shape).reshape(-1, 1)
        j = j.reshape(len(q), -1, j.shape[-1])
        return (j.transpose(0, 2, 1) @ j) * ((t[-1] - t[0]) * COARSE_HZ / len(t))

    def add(self, t: np.ndarray, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> None:
        """Add the information of one motion q, dq, ddq (T, n) at times t (T,) s to the sum `information`."""
        self.information = self.information + self.of(t, q[None], dq[None], ddq[None])[0]

    def half(self, information: np.ndarray) -> np.ndarray:
        """Return half widths (..., P) of 95 % intervals on the unit cube from `information` (..., P, P) and prior."""
        covariance = np.linalg.inv(information + self._prior)
        return Z_95 * np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))

    def score(self, t: np.ndarray, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
        """Return scores (B,) of candidates for the next motion: -mean(log(interval width)) of the chosen values."""
        some = slice(None, None, 1 + len(t) // MOST_ROWS)
        information = self.of(t[some], q[:, some], dq[:, some], ddq[:, some])
        return -np.log(self.half(self.information + information)[:, self._chosen]).mean(1)

    @property
    def width(self) -> np.ndarray:
        """(P,) widths of the 95 % intervals, expected from all added motions, in SI units."""
        h = np.where(self._u > 0.5, -STEP, STEP)
        slope = (self.space.from_unit(self._u + h) - self.space.from_unit(self._u)) / h
        return 2 * self.half(self.information) * slope

    @property
    def share(self) -> np.ndarray:
        """(P,) interval width expected from all added motions / interval width of the prior, at most 1."""
        return np.minimum(self.half(self.information) / (Z_95 * self._problem.prior_width), 1.0)

    @property
    def identifiable(self) -> np.ndarray:
        """(P,) whether each value will be identifiable from all added motions (result.py: SHARPER)."""
        return Z_95 * self.share < 1.0 / SHARPER
