"""Linearize the torque residual of a loaded arm with respect to payload parameters and errors of the arm's model."""

from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np

from r2s.identification.arm_uncertainty import Arm, arm_directions, sensor_factor, sliding_sign
from r2s.identification.identify import STANDSTILL
from r2s.identification.parameters import ParameterSpace
from r2s.identification.residuals.torque_residual import TorqueResidual
from r2s.physics.dynamics import Dynamics
from r2s.physics.payload import LoadTorque, Payload, dynamics_with_payload, mass_and_moment
from r2s.physics.rigid_body import LinkInertia, nominal_torque
from r2s.recordings.recording import Recording

# Standard deviations of drift since the calibration. FRICTION_DRIFT: relative, from warming within minutes (WARMED in
# adaptation). OFFSET_DRIFT: relative to friction. SENSOR_DRIFT: link-side offsets / largest torque (conf/identify).
FRICTION_DRIFT, OFFSET_DRIFT, SENSOR_DRIFT = 0.07, 0.02, 7e-4
LOAD_FRICTION = 0.015  # standard deviation of friction, Nm per Nm of load (adaptation/tuning.py: PAYLOAD_FRICTION)
RATE_HZ, LONG_S = 100.0, 240.0  # rows per second; fewer for recordings longer than LONG_S (s)
REACH = 10.0  # half-width of the unit cube along w, in standard deviations of w


@dataclass(frozen=True)
class LoadedSpace(ParameterSpace):
    """The parameters of an arm that carries a given payload."""

    payload: Payload | None = None

    def dynamics(self, x: np.ndarray) -> Dynamics:
        """Return the dynamics of an arm with parameters x (..., P) and with the payload."""
        return dynamics_with_payload(self.robot, super().dynamics(x), self.payload)


@dataclass(frozen=True, eq=False)
class Rows:
    """Residual of a recording with a payload, in standard deviations: error + body @ phi + arm @ w.

    Attributes:
        error: (R,), residual without payload. body: (R, 10), derivative with respect to the payload's standard
            parameters phi about the end effector. arm: (R, r), derivative with respect to the arm's model errors w ~
            N(0, I). clusters: (R,), block number of each row.
    """

    error: np.ndarray
    body: np.ndarray
    arm: np.ndarray
    clusters: np.ndarray

    @cached_property
    def _eliminated(self) -> tuple[np.ndarray, np.ndarray]:
        """Gain (r, 10), constant (r,): model errors w = gain @ phi + constant minimize the cost of a payload phi."""
        h = self.arm.T @ self.arm + np.eye(self.arm.shape[1])
        solved = -np.linalg.solve(h, self.arm.T @ np.column_stack([self.body, self.error]))
        return solved[:, :-1], solved[:, -1]

    @cached_property
    def reduced(self) -> tuple[np.ndarray, np.ndarray]:
        """Slope (K, 10), constant (K,): the cost of a payload phi is |slope @ phi + constant|^2 plus a fixed term."""
        gain, constant = self._eliminated
        h = self.body.T @ (self.body + self.arm @ gain)
        b = self.body.T @ (self.error + self.arm @ constant)
        size = 1.0 / np.sqrt(np.maximum(h.diagonal(), 1e-300))  # scales in kg, kg m and kg m^2
        values, axes = np.linalg.eigh(0.5 * size[:, None] * (h + h.T) * size)
        some = values > 1e-12 * values.max()
        root = np.sqrt(values[some])[:, None] * axes[:, some].T
        return root / size, np.linalg.lstsq(root.T, size * b, rcond=None)[0]

    def best_arm(self, phi: np.ndarray) -> np.ndarray:
        """Return the arm's model errors w (r,) with the least cost for a payload phi (10,)."""
        gain, constant = self._eliminated
        return gain @ phi + constant


