"""The rigid variant of the hidden twin: a simulated arm that replaces a real one, with friction, offsets and latency.

The twin runs in DART, not in the training engine. It has LuGre friction (bristles, Stribeck effect, load and
direction dependence, breakaway), torque offsets, delay and lag, cable drag, sensor noise and quantization. Masses,
centers and inertia tensors of the links differ from the nominal values that gravity compensation uses. The seed
determines the robot's parameters, which only the twin reads. Seeds 0-9 are for development, seeds of 100 and above
for final evaluation.

In each cycle, delay and lag act on the command first. The code in lugre_joints.py then solves the next step
implicitly for joint velocities, friction and contact force. DART integrates the step with the contact force and
friction that lugre_joints.py has computed; the friction is linearized about the computed velocities. Finally the
sensors measure the new state.
"""

from typing import Any

import numpy as np

from r2s.arm.twins import lugre_joints as lj
from r2s.arm.twins.draws import draw_links, draw_surroundings, magnitudes
from r2s.arm.twins.twin_base import NOISE_BLOCK, TwinBase
from r2s.engines.dart import DartEngine
from r2s.physics.payload import Payload, with_payload
from r2s.physics.robot import SIM_DT, Robot

MASS_EVERY = 4  # cycles between updates of the mass matrix for lugre_joints.py; DART updates its matrix in every step
STOP_MARGIN = 0.1  # rad by which the mechanical stops lie beyond the position limits, where the reflexes stop the arm


