"""The elastic variant of the hidden twin, with effects that the identification's models lack.

The gears are elastic and oscillate. Friction holds a resting motor without creep. The Stribeck curve differs from
that of the rigid variant. Friction decreases with heat, and varies periodically with the gear angle
(elastic_joints.py). The control box compensates part of the friction, has a clock that jitters, and occasionally
loses a command. Delay and lag differ between joints. Links, offsets, cable drag, noise and quantization are as in the
rigid variant. The seed determines the robot's parameters, which only the twin reads. Seeds 0-9 are for development,
seeds >= 200 for evaluation.

In each 1 ms cycle the control box adds gravity and friction compensation to the command. The code in
elastic_joints.py then integrates rotors and links in steps of at most 0.05 ms. The sensors measure the motors at most
0.5 ms before the end of the cycle.
"""

from typing import Any

import numpy as np

from r2s.arm.twins import elastic_joints as ej
from r2s.arm.twins.draws import drag, draw_links, draw_surroundings, magnitudes
from r2s.arm.twins.twin_base import NOISE_BLOCK, TwinBase
from r2s.errors import UserError
from r2s.physics.newton_euler import WORK, equations, links_of
from r2s.physics.payload import Payload, with_payload
from r2s.physics.robot import SIM_DT, Robot

MIN_STEPS = 20  # per cycle; finer steps change an open-loop motion of 1 s by less than 1e-5 rad
MAX_STEPS = 200
PHASE_STEP = 0.1  # rad, largest phase change per step of the fastest gear oscillation in the home posture
SLOTS = 8  # number of stored commands, one per cycle
WARM_SPEED = 0.25  # speed at which heat settles at 1, as a share of dq_max
STATIC_ROUNDS = 50  # fixed-point iterations that find the posture in which the gears balance gravity


