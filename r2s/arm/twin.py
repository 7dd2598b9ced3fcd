"""The first make of hidden twin: the stand-in for a real arm, with what a rigid simulator with friction lacks.

Another engine (DART), friction of another family (LuGre: bristles, Stribeck, load and direction dependence,
breakaway), torque offsets, wrong masses, centres and tensors under a gravity compensation that believes the
nominal ones, a delayed and lagging torque, cable drag, noise and quantisation. `seed` draws a robot; nothing
but this file reads what was drawn. Seeds 0-9 are for development; seeds of 100 and above are for judging.

One cycle: the command goes through delay and lag; the friction of the coming step is solved implicitly
together with the coupled joint velocities; DART takes the step with that friction linearised about the
solution; sensors are read.

Friction, per joint (Canudas de Wit et al., IEEE TAC 40(3), 1995), bristle z rad, h the time step:
    dz/dt = v - s0 |v| z / g(v),   f = s0 z + s1(v) dz/dt + s2 v,   s1(v) = s1 exp(-(v / vd)^2)
    g(v) = c (1 + (b - 1) exp(-(v / vs)^2)) + mu |load|,   c one value per direction
"""

from typing import Any

import numpy as np

from r2s.arm.hidden_arm import (
    ENCODER,
    NOISE_BLOCK,
    HiddenArm,
    drag,
    draw_links,
    draw_surroundings,
    magnitudes,
)
from r2s.compiled import njit
from r2s.engines.dart import DartEngine
from r2s.physics.payload import Links, Payload, carrying
from r2s.physics.robot import SIM_DT, Robot

# Rows of the parameters (rows, n) ...
C_NEG, C_POS, BREAK, MU, V_STRIBECK, S0, S1, S2, OFFSET = range(9)
DRAG_OWN, DRAG_NEXT, DRAG_WAVES, DRAG_PHASE, NOISE_Q, NOISE_DQ, NOISE_TAU, ARMATURE, COMPLIANCE = range(9, 18)
# ... and of the state (rows, n)
Z, MOTOR, DRIVE, V_GUESS, LEVEL, FRICTION, SLOPE, BIAS, DQ_FILTERED, Q_SEEN, TAU_SEEN, BENT = range(12)

DQ_BRISTLE = 0.02  # rad/s, vd: bristle damping fades with speed, or each reversal would kick
MASS_EVERY = 4  # cycles between mass matrices for the implicit solve; DART itself always has the current one
STOP_MARGIN = 0.1  # rad from the position limits, where the arm stops itself, to the mechanical stops


