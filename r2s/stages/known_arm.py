"""stage=identify with the arm of `calibration=`: identify only gears, a surface or a payload."""

from r2s.errors import UserError
from r2s.stages.build import make_robot, open_run
from r2s.stages.contact import (
    calibrated_arm,
    contact_data,
    identify_surface,
    keep_calibration,
    press_parts,
    pressed_surface,
    stated_stiffness,
)
from r2s.stages.data import file_data
from r2s.stages.gears import check_alone, check_motions, gear_file, identify_gears, recorded_slides
from r2s.stages.payload import identify_load, loaded_data, torque_of_calibration


def with_known_arm(cfg):
    """Return the option of `data` (gears, presses, contact, loaded) that needs an arm from `calibration=`, or None.

    Raises:
        UserError: the option needs an identified arm, but `calibration=` and data.path= are missing.
    """
    from omegaconf import OmegaConf

    if cfg.data.get("gears"):
        check_alone(cfg)
        return "gears"
    if cfg.data.get("presses"):
        if not cfg.calibration:
            raise UserError("data.presses: give the arm, identified from free motion, by calibration=RUN_FOLDER")
        return "presses"
    key = next((k for k in ("contact", "loaded") if cfg.data.get(k)), None)
    if key is None or not OmegaConf.is_missing(cfg.data, "path"):
        return None
    if not cfg.calibration:
        what = {"contact": "its free motion", "loaded": "its motion without payload"}[key]
        raise UserError(f"data.{key}: give the arm by calibration=RUN_FOLDER, or {what} by data.path=FILE")
    return key


def identify_with_known_arm(cfg, overrides, key):
    """Identify gears, a surface or a payload with the model of `calibration=`; write the corresponding file."""
    robot = make_robot(cfg)
    if key == "gears":
        _identify_gears(cfg, overrides, robot)
        return
    stated_stiffness(cfg, robot)
    if key == "presses":
        arm = calibrated_arm(cfg, robot)
        plan = press_parts(cfg, robot, arm)
        with open_run(cfg, overrides) as run:
            entry = identify_surface(cfg, run, arm, pressed_surface(cfg, run, arm, plan))
            keep_calibration(cfg, run)
            run.summary({"contact": entry})
        print(f"written: {run.folder}")
        return
    file = file_data(cfg, cfg.data[key])
    if key == "contact":
        data = contact_data(cfg, robot, file)
    else:
        data = loaded_data(cfg, robot, file, torque_of_calibration(cfg, file.torque))
    arm = calibrated_arm(cfg, robot)
    with open_run(cfg, overrides, data.files) as run:
        entry = (identify_surface if key == "contact" else identify_load)(cfg, run, arm, data)
        keep_calibration(cfg, run)
        run.summary({"contact" if key == "contact" else "payload": entry})
    print(f"written: {run.folder}")


def _identify_gears(cfg, overrides, robot):
    """Identify the gears from data.gears=FILE, or from a motion of the arm; write gears.yaml."""
    recording, files = None, []
    if cfg.data.kind == "recording":
        recording, path = gear_file(robot, file_data(cfg, cfg.data.gears))
        files = [path]
    else:
        check_motions(cfg, robot)
    arm = calibrated_arm(cfg, robot)
    with open_run(cfg, overrides, files) as run:
        if recording is None:
            recording = recorded_slides(cfg, run, robot)
        entry = identify_gears(cfg, run, arm, recording)
        keep_calibration(cfg, run)
        run.summary({"gears": entry})
    print(f"written: {run.folder}")
