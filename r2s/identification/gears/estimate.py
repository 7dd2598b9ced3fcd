"""Identify the stiffness of an arm's gears from slow slides under a multisine torque, with intervals.

The encoders must be on the motors. In each joint, the gear is a spring between rotor and link. Below the resonance,
rotor and link move together; far above the resonance, only the rotor moves. The response around the resonance
determines the stiffness, even if the links' inertia tensors are uncertain.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from r2s.identification.arm_uncertainty import Arm
from r2s.identification.gears.response import Drives, Slides, motor_response, slides_of
from r2s.identification.result import SHARPER
from r2s.physics.dynamics import Dynamics
from r2s.physics.inverse_dynamics import InverseDynamics
from r2s.physics.robot import Robot
from r2s.recordings.recording import Recording

DRAWS = 400  # posterior draws
BLOCKS, STIFFNESS = 8, 1  # values per joint in x (fields of `Drives`, scale of link tensor); index of the stiffness
FTOL, XTOL = 1e-5, 1e-4  # a search ends when a step changes the cost or x by less than this share
MODEL = 0.02  # relative error of a stiffness that more data do not reduce: standard deviation on elastic twins 0 to 4
# if the data do not determine every gear, a second search starts with gears that are 20 times stiffer, so that all
# resonances are above the lines of the multisine
STIFF = np.log(20.0)
# Prior: median, and standard deviation of the logarithm unless stated otherwise. The priors are wide, because no
# source gives these values for a robot. They matter only for light wrists, whose links hardly load the motors.
DEFLECTION = 0.0055, 0.6  # rad, of a strain wave gear at the joint's largest torque (contact/surface_space.py)
ROTOR = 0.2, 0.7  # rotor inertia missing in the model's armature / inertia of the joint's links
GEAR_DAMPING = 0.04, 0.7  # relative to critical damping; 0.01 to 0.1 for metal gears
LOOP_DAMPING = 0.3, 1.0  # relative to critical damping
DELAY = 3e-3, 2e-3  # s, not logarithmic
LAG = 1.2e-3, 0.6  # s
TENSOR = 0.3  # scale of a link's inertia tensor, which slow motion hardly determines (paper, Table IV: 0.73 to 1.37)
VISCOUS = 0.3  # slope of friction over speed, relative to friction level / sliding speed; mean 0, not logarithmic


@dataclass(frozen=True, eq=False)
class GearEstimate:
    """Identified gears of n joints.

    Attributes:
        drives: the estimate. draws: (S, n) Nm/rad, posterior draws of the stiffness.
        identifiable: (n,) bool, whether the data determine each stiffness.
        misfit: (n,), RMS of each joint's residual in standard deviations; a misfit above 1 widens the joint's
            interval. tau_max: (n,) Nm.
        slides: the measured spectra. response: (W, F) rad/Nm, the estimate's response.
    """

    drives: Drives
    draws: np.ndarray
    identifiable: np.ndarray
    misfit: np.ndarray
    tau_max: np.ndarray
    slides: Slides
    response: np.ndarray

    @property
    def spread(self) -> np.ndarray:
        """Relative standard deviation (n,) of each stiffness."""
        return np.log(self.draws).std(0)


@dataclass(frozen=True, eq=False)
class GearProblem:
    """Least-squares problem for x (8 n,), eight values per joint, each in standard deviations of its prior.

    Attributes:
        slides: measured spectra. mass: (W, n, n) kg m^2, mass matrices of the links. tensors: (n, W, n, n) kg m^2,
            parts of `mass` due to each link's inertia tensor.
        rotor: (n,) kg m^2, prior median. stiffness: (n,) Nm/rad, prior median.
        critical: (n,) ratio of a gear's critical damping to sqrt(stiffness). viscous: (n,) Nm s/rad, prior standard
            deviation of `Drives.viscous`.
        noise: factor (W, 1) on `slides.sigma`.
    """

    slides: Slides
    mass: np.ndarray
    tensors: np.ndarray
    rotor: np.ndarray
    stiffness: np.ndarray
    critical: np.ndarray
    viscous: np.ndarray
    noise: np.ndarray | float = 1.0

    def drives(self, x: np.ndarray) -> Drives:
        """Return the drives at x (8 n,)."""
        rotor, stiff, damping, loop, viscous, delay, lag, _ = x.reshape(BLOCKS, -1)
        stiffness = self.stiffness * np.exp(DEFLECTION[1] * stiff)
        critical = self.critical * np.sqrt(stiffness)
        return Drives(
            rotor=self.rotor * np.exp(ROTOR[1] * rotor),
            stiffness=stiffness,
            damping=critical * GEAR_DAMPING[0] * np.exp(GEAR_DAMPING[1] * damping),
            loop=critical * LOOP_DAMPING[0] * np.exp(LOOP_DAMPING[1] * loop),
            viscous=self.viscous * viscous,
            delay=DELAY[0] + DELAY[1] * delay,
            lag=LAG[0] * np.exp(LAG[1] * lag),
        )

    def response(self, x: np.ndarray) -> np.ndarray:
        """Return the response (W, F) rad/Nm at x (8 n,)."""
        scale = np.exp(TENSOR * x.reshape(BLOCKS, -1)[-1]) - 1.0
        return motor_response(self.slides, self.mass + np.tensordot(scale, self.tensors, 1), self.drives(x))

    def misfit(self, x: np.ndarray) -> np.ndarray:
        """Return the complex residual (W, F) at x (8 n,), in standard deviations."""
        return (self.response(x) - self.slides.response) / (self.noise * self.slides.sigma)

    def residual(self, x: np.ndarray) -> np.ndarray:
        """Return residual and prior (2 W F + 8 n,) at x (8 n,)."""
        error = self.misfit(x).ravel()
        return np.concatenate([error.real, error.imag, x])


def gear_problem(robot: Robot, dynamics: Dynamics, slides: Slides) -> GearProblem:
    """Return the problem of gears on an arm with identified `dynamics`."""

    def masses(d: Dynamics, q: np.ndarray) -> np.ndarray:
        return InverseDynamics(robot, d).mass(q) - np.diag(d.armature)

    mass = masses(dynamics, slides.q)
    tensors = []
    for link in range(robot.n):
        inertia = np.array(dynamics.inertia)
        inertia[link] *= 2.0
        tensors.append(masses(replace(dynamics, inertia=inertia), slides.q) - mass)
    # kg m^2, inertia of the links at each joint if all other joints move freely
    own = 1 / np.diag(np.linalg.inv(masses(dynamics, robot.q_home[None])[0]))
    rotor = dynamics.armature + ROTOR[0] * own
    stiffness = robot.tau_max / DEFLECTION[0]
    speed = np.array([np.abs(slides.speed[slides.joint == i]).mean() for i in range(robot.n)])
    critical = 2 * np.sqrt(rotor * own / (rotor + own))
    viscous = VISCOUS * dynamics.level / speed
    return GearProblem(slides, mass, np.array(tensors), rotor, stiffness, critical, viscous)


def identify_gears(
    arm: Arm, recording: Recording, *, seed: int = 0, report: Callable[[float, str], None] = lambda share, what: None
) -> GearEstimate:
    """Identify the gears of an arm whose encoders are on the motors.

    Args:
        arm: the identified arm. recording: slides of all joints (r2s/excitation/multisine.py), commanded torque.
        seed: seed of the posterior's draws. report: function that receives the completed share and the next step.

    Raises:
        UserError: the recording does not contain a slide of each joint with the multisine.
    """
    report(0.0, "spectra")
    slides = slides_of(recording)
    problem = gear_problem(arm.robot, arm.space.dynamics(arm.x), slides)
    n = arm.robot.n
    report(0.1, "stiffness")
    x, covariance, cost = _minimum(problem, np.zeros(BLOCKS * n))
    if not _determined(covariance).all():
        stiff = np.zeros((BLOCKS, n))
        stiff[STIFFNESS] = STIFF / DEFLECTION[1]
        again = _minimum(problem, stiff.ravel())
        x = again[0] if again[2] < cost else x
    report(0.6, "intervals")
    # the model's error may exceed the measured noise; a misfit above 1 therefore widens sigma
    size = np.abs(problem.misfit(x)) ** 2
    misfit = np.sqrt(0.5 * np.array([size[slides.joint == i].mean() for i in range(n)]))
    problem = replace(problem, noise=np.maximum(misfit, 1.0)[slides.joint, None])
    x, covariance, _ = _minimum(problem, x)
    drives = problem.drives(x)
    rng = np.random.default_rng(seed)
    spread = _of_stiffness(covariance) * DEFLECTION[1] ** 2 + MODEL**2 * np.eye(n)
    steps = rng.multivariate_normal(np.zeros(n), spread, DRAWS)
    return GearEstimate(
        drives, drives.stiffness * np.exp(steps), _determined(covariance), misfit, arm.robot.tau_max, slides,
        problem.response(x),
    )  # fmt: skip


def _of_stiffness(covariance: np.ndarray) -> np.ndarray:
    """Return the covariance (n, n) of the stiffness values in x, given the covariance (8 n, 8 n) of x."""
    n = len(covariance) // BLOCKS
    return covariance.reshape(BLOCKS, n, BLOCKS, n)[STIFFNESS, :, STIFFNESS]


def _determined(covariance: np.ndarray) -> np.ndarray:
    """Return (n,) bool: whether the data determine the stiffness, given the covariance (8 n, 8 n) of x."""
    return np.diag(_of_stiffness(covariance)) < 1.0 / SHARPER**2  # the prior's variance is 1


def _minimum(problem: GearProblem, start: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the minimum x (8 n,) near `start`, its covariance (8 n, 8 n) and its cost.

    The loss grows linearly with large residuals of the data, because the friction ripple of a revolving motor may
    have the frequency of a multisine line.
    """
    count = problem.slides.sigma.size * 2

    def loss(z: np.ndarray, /) -> np.ndarray:
        """Return the loss of squared residuals z (soft l1 for data, z for the prior) and its two derivatives."""
        root = np.sqrt(1.0 + z[:count])
        rest = np.stack([z[count:], np.ones(len(start)), np.zeros(len(start))])
        return np.concatenate([np.stack([2.0 * (root - 1.0), 1.0 / root, -0.5 / root**3]), rest], 1)

    fit = least_squares(problem.residual, start, loss=loss, ftol=FTOL, xtol=XTOL)  # type: ignore[arg-type]
    jacobian = np.asarray(fit.jac)
    return fit.x, np.linalg.inv(jacobian.T @ jacobian), float(fit.cost)