class Twin(HiddenArm):
    """The first make; arguments as of `HiddenArm`.

    Time and bristles restart at every `move_to`, too: an evaluation on a fresh twin is reproducible.

    Args:
        stiffness: None: rigid gears. The encoders are on the motors' side, so that q and dq lack what the load bends;
            the gears do not swing.
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
        rng = np.random.default_rng([self._seed, 0])
        self._links = links = draw_links(robot, rng)
        self._engine = _engine(robot, links)
        self._nominal = DartEngine(robot, gravity=True)
        at_home = self._nominal.gravity_torque(robot.q_home), self._engine.gravity_torque(robot.q_home)
        inertia = 1 / np.diag(np.linalg.inv(self._nominal.mass_matrix(robot.q_home)))
        self._hidden = _draw_joints(robot, rng, inertia, at_home[0] - at_home[1])
        self._hidden[[C_NEG, C_POS, S2]] *= self._friction
        if stiffness:
            self._hidden[COMPLIANCE] = robot.tau_max.max() / (robot.tau_max * stiffness)
        if self._load is not None:
            told = carrying(robot, self._load, (robot.mass, robot.com, robot.inertia))
            self._nominal.relink(*(a[-1] for a in told))
        self._grasp()
        delay = rng.uniform(2.0, 5.0) * 1e-3 / SIM_DT  # cycles
        lag = rng.uniform(1e-3, 3e-3)  # s
        filter_hz = rng.uniform(60.0, 120.0)
        self._delay, self._lag = delay, -np.expm1(-SIM_DT / lag)
        self._dq_filter = -np.expm1(-2 * np.pi * filter_hz * SIM_DT)
        self._line = np.zeros((int(delay) + 2, robot.n))
        self._state = np.zeros((12, robot.n))
        self._start(robot.q_home)

    def _start(self, q: np.ndarray) -> None:
        n = self.robot.n
        self._rng = np.random.default_rng([self._seed, 1, self._episode, self._stream])
        self._cycle = 0
        q = q - self._hidden[COMPLIANCE] * self._engine.gravity_torque(q)  # the motors are where was asked for
        self._q, self._dq, self._tau_J_d = q, np.zeros(n), np.zeros(n)
        self._engine.reset(q, self._dq)
        self._mass = self._engine.mass_matrix(q)
        self._line[:] = 0
        gravity = self._nominal.gravity_torque(q)
        _rest(self._hidden, self._state, q, gravity, self._engine.gravity_torque(q))
        self._sense(before=self._dq)

    def _hold(self, payload: Payload | None) -> None:
        self._engine.relink(*(a[-1] for a in carrying(self.robot, payload, self._links)))
        self._mass = self._engine.mass_matrix(self._q)

    def _advance(self, tau: np.ndarray) -> None:
        if self._cycle % MASS_EVERY == 0:
            self._mass = self._engine.mass_matrix(self._q)
        gravity = self._nominal.gravity_torque_there(self._q)
        passive, damping = _drive(
            self._hidden, self._state, self._line, self._mass, tau, self._q, self._dq, gravity,
            self._cycle, self._delay, self._lag, SIM_DT,
        )  # fmt: skip
        before = self._dq
        self._q, self._dq = self._engine.step(self._state[MOTOR], passive, damping)
        self._tau_J_d = tau
        self._cycle += 1
        self._sense(before)

    def _seen(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        s = self._state
        return s[Q_SEEN], s[DQ_FILTERED], s[TAU_SEEN]

    def _sense(self, before: np.ndarray) -> None:
        row = self._cycle % NOISE_BLOCK
        if row == 0:
            self._noise = self._rng.standard_normal((NOISE_BLOCK, 3, self.robot.n))
        _sense(
            self._hidden, self._state, self._noise[row], self._q, self._dq, before, self._mass,
            self._dq_filter, SIM_DT,
        )  # fmt: skip


def _engine(robot: Robot, links: Links) -> DartEngine:
    masses, coms, inertias = links
    return DartEngine(robot, gravity=True, masses=masses, coms=coms, inertias=inertias, stop_margin=STOP_MARGIN)


def _draw_joints(robot: Robot, rng: np.random.Generator, inertia: np.ndarray, unbalanced: np.ndarray) -> np.ndarray:
    """Return the parameters (rows, n).

    Args:
        robot: the arm.
        rng: the stream to draw from.
        inertia: (n,) kg m^2, what each joint feels at home with the others free.
        unbalanced: (n,) Nm, what the gravity compensation leaves at home.

    """
    n = robot.n
    p = np.empty((18, n))
    level = magnitudes(robot)[0] * rng.uniform(0.7, 1.3, n)
    coulomb = 0.6 * level  # the rest of the level comes with speed
    lean = coulomb * rng.uniform(0.05, 0.25, n) * rng.choice([-1, 1], n)
    p[C_NEG], p[C_POS] = coulomb - lean, coulomb + lean
    p[BREAK] = rng.uniform(1.1, 1.5, n)  # of the Coulomb level
    p[MU] = rng.uniform(0.01, 0.02, n)  # Nm per Nm of joint load
    p[V_STRIBECK] = rng.uniform(0.05, 0.15, n)
    p[S0] = p[BREAK] * coulomb / rng.uniform(3e-4, 8e-4, n)  # breaks away after U(0.3, 0.8) mrad
    p[S1] = 2 * rng.uniform(0.2, 0.4, n) * np.sqrt(p[S0] * inertia)  # damping ratio of the bristles
    p[S2] = 0.4 * level * rng.uniform(0.7, 1.3, n)
    p[OFFSET : NOISE_TAU + 1] = draw_surroundings(robot, rng, 0.7 * coulomb, unbalanced)
    p[ARMATURE] = robot.model(gravity=False).dof_armature
    p[COMPLIANCE] = 0.0
    return p


@njit(cache=True)
def _stribeck(p, z, v, load, i):
    """Return the friction level g(v), Nm; the direction is the bristle's."""
    coulomb = p[C_POS, i] if z >= 0 else p[C_NEG, i]
    fade = np.exp(-((v / p[V_STRIBECK, i]) ** 2))
    return coulomb * (1 + (p[BREAK, i] - 1) * fade) + p[MU, i] * abs(load)


@njit(cache=True)
def _dragged(p, q, i):
    own, along, waves, phase = p[DRAG_OWN, i], p[DRAG_NEXT, i], p[DRAG_WAVES, i], p[DRAG_PHASE, i]
    return drag(own, along, waves, phase, q[i], q[(i + 1) % len(q)])


@njit(cache=True)
def _rest(p, s, q, believed, true):
    """Set the state of an arm at rest: bristles carry what `believed` leaves of the `true` gravity torque."""
    s[:] = 0
    for i in range(len(q)):
        left = believed[i] + p[OFFSET, i] + _dragged(p, q, i)
        level = 0.95 * _stribeck(p, left - true[i], 0.0, believed[i], i)
        s[FRICTION, i] = min(max(left - true[i], -level), level)
        s[Z, i] = s[FRICTION, i] / p[S0, i]
        s[DRIVE, i] = left
        s[LEVEL, i] = np.inf
        s[BIAS, i] = true[i]
        s[BENT, i] = p[COMPLIANCE, i] * (s[DRIVE, i] - s[FRICTION, i])


