"""The second make of hidden twin: nothing that makes it hard is in the identification's model.

Elastic gears that swing, friction with an exact rest, a Stribeck range of its own shape, that warms up and ripples
with the gears (elastic_joints.py), a control box that compensates a part of the friction by the speed it measures,
a clock that jitters and loses a packet now and then, another delay and lag for each joint; under wrong masses,
centres and tensors, offsets, cable drag, noise and quantisation as the first make has. `seed` draws a robot; nothing
but this file reads what was drawn. Seeds 0-9 are for development; seeds of 200 and above are for judging.

One cycle of 1 ms: the box adds its compensations to the command, elastic_joints.py takes rotors and links through it
in steps of at most 0.05 ms, and the sensors look at the motors up to half a millisecond before its end.
"""

from typing import Any

import numpy as np

from r2s.arm.elastic_joints import (
    BREAK,
    C_NEG,
    C_POS,
    COOLING,
    DAMPING,
    DELAY,
    DQ_SEEN,
    DRAG_NEXT,
    DRAG_OWN,
    DRAG_PHASE,
    DRAG_WAVES,
    FALL,
    GEAR,
    HEAT,
    HELP,
    HELP_VISCOUS,
    HELP_WIDTH,
    LAG,
    LINK_Q,
    LOOP,
    MOTOR,
    MU,
    NOISE_TAU,
    OFFSET,
    PHASE,
    POWER,
    POWER_0,
    Q_SEEN,
    RATIO,
    RIPPLE,
    ROTOR,
    ROWS,
    S_AT,
    SHAPE,
    STATES,
    STIFF,
    TAU_SEEN,
    THETA,
    THETA_AT,
    V_STRIBECK,
    VISCOUS,
    W,
    advance,
    helped,
    level,
    sense,
)
from r2s.arm.hidden_arm import NOISE_BLOCK, HiddenArm, drag, draw_links, draw_surroundings, magnitudes
from r2s.errors import UserError
from r2s.physics.newton_euler import WORK, equations, links_of
from r2s.physics.payload import Payload, carrying
from r2s.physics.robot import SIM_DT, Robot

STEPS = 20  # per cycle, at least: 1 s of open loop is then within 1e-5 rad of what finer steps give
SWING = 0.1  # rad per step of the fastest swing at home, at most
MOST_STEPS = 200
LATEST = 8  # cycles of commands that are kept
WARM_SPEED = 0.25  # of dq_max, at which heat comes to 1
SETTLED = 50  # rounds for the posture in which gears and gravity agree


