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
from r2s.stages.gears import check_alone, check_motions, identify_gears, recorded_slides, slides_in_file
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
    files, entry, identified = _prepared(cfg, robot, key)
    with open_run(cfg, overrides, files) as run:
        found = identified(run)
        keep_calibration(cfg, run)
        run.summary({entry: found})
    print(f"written: {run.folder}")


def _prepared(cfg, robot, key):
    """Check all inputs; return the files to read, the result's key in summary.json, and a function of the open run.

    The function records the arm unless a file is given, identifies, and returns the entry for summary.json.
    """
    stated_stiffness(cfg, robot)  # checks identify.gears
    if key == "gears":
        if cfg.data.kind == "recording":
            slides, path = slides_in_file(cfg, robot)
            arm = calibrated_arm(cfg, robot)
            return [path], key, lambda run: identify_gears(cfg, run, arm, slides)
        check_motions(cfg, robot)
        arm = calibrated_arm(cfg, robot)
        return [], key, lambda run: identify_gears(cfg, run, arm, recorded_slides(cfg, run, robot))
    if key == "presses":
        arm = calibrated_arm(cfg, robot)
        plan = press_parts(cfg, robot, arm)
        return [], "contact", lambda run: identify_surface(cfg, run, arm, pressed_surface(cfg, run, arm, plan))
    file = file_data(cfg, cfg.data[key])
    if key == "contact":
        data = contact_data(cfg, robot, file)
        arm = calibrated_arm(cfg, robot)
        return data.files, key, lambda run: identify_surface(cfg, run, arm, data)
    data = loaded_data(cfg, robot, file, torque_of_calibration(cfg, file.torque))
    arm = calibrated_arm(cfg, robot)
    return data.files, "payload", lambda run: identify_load(cfg, run, arm, data)
