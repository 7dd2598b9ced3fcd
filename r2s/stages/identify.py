"""stage=identify: recording -> parameters.yaml, errors on training and validation motion, figures."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from r2s.errors import UserError, check_number
from r2s.stages.build import check_source, console, make_dynamics, make_robot, open_run
from r2s.stages.contact import calibrated_arm, contact_data, identify_surface, keep_calibration
from r2s.stages.data import check_cutoff, check_data, file_data, ramp_poses, read_motion, read_user_ramps, record_arm
from r2s.stages.parts import called, part, plain
from r2s.stages.payload import identify_load, loaded_data, torque_of_calibration

WHY = {
    "arm": "only data=arm moves an arm",
    "inertia": "calibration= gives the links",
    "friction": "calibration= gives the friction; friction.family= may change its law",
}


def reads(cfg):
    """Return the keys of the config that this stage reads."""
    keys = {"robot", "calibration", "identify", "search", "data"}
    keys |= {"friction.family"} if cfg.calibration else {"friction", "inertia"}
    return keys | ({"arm"} if cfg.data.kind == "arm" else set())


def make_settings(cfg, torque):
    """Return the `Settings` of an identification with this kind of torque."""
    from r2s.identification.settings import Settings

    settings: dict[str, Any] = plain(cfg.identify)
    del settings["validation_fraction"]
    for key in ("terms", "prior", "candidate_terms", "prunable_terms"):
        settings[key] = settings[key][torque]
    own = {"family": cfg.friction.family, "seed": cfg.seed, "nthread": cfg.threads}
    return called(Settings, "identify", settings | own)


@dataclass(frozen=True)
class Parts:
    """Inputs of an identification, made and checked before there is a run folder.

    With an arm, `train`, `validation` and `ramps` are recorded later, along `motion`.
    """

    robot: Any
    nominal: Any
    searches: list[Any]
    inputs: list[Path | str]
    motion: Any = None
    train: Any = None
    validation: Any = None
    ramps: Any = None
    contact: Any = None
    loaded: Any = None


def make_parts(cfg):
    """Return the inputs of an identification; a real arm is not touched.

    Raises:
        UserError: the config contradicts itself, or a file is missing or wrong.
    """
    from r2s.excitation.motion import load

    robot = make_robot(cfg)
    nominal = make_dynamics(cfg, robot)
    searches = [part(node, f"search.{k}") for k, node in enumerate(cfg.search)]
    check_number("identify.validation_fraction", cfg.identify.validation_fraction, "(0, 1)")
    if cfg.data.torque in cfg.identify.terms:
        make_settings(cfg, cfg.data.torque)
    if cfg.data.kind == "recording":
        file = file_data(cfg)
        contact, loaded = contact_data(cfg, robot, file), loaded_data(cfg, robot, file)
        train, validation = read_motion(robot, file, cfg.identify.validation_fraction)
        check_cutoff(cfg.identify.cutoff_hz, (train, validation))
        ramps = read_user_ramps(robot, file)
        files = [*file.files, *(f for more in (contact, loaded) if more for f in more.files)]
        return Parts(robot, nominal, searches, files, None, train, validation, ramps, contact, loaded)
    check_data(cfg)
    check_cutoff(cfg.identify.cutoff_hz, ())
    ramp_poses(cfg, robot)
    check_source(cfg, robot)
    if not cfg.data.excitation:
        return Parts(robot, nominal, searches, [])
    return Parts(robot, nominal, searches, [cfg.data.excitation], load(cfg.data.excitation, robot))


def with_known_arm(cfg):
    """Return the data option to identify on top of the arm that `calibration=` gives, or None.

    Raises:
        UserError: neither `calibration=` nor data.path= gives the arm.
    """
    from omegaconf import OmegaConf

    key = next((k for k in ("contact", "loaded") if cfg.data.get(k)), None)
    if key is None or not OmegaConf.is_missing(cfg.data, "path"):
        return None
    if not cfg.calibration:
        what = {"contact": "its free motion", "loaded": "its motion without payload"}[key]
        raise UserError(f"data.{key}: give the arm by calibration=RUN_FOLDER, or {what} by data.path=FILE")
    return key


def identify_with_known_arm(cfg, overrides, key):
    """Presses -> contact.yaml, or a loaded recording -> payload.yaml, on top of the arm of `calibration=`."""
    robot = make_robot(cfg)
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


def identify(cfg, overrides):
    """Recording -> parameters.yaml, errors on training and validation motion, figures."""
    if key := with_known_arm(cfg):
        identify_with_known_arm(cfg, overrides, key)
        return
    from r2s.identification.arm_uncertainty import Arm
    from r2s.identification.identify import identify as run_identify
    from r2s.identification.parameter_file import save_parameters
    from r2s.identification.prediction import prediction_errors
    from r2s.identification.verdict import judge
    from r2s.physics.crisp import write_crisp
    from r2s.physics.description import write_description
    from r2s.progress import Progress
    from r2s.recordings.speed_noise import speed_noise
    from r2s.reporting.identification.page import identification_page
    from r2s.reporting.identification.tables import identification_table
    from r2s.runs import write_json

    made = make_parts(cfg)
    robot, nominal = made.robot, made.nominal
    train, validation, ramps = made.train, made.validation, made.ramps
    with open_run(cfg, overrides, made.inputs) as run:
        if cfg.data.kind != "recording":
            train, validation, ramps = record_arm(cfg, robot, run, made.motion)
        settings = make_settings(cfg, train.torque)
        verdict = judge(robot, nominal, train, settings)
        write_json(run.folder / "verdict.json", verdict.document())
        verdict.refuse()
        for warning in verdict.warnings:
            print(f"warning: {warning}")
        nominal = replace(nominal, speed_noise=speed_noise([train, validation]))
        progress = Progress("identify")

        def report(row):
            cost = f"cost {row.get('cost', float('nan')):.4g}"
            progress(row["done"] / row["total"], f"{row['search']}, {row['evaluations']} candidates, {cost}")

        found = run_identify(
            robot, nominal, train, made.searches, settings, ramps=ramps, report=report, memo=run.memo
        )
        progress.close()
        for line in found.at_bounds:
            print(f"warning: {line}")
        how = {"window_s": settings.window_s, "cutoff_hz": settings.cutoff_hz}
        summary = {
            side: prediction_errors(robot, nominal, found.dynamics, data, **how, nthread=cfg.threads)
            for side, data in (("train", train), ("validation", validation))
        }
        source = {"recording": train.name, "torque": train.torque, "run": str(run.folder)}
        save_parameters(run.folder / "parameters.yaml", *found.saved, source, found.note)
        found.history.to_csv(run.folder / "metrics.csv", index=False)
        for row in found.history.to_dict("records"):
            run.track("metrics", row)
        for line in write_description(run.folder / "model", robot, found.dynamics):
            print(line)
        if train.torque != "measured":  # a link-side sensor does not see the friction that a command must overcome
            write_crisp(run.folder / "model" / "crisp_friction.yaml", robot, found.dynamics)
        run.summary(summary)
        identification_page(run, robot, nominal, found, validation, summary, **how)
        identification_table(console(), robot, found, summary)
        arm = Arm(found.space, found.x, found.found.samples)
        if made.contact:
            run.summary(summary | {"contact": identify_surface(cfg, run, arm, made.contact)})
        if made.loaded:
            run.summary(summary | {"payload": identify_load(cfg, run, arm, made.loaded)})
    print(f"written: {run.folder}")
