"""Many copies of the arm at once: `mujoco.batch.Batch` with the friction law inside the physics step.

The convention is libfranka's: a commanded torque excludes gravity, because the arm adds its own compensation, so
the commanded simulator has no gravity and what the compensation gets wrong is the torque offset.
"""

from dataclasses import dataclass, replace

import mujoco
import mujoco.batch
import numpy as np

from r2s import friction
from r2s.actuation import SoftLimits
from r2s.robot import SIM_DT, Robot


@dataclass(frozen=True)
class Dynamics:
    """What identification finds and domain randomization draws; any leading batch shape.

    Attributes:
        phi: (..., n, 3), eq. (5): Nm, s/rad, rad/s.
        offset: (..., n) Nm, added to every command.
        breakaway: (..., n, 2) Nm, negative and positive edge of the dead zone.
        dq_min: rad/s, speed below which the dead zone may hold.
        inertia: (..., n, 3, 3) kg m^2 about each link's centre of mass, link axes.
    """

    phi: np.ndarray
    offset: np.ndarray
    breakaway: np.ndarray
    dq_min: float
    inertia: np.ndarray

    def scaled(self, scale: np.ndarray) -> "Dynamics":
        """Return these dynamics with link tensors times `scale` (..., n): the paper's inertia genes."""
        return replace(self, inertia=self.inertia * np.asarray(scale)[..., None, None])


class Simulator:
    """`nsim` arms stepped together on `nthread` threads (0: all), each with its own Dynamics.

    Results are bit-identical at any thread count.
    """

    def __init__(self, robot: Robot, dynamics: Dynamics, nsim: int, nthread: int = 0, dt: float = SIM_DT):
        friction.install()
        self.robot = robot
        self.model = robot.model(gravity=False, user=friction.WIDTH, dt=dt)
        self.batch = mujoco.batch.Batch(self.model, nsim, nthread)
        self.nsim = nsim
        self._bodies = self.model.jnt_bodyid
        self._site = self.model.site(robot.ee_site).id
        self._user = self.batch.expand("jnt_user")
        self._damping = self.batch.expand("dof_damping")  # the friction law writes it: must not be shared by threads
        self._inertia = self.batch.expand("body_inertia")
        self._iquat = self.batch.expand("body_iquat")
        self.q = self.batch.bind("qpos")
        self.dq = self.batch.bind("qvel")
        self._xanchor, self._xaxis = self.batch.bind("xanchor"), self.batch.bind("xaxis")
        self._site_xpos = self.batch.bind("site_xpos")
        self.set_dynamics(dynamics)

    def set_dynamics(self, dynamics: Dynamics, ids: np.ndarray | None = None, repeat: int = 1) -> None:
        """Give the arms `ids` (all by default) new dynamics, broadcast over the arms where it has no batch shape.

        With repeat > 1 each of the given dynamics goes to that many consecutive arms.
        """
        arms = np.arange(self.nsim) if ids is None else np.asarray(ids)
        d = dynamics
        rows = friction.pack(d.phi, d.offset, d.breakaway, d.dq_min, self.model.dof_damping)
        moments, axes = np.linalg.eigh(d.inertia)
        axes[..., 0] *= np.sign(np.linalg.det(axes))[..., None]  # a rotation, not a reflection
        quaternions = _quaternions(axes)

        def spread(a: np.ndarray) -> np.ndarray:
            return np.repeat(a, repeat, axis=0) if a.ndim == 3 and repeat > 1 else a

        self._user[arms, :, : friction.Q_LOW] = spread(rows)
        self._damping[arms] = self.model.dof_damping
        self._inertia[arms[:, None], self._bodies] = spread(moments)
        self._iquat[arms[:, None], self._bodies] = spread(quaternions)
        self.batch.set_const(ids)

    def set_soft_limits(self, limits: SoftLimits) -> None:
        """Let the driver's soft limits act in all arms; without this call there are none."""
        columns = (limits.q_low, limits.q_high, limits.q_gain, limits.dq_soft, limits.dq_gain)
        for i, column in zip(range(friction.Q_LOW, friction.WIDTH), columns, strict=True):
            self._user[:, :, i] = column

    def reset(self, q: np.ndarray, dq: np.ndarray, ids: np.ndarray | None = None) -> None:
        """Put the arms `ids` (all by default) at q, dq (m, n) rad, rad/s, with current kinematics."""
        self.batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        at = slice(None) if ids is None else ids
        self.q[at] = q
        self.dq[at] = dq
        self._damping[at] = self.model.dof_damping
        self.batch.forward(ids, stage=mujoco.mjtStage.mjSTAGE_POS)

    def rollout(self, tau: np.ndarray, record: tuple[str, ...] = ("qpos",), ids: np.ndarray | None = None) -> dict:
        """Apply torques tau (m, nstep, n) Nm, one per step; return {"qpos": (m, nstep, n), ...} after each step."""
        spec = int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)
        return self.batch.rollout(tau.shape[1], tau, control_spec=spec, record=record, ids=ids)

    def kinematics(self) -> None:
        """Make `ee` and `jacobian` current after a rollout."""
        self.batch.forward(stage=mujoco.mjtStage.mjSTAGE_POS)

    @property
    def ee(self) -> np.ndarray:
        """(nsim, 3) m, the end effector in the base frame."""
        return self._site_xpos[:, self._site]

    @property
    def jacobian(self) -> np.ndarray:
        """(nsim, 3, n) m/rad, translational Jacobian of the end effector: axis x (ee - anchor) for hinges."""
        return np.cross(self._xaxis, self.ee[:, None] - self._xanchor).transpose(0, 2, 1)


def _quaternions(rotation: np.ndarray) -> np.ndarray:
    """Return (..., 4) w x y z for rotation matrices (..., 3, 3)."""
    from scipy.spatial.transform import Rotation

    flat = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_quat(scalar_first=True)
    return flat.reshape(*rotation.shape[:-2], 4)
