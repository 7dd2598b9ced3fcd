"""Predict the widths of the 95 % intervals of an identification before it runs.

A few least-squares steps on torque, with all model terms, estimate the parameters and the noise. `posterior`
linearizes the model at the estimated parameters and computes the widths. The prediction omits the slow parts of an
identification: choice of friction family and terms, iteration to convergence, replays and breakaway torques.
"""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from r2s.identification.identify import History, State, formulate
from r2s.identification.parameters import TIMING, ParameterSpace
from r2s.identification.posterior import Z_95, posterior
from r2s.identification.problem import Problem
from r2s.identification.result import SHARPER, conclude
from r2s.identification.search.least_squares import LeastSquares
from r2s.identification.settings import Settings
from r2s.identification.terms import scaled_prior
from r2s.physics.dynamics import Dynamics, with_family
from r2s.physics.robot import SIM_DT, Robot
from r2s.recordings.parts import spread
from r2s.recordings.recording import Recording

STEPS, FTOL = 6, 1e-2  # most Jacobians per weighting; relative decrease of cost per step below which a fit ends
USED_S = 120.0  # s, longest part of a recording that is used


@dataclass(frozen=True)
class ExpectedWidths:
    """Expected widths of the 95 % intervals of P parameters.

    Attributes:
        space: parameter space. width: (P,), expected widths, SI units. share: (P,), ratio of posterior to prior
            sigma.
        identifiable: (P,), whether the data will determine each parameter, by the rule of `conclude`.
        late: s, time shift between torque and motion, and the shift's standard deviation. The shift is the delay of
            motion behind commanded torque, or the delay of measured or motor torque behind motion.
    """

    space: ParameterSpace
    width: np.ndarray
    share: np.ndarray
    identifiable: np.ndarray
    late: tuple[float, float]


def torque_problem(robot: Robot, nominal: Dynamics, recording: Recording, settings: Settings) -> Problem:
    """Return the torque problem that an identification with `settings` solves, with all model terms in `settings`.

    If `settings.family` is "auto", the problem uses the friction family of the nominal arm.
    """
    if settings.family != "auto":
        nominal = with_family(nominal, settings.family)
    prior = scaled_prior(settings.prior, robot, recording, nominal)
    history = History(lambda row: None, lambda name, make: make())
    return formulate(State(robot, nominal, recording, (), settings, None, prior, history, settings.terms)).problem


def expected_widths(robot: Robot, nominal: Dynamics, recording: Recording, settings: Settings) -> ExpectedWidths:
    """Return the expected interval widths of an identification from `recording`.

    Raises:
        UserError: all trajectories in the recording are too short, or a setting does not fit the arm.
    """
    used = spread(recording, USED_S)
    problem = torque_problem(robot, nominal, used, settings)
    space = problem.space
    u = LeastSquares(STEPS, FTOL, level="torque")(problem, problem.start, lambda row: None)
    problem = problem.reweighted(u, fitted=True)
    sure = posterior(problem, u, settings.seed)
    found = conclude(problem, space, sure._asdict(), history=pd.DataFrame(), families={}).found
    share = np.minimum(sure.steps.std(0) / problem.prior_width, 1.0)
    # assume that unused rows contain as much information as used rows
    more = recording.duration / used.duration
    less = 1.0 / np.sqrt(share**2 + more * (1.0 - share**2))
    seen = found.identifiable | ((more > 1.0) & (Z_95 * less * share < 1.0 / SHARPER))
    if timing := [k for name in TIMING if name in space.blocks for k in space.where(name).tolist()]:
        draws = space.from_unit(u + sure.steps)[:, timing].sum(1)
        late = float(space.from_unit(u)[timing].sum()), float(draws.std())
    else:
        late = _lateness(problem, u)
    return ExpectedWidths(space, less * (found.high - found.low), less * share, seen, late)


def _lateness(problem: Problem, u: np.ndarray) -> tuple[float, float]:
    """Return the time shift, s, between torque and motion that no parameter explains, and the shift's sigma, s."""
    data = problem.torque_data
    r, j = data(problem.space.from_unit(u[None]))[0], data.jacobian(u)
    change = (data.motion.command(0.0, 0.0) - data.motion.command(SIM_DT, 0.0)) / SIM_DT
    column = (change * data.seen / data.scale).reshape(-1)
    own = column - j @ np.linalg.lstsq(j.T @ j + problem.prior_information(u), j.T @ column, rcond=None)[0]
    square = max(float(own @ own), 1e-12)
    late = float(own @ r) / square
    return (-late if data.commanded else late), square**-0.5
