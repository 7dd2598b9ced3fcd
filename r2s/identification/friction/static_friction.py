"""Compare the model's friction at zero speed with the net torque at breakaway in recorded ramps."""

import numpy as np

from r2s.identification.friction.breakaway import Breakaway, Slide
from r2s.identification.parameters import ParameterSpace
from r2s.physics.dynamics import Dynamics
from r2s.physics.rigid_body import LinkInertia, regressor
from r2s.physics.robot import Robot
from r2s.recordings.ramps import Ramps

# standard deviation of (net torque - friction) / command, due to creep and the onset of sliding
SIGMA = 0.03
LEAST = 1e-3  # least command / tau_max to which SIGMA refers


class StaticFriction:
    """Residual of K ramps in which a joint broke away.

    The residual is the net torque at breakaway minus the model's friction at zero speed in the ramp's direction.

    Without ramps, recordings contain little information on the rise of Stribeck friction near standstill.
    """

    def __init__(self, robot: Robot, ramps: Ramps, edges: Breakaway):
        kept = np.flatnonzero(~np.isnan(edges.value))
        q = np.stack([ramps.recording.q[s.start] for s in ramps.recording.stretches])[kept]
        self._kept, self._misfit = kept, edges.misfit
        self.joint, self.side = edges.joint[kept], (edges.sign[kept] > 0).astype(int)
        self.command, own = edges.value[kept], np.arange(len(kept))
        still = np.zeros_like(q)
        gravity = regressor(robot, q, still, still, robot.gravity)[own, self.joint].reshape(len(kept), -1)
        self._gravity, self._nominal = gravity, LinkInertia(robot.mass, robot.com, robot.inertia).standard().ravel()
        self._load = np.abs(gravity @ self._nominal)
        self._q, self._least = q[own, self.joint], LEAST * robot.tau_max[self.joint]
        unit = np.eye(robot.n)[self.joint]
        self._inertia = regressor(robot, q, still, unit)[own, self.joint].reshape(len(kept), -1)

    def net_torque(self, d: Dynamics) -> np.ndarray:
        """Return the net torque (..., K) Nm, friction excluded, on the joint at each of the K breakaways."""
        standard = LinkInertia(d.mass, d.com, d.inertia).standard()
        left = (standard.reshape(*standard.shape[:-2], -1) - self._nominal) @ self._gravity.T
        drag = d.drag[..., self.joint, :]
        pull = d.offset[..., self.joint] + drag[..., 0] * np.sin(self._q) + drag[..., 1] * np.cos(self._q)
        return self.command + pull - left

    def slide(self, d: Dynamics) -> Slide:
        """Return parameters of each ramp's motion after breakaway, see `Slide`; NaN for ramps without breakaway."""
        phi = dict(zip(d.family.names, d.phi[self.joint].T, strict=False))
        sign = np.where(self.side, 1.0, -1.0)
        level = phi["coulomb"] * (1 + sign * phi["asymmetry"]) + d.load[self.joint] * self._load
        viscous = phi["viscous"] * (1 + sign * phi.get("viscous_asymmetry", 0.0))
        inertia = self._inertia @ LinkInertia(d.mass, d.com, d.inertia).standard().ravel() + d.armature[self.joint]
        out = np.full((4, len(self._misfit)), np.nan)
        pull = sign * (self.net_torque(d) - self.command)
        out[:, self._kept] = 1 / inertia, level - pull, viscous, phi["stribeck_velocity"]
        kappa, level, viscous, fall = out
        return Slide(kappa, level, viscous, fall, self._misfit)

    def breakaway(self, d: Dynamics) -> np.ndarray:
        """Return mean net torques (n, 2) Nm at breakaway, or `d.breakaway` for directions without breakaway."""
        net, out = self.net_torque(d), d.breakaway.copy()
        for j, side in set(zip(self.joint.tolist(), self.side.tolist(), strict=True)):
            out[j, side] = net[(self.joint == j) & (self.side == side)].mean()
        return np.stack([np.minimum(out[:, 0], 0.0), np.maximum(out[:, 1], 0.0)], -1)

    def residual(self, space: ParameterSpace, x: np.ndarray) -> np.ndarray:
        """Return the residual (C, K), in standard deviations, of candidates x (C, P)."""
        d = space.dynamics(x)
        sign = np.where(self.side, 1.0, -1.0)
        friction = d.onset_friction()[..., self.joint, self.side] + sign * d.load[..., self.joint] * self._load
        return (self.net_torque(d) - friction) / (SIGMA * np.maximum(np.abs(self.command), self._least))
