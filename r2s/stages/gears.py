"""stage=identify data.gears: identify the stiffness of elastic gears; write gears.yaml."""

from r2s.errors import UserError
from r2s.files import located
from r2s.stages.build import check_source, console, opened_source, planned_speed_share
from r2s.stages.data import check_data, file_data, read_file
from r2s.stages.recordings import recorded_once

ALONE = "identify the gears first, then name their run folder: identify.gears.stiffness=RUN_FOLDER"
OTHERS = (
    *("path", "validation", "ramps", "presses", "contact", "contact_validation"),
    *("loaded", "declared_payload", "payload", "excitation"),
)


def check_alone(cfg):
    """Raise UserError if data.gears is combined with another recording, or if calibration= is missing."""
    from omegaconf import OmegaConf

    for key in OTHERS:
        if not OmegaConf.is_missing(cfg.data, key) and cfg.data.get(key):
            raise UserError(f"data.gears: cannot be combined with data.{key}; {ALONE}")
    if cfg.data.torque not in (None, "commanded"):
        raise UserError(f"data.gears: gears need commanded torque, not data.torque={cfg.data.torque}")
    if (cfg.identify.get("gears") or {}).get("stiffness") is not None:
        raise UserError("data.gears: identifies the stiffness that identify.gears.stiffness gives; leave one out")
    if cfg.data.kind == "recording" and not isinstance(cfg.data.gears, str):
        raise UserError(f"data.gears: expected a file with slides, got {cfg.data.gears!r}; data=arm records slides")
    if not cfg.calibration:
        raise UserError("data.gears: give the arm, identified from free motion, by calibration=RUN_FOLDER")


def slides_in_file(cfg, robot):
    """Return the recording in data.gears=FILE and its path; raise UserError if the file is invalid."""
    from r2s.identification.checks import check_recording

    file = file_data(cfg, cfg.data.gears)
    path = located(file.gears)
    recording = read_file(robot, file, path, torque="commanded")
    check_recording(robot, recording)
    return recording, path


def check_motions(cfg, robot):
    """Raise UserError if the settings of data=arm are invalid, or if a planned slide violates a limit or collides."""
    from r2s.arm.gear_motions import check_gear_motions

    check_data(cfg)
    check_source(cfg, robot)
    check_gear_motions(robot, planned_speed_share(cfg))


def recorded_slides(cfg, run, robot):
    """Let one joint after another slide, and return the recording; see `recorded_once`."""
    from r2s.arm.gear_motions import record_gear_motions

    def slide(progress, timing):
        with opened_source(cfg, robot, 4) as arm:
            show = lambda k, n: progress(k / n, f"{k} joints")  # noqa: E731
            return record_gear_motions(arm, progress=show, timing=timing)

    return recorded_once(run, "gears", "slide joint by joint", slide)


def identify_gears(cfg, run, arm, recording):
    """Identify the gears; write gears.yaml and a figure, print the table, return the entry for summary.json."""
    from r2s.identification.gears.estimate import identify_gears
    from r2s.identification.gears.gears_file import save_gears
    from r2s.progress import Progress
    from r2s.reporting.identification.gears import gears_figure, gears_table
    from r2s.reporting.tables import print_table

    progress = Progress("gears")
    found = identify_gears(arm, recording, seed=cfg.seed, report=progress)
    progress.close()
    source = {"recording": recording.name, "calibration": cfg.calibration, "run": str(run.folder)}
    save_gears(run.folder / "gears.yaml", arm.robot, found, source)
    gears_figure(run.figure("gears"), found)
    print_table(console(), gears_table(found), "gears, 95 % intervals")
    if unseen := [str(i + 1) for i, seen in enumerate(found.identifiable) if not seen]:
        print(f"warning: gears of joints {', '.join(unseen)} not determined: rigid gears, or encoders on the links?")
    entry = {"stiffness_Nm_per_rad": found.drives.stiffness.tolist(), "relative_sd": found.spread.tolist()}
    return entry | {"identifiable": found.identifiable.tolist()}
