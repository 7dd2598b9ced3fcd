"""stage=excite: design an excitation for an arm that another program drives; write CSV and a ROS 2 trajectory."""

from dataclasses import dataclass, replace

from r2s.errors import UserError, check_number, choices, nearest
from r2s.stages.build import base_dynamics, console, make_robot, open_run
from r2s.stages.parts import called, plain

WHY = {
    "arm": "nothing moves",
    "data": "nothing is recorded; excite.torque says what will be",
    "inertia": "calibration= gives the links",
    "friction": "calibration= gives the friction; friction.family= may change its law",
}


def reads(cfg):
    """Return the config keys that stage=excite reads."""
    return {"robot", "calibration", "identify", "excite"} | (
        {"friction.family"} if cfg.calibration else {"friction", "inertia"}
    )


@dataclass(frozen=True)
class Excite:
    """Settings of conf/stage/excite.yaml.

    Raises:
        UserError: a value is outside its range.
    """

    seconds: float
    torque: str
    parameters: list[str]
    effort: int
    noise: float
    q_center: list[float] | None
    speed_share: float
    table: float | None
    z_min: float | None
    obstacles: list[dict]
    ros_hz: float

    def __post_init__(self):
        from r2s.excitation.design import LONGEST_S
        from r2s.excitation.fourier import LEAST_S
        from r2s.recordings.recording import TORQUES

        check_number("seconds", self.seconds, f"[{LEAST_S:g}, {LONGEST_S:g}]")
        if self.torque not in TORQUES:
            near = nearest(self.torque, TORQUES)
            raise UserError(f"torque: expected {choices(TORQUES)}, got {self.torque!r}{near}")
        check_number("effort", self.effort, "[0, inf)", whole=True)
        check_number("noise", self.noise, "(0, 1]")
        check_number("speed_share", self.speed_share, "(0, 1]")
        check_number("ros_hz", self.ros_hz, "[1, 1000]")
        for name in ("table", "z_min"):
            if getattr(self, name) is not None:
                check_number(name, getattr(self, name), "(-inf, inf)")
        for name in ("parameters", "obstacles"):
            if not isinstance(getattr(self, name), list):
                raise UserError(f"{name}: expected a list, got {getattr(self, name)!r}")


def make_design(cfg, robot, how):
    """Return the `PlannedWidths`: predicted widths of the parameters' intervals, which the design minimizes."""
    from r2s.identification.planned_width import PlannedWidths
    from r2s.stages.prior import make_settings

    nominal = base_dynamics(cfg, robot)
    try:
        return PlannedWidths(
            robot, nominal, make_settings(cfg, how.torque), how.torque, noise=how.noise, chosen=how.parameters
        )
    except UserError as error:
        raise UserError(f"excite.{error}" if str(error).startswith("parameters:") else str(error)) from None


def excite(cfg, overrides):
    """Design an excitation; write excitation.csv, trajectory.yaml, expected interval widths and a figure."""
    import numpy as np

    from r2s.excitation.design import designed, trajectory_yaml
    from r2s.excitation.fourier import checked_center
    from r2s.excitation.motion_checks import Space
    from r2s.files import atomic_write
    from r2s.physics.obstacle import boxes
    from r2s.progress import Progress
    from r2s.reporting.excitation import excitation_page

    how = called(Excite, "excite", plain(cfg.excite))
    robot = make_robot(cfg)
    planned = replace(robot, dq_max=how.speed_share * robot.dq_max)
    design = make_design(cfg, planned, how)
    low = {k: -np.inf if getattr(how, k) is None else getattr(how, k) for k in ("table", "z_min")}
    try:
        space = Space(robot, **low, obstacles=boxes("excite.obstacles", how.obstacles))
        center = checked_center(planned, space, how.q_center)
    except UserError as error:
        raise UserError(str(error).replace("excitation.q_center", "excite.q_center")) from None
    with open_run(cfg, overrides) as run:
        progress = Progress("excite")
        rest = {"seconds": how.seconds, "center": center, "seed": cfg.seed, "effort": how.effort}
        motion = designed(planned, design, space, **rest, report=progress)
        progress.close(f"{motion.t[-1]:.1f} s of motion")
        motion.save(run.folder / "excitation.csv")
        names = [robot.model(gravity=False).joint(j).name or f"joint{j + 1}" for j in range(robot.n)]
        with atomic_write(run.folder / "trajectory.yaml") as part:
            part.write_text(trajectory_yaml(motion, names, how.ros_hz))
        run.summary(excitation_page(console(), run, robot, motion, design))
    print(f"written: {run.folder}")