@njit(cache=True)
def _drive(p, s, line, mass, tau, q, v, gravity, cycle, delay, lag, h):
    """Take a command into the joints; return passive torque and implicit damping (n,) for the engine's step.

    The coupled implicit equation of the step, mass (w - v) / h + bias + f(w) = drive, is solved for the
    coming velocity w joint by joint (Gauss-Seidel), each exactly: with the bristle's backward Euler step
    z' = (z + h w) / (1 + k |w|), k = h s0 / g, it is a quadratic with one root of the right sign.
    """
    n, slots = len(tau), len(line)
    passive, damping = np.empty(n), np.empty(n)
    whole = int(delay)
    late = delay - whole
    for i in range(n):  # as a slice it takes 2 s longer to compile
        line[cycle % slots, i] = tau[i]
    newer, older = (cycle - whole) % slots, (cycle - whole - 1) % slots
    w = s[V_GUESS]
    for i in range(n):
        delayed = (1 - late) * line[newer, i] + late * line[older, i]
        s[MOTOR, i] += lag * (delayed - s[MOTOR, i])
        passive[i] = gravity[i] + p[OFFSET, i] + _dragged(p, q, i)
        s[DRIVE, i] = s[MOTOR, i] + passive[i]
        s[LEVEL, i] = _stribeck(p, s[Z, i], v[i], gravity[i], i)
        limit = s[LEVEL, i] / p[S0, i]
        s[Z, i] = min(max(s[Z, i], -limit), limit)
        damping[i] = p[S1, i] * np.exp(-((v[i] / DQ_BRISTLE) ** 2)) / h  # for now: s1 / h
    for _ in range(50):
        change = 0.0
        for i in range(n):
            free = s[DRIVE, i] - s[BIAS, i] + mass[i, i] / h * v[i]
            for j in range(n):
                if j != i:
                    free -= mass[i, j] / h * (w[j] - v[j])
            stiff, z, k = p[S0, i] + damping[i], s[Z, i], h * p[S0, i] / s[LEVEL, i]
            a = mass[i, i] / h + p[S2, i]
            rest = free + damping[i] * z - stiff * z  # what is left at w = 0 tells the direction
            sign = 1.0 if rest >= 0 else -1.0
            b = a + stiff * h - sign * (free + damping[i] * z) * k
            root = np.sqrt(b * b + 4 * a * k * abs(rest))
            speed = 2 * abs(rest) / (b + root) if b > 0 else (root - b) / (2 * a * k)
            change = max(change, abs(sign * speed - w[i]))
            w[i] = sign * speed
        if change < 1e-9:
            break
    for i in range(n):
        stiff, z, k = p[S0, i] + damping[i], s[Z, i], h * p[S0, i] / s[LEVEL, i]
        grow = 1 + k * abs(w[i])
        sign = 1.0 if w[i] >= 0 else -1.0
        friction = stiff * (z + h * w[i]) / grow - damping[i] * z + p[S2, i] * w[i]
        slope = stiff * (h - z * k * sign) / (grow * grow) + p[S2, i]
        s[FRICTION, i], s[SLOPE, i] = friction, slope
        damping[i] = slope
        passive[i] -= friction - slope * w[i]
    return passive, damping


@njit(cache=True)
def _sense(p, s, noise, q, v, before, mass, dq_filter, h):
    """Finish the step that ended at q, v (n,): bristles, link torque, remaining bias, sensors."""
    n = len(q)
    for i in range(n):
        s[FRICTION, i] += s[SLOPE, i] * (v[i] - s[V_GUESS, i])
        s[Z, i] = (s[Z, i] + h * v[i]) / (1 + h * p[S0, i] / s[LEVEL, i] * abs(v[i]))
        link = s[DRIVE, i] - s[FRICTION, i]
        inertial = 0.0
        for j in range(n):
            inertial += mass[i, j] * (v[j] - before[j]) / h
        s[BIAS, i] = link - inertial
        rotor = p[ARMATURE, i] * (v[i] - before[i]) / h  # on the motor's side of gear and sensor
        bent = p[COMPLIANCE, i] * (link - rotor)
        turned, speed = q[i] + bent, v[i] + (bent - s[BENT, i]) / h
        s[BENT, i] = bent
        s[Q_SEEN, i] = ENCODER * np.round((turned + p[NOISE_Q, i] * noise[0, i]) / ENCODER)
        s[DQ_FILTERED, i] += dq_filter * (speed + p[NOISE_DQ, i] * noise[1, i] - s[DQ_FILTERED, i])
        s[TAU_SEEN, i] = link - rotor + p[NOISE_TAU, i] * noise[2, i]
    for i in range(n):
        s[V_GUESS, i] = v[i]