class ElasticTwin(HiddenArm):
    """The second make; arguments as of `HiddenArm`.

    Time, noise and swings restart at every `move_to`; what friction warmed up stays, as the arm is the same: the k-th
    motion of a twin depends on those before it. It is cold when it is made, and `move_to` takes no time.

    Args:
        stiffness: None: drawn with the robot.

    Raises:
        UserError: gears so stiff, or rotors and links so light, that their swing is too fast to be computed.
    """

    def __init__(
        self,
        robot: Robot,
        seed: int,
        payload: Any = 0.0,
        stiffness: float | None = None,
        noise: int = 0,
        load: Any = None,
        friction: float = 1.0,
        late: float = 0.0,
    ):
        super().__init__(robot, seed, payload, stiffness, noise, load, friction, late)
        rng = np.random.default_rng([self._seed, 2])
        self._believed = links_of(robot, robot.mass, robot.com, robot.inertia)
        self._bare = links = draw_links(robot, rng)
        self._links = links_of(robot, *links)
        self._mass, self._bias = np.empty((robot.n, robot.n)), np.empty(robot.n)
        self._work = np.empty((robot.n, WORK))
        at_home = self._gravity(self._believed, robot.q_home)
        unbalanced = at_home - self._gravity(self._links, robot.q_home)
        inertia = self._mass.copy()
        self._hidden = _draw_joints(robot, rng, inertia, unbalanced)
        self._hidden[[C_NEG, C_POS, VISCOUS]] *= self._friction
        if stiffness is not None:
            self._hidden[STIFF] = robot.tau_max * stiffness / robot.tau_max.max()
        whole = _critical(self._hidden, inertia)
        self._hidden[GEAR] = whole * rng.uniform(0.02, 0.06, robot.n)
        self._hidden[LOOP] = whole * rng.uniform(0.45, 0.7, robot.n)
        self._steps = _steps(self._hidden, inertia)
        if self._load is not None:
            told = carrying(robot, self._load, (robot.mass, robot.com, robot.inertia))
            self._believed = links_of(robot, *told)
        self._grasp()
        self._dq_filter = -np.expm1(-2 * np.pi * rng.uniform(60.0, 120.0) * SIM_DT)
        self._jitter = rng.uniform(0.2, 0.5)  # cycles, of sensors and of commands
        self._lost = rng.uniform(5e-4, 3e-3)  # share of the commands that miss their cycle
        self._line, self._sent = np.zeros((LATEST, robot.n)), np.zeros(LATEST)
        self._state, self._help = np.zeros((STATES, robot.n)), np.zeros(robot.n)
        self._start(robot.q_home)

    def _hold(self, payload: Payload | None) -> None:
        self._links = links_of(self.robot, *carrying(self.robot, payload, self._bare))

    def _gravity(self, links: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Return (n,) Nm that holds these links at q (n,) rad."""
        equations(links, self.robot.gravity, q, np.zeros(self.robot.n), self._mass, self._bias, self._work)
        return self._bias.copy()

    def _start(self, q: np.ndarray) -> None:
        p, s = self._hidden, self._state
        self._rng = np.random.default_rng([self._seed, 3, self._episode, self._stream])
        self._cycle, self._tau_J_d = 0, np.zeros(self.robot.n)
        warm = s[HEAT].copy()
        s[:] = 0
        s[HEAT], s[LINK_Q], s[THETA], s[MOTOR] = warm, q, q, self._gravity(self._believed, q)
        for _ in range(SETTLED):
            pull = drag(p[DRAG_OWN], p[DRAG_NEXT], p[DRAG_WAVES], p[DRAG_PHASE], s[LINK_Q], np.roll(s[LINK_Q], -1))
            s[LINK_Q] = q - (self._gravity(self._links, s[LINK_Q]) - pull) / p[STIFF]
        s[THETA_AT], s[S_AT] = q, p[STIFF] * (q - s[LINK_Q])
        self._line[:], self._sent[:] = 0, 0
        self._q, self._dq = s[THETA], s[W]  # what the arm's own reflexes see
        self._look()

    def _advance(self, tau: np.ndarray) -> None:
        s, robot = self._state, self.robot
        age, late, luck = self._clock[self._cycle % NOISE_BLOCK]
        if luck >= self._lost:  # else the arm goes on with the command before
            self._tau_J_d = tau
        slot = self._cycle % LATEST
        self._line[slot], self._sent[slot] = self._tau_J_d, self._cycle + self._jitter * late
        helped(self._hidden, s, self._gravity(self._believed, s[Q_SEEN]), self._help)
        advance(
            self._hidden, s, self._links, robot.gravity, self._help, self._line, self._sent, self._cycle,
            self._steps, self._jitter * age, SIM_DT, self._work,
        )  # fmt: skip
        self._cycle += 1
        self._look()

    def _look(self) -> None:
        row = self._cycle % NOISE_BLOCK
        if row == 0:
            self._noise = self._rng.standard_normal((NOISE_BLOCK, 3, self.robot.n))
            self._clock = self._rng.uniform(size=(NOISE_BLOCK, 3))
        sense(self._hidden, self._state, self._noise[row], self._dq_filter)

    def _seen(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        s = self._state
        return s[Q_SEEN], s[DQ_SEEN], s[TAU_SEEN]


def _draw_joints(robot: Robot, rng: np.random.Generator, inertia: np.ndarray, unbalanced: np.ndarray) -> np.ndarray:
    """Return the parameters (ROWS, n), but the gears' damping.

    Args:
        robot: the arm.
        rng: the stream to draw from.
        inertia: (n, n) kg m^2, of the true links at home.
        unbalanced: (n,) Nm, what the gravity compensation leaves at home.

    """
    n, model = robot.n, robot.model(gravity=False)
    felt = 1 / np.diag(np.linalg.inv(inertia))
    p = np.zeros((ROWS, n))
    size = magnitudes(robot)[0] * rng.uniform(0.7, 1.3, n)
    coulomb = 0.75 * size  # of which the control box takes a quarter; the rest of the size comes with speed
    lean = coulomb * rng.uniform(0.05, 0.25, n) * rng.choice([-1, 1], n)
    p[C_NEG], p[C_POS] = coulomb - lean + model.dof_frictionloss, coulomb + lean + model.dof_frictionloss
    p[BREAK] = rng.uniform(1.1, 1.35, n)  # of the Coulomb level
    p[MU] = rng.uniform(0.01, 0.02, n)  # Nm per Nm that the gear carries
    p[V_STRIBECK], p[SHAPE] = rng.uniform(0.02, 0.08, n), rng.uniform(1.0, 1.6, n)
    p[VISCOUS], p[POWER] = 0.5 * size * rng.uniform(0.7, 1.3, n), rng.uniform(0.6, 0.9, n)
    p[RATIO] = rng.choice([50.0, 80.0, 100.0, 120.0, 160.0], n)
    p[RIPPLE : RIPPLE + 3] = rng.uniform(0.01, 0.05, (3, n))
    p[PHASE : PHASE + 3] = rng.uniform(-np.pi, np.pi, (3, n))
    p[FALL], p[COOLING] = rng.uniform(0.13, 0.3, n), rng.uniform(60.0, 180.0, n)
    share = rng.uniform(0.15, 0.3, n)
    p[HELP], p[HELP_VISCOUS] = share * coulomb * rng.uniform(0.9, 1.1, n), share * p[VISCOUS]
    p[HELP_WIDTH] = rng.uniform(0.02, 0.05, n)  # rad/s
    p[ROTOR] = felt * rng.uniform(0.15, 0.3, n) + model.dof_armature
    p[STIFF] = robot.tau_max * rng.uniform(125.0, 210.0, n)  # 1.5e4 Nm/rad of the strong joints of a Panda
    p[DAMPING] = model.dof_damping
    p[DELAY] = rng.uniform(1.75, 3.75) * rng.uniform(0.75, 1.25, n) * 1e-3 / SIM_DT  # cycles
    p[LAG] = rng.uniform(5e-4, 2e-3, n)  # s
    p[OFFSET : NOISE_TAU + 1] = draw_surroundings(robot, rng, 0.7 * coulomb, unbalanced)
    pace = WARM_SPEED * robot.dq_max
    p[POWER_0] = [pace[i] * level(p, pace[i], 0.0, 1.0, i) for i in range(n)]
    return p


def _critical(p: np.ndarray, inertia: np.ndarray) -> np.ndarray:
    """Return (n,) Nm s/rad of each gear, with the other joints free, beyond which it would not swing."""
    reduced = 1 / (1 / p[ROTOR] + np.diag(np.linalg.inv(inertia)))
    return 2 * np.sqrt(p[STIFF] * reduced)


def _steps(p: np.ndarray, inertia: np.ndarray) -> int:
    """Return into how many steps a cycle is cut so that the gears' fastest swing is followed."""
    mobility = np.linalg.inv(inertia) + np.diag(1 / p[ROTOR])  # of what each gear is bent by
    root = np.sqrt(p[STIFF])
    fastest = np.sqrt(np.linalg.eigvalsh(root[:, None] * mobility * root)[-1])
    steps = int(np.ceil(fastest * SIM_DT / SWING))
    if steps > MOST_STEPS:
        most = MOST_STEPS * SWING / SIM_DT / 2 / np.pi
        raise UserError(
            f"arm.stiffness: gears of {p[STIFF].max():.3g} Nm/rad swing at {fastest / 2 / np.pi:.3g} Hz on this arm, "
            f"allowed with arm.make=2 is up to {most:.3g} Hz; arm.make=1 has rigid gears"
        )
    return max(STEPS, steps)
