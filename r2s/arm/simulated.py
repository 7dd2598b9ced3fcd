"""Simulate an arm with known dynamics and sensor noise in MuJoCo, behind the interface of a real arm."""

import numpy as np

from r2s.arm.interface import ArmState, Reflexes
from r2s.physics.actuation import Motors
from r2s.physics.dynamics import Dynamics
from r2s.physics.payload import LoadTorque, Payload, dynamics_with_payload, mass_and_moment
from r2s.physics.robot import SIM_DT, Robot
from r2s.physics.simulator import Simulator


class SimulatedArm:
    """An `Arm` in MuJoCo with the friction model of r2s/physics/friction.py, to test identification on known values.

    Attributes:
        external: (n,) Nm, external joint torque that acts from the next cycle on; zero by default.
        declared_payload: payload that the arm's gravity compensation assumes.

    Args:
        robot: nominal model of the arm. dynamics: true dynamics of the arm.
        position_noise, velocity_noise: rad, rad/s, standard deviations of the white noise on q and on dq.
        seed: random seed of the noise.
        payload: carried body and its attachment times. declared_payload: payload that gravity compensation assumes.
    """

    def __init__(
        self,
        robot: Robot,
        dynamics: Dynamics,
        *,
        position_noise: float,
        velocity_noise: float,
        seed: int = 0,
        payload: Payload | None = None,
        declared_payload: Payload | None = None,
    ):
        self.robot = robot
        without = dynamics_with_payload(robot, dynamics, None, declared_payload)
        self._dynamics = {False: without, True: dynamics_with_payload(robot, dynamics, payload, declared_payload)}
        self._payload, self._carries = payload, False
        self.declared_payload, self._load_torque = declared_payload, LoadTorque(robot)
        self._sim = Simulator(robot, without, 1, 1)
        self._motors = Motors(1, robot.n, dynamics.delay, dynamics.lag)
        self._noise = position_noise, velocity_noise
        self._rng = np.random.default_rng(seed)
        self._reflexes = Reflexes(robot)
        self._cycle, self._last = 0, np.zeros(robot.n)
        self.external = np.zeros(robot.n)
        self._state = self.move_to(robot.q_home)

    def move_to(self, q: np.ndarray) -> ArmState:
        """Place the arm at rest at q (n,) rad, and set its clock to 0."""
        self._sim.reset(np.asarray(q, dtype=float)[None], np.zeros((1, self.robot.n)))
        self._motors.reset()
        self._cycle, self._last = 0, np.zeros(self.robot.n)
        self._update_payload()
        return self._sense()

    def read(self) -> ArmState:
        """Return the arm's state in the current cycle."""
        return self._state

    def command(self, tau: np.ndarray) -> None:
        """Apply tau (n,) Nm, without gravity, for 1 ms; raise ArmStopped if a real arm would stop itself."""
        self._reflexes.command(tau, self._last)
        self._update_payload()
        self._last = np.array(tau, dtype=float)
        self._sim.rollout(self._motors(self._last[None, None]) + self.external)
        self._reflexes.state(self._sim.q[0], self._sim.dq[0])
        self._cycle += 1
        self._sense()

    def stop(self) -> None:
        """End the motion: set velocity and command to zero at the present posture."""
        self._sim.reset(self._sim.q.copy(), np.zeros((1, self.robot.n)))
        self._motors.reset()
        self._last = np.zeros(self.robot.n)
        self._sense()

    def _update_payload(self) -> None:
        """Attach the payload at the time `on_s`, and detach the payload at the time `off_s`."""
        now = self._payload is not None and bool(self._payload.attached(self._cycle * SIM_DT))
        if now != self._carries:
            self._sim.set_dynamics(self._dynamics[now])
            self._carries = now

    def _sense(self) -> ArmState:
        n = self.robot.n
        q = self._sim.q[0] + self._noise[0] * self._rng.normal(size=n)
        dq = self._sim.dq[0] + self._noise[1] * self._rng.normal(size=n)
        # the simulation excludes gravity, so tau_J is a copy of the command: do not record tau_J as 'measured'
        carried, declared = (
            mass_and_moment(self.robot, x) for x in (self._payload if self._carries else None, self.declared_payload)
        )
        external = self._load_torque(self._sim.q[0], carried - declared) - self.external
        if self._dynamics[False].surface is not None:
            external = external - self._sim.contact_torque()[0]
        self._state = ArmState(
            self._cycle * SIM_DT, q, dq, self._last.copy(), self._last.copy(),
            tau_ext_hat_filtered=external, m_ee=0.0, m_load=float(declared[0]),
        )  # fmt: skip
        return self._state
