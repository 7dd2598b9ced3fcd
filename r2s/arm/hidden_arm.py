"""What the hidden twins have in common: an arm of which only the seed is known, and how large its errors are.

Each make (twin.py, elastic_twin.py) draws a robot from its seed around the one it is believed to be, and has drives
and friction of its own. Nothing but the make itself reads what was drawn.
"""

from collections import deque
from typing import Any

import numpy as np

from r2s.arm.interface import ArmState, ArmStopped, Reflexes
from r2s.compiled import njit
from r2s.errors import UserError, check_number
from r2s.physics.payload import Links, Payload, payload_of
from r2s.physics.robot import SIM_DT, Robot

ENCODER = 2e-5  # rad
NOISE_BLOCK = 1000  # cycles of noise drawn at once
LATEST_S = 0.02  # s, the most of `late`


class HiddenArm:
    """An `Arm` (r2s/arm/interface.py) of which only the seed is known; a make says what moves it.

    The same seed, noise and calls give bit-identical states. Noise restarts at every `move_to`, from a stream of its
    own for each episode: the k-th episode of a twin has the same noise whatever the episodes before it did.

    A make has `_start(q)`, which places the arm, `_advance(tau)`, one cycle under a command, `_hold(payload)`, which
    changes what is in its hand, `_seen()`, the sensors' q, dq and tau_J, `_q` and `_dq`, which the reflexes watch,
    `_cycle` and `_tau_J_d`, and multiplies its friction by `_friction`.

    Args:
        robot: what it is believed to be. seed: of the robot drawn around that.
        payload: what is in the hand, as of r2s/physics/payload.py: kg of a point mass, or a mapping.
        load: what its gravity compensation was told of that, as libfranka's setLoad; the same kinds of value. None:
            nothing.
        stiffness: Nm/rad of the strongest joints' gears, the others in proportion to their torque.
        noise: of the sensors, another stream for each: two recordings of one robot have not the same noise.
        friction: share of the drawn friction that is there, of all but what goes with the load: below 1 for an arm
            that has warmed up.
        late: s, by which commands come later than by the make's own delay; whole milliseconds.

    Raises:
        UserError: a payload or load that cannot be, a stiffness that is not above 0 and finite, a friction or a delay
            out of its range.
    """

    def __init__(
        self,
        robot: Robot,
        seed: int,
        payload: Any,
        stiffness: float | None,
        noise: int,
        load: Any = None,
        friction: float = 1.0,
        late: float = 0.0,
    ):
        check_number("arm.seed", seed, "[0, inf)", whole=True)
        self._payload, self._load = payload_of(payload), payload_of(load, "arm.load")
        self._holds = False
        if stiffness is not None:
            check_number("arm.stiffness", stiffness, "(0, inf)")
        check_number("arm.noise", noise, "[0, inf)", whole=True)
        check_number("arm.friction", friction, "[0.1, 3]")
        self._friction, self._late = float(friction), _cycles_late(late)
        self.robot = robot
        self._seed, self._stream = int(seed), int(noise)
        self._reflexes = Reflexes(robot)
        self._episode = 0
        self._stopped: str | None = "no motion was started; call move_to first"
        self._cycle, self._tau_J_d = 0, np.zeros(robot.n)
        self._q, self._dq = robot.q_home, np.zeros(robot.n)
        self._waiting: deque[np.ndarray] = deque()  # commands whose time has not come
        self._said = np.zeros(robot.n)

    def move_to(self, q: np.ndarray) -> ArmState:
        """Place the arm at rest at q (n,) rad; friction carries what gravity compensation leaves."""
        q = np.array(q, dtype=float)
        if q.shape != (self.robot.n,) or not np.isfinite(q).all():
            raise ArmStopped(f"move_to needs {self.robot.n} finite joint angles; it got {q}")
        self._reflexes.state(q, np.zeros(self.robot.n))
        self._cycle = 0
        self._grasp()
        self._start(q)
        self._waiting, self._said = deque(np.zeros((self._late, self.robot.n))), np.zeros(self.robot.n)
        self._episode += 1
        self._stopped = None
        return self.read()

    def read(self) -> ArmState:
        """Return the sensors' view of the current cycle."""
        q, dq, tau_J = self._seen()
        return ArmState(self._cycle * SIM_DT, q.copy(), dq.copy(), tau_J.copy(), self._commanded.copy())

    def command(self, tau: np.ndarray) -> None:
        """Advance one 1 ms cycle under tau (n,) Nm without gravity; the reflexes raise ArmStopped."""
        if self._stopped is not None:
            raise ArmStopped(f"the arm is stopped: {self._stopped}")
        tau = np.array(tau, dtype=float)
        try:
            self._reflexes.command(tau, self._commanded)
            self._grasp()
            self._advance(self._due(tau) if self._late else tau)
            self._reflexes.state(self._q, self._dq)
        except ArmStopped as reason:
            self._stopped = str(reason)
            raise

    def stop(self) -> None:
        """End the motion; `command` is refused until the next `move_to`."""
        if self._stopped is None:
            self._stopped = "stop was called"

    def carry(self, payload: Payload | None) -> None:
        """Change what is in the hand, now and in all motions to come."""
        self._payload = payload
        self._hold(payload if payload is not None and payload.there(self._cycle * SIM_DT) else None)
        self._holds = payload is not None and bool(payload.there(self._cycle * SIM_DT))

    @property
    def _commanded(self) -> np.ndarray:
        """(n,) Nm, the last command: that was given where commands come later, else that the arm obeys."""
        return self._said if self._late else self._tau_J_d

    def _due(self, tau: np.ndarray) -> np.ndarray:
        """Let a command (n,) Nm wait and return the one whose time has come."""
        self._waiting.append(tau)
        self._said = tau
        now, step = self._tau_J_d, self.robot.dtau_max * SIM_DT  # `now` lags where a command was lost on its way
        return now + np.clip(self._waiting.popleft() - now, -step, step)

    def _grasp(self) -> None:
        """Put the payload on or take it off where it is time."""
        payload = self._payload
        if payload is not None and self._holds != (now := bool(payload.there(self._cycle * SIM_DT))):
            self._hold(payload if now else None)
            self._holds = now

    def _hold(self, payload: Payload | None) -> None:
        raise NotImplementedError

    def _start(self, q: np.ndarray) -> None:
        raise NotImplementedError

    def _advance(self, tau: np.ndarray) -> None:
        raise NotImplementedError

    def _seen(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        raise NotImplementedError


def _cycles_late(late: float) -> int:
    """Return how many cycles `late` s are; raises UserError where it is no whole number of them, or too many."""
    check_number("arm.late", late, f"[0, {LATEST_S}]")
    cycles = round(late / SIM_DT)
    if abs(late / SIM_DT - cycles) > 1e-6:
        raise UserError(f"arm.late: {late!r} is not allowed; whole milliseconds from 0 to {LATEST_S} s are")
    return cycles


def draw_links(robot: Robot, rng: np.random.Generator) -> Links:
    """Return true masses, centres and tensors; U: uniform."""
    model = robot.model(gravity=True)
    n, bodies = robot.n, model.jnt_bodyid
    small = np.minimum(1.0, robot.tau_max / 12)[:, None]  # arms smaller than a Panda's wrist
    masses = model.body_mass[bodies] * rng.uniform(0.98, 1.02, n)  # U(0.98, 1.02) of the nominal mass
    coms = model.body_ipos[bodies] + small * rng.uniform(-2e-3, 2e-3, (n, 3))  # U(-2, 2) mm
    scale = rng.uniform(0.73, 1.37, n)  # the range of the paper's NEW / OLD; a scaled tensor stays physical
    return masses, coms, robot.inertia * scale[:, None, None]


def magnitudes(robot: Robot) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return friction level at speed, range of |offset| (n, 2), largest cable drag and sensor noise, Nm.

    A Panda has the size of the paper's Tables I and IV; other arms get it in proportion to their torque
    limits.
    """
    big = robot.tau_max >= 40
    if robot.n == 7 and np.allclose(robot.tau_max, [87] * 4 + [12] * 3):
        level = 0.5 * np.array([3.40, 1.98, 2.51, 2.44, 2.60, 1.19, 1.55])  # phi1 / 2, Table IV NEW
    else:
        level = np.minimum(0.05 * robot.tau_max, 0.45 * robot.tau_max**0.25)
    small = np.minimum(1.0, robot.tau_max / 12)
    offset = np.where(big[:, None], [0.05, 0.7], small[:, None] * [0.01, 0.08])
    return level, offset, np.where(big, 0.3, 0.08 * small), np.where(big, 0.3, 0.1 * small)


def draw_surroundings(robot: Robot, rng: np.random.Generator, hold: np.ndarray, unbalanced: np.ndarray) -> np.ndarray:
    """Return (8, n): torque offset, Nm; cable drag, the arguments of `drag`; noise of q, dq and tau_J.

    Args:
        robot, rng: the arm, and the stream to draw from.
        hold: (n,) Nm that friction surely holds. unbalanced: (n,) Nm, what the gravity compensation leaves at home.
    """
    _, offset_range, drag_max, noise_max = magnitudes(robot)
    n = robot.n
    offset = rng.uniform(offset_range[:, 0], offset_range[:, 1]) * rng.choice([-1, 1], n)
    return np.array(
        [
            # Table I is what is left of gravity and offset together; an arm that drifts at home would be recalibrated
            np.clip(offset, -hold - unbalanced, hold - unbalanced),
            drag_max * rng.uniform(0.15, 0.7, n),
            drag_max * rng.uniform(0.0, 0.3, n),  # a cable along two joints
            rng.uniform(0.7, 2.0, n),  # rad per rad
            rng.uniform(-np.pi, np.pi, n),
            rng.uniform(0.5e-5, 1.5e-5, n),
            rng.uniform(2e-3, 4e-3, n),  # before the filter
            noise_max * rng.uniform(0.5, 1.0, n),
        ]
    )


@njit(cache=True)
def drag(own, along, waves, phase, q, after):
    """Return Nm that a cable pulls a joint at q with; the next joint is at `after`."""
    return own * np.sin(waves * q + phase) + along * np.sin(after - phase)