class LoadedTorque:
    """The torque residual of an arm with an unknown payload.

    Args:
        arm: the arm, identified without payload from the recording's kind of torque. recording: motion with payload.
        declared: payload declared to gravity compensation (only for commanded torque).
        cutoff_hz: cutoff of the low-pass for measured or motor torque.
    """

    def __init__(self, arm: Arm, recording: Recording, declared: Payload | None = None, cutoff_hz: float = 10.0):
        self.arm, self.kind, self.factor = arm, recording.torque, sensor_factor(arm)
        commanded = recording.torque == "commanded"
        how = {"cutoff_hz": cutoff_hz, "slowest": STANDSTILL if commanded else 0.0}
        rate = RATE_HZ / max(1, round(recording.duration / LONG_S))
        self._space = LoadedSpace(**{f.name: getattr(arm.space, f.name) for f in fields(arm.space)})
        self.torque = TorqueResidual(self._space, recording, rate_hz=rate, **how)
        m, robot, load = self.torque.motion, arm.robot, LoadTorque(arm.robot)
        still = np.zeros_like(m.q)
        self._load = load
        self._weight = nominal_torque(robot, m.q, still, still)
        held = mass_and_moment(robot, declared)
        self._declared = m.rows(np.array([load(q, held) for q in m.q])) if held.any() else np.zeros(m.tau.shape)
        self._sign = m.filtered(sliding_sign(self.torque))

    def with_payload(self, payload: Payload | None, unexplained: np.ndarray | float = 0.0) -> TorqueResidual:
        """Return the residual of the arm with a payload, each row divided by its estimated standard deviation.

        unexplained: (T, n) Nm, torque due to errors of the arm's model, to subtract from the residual.
        """
        own = self.torque.on(replace(self._space, payload=payload)).with_external(self._declared + unexplained)
        return own.reweighted(self.arm.x, fitted=True)

    def body_torque(self, torque: TorqueResidual, payload: Payload | None) -> np.ndarray:
        """Return torque (T, n, 10) Nm per unit of each standard parameter of a body that is added to `payload`."""
        d, robot = self.arm.space.dynamics(self.arm.x), self.arm.robot
        d = dynamics_with_payload(robot, d, payload)
        # ten bodies of 1 kg whose standard parameters are linearly independent
        centre, tensor = np.zeros((10, 3)), np.zeros((10, 3, 3))
        centre[1:4] = np.eye(3)
        for k, (i, j) in enumerate(((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)), start=4):
            tensor[k, i, j] = tensor[k, j, i] = 1.0
        before = torque.predict(d)
        moved = [
            torque.predict(dynamics_with_payload(robot, d, Payload(np.ones(()), c, i))) - before
            for c, i in zip(centre, tensor, strict=True)
        ]
        return np.stack(moved, -1) @ np.linalg.inv(LinkInertia(np.ones(10), centre, tensor).standard()).T

    def load_friction(self, payload: Payload | None) -> np.ndarray:
        """Return the change of friction (T, n) Nm due to a payload's weight, for a load coefficient of 1."""
        m = self.torque.motion
        carried = mass_and_moment(self.arm.robot, payload)
        loaded = self._weight + np.array([self._load(q, carried) for q in m.q])
        return m.rows(np.abs(loaded) - np.abs(self._weight)) * self._sign

    def rows(self, payload: Payload | None, phi: np.ndarray, w: np.ndarray | None = None) -> Rows:
        """Linearize the residual at `payload`, phi (10,); weights exclude torque explained by model errors w (r,)."""
        torque, x = self.with_payload(payload), self.arm.x
        d = self.arm.space.dynamics(x)
        offset = SENSOR_DRIFT * self.arm.robot.tau_max.max() if self.kind == "measured" else OFFSET_DRIFT * d.level
        given = FRICTION_DRIFT, np.broadcast_to(offset, d.level.shape)
        arm = arm_directions(torque, x, self.arm.samples, *given)
        error = torque.error(torque.space.dynamics(x))
        if self.kind != "measured" and payload is not None:  # a link-side sensor does not measure gear friction
            change = self.load_friction(payload)
            error = error + d.load * change
            arm = np.concatenate([arm, LOAD_FRICTION * change[..., None] * np.eye(len(d.load))], -1)
        body = self.body_torque(torque, payload)
        carried, (factor, sd) = body @ phi, self.factor
        arm = np.concatenate([arm, (sd * carried)[..., None]], -1)
        if w is not None and len(w) == arm.shape[-1]:
            torque = self.with_payload(payload, -arm @ w - (factor - 1.0) * carried)
        error, body = error - carried, body * factor[:, None]
        weight = (1.0 / torque.scale)[torque.seen]
        clusters = np.unique(torque.clusters[torque.seen.ravel()], return_inverse=True)[1]
        return Rows(
            error[torque.seen] * weight,
            body[torque.seen] * weight[:, None],
            arm[torque.seen] * weight[:, None],
            clusters,
        )