class RigidTwin(TwinBase):
    """The rigid twin, with the arguments of `TwinBase`.

    Each `move_to` resets the clock and the friction bristles, so an evaluation on a new twin is reproducible.

    Args:
        stiffness: as in `TwinBase`; None: rigid gears. Elastic gears deflect without oscillation. Encoders on the
            motors' side do not measure the gear deflection.
    """

    def __init__(self, robot: Robot, seed: int, **settings: Any):
        super().__init__(robot, seed, **settings)
        rng = np.random.default_rng([self._seed, 0])
        self._links = draw_links(robot, rng)
        masses, coms, inertias = self._links
        self._engine = DartEngine(
            robot, gravity=True, masses=masses, coms=coms, inertias=inertias, stop_margin=STOP_MARGIN
        )
        self._nominal = DartEngine(robot, gravity=True)
        at_home = self._nominal.gravity_torque(robot.q_home), self._engine.gravity_torque(robot.q_home)
        inertia = 1 / np.diag(np.linalg.inv(self._nominal.mass_matrix(robot.q_home)))
        self._hidden = p = _draw_joints(robot, rng, inertia, at_home[0] - at_home[1])
        p[[lj.C_NEG, lj.C_POS, lj.S2]] *= self._friction_scale
        if self._stiffness:
            p[lj.COMPLIANCE] = robot.tau_max.max() / (robot.tau_max * self._stiffness)
        if self.declared_payload is not None:
            declared = with_payload(robot, self.declared_payload, (robot.mass, robot.com, robot.inertia))
            self._nominal.relink(*(a[-1] for a in declared))
        self._update_payload()
        delay = rng.uniform(2.0, 5.0) * 1e-3 / SIM_DT  # cycles
        lag = rng.uniform(1e-3, 3e-3)  # s
        filter_hz = rng.uniform(60.0, 120.0)
        p[lj.DELAY], p[lj.LAG] = delay, -np.expm1(-SIM_DT / lag)
        p[lj.DQ_FILTER] = -np.expm1(-2 * np.pi * filter_hz * SIM_DT)
        self._line = np.zeros((int(delay) + 2, robot.n))
        self._state = np.zeros((lj.STATES, robot.n))
        self._start(robot.q_home)

    def _start(self, q: np.ndarray) -> None:
        n = self.robot.n
        self._rng = np.random.default_rng([self._seed, 1, self._episode, self._stream])
        self._cycle = 0
        q = q - self._hidden[lj.COMPLIANCE] * self._engine.gravity_torque(q)  # the motors are at q, the links sag
        self._q, self._dq, self._tau_J_d = q, np.zeros(n), np.zeros(n)
        self._engine.reset(q, self._dq)
        self._mass = self._engine.mass_matrix(q)
        self._line[:] = 0
        compensation = self._nominal.gravity_torque(q)
        lj.rest(self._hidden, self._state, q, compensation, self._engine.gravity_torque(q))
        self._sense()

    def _attach(self, payload: Payload | None) -> None:
        self._engine.relink(*(a[-1] for a in with_payload(self.robot, payload, self._links)))
        self._mass = self._engine.mass_matrix(self._q)

    def _advance(self, tau: np.ndarray) -> None:
        touches = self._touch.near(self._q, self._dq)
        if touches or self._cycle % MASS_EVERY == 0:
            self._mass = self._engine.mass_matrix(self._q)
        s, compensation = self._state, self._nominal.gravity_torque_there(self._q)
        touch = self._touch.contact, self._touch.jacobian, touches
        passive, damping = lj.drive(self._hidden, s, self._line, self._cycle, tau, compensation, self._mass, touch)
        self._q, self._dq = self._engine.step(s[lj.MOTOR], passive, damping)
        s[lj.V_BEFORE], s[lj.Q], s[lj.V] = s[lj.V], self._q, self._dq
        self._tau_J_d = tau
        self._cycle += 1
        self._sense()

    def _sensors(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        s = self._state
        return s[lj.Q_MEASURED], s[lj.DQ_MEASURED], s[lj.TAU_MEASURED]

    def _sense(self) -> None:
        row = self._cycle % NOISE_BLOCK
        if row == 0:
            self._noise = self._rng.standard_normal((NOISE_BLOCK, 3, self.robot.n))
        lj.sense(self._hidden, self._state, self._mass, self._noise[row])


def _draw_joints(robot: Robot, rng: np.random.Generator, inertia: np.ndarray, unbalanced: np.ndarray) -> np.ndarray:
    """Draw random parameters (ROWS, n) for all joints; the caller sets delay, lag and speed filter.

    Args:
        robot: the arm. rng: random number generator.
        inertia: (n,) kg m^2, inertia of each joint in the home posture while the other joints are free to move.
        unbalanced: (n,) Nm, gravity compensation minus gravity torque in the home posture.

    """
    n = robot.n
    p = np.empty((lj.ROWS, n))
    level = magnitudes(robot)[0] * rng.uniform(0.7, 1.3, n)
    coulomb = 0.6 * level  # viscous friction supplies the remainder of the level
    asymmetry = coulomb * rng.uniform(0.05, 0.25, n) * rng.choice([-1, 1], n)
    p[lj.C_NEG], p[lj.C_POS] = coulomb - asymmetry, coulomb + asymmetry
    p[lj.BREAK] = rng.uniform(1.1, 1.5, n)  # breakaway torque / Coulomb friction
    p[lj.MU] = rng.uniform(0.01, 0.02, n)  # friction, Nm per Nm of joint load
    p[lj.V_STRIBECK] = rng.uniform(0.05, 0.15, n)
    p[lj.S0] = p[lj.BREAK] * coulomb / rng.uniform(3e-4, 8e-4, n)  # breaks away after U(0.3, 0.8) mrad
    p[lj.S1] = 2 * rng.uniform(0.2, 0.4, n) * np.sqrt(p[lj.S0] * inertia)  # U(0.2, 0.4): bristles' damping ratio
    p[lj.S2] = 0.4 * level * rng.uniform(0.7, 1.3, n)
    p[lj.OFFSET : lj.NOISE_TAU + 1] = draw_surroundings(robot, rng, 0.7 * coulomb, unbalanced)
    p[lj.ARMATURE] = robot.model(gravity=False).dof_armature
    p[lj.COMPLIANCE] = 0.0
    return p
