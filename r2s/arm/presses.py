"""Record an arm while it presses on a surface and slides along it, to identify the surface.

The arm performs `task=wipe`: hybrid control with the identified model moves the tip along paths on the surface. The
contact force rises along the first path, falls along the second, and so on. The joints must move, because stiction of
a resting joint hides contact force (docs/how_to/surfaces.md).
"""

import itertools
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from r2s.arm.command_loop import CommandLoop
from r2s.arm.interface import Arm, ArmState, ArmStopped, speed_share
from r2s.arm.policy_runner import episode_driver
from r2s.arm.realtime import Timing
from r2s.errors import UserError, check_number
from r2s.excitation.motion_checks import Space
from r2s.excitation.paths import approach
from r2s.physics.dynamics import Dynamics
from r2s.physics.impedance import FORCE_MAX
from r2s.physics.push_limit import PushLimit
from r2s.physics.robot import SIM_DT, Robot
from r2s.recordings.recording import Recording
from r2s.tasks.wipe import WipeTask

LOADS = 0.25, 0.9  # lowest and highest force of a path, as shares of the controller's largest force
PAUSE_S = 2.0  # s, recorded gap between paths, so that identification/contact treats each path as a separate press


@dataclass(frozen=True)
class PressPlan(WipeTask):
    """Wipe task for recordings: the contact force rises along the first path, falls along the second, and so on."""

    speed: tuple[float, float] = (0.05, 0.1)
    force: tuple[float, float] = (1.0, 2.0)  # see `press_plan`

    def goals(self, robot: Robot, rng: np.random.Generator, count: int) -> np.ndarray:
        """Return the goals of `WipeTask` with this plan's forces; every second path begins with the larger force."""
        goals = super().goals(robot, rng, count)
        goals[:, 6:8] = self.force
        goals[1::2, 6:8] = self.force[::-1]
        return goals


def press_plan(
    robot: Robot,
    dynamics: Dynamics,
    point: Sequence[float] | None = None,
    normal: Sequence[float] | None = None,
    force_max: float | None = None,
    speed_near: float | None = None,
) -> PressPlan:
    """Return the plan for a plane whose point (3,) m and normal (3,) are known within 5 mm and 5 degrees.

    If `force_max` (N) and `speed_near` (m/s) are given, the driver limits push and closing speed, see `PushLimit`.
    The plan's forces are then low enough to respect `force_max`, however much force joint friction hides.

    Raises:
        UserError: the robot has no tool, the plane is invalid, or a limit is out of range or too low to press.
    """
    plan = PressPlan(point=point, normal=normal).with_model(robot, dynamics)  # type: ignore[arg-type]
    most = float(plan.own.parameters[FORCE_MAX])  # type: ignore[union-attr]
    low, high = (share * most for share in LOADS)
    if force_max is not None:
        check_number("safety.force_max", force_max, "(0, inf)")
        hidden = PushLimit(force_max, 1.0, *plan.plane(robot)).at(robot, dynamics.level, robot.q_home)[1]
        if (least := low + 2.0 * hidden) > force_max:
            raise UserError(
                f"safety.force_max: {force_max:g} N is not allowed with data.presses; {least:.3g} N or more is: the "
                f"largest force is {low:.3g} N or more, and joint friction may hide {hidden:.2g} N in each direction"
            )
        high = min(high, (force_max - 2.0 * hidden) * (1.0 - 1e-9))  # so that round-off does not exceed `force_max`
        low *= high / (LOADS[1] * most)
    return replace(plan, force=(low, high)).pushing_within(robot, dynamics.level, force_max, speed_near)


def record_presses(
    arm: Arm,
    plan: PressPlan,
    dynamics: Dynamics,
    count: int,
    *,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
    timing: Timing | None = None,
) -> Recording:
    """Follow `count` random paths on the surface; return a recording with commanded torque, one trajectory per path.

    The rows have the format of `r2s.arm.recorder.record`. The recorded time has gaps of PAUSE_S between paths.

    Args:
        arm: the arm, which moves to a posture above the start of each path, and always stops at the end.
        seed: random seed of the paths. progress: called after every path with (paths done, total).
        timing: receives the durations of the cycles. dynamics: dynamics of the arm.

    Raises:
        ArmStopped: arm or driver stopped the motion, or commands came late. The exception's `recording` contains the
            completed paths, if any.
        UserError: the tip cannot reach the surface, or no safe path leads to the start of a path.
    """
    robot, control = arm.robot, plan.control(arm.robot)
    goals = plan.goals(robot, np.random.default_rng(seed), count)
    starts = plan.begin(np.zeros((count, robot.n)), goals)
    space = Space(robot)
    for k, start in enumerate(starts, 1):
        approach(robot, robot.q_home, start, what=f"the start of path {k}", space=space)
    log: deque[tuple[ArmState, np.ndarray]] = deque()
    share = speed_share(arm)
    loop = CommandLoop(arm, episode_driver(robot, plan, 0.0, dynamics.level, dynamics.armature, share), log)
    idle, timing, ends = np.zeros((1, control.action_dim)), timing or Timing(), [0]
    try:
        for k in range(count):
            loop.place(starts[k])
            timing.begin()
            for step in range(plan.steps):
                command = control.command(idle, plan, np.array([step / plan.ctrl_hz]), goals[k : k + 1])[0]
                hold = control.holding_torque(loop.state.q)
                for cycle in range(plan.substeps):
                    loop(command if cycle == 0 else None, hold)
                    timing.cycle(loop.clock, loop.state)
            loop.settle()
            if (reason := loop.end()) is not None:
                raise ArmStopped(reason)
            timing.check(arm)
            ends.append(len(log))
            if progress is not None:
                progress(k + 1, count)
    except ArmStopped as stop:
        if len(ends) > 1:
            stop.recording = _recording(log, ends, robot.name)
        raise
    finally:
        loop.end()
    return _recording(log, ends, robot.name)


def _recording(log: deque[tuple[ArmState, np.ndarray]], ends: list[int], name: str) -> Recording:
    """Return the recording of the completed paths; rows ends[k] to ends[k + 1] of `log` belong to path k."""
    rows = list(log)[: ends[-1]]
    path = np.repeat(np.arange(len(ends) - 1), np.diff(ends))
    t, q, dq, tau = (np.array(x) for x in zip(*((s.t, s.q, s.dq, sent) for s, sent in rows), strict=True))
    for begin, end in itertools.pairwise(ends):  # the arm's clock starts again at each path
        t[begin:end] += (0.0 if begin == 0 else t[begin - 1] + SIM_DT + PAUSE_S) - t[begin]
    return Recording(t=t, q=q, dq=dq, tau=tau, torque="commanded", trajectory=path, name=name)
