"""Recordings of an arm that presses and slides on a known surface, by inverse dynamics: every parameter is known.

The motion is planned, so nothing is simulated: the command is what links, friction and contact need for it, sent as
early as delay and hold demand. Encoders and velocities are noisy; the arm differs from its estimate by a draw of the
posterior.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator

from r2s.identification.contact.estimate import Arm
from r2s.identification.contact.tip import TipMotion
from r2s.identification.parameters import parameter_space
from r2s.physics.dynamics import Dynamics
from r2s.physics.friction import COULOMB
from r2s.physics.inverse_dynamics import InverseDynamics
from r2s.physics.kinematics import HandKinematics
from r2s.physics.robot import SIM_DT, Robot
from r2s.physics.surface import Surface
from r2s.recordings.recording import Recording

ENCODER, SPEED = 2e-5, 3e-3  # rad, rad/s, standard deviations of a Panda's sensors
BOUNDS = {"coulomb": [1e-3, 5.0], "asymmetry": [-0.5, 0.5], "viscous": [0.0, 2.0], "offset": [-2.0, 2.0]}
BOUNDS |= {"inertia_scale": [0.5, 2.0], "delay": [0.0, 5e-3]}
# of the posterior: those of an identification of 20 s (relative for the level of friction)
SIGMA = {
    "coulomb": 0.005,
    "asymmetry": 0.003,
    "viscous": 0.005,
    "offset": 0.005,
    "inertia_scale": 0.02,
    "delay": 1e-5,
}
KNOTS_S = 0.04  # s, between knots of the joint motion: smooth far below the noise of its velocity


@dataclass(frozen=True)
class Plan:
    """Forces (N) of the presses at each place, slides (m) along the plane, and seconds from knot to knot."""

    loads: tuple[float, ...] = (6.0, 12.0, 20.0, 9.0, 16.0, 8.0, 14.0)
    slides: tuple[float, ...] = (0.0, 0.0, 0.01, 0.05, 0.0, -0.04, 0.02)
    step: float = 0.7
    places: tuple[tuple[float, float], ...] = ((0.0, 0.0), (0.08, 0.05), (-0.06, 0.08))


def estimated_arm(robot: Robot, seed: int) -> Arm:
    """Return a drawn arm with Coulomb friction, and draws of its posterior."""
    rng = np.random.default_rng(seed)
    phi = np.stack([rng.uniform(0.2, 1.2, 7), rng.uniform(-0.05, 0.05, 7), rng.uniform(0.03, 0.4, 7)], -1)
    space = parameter_space(robot, Dynamics.of(robot, phi, COULOMB), BOUNDS)
    offset, scale = rng.uniform(-0.3, 0.3, 7), rng.uniform(0.85, 1.15, 7)
    own = {"coulomb": phi[:, 0], "asymmetry": phi[:, 1], "viscous": phi[:, 2], "offset": offset}
    own |= {"inertia_scale": scale, "delay": np.array([2e-3])}
    x = np.concatenate([own[b] for b in space.blocks])
    sigma = space.expand(SIGMA, 0.0) * np.where(space.expand({"coulomb": True}, False), x, 1.0)
    draws = np.clip(x + sigma * rng.standard_normal((512, len(x))), space.lower, space.upper)
    return Arm(space, x, draws)


def drawn_surface(seed: int) -> Surface:
    """Return a surface below the home posture: tilt up to 20 degrees, k 3 to 50 kN/m, e 1 to 1.5, mu 0.1 to 0.5."""
    rng = np.random.default_rng(seed)
    tilt, way = np.radians(rng.uniform(0.0, 20.0)), rng.uniform(0.0, 2 * np.pi)
    normal = np.array([np.sin(tilt) * np.cos(way), np.sin(tilt) * np.sin(way), np.cos(tilt)])
    stiffness = float(np.exp(rng.uniform(np.log(3e3), np.log(5e4))))
    numbers = rng.uniform([1.0, 0.5, 0.1, 1e-4], [1.5, 5.0, 0.5, 3e-4]).tolist()
    return Surface(np.array([0.45, 0.0, 0.25]), normal, stiffness, *numbers)


def planned_motion(robot: Robot, surface: Surface, plan: Plan) -> CubicSpline:
    """Return joint angles over time, s, that press along the plan with the site of the end effector as tip."""
    first = np.cross(surface.normal, [0.0, 1.0, 0.0])
    first /= np.linalg.norm(first)
    axes = np.stack([first, np.cross(surface.normal, first)])
    times, heights, across = [0.0], [0.03], [plan.places[0]]
    for k, place in enumerate(plan.places):
        way = np.array([1.0, 0.0]) if k % 2 else np.array([0.0, 1.0])
        deep = [-((load / surface.coefficient) ** (1 / surface.exponent)) for load in plan.loads]
        for height, slide in zip([0.004, *deep, 0.03], [0.0, *plan.slides, 0.0], strict=True):
            times.append(times[-1] + plan.step)
            heights.append(height)
            across.append(tuple(np.array(place) + slide * way))
    assert robot.tool is not None
    grid = np.arange(0.0, times[-1], KNOTS_S)
    height = PchipInterpolator(times, heights)(grid)
    flat = PchipInterpolator(times, np.array(across))(grid)
    middle = surface.point + (height + robot.tool.radius)[:, None] * surface.normal + flat @ axes
    hand = HandKinematics(robot)
    way, _ = hand.follow(robot.q_home, np.linspace(hand.place(robot.q_home[None])[0], middle[0], 200))
    q, missed = hand.follow(way[-1], middle)
    assert missed < 1e-4  # m
    return CubicSpline(grid, q)


def press_recording(
    arm: Arm,
    surface: Surface,
    seed: int,
    plan: Plan | None = None,
    *,
    touched: bool = True,
    gears: np.ndarray | float = 0.0,
) -> Recording:
    """Return a recording of the arm on a surface; the true arm is a draw of the posterior, chosen by the seed.

    touched: False: the same motion without the surface. gears: rad/Nm, compliance (n,) between encoders and links.
    """
    rng, robot = np.random.default_rng(seed), arm.robot
    assert arm.samples is not None
    true = arm.space.dynamics(arm.samples[rng.integers(len(arm.samples))])
    motion = planned_motion(robot, surface, plan or Plan())
    t = np.arange(0.0, motion.x[-1], SIM_DT)
    late = np.clip(t + float(true.delay) + 0.5 * SIM_DT, 0.0, motion.x[-1])  # a command is held for a step
    q, dq, ddq = (motion(late, k) for k in (0, 1, 2))
    inverse = InverseDynamics(robot, true)
    contact = TipMotion.of(robot, q, dq, SIM_DT, late == late[0], 0.0).contact(surface)[0] * touched
    bent = gears * (inverse.gravity(q) - contact)  # rad, by which motors are ahead of links; quasi-static
    sliding = dq + np.gradient(bent, SIM_DT, axis=0)
    tau = inverse.rigid(q, dq, ddq) + true.friction(sliding, np.sign(sliding)) - true.offset - contact
    shift = (late[1] - t[1]) / SIM_DT  # the motors at t instead of `late`
    at = np.arange(len(t)) - shift
    ahead, speed = (
        np.stack([np.interp(at, np.arange(len(t)), x) for x in own.T], -1) for own in (bent, sliding - dq)
    )
    q = np.round((motion(t) + ahead + ENCODER * rng.standard_normal(q.shape)) / ENCODER) * ENCODER
    return Recording(t, q, motion(t, 1) + speed + SPEED * rng.standard_normal(q.shape), tau, "commanded")
