"""Simulator of many arms at once: `mujoco.batch.Batch` with friction, control law and safety filter in each step.

The simulation has no gravity, and commanded torques exclude gravity (libfranka's convention), because the arm adds
its own gravity compensation. The arm computes gravity compensation from the nominal links and the declared payload.
The simulation adds only the torque error of gravity compensation (r2s/physics/mujoco_callback.py).
"""

from collections.abc import Mapping

import mujoco
import mujoco.batch
import numpy as np

from r2s.compiled import njit
from r2s.physics import mujoco_callback as native
from r2s.physics.actuation import low_pass_factor, steps_late
from r2s.physics.contact_layout import (
    COLUMNS,
    DEFLECTION,
    DEPTH,
    FORCE,
    NORMAL,
    RADIUS,
    TIP,
    box_pose,
    contact_columns,
)
from r2s.physics.control_laws import ControlLaw, law_number
from r2s.physics.dynamics import Dynamics
from r2s.physics.push_limit import COLUMNS as PUSH_COLUMNS
from r2s.physics.push_limit import PushLimit
from r2s.physics.rigid_body import principal_axes, set_links
from r2s.physics.robot import SIM_DT, Robot


class Simulator:
    """Batch of `nsim` simulated arms, each with its own `Dynamics`, on `nthread` threads (0: all CPUs).

    The simulated motion is bit-identical for any number of threads.

    Args:
        robot: robot to simulate; a robot with a tool may touch a surface (`Dynamics.surface`).
        dynamics: one `Dynamics` for all arms, or a batch of `nsim`. nsim, nthread: numbers of arms and threads.
        dt: duration of a physics step, s.
        control: control law that maps commands to torques; if None, the caller passes torques to `rollout`.
    """

    def __init__(
        self,
        robot: Robot,
        dynamics: Dynamics,
        nsim: int,
        nthread: int = 0,
        dt: float = SIM_DT,
        control: ControlLaw | None = None,
    ):
        self._control, self._kept = control, native.KEPT * robot.n
        self._touching, pushing = (0, 0) if robot.tool is None else (COLUMNS, PUSH_COLUMNS)
        self._law_number = native.NO_CONTROL if control is None else float(law_number(control.law))
        native.install()
        self.robot = robot
        sizes = (0, 0, 0) if control is None else (control.command_size, control.memory_size, len(control.parameters))
        self._sizes = sizes
        self._push_at = self._kept + sum(sizes)
        self._contact_at = self._push_at + pushing
        memory = self._contact_at + self._touching
        self.model = robot.model(gravity=False, user=native.WIDTH, memory=memory, dt=dt)
        self.batch = mujoco.batch.Batch(self.model, nsim, nthread)
        self.nsim = nsim
        self._bodies = self.model.jnt_bodyid
        self._site = self.model.site(robot.ee_site).id
        self._user = self.batch.expand("jnt_user")
        self._damping = self.batch.expand("dof_damping")  # one array per arm, for the slope of its friction
        self._armature = self.batch.expand("dof_armature")
        self._inertia = self.batch.expand("body_inertia")
        self._iquat = self.batch.expand("body_iquat")
        self._mass, self._com = self.batch.expand("body_mass"), self.batch.expand("body_ipos")
        self._offset = np.zeros((nsim, robot.n))  # offsets of the dynamics, without the torques of `push`
        self.q = self.batch.bind("qpos")
        self.dq = self.batch.bind("qvel")
        self._memory = self.batch.bind("userdata")
        self._parameters = self._memory[:, self._kept + sizes[0] + sizes[1] : self._push_at]
        self._push, self._push_limit = self._memory[:, self._push_at : self._contact_at], np.zeros(pushing)
        self._contact = self._memory[:, self._contact_at :]
        self._surfaces = np.zeros((nsim, self._touching))  # initial contacts, which `reset` copies into the memory
        self._xanchor, self._xaxis = self.batch.bind("xanchor"), self.batch.bind("xaxis")
        self._xpos, self._xmat = self.batch.bind("xpos"), self.batch.bind("xmat")
        self._site_xpos = self.batch.bind("site_xpos")
        self.set_dynamics(dynamics)

    def set_dynamics(self, dynamics: Dynamics, ids: np.ndarray | None = None, repeat: int = 1) -> None:
        """Set the dynamics of the arms `ids`, by default of all arms.

        A field without a batch axis applies to all `ids`; each entry of a batch applies to `repeat` consecutive arms.
        """
        arms = np.arange(self.nsim) if ids is None else np.asarray(ids)
        moments, axes = principal_axes(dynamics.inertia)

        def spread(a: np.ndarray, without: int) -> np.ndarray:
            return np.repeat(a, repeat, axis=0) if a.ndim > without and repeat > 1 else a

        at = arms[:, None], self._bodies
        self._user[arms, :, : native.LIMITS] = spread(_law_columns(self.robot, self.model, dynamics), 2)
        self._offset[arms] = self._user[arms, :, native.OFFSET]
        self._damping[arms] = self.model.dof_damping
        self._armature[arms] = spread(dynamics.armature, 1)
        self._inertia[at] = spread(moments, 2)
        self._iquat[at] = spread(axes, 2)
        self._mass[at] = spread(dynamics.mass, 1)
        self._com[at] = spread(dynamics.com, 2)
        self._user[arms, :, native.CONTACT] = 0.0 if dynamics.surface is None else self._contact_at
        if dynamics.surface is not None:
            self._surfaces[arms] = spread(contact_columns(self.robot, dynamics.surface), 1)
            self._contact[arms, :DEFLECTION] = self._surfaces[arms, :DEFLECTION]
        self.batch.set_const(ids)

    def drive(
        self,
        limits: np.ndarray,
        torque_limit: np.ndarray | float = np.inf,
        cutoff_hz: float = np.inf,
        soft_start_s: float = 0.0,
        push_limit: PushLimit | None = None,
    ) -> None:
        """Enable control law, torque low-pass, limits, safety filter, delay and lag in all later steps.

        Without a control law, the torques passed to `rollout` are the efforts that enter the safety filter.

        Args:
            limits: (n, COLUMNS), limits of the safety filter, see `r2s.physics.safety_filter.filter_limits`.
            torque_limit: (n,) Nm, largest target torque. cutoff_hz: Hz, cutoff of the torque low-pass.
            soft_start_s: s, fade-in time of torque after `reset`. push_limit: push limit of a tool; None: no limit.
        """
        u = native
        self._user[:, :, u.LIMITS : u.LIMITS + limits.shape[1]] = limits
        self._user[:, :, u.CONTROL] = self._law_number
        self._user[:, :, u.FADE] = round(soft_start_s / SIM_DT)
        self._user[:, :, u.LOW_PASS] = low_pass_factor(cutoff_hz)
        self._user[:, :, u.TARGET_MAX] = torque_limit
        self._user[:, :, u.COMMANDS : u.PARAMETERS + 1] = self._sizes
        self._user[:, :, u.PUSH] = 0.0 if push_limit is None else self._push_at
        if push_limit is not None:
            self._push[:] = self._push_limit = push_limit.columns(self.robot)

    def command(self, command: np.ndarray, speed_noise: np.ndarray | None = None) -> None:
        """Set the commands (nsim, c) of the arms' control laws until the next call of `command`.

        speed_noise: (nsim, n) rad/s, sensor noise on the speeds that the law receives; None: the last noise stays;
        `reset` sets the noise to 0.
        """
        n = self.robot.n
        self._memory[:, self._kept : self._kept + self._sizes[0]] = command
        if speed_noise is not None:
            self._memory[:, native.NOISE * n : (native.NOISE + 1) * n] = speed_noise

    def push(self, tau: np.ndarray) -> None:
        """Apply external joint torques tau (nsim, n) Nm, in addition to offsets, until the next call of `push`."""
        self._user[:, :, native.OFFSET] = self._offset + tau

    def reset(
        self, q: np.ndarray, dq: np.ndarray, ids: np.ndarray | None = None, bristle: np.ndarray | float = 0.0
    ) -> None:
        """Set q (m, n) rad and dq (m, n) rad/s of the arms `ids` (by default all), and update their kinematics.

        bristle: (m, n), bristle deflection from -1 to 1, for friction laws with memory.
        """
        self.batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        at = slice(None) if ids is None else ids
        self.q[at] = q
        self.dq[at] = dq
        self._memory[at] = 0.0
        self._memory[at, : self.robot.n] = bristle
        if self._control is not None:
            self._parameters[at] = self._control.parameters
        self._contact[at] = self._surfaces[at]
        self._push[at] = self._push_limit
        self._damping[at] = self.model.dof_damping
        self.batch.forward(ids, stage=mujoco.mjtStage.mjSTAGE_POS)

    def state(self) -> dict[str, np.ndarray]:
        """Return a copy of the complete state of the arms, for `set_state`."""
        return {name: array.copy() for name, array in self._arrays().items()}

    def set_state(self, state: Mapping[str, np.ndarray]) -> None:
        """Restore a state that `state` returned; the same torques then cause the same motion, bit for bit."""
        for name in ("_user", "_armature", "_inertia", "_iquat", "_mass", "_com", "_offset", "_surfaces"):
            self._arrays()[name][:] = state[name]
        self.batch.set_const()
        self.batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
        for name in ("q", "dq", "_memory", "_damping"):
            self._arrays()[name][:] = state[name]
        self.batch.forward(stage=mujoco.mjtStage.mjSTAGE_POS)

    def _arrays(self) -> dict[str, np.ndarray]:
        names = ("q", "dq", "_memory", "_damping", "_user", "_armature", "_inertia", "_iquat", "_mass", "_com")
        return {name: getattr(self, name) for name in (*names, "_offset", "_surfaces")}

    def rollout(self, tau: np.ndarray, record: tuple[str, ...] = ("qpos",), ids: np.ndarray | None = None) -> dict:
        """Simulate steps with torques tau (m, nstep, n) Nm; return {"qpos": (m, nstep, n), ...} after each step."""
        spec = int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)
        return self.batch.rollout(tau.shape[1], tau, control_spec=spec, record=record, ids=ids)

    def kinematics(self) -> None:
        """Update the properties `ee` and `jacobian` after a rollout."""
        self.batch.forward(stage=mujoco.mjtStage.mjSTAGE_POS)

    @property
    def tau(self) -> np.ndarray:
        """Last torque (nsim, n) Nm that the safety filter commanded."""
        n = self.robot.n
        return self._memory[:, native.SENT * n : (native.SENT + 1) * n]

    @property
    def effort(self) -> np.ndarray:
        """Target torque (nsim, n) Nm after low-pass, clip and rate limit."""
        n = self.robot.n
        return self._memory[:, native.EFFORT * n : (native.EFFORT + 1) * n]

    @property
    def limited(self) -> np.ndarray:
        """Number of cycles (nsim,) since `reset` in which the safety filter changed the effort."""
        return self._memory[:, native.LIMITED * self.robot.n]

    @property
    def contact_force(self) -> np.ndarray:
        """Mean force (nsim, 3) N on the tool over the last step, in the base frame; requires a tool."""
        return self._contact[:, FORCE : FORCE + 3]

    @property
    def box(self) -> np.ndarray:
        """Pose (nsim, 6) of the box that the tool pushes: center, m, and first axis; requires a tool."""
        return box_pose(self._contact)

    @property
    def depth(self) -> np.ndarray:
        """Penetration (nsim,) m of the tool at the start of the last step, negative outside the surface."""
        return self._contact[:, DEPTH]

    def contact_torque(self) -> np.ndarray:
        """Return the joint torques (nsim, n) Nm that `contact_force` causes; requires a tool."""
        c, last = self._contact, self._bodies[-1]
        axes = self._xmat[:, last].reshape(-1, 3, 3)
        point = self._xpos[:, last] + (axes @ c[:, TIP : TIP + 3, None])[..., 0]
        point = point - c[:, RADIUS, None] * c[:, NORMAL : NORMAL + 3]
        return (self._xaxis * np.cross(point[:, None] - self._xanchor, self.contact_force[:, None])).sum(-1)

    @property
    def ee(self) -> np.ndarray:
        """Position (nsim, 3) m of the end effector in the base frame."""
        return self._site_xpos[:, self._site]

    @property
    def jacobian(self) -> np.ndarray:
        """Translational Jacobian (nsim, 3, n) m/rad of the end effector; a hinge's column is axis x (ee - anchor)."""
        return _jacobian(self._xaxis, self._xanchor, self.ee)