class ElasticTwin(TwinBase):
    """The elastic twin, with the arguments of `TwinBase`.

    Each `move_to` resets time, noise and oscillation. The joints do not cool in `move_to`, so a motion depends on the
    twin's earlier motions. A new twin is cold.

    Args:
        stiffness: as in `TwinBase`; if None, the gear stiffness is drawn at random, like all other parameters.

    Raises:
        UserError: the gears are so stiff, or rotors and links so light, that a cycle needs more than MAX_STEPS steps.
    """

    def __init__(self, robot: Robot, seed: int, **settings: Any):
        super().__init__(robot, seed, **settings)
        rng = np.random.default_rng([self._seed, 2])
        self._nominal = links_of(robot, robot.mass, robot.com, robot.inertia)
        self._unloaded = links = draw_links(robot, rng)
        self._links = links_of(robot, *links)
        self._mass, self._bias = np.empty((robot.n, robot.n)), np.empty(robot.n)
        self._work = np.empty((robot.n, WORK))
        at_home = self._gravity(self._nominal, robot.q_home)
        unbalanced = at_home - self._gravity(self._links, robot.q_home)
        inertia = self._mass.copy()
        self._hidden = p = _draw_joints(robot, rng, inertia, unbalanced)
        p[[ej.C_NEG, ej.C_POS, ej.VISCOUS]] *= self._friction_scale
        if self._stiffness is not None:
            p[ej.STIFF] = robot.tau_max * self._stiffness / robot.tau_max.max()
        critical = _critical_damping(p, inertia)
        p[ej.GEAR] = critical * rng.uniform(0.02, 0.06, robot.n)
        p[ej.LOOP] = critical * rng.uniform(0.45, 0.7, robot.n)
        self._steps = _steps(p, inertia)
        if self.declared_payload is not None:
            declared = with_payload(robot, self.declared_payload, (robot.mass, robot.com, robot.inertia))
            self._nominal = links_of(robot, *declared)
        self._update_payload()
        self._dq_filter = -np.expm1(-2 * np.pi * rng.uniform(60.0, 120.0) * SIM_DT)
        self._jitter = rng.uniform(0.2, 0.5)  # cycles, largest jitter of sensors and commands
        self._loss = rng.uniform(5e-4, 3e-3)  # share of the commands that miss their cycle
        self._line = np.zeros((SLOTS, robot.n + 1))
        self._state = np.zeros((ej.STATES, robot.n))
        self._start(robot.q_home)

    def _attach(self, payload: Payload | None) -> None:
        self._links = links_of(self.robot, *with_payload(self.robot, payload, self._unloaded))

    def _gravity(self, links: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Return the torque (n,) Nm that holds `links` at rest at q (n,) rad."""
        equations(links, self.robot.gravity, q, np.zeros(self.robot.n), self._mass, self._bias, self._work)
        return self._bias.copy()

    def _start(self, q: np.ndarray) -> None:
        p, s = self._hidden, self._state
        self._rng = np.random.default_rng([self._seed, 3, self._episode, self._stream])
        self._cycle, self._tau_J_d = 0, np.zeros(self.robot.n)
        heat = s[ej.HEAT].copy()
        s[:] = 0
        s[ej.HEAT], s[ej.LINK_Q], s[ej.THETA], s[ej.MOTOR] = heat, q, q, self._gravity(self._nominal, q)
        cable = p[ej.DRAG_OWN], p[ej.DRAG_NEXT], p[ej.DRAG_WAVES], p[ej.DRAG_PHASE]
        for _ in range(STATIC_ROUNDS):
            pull = drag(*cable, s[ej.LINK_Q], np.roll(s[ej.LINK_Q], -1))
            s[ej.LINK_Q] = q - (self._gravity(self._links, s[ej.LINK_Q]) - pull) / p[ej.STIFF]
        s[ej.THETA_AT], s[ej.S_AT] = q, p[ej.STIFF] * (q - s[ej.LINK_Q])
        self._line[:] = 0
        self._q, self._dq = s[ej.THETA], s[ej.W]  # views of the motors' state, which the reflexes check
        self._sense()

    def _advance(self, tau: np.ndarray) -> None:
        s, robot = self._state, self.robot
        age, late, luck = self._clock[self._cycle % NOISE_BLOCK]
        if luck >= self._loss:  # otherwise the arm repeats the previous command
            self._tau_J_d = tau
        slot = self._cycle % SLOTS
        self._line[slot, :-1], self._line[slot, -1] = self._tau_J_d, self._cycle + self._jitter * late
        ej.compensate(self._hidden, s, self._gravity(self._nominal, s[ej.Q_MEASURED]))
        t = self._touch
        arm = self._links, robot.gravity, (t.contact, t.jacobian, t.frames, t.axes, t.there)
        ej.advance(self._hidden, s, arm, self._line, self._cycle, self._steps, self._jitter * age)
        self._cycle += 1
        self._sense()

    def _sense(self) -> None:
        row = self._cycle % NOISE_BLOCK
        if row == 0:
            self._noise = self._rng.standard_normal((NOISE_BLOCK, 3, self.robot.n))
            self._clock = self._rng.uniform(size=(NOISE_BLOCK, 3))
        ej.sense(self._hidden, self._state, self._noise[row], self._dq_filter)

    @property
    def _link_q(self) -> np.ndarray:
        return self._state[ej.LINK_Q]

    def _sensors(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        s = self._state
        return s[ej.Q_MEASURED], s[ej.DQ_MEASURED], s[ej.TAU_MEASURED]


def _draw_joints(robot: Robot, rng: np.random.Generator, inertia: np.ndarray, unbalanced: np.ndarray) -> np.ndarray:
    """Draw random parameters (ROWS, n) for all joints; the caller sets the rows GEAR and LOOP.

    Args:
        robot: the arm. rng: random number generator.
        inertia: (n, n) kg m^2, mass matrix of the true links in the home posture.
        unbalanced: (n,) Nm, gravity compensation minus gravity torque in the home posture.

    """
    n, model = robot.n, robot.model(gravity=False)
    own_inertia = 1 / np.diag(np.linalg.inv(inertia))  # kg m^2, while the other joints are free to move
    p = np.zeros((ej.ROWS, n))
    size = magnitudes(robot)[0] * rng.uniform(0.7, 1.3, n)
    coulomb = 0.75 * size  # viscous friction comes on top; the control box compensates about a quarter of both
    asymmetry = coulomb * rng.uniform(0.05, 0.25, n) * rng.choice([-1, 1], n)
    p[ej.C_NEG] = coulomb - asymmetry + model.dof_frictionloss
    p[ej.C_POS] = coulomb + asymmetry + model.dof_frictionloss
    p[ej.BREAK] = rng.uniform(1.1, 1.35, n)  # breakaway torque / Coulomb friction
    p[ej.MU] = rng.uniform(0.01, 0.02, n)  # friction, Nm per Nm of gear torque
    p[ej.V_STRIBECK], p[ej.SHAPE] = rng.uniform(0.02, 0.08, n), rng.uniform(1.0, 1.6, n)
    p[ej.VISCOUS], p[ej.POWER] = 0.5 * size * rng.uniform(0.7, 1.3, n), rng.uniform(0.6, 0.9, n)
    p[ej.RATIO] = rng.choice([50.0, 80.0, 100.0, 120.0, 160.0], n)
    p[ej.RIPPLE : ej.RIPPLE + 3] = rng.uniform(0.01, 0.05, (3, n))
    p[ej.PHASE : ej.PHASE + 3] = rng.uniform(-np.pi, np.pi, (3, n))
    p[ej.FALL], p[ej.COOLING] = rng.uniform(0.13, 0.3, n), rng.uniform(60.0, 180.0, n)
    share = rng.uniform(0.15, 0.3, n)
    p[ej.HELP], p[ej.HELP_VISCOUS] = share * coulomb * rng.uniform(0.9, 1.1, n), share * p[ej.VISCOUS]
    p[ej.HELP_WIDTH] = rng.uniform(0.02, 0.05, n)  # rad/s
    p[ej.ROTOR] = own_inertia * rng.uniform(0.15, 0.3, n) + model.dof_armature
    p[ej.STIFF] = robot.tau_max * rng.uniform(125.0, 210.0, n)  # 1.5e4 Nm/rad for the strong joints of a Panda
    p[ej.DAMPING] = model.dof_damping
    p[ej.DELAY] = rng.uniform(1.75, 3.75) * rng.uniform(0.75, 1.25, n) * 1e-3 / SIM_DT  # cycles
    p[ej.LAG] = rng.uniform(5e-4, 2e-3, n)  # s
    p[ej.OFFSET : ej.NOISE_TAU + 1] = draw_surroundings(robot, rng, 0.7 * coulomb, unbalanced)
    speed = WARM_SPEED * robot.dq_max
    p[ej.POWER_0] = [speed[i] * ej.level(p, speed[i], 0.0, 1.0, i) for i in range(n)]
    return p


def _critical_damping(p: np.ndarray, inertia: np.ndarray) -> np.ndarray:
    """Return the critical damping (n,) Nm s/rad of each gear while the other joints are free to move."""
    reduced = 1 / (1 / p[ej.ROTOR] + np.diag(np.linalg.inv(inertia)))
    return 2 * np.sqrt(p[ej.STIFF] * reduced)


def _steps(p: np.ndarray, inertia: np.ndarray) -> int:
    """Return the number of steps per cycle that resolve the fastest oscillation of the gears."""
    mobility = np.linalg.inv(inertia) + np.diag(1 / p[ej.ROTOR])  # inverse inertia of the gears' deflections
    root = np.sqrt(p[ej.STIFF])
    fastest = np.sqrt(np.linalg.eigvalsh(root[:, None] * mobility * root)[-1])
    steps = int(np.ceil(fastest * SIM_DT / PHASE_STEP))
    if steps > MAX_STEPS:
        limit = MAX_STEPS * PHASE_STEP / SIM_DT / 2 / np.pi
        raise UserError(
            f"arm.stiffness: gears of {p[ej.STIFF].max():.3g} Nm/rad oscillate at {fastest / 2 / np.pi:.3g} Hz on "
            f"this arm; arm.variant=elastic allows up to {limit:.3g} Hz; arm.variant=rigid has rigid gears"
        )
    return max(MIN_STEPS, steps)
