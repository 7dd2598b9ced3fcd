"""Implement the base of both twin variants: settings, reflexes, payload, surface, extra delay and episodes.

Each variant (rigid_twin.py, elastic_twin.py) uses the seed to draw a random robot near the nominal robot. Each
variant also has its own model of drives and friction. No code outside the variant reads the drawn parameters.
"""

from collections import deque
from typing import Any

import numpy as np

from r2s.arm.interface import ArmState, ArmStopped, Reflexes
from r2s.arm.twins.touch import Touch, draw_surface
from r2s.errors import UserError, check_number
from r2s.physics.payload import LoadTorque, Payload, mass_and_moment, payload_of
from r2s.physics.robot import SIM_DT, Robot

NOISE_BLOCK = 1000  # cycles of noise drawn at once
MAX_EXTRA_DELAY_S = 0.02
STAYS = 2e-3  # rad; a `move_to` that moves each joint by less may leave the tip pressed into the surface


class TwinBase:
    """An `Arm` (r2s/arm/interface.py) with hidden parameters, of which only the random seed is known.

    Equal seeds, noise streams and calls produce bit-identical states. Each `move_to` begins an episode with its own
    random numbers, so the noise of the k-th episode does not depend on earlier episodes.

    A variant implements `_start(q)` (place the arm), `_advance(tau)` (run a cycle with a command), `_attach(payload)`
    (change the payload at once) and `_sensors()` (return q, dq and tau_J). A variant sets `_cycle`, `_tau_J_d`, `_q`
    and `_dq`; the reflexes check `_q` and `_dq`. A variant multiplies its friction by `_friction_scale`, and
    applies the contact force of `_touch` to its links. `_link_q` (n,) rad contains the angles of the links.

    Attributes:
        robot, declared_payload: see Args.

    Args:
        robot: the nominal arm. seed: random seed; the hidden robot is drawn near the nominal arm.
        payload: carried body, a point mass in kg or a mapping, see `r2s.physics.payload.payload_of`.
        declared_payload: payload that the arm's gravity compensation assumes (libfranka's setLoad), in the format of
            `payload`; None: no payload.
        stiffness: Nm/rad, gear stiffness of the strongest joints; each gear's stiffness is proportional to tau_max.
        noise: stream number of the sensor noise; two recordings of one robot need different numbers.
        friction_scale: factor on the drawn friction, except on its load-dependent part; below 1 for a warm arm.
        extra_delay_s: s, delay of commands in addition to the twin's own delay; a whole number of ms.
        surface: a surface for the tool, drawn from the seed. False means no surface. True means a work table below
            the tip in the home posture. {point: (3,) m, normal: (3,)} means a random plane within 5 mm and 5 degrees
            of the given plane (base frame). `box` means a box on a work table. See `draw_surface`.

    Raises:
        UserError: an argument is out of its range.
    """

    def __init__(
        self,
        robot: Robot,
        seed: int,
        *,
        payload: Any = 0.0,
        declared_payload: Any = None,
        stiffness: float | None = None,
        noise: int = 0,
        friction_scale: float = 1.0,
        extra_delay_s: float = 0.0,
        surface: Any = False,
    ):
        check_number("arm.seed", seed, "[0, inf)", whole=True)
        self._payload = payload_of(payload, robot.payload_max)
        self.declared_payload = payload_of(declared_payload, robot.payload_max, "arm.declared_payload")
        self._declared, self._load_torque = mass_and_moment(robot, self.declared_payload), LoadTorque(robot)
        self._carries = False
        if stiffness is not None:
            check_number("arm.stiffness", stiffness, "(0, inf)")
        check_number("arm.noise", noise, "[0, inf)", whole=True)
        check_number("arm.friction_scale", friction_scale, "[0.1, 3]")
        self._stiffness, self._friction_scale = stiffness, float(friction_scale)
        self._extra_delay = _delay_cycles(extra_delay_s)
        self.robot = robot
        self._seed, self._stream = int(seed), int(noise)
        self._touch = Touch(robot, draw_surface(robot, surface, np.random.default_rng([self._seed, 4])))
        self._reflexes = Reflexes(robot)
        self._episode = 0
        self._stopped: str | None = "no motion was started; call move_to first"
        self._cycle, self._tau_J_d = 0, np.zeros(robot.n)
        self._q, self._dq = robot.q_home, np.zeros(robot.n)
        self._pending: deque[np.ndarray] = deque()  # commands that the extra delay still holds back
        self._sent = np.zeros(robot.n)

    def move_to(self, q: np.ndarray) -> ArmState:
        """Place the arm at rest at q (n,) rad; friction balances the error of the gravity compensation.

        The tip may be inside the surface at q only if the arm is already at q and presses on the surface.
        """
        q = np.array(q, dtype=float)
        if q.shape != (self.robot.n,) or not np.isfinite(q).all():
            raise ArmStopped(f"move_to: expected {self.robot.n} finite joint angles, got {q}")
        self._reflexes.state(q, np.zeros(self.robot.n))
        stays = np.abs(q - self._q).max() < STAYS  # here the tip may press, as on a real arm in position control
        if (depth := self._touch.start(q, [self._seed, 5, self._episode, self._stream])) > 0 and not stays:
            raise ArmStopped(f"move_to: the tool's tip would be {1e3 * depth:.1f} mm inside the surface")
        self._cycle = 0
        self._update_payload()
        self._start(q)
        self._pending, self._sent = deque(np.zeros((self._extra_delay, self.robot.n))), np.zeros(self.robot.n)
        self._episode += 1
        self._stopped = None
        return self.read()

    def read(self) -> ArmState:
        """Return the state of this cycle; external torque (undeclared payload, contact) has no sensor error."""
        q, dq, tau_J = self._sensors()
        load = mass_and_moment(self.robot, self._payload if self._carries else None) - self._declared
        external, wrench = self._load_torque(self._q, load), None
        if self._touch.there:
            torque, wrench = self._touch.wrench(self._link_q)
            external = external + torque
        return ArmState(
            self._cycle * SIM_DT, q.copy(), dq.copy(), tau_J.copy(), self._last_command.copy(),
            tau_ext_hat_filtered=external, O_F_ext_hat_K=wrench, m_ee=0.0, m_load=float(self._declared[0]),
            box=self._touch.perceived(self._cycle),
        )  # fmt: skip

    def command(self, tau: np.ndarray) -> None:
        """Run a 1 ms cycle with the command tau (n,) Nm, without gravity; raise ArmStopped after a reflex."""
        if self._stopped is not None:
            raise ArmStopped(f"the arm is stopped: {self._stopped}")
        tau = np.array(tau, dtype=float)
        try:
            self._reflexes.command(tau, self._last_command)
            self._update_payload()
            self._advance(self._delayed(tau) if self._extra_delay else tau)
            self._reflexes.state(self._q, self._dq)
        except ArmStopped as reason:
            self._stopped = str(reason)
            raise

    def stop(self) -> None:
        """End the motion; until the next `move_to`, `command` raises ArmStopped."""
        if self._stopped is None:
            self._stopped = "stop was called"

    def carry(self, payload: Payload | None) -> None:
        """Replace the payload for the present motion and all later motions."""
        self._payload = payload
        self._attach(payload if payload is not None and payload.attached(self._cycle * SIM_DT) else None)
        self._carries = payload is not None and bool(payload.attached(self._cycle * SIM_DT))

    @property
    def _link_q(self) -> np.ndarray:
        """(n,) rad, angles of the links, which differ from the motors' angles if the gears are elastic."""
        return self._q

    @property
    def _last_command(self) -> np.ndarray:
        """(n,) Nm, the last sent command if there is an extra delay, else the last executed command."""
        return self._sent if self._extra_delay else self._tau_J_d

    def _delayed(self, tau: np.ndarray) -> np.ndarray:
        """Queue the command tau (n,) Nm, and return the command that the arm executes in this cycle."""
        self._pending.append(tau)
        self._sent = tau
        # rate-limited, because a variant may have lost the previous command
        executed, step = self._tau_J_d, self.robot.dtau_max * SIM_DT
        return executed + np.clip(self._pending.popleft() - executed, -step, step)

    def _update_payload(self) -> None:
        """Attach the payload at the time `on_s`, and detach the payload at the time `off_s`."""
        payload = self._payload
        if payload is not None and self._carries != (now := bool(payload.attached(self._cycle * SIM_DT))):
            self._attach(payload if now else None)
            self._carries = now

    def _attach(self, payload: Payload | None) -> None:
        raise NotImplementedError

    def _start(self, q: np.ndarray) -> None:
        raise NotImplementedError

    def _advance(self, tau: np.ndarray) -> None:
        raise NotImplementedError

    def _sensors(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        raise NotImplementedError


def _delay_cycles(extra_delay_s: float) -> int:
    """Return the extra delay in cycles; raise UserError unless the delay is whole ms up to MAX_EXTRA_DELAY_S."""
    check_number("arm.extra_delay_s", extra_delay_s, f"[0, {MAX_EXTRA_DELAY_S}]")
    cycles = round(extra_delay_s / SIM_DT)
    if abs(extra_delay_s / SIM_DT - cycles) > 1e-6:
        raise UserError(
            f"arm.extra_delay_s: {extra_delay_s!r}; allowed: whole milliseconds from 0 to {MAX_EXTRA_DELAY_S} s"
        )
    return cycles