@njit(cache=True)
def _jacobian(axis, anchor, ee):
    out = np.empty((axis.shape[0], 3, axis.shape[1]))
    for i in range(axis.shape[0]):
        for j in range(axis.shape[1]):
            x, y, z = ee[i] - anchor[i, j]
            a, b, c = axis[i, j]
            out[i, 0, j], out[i, 1, j], out[i, 2, j] = b * z - c * y, c * x - a * z, a * y - b * x
    return out


def single_arm(robot: Robot, dynamics: Dynamics) -> mujoco.MjModel:
    """Return the model of one arm with links, rotors and friction law of `dynamics`, without gravity and contact."""
    native.install()
    memory = native.KEPT * robot.n + (0 if robot.tool is None else COLUMNS)
    model = robot.model(gravity=False, user=native.WIDTH, memory=memory)
    model.jnt_user[:, : native.LIMITS] = _law_columns(robot, model, dynamics)
    set_links(model, dynamics.mass, dynamics.com, dynamics.inertia, dynamics.armature)
    return model


def _law_columns(robot: Robot, model: mujoco.MjModel, d: Dynamics) -> np.ndarray:
    """Return the columns (..., n, LIMITS) of `jnt_user` that describe the arm."""
    f = native
    moment, nominal = d.mass[..., None] * d.com, robot.mass[:, None] * robot.com
    # error of gravity compensation, which uses the nominal links and the declared payload
    last = np.arange(robot.n) == robot.n - 1
    errors = (
        d.mass - robot.mass - last * d.declared_payload[..., :1],
        moment - nominal - last[:, None] * d.declared_payload[..., None, 1:],
    )
    arrays = (errors[0], d.phi[..., 0], d.offset, d.breakaway[..., 0], moment[..., 0], d.load, d.drag[..., 0])
    delay, lag = (late[..., None] for late in steps_late(d.delay, d.lag))
    rows = np.zeros((*np.broadcast_shapes(*(a.shape for a in (*arrays, delay, lag))), f.LIMITS))
    rows[..., f.MARK], rows[..., f.FAMILY] = f.MARKER, f.number(d.family, d.stiction_model)
    rows[..., f.P1 : f.P1 + d.phi.shape[-1]] = d.phi
    rows[..., f.OFFSET] = d.offset
    rows[..., f.BREAK_NEG : f.BREAK_POS + 1] = d.breakaway
    if not d.family.has_memory:  # a law with memory contains stiction, so no stiction model is needed
        rows[..., f.DQ_MIN], rows[..., f.NET] = d.dq_min, d.stiction_model == "net"
        rows[..., f.REST_NEG : f.REST_POS + 1] = d.family.at_rest(d.phi)
    rows[..., f.DAMPING] = model.dof_damping
    rows[..., f.DRAG_SIN : f.DRAG_COS + 1] = d.drag
    rows[..., f.LOAD], rows[..., f.BODY] = d.load, model.jnt_bodyid
    rows[..., f.STEP] = model.opt.timestep
    rows[..., f.MASS_ERROR] = errors[0]
    rows[..., f.MOMENT_ERROR : f.MOMENT_ERROR + 3] = errors[1]
    rows[..., f.MASS], rows[..., f.MOMENT : f.MOMENT + 3] = robot.mass, nominal
    rows[..., f.GRAVITY : f.GRAVITY + 3] = robot.gravity
    rows[..., f.DELAY], rows[..., f.LAG], rows[..., f.LEVEL] = delay, lag, d.level
    # only arms with changed links or load-dependent friction sum up masses in every step
    differs = (d.load != 0) | (errors[0] != 0) | (errors[1] != 0).any(-1)
    rows[..., f.LINK] = differs.any(-1, keepdims=True)
    return rows
