"""stage=identify data.contact=FILE or data.presses=N: identify a surface from contact; write contact.yaml."""

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from r2s.errors import UserError
from r2s.files import located
from r2s.stages.build import console
from r2s.stages.data import read_file
from r2s.stages.recordings import recorded_once

ARM = ("parameters.yaml", "posterior.npz")


@dataclass(frozen=True)
class ContactData:
    """Two recordings with contact and their files: `recording` for the fit, `held_out` (or None) for validation."""

    recording: Any
    held_out: Any
    files: list[Path]


def contact_data(cfg, robot, file):
    """Return the `ContactData` from data.contact and data.contact_validation; None without data.contact.

    file: `FileData` of the config, with the column names of the files.

    Raises:
        UserError: the tool, commanded torque or data.contact is missing, or a file is invalid.
    """
    from r2s.identification.checks import check_recording

    if not file.contact:
        if file.contact_validation:
            raise UserError("data.contact_validation: there is no data.contact= to validate")
        return None
    if robot.tool is None:
        raise UserError("robot.tool: data.contact needs the tip that touches: robot.tool=TOOL.json")
    if file.torque not in (None, "commanded"):
        raise UserError(f"data.contact: a surface is identified from commanded torque, not data.torque={file.torque}")
    files = [located(path) for path in (file.contact, file.contact_validation) if path]
    recordings = [read_file(robot, file, path, torque="commanded") for path in files]
    for recording in recordings:
        check_recording(robot, recording)
    return ContactData(recordings[0], recordings[1] if len(recordings) > 1 else None, files)


def stated_stiffness(cfg, robot):
    """Return the prior of gear stiffness from identify.gears; None if identify.gears.stiffness is unset.

    identify.gears.stiffness names a run folder with gears.yaml, or states values in Nm/rad. Stated values have the
    relative standard deviation identify.gears.accuracy.

    Raises:
        UserError: a value is invalid.
    """
    from r2s.identification.contact.surface_space import identified_gears, stated_gears
    from r2s.identification.gears.gears_file import load_gears
    from r2s.stages.parts import called, plain

    gears = plain(cfg.identify.get("gears"))  # older configs lack this key
    if gears is None:
        return None
    if not isinstance(gears, dict):
        raise UserError(f"identify.gears: expected identify.gears.stiffness= and .accuracy=, got {gears!r}")
    if isinstance(folder := gears.get("stiffness"), str):
        called(stated_gears, "identify.gears", gears | {"stiffness": None}, robot.tau_max)  # checks the rest
        found = load_gears(located(folder), robot, "identify.gears.stiffness")
        return called(identified_gears, "identify.gears", found, robot.tau_max)
    return called(stated_gears, "identify.gears", gears, robot.tau_max)


def press_parts(cfg, robot, arm):
    """Check the settings of data.presses before a run folder exists; return the `PressPlan`.

    Raises:
        UserError: the robot has no tool, the simulated arm has no surface, or a setting is invalid.
    """
    from r2s.arm.presses import press_plan
    from r2s.stages.build import check_source, is_simulated
    from r2s.stages.data import check_data
    from r2s.stages.parts import plain

    check_data(cfg)
    if robot.tool is None:
        raise UserError("robot.tool: data.presses needs the tip that touches: robot.tool=TOOL.json")
    if is_simulated(cfg) and not cfg.arm.get("surface"):
        raise UserError("arm.surface: data.presses touches a surface, and this arm has none; true is allowed")
    check_source(cfg, robot)
    plane = {"point": cfg.data.press_point, "normal": cfg.data.press_normal}
    plane = {k: None if v is None else tuple(v) for k, v in plane.items()}
    limits = plain(cfg.get("safety")) or {}  # older configs lack this key
    return press_plan(robot, arm.space.dynamics(arm.x), **plane, **limits)


def pressed_surface(cfg, run, arm, plan):
    """Let the arm press on the surface, and return the `ContactData`; see `recorded_once`."""
    from r2s.arm.presses import record_presses
    from r2s.stages.build import opened_arm

    def press(progress, timing):
        how = {"seed": cfg.data.excitation_seed, "timing": timing}
        with opened_arm(cfg, plan.model.robot, 3, plan) as connected:
            show = lambda k, n: progress(k / n, f"{k} paths")  # noqa: E731
            dynamics = arm.space.dynamics(arm.x)
            return record_presses(connected, plan, dynamics, cfg.data.presses, **how, progress=show)

    recording = recorded_once(run, "contact", "press and slide on the surface", press)
    return ContactData(recording, None, [run.folder / "contact.npz"])


def calibrated_arm(cfg, robot):
    """Return an `Arm`: the identified arm that `calibration=` names, with the posterior of the identification."""
    from r2s.identification.arm_uncertainty import Arm
    from r2s.identification.parameter_file import load_parameters, load_posterior
    from r2s.stages.run_config import modules

    space, x = load_parameters(cfg.calibration, robot, modules(cfg.get("trust")))
    return Arm(space, x, load_posterior(cfg.calibration, space))


def identify_surface(cfg, run, arm, data):
    """Identify a surface; write contact.yaml, model and figure, print tables, return the entry for summary.json."""
    from r2s.identification.contact.contact_file import save_contact
    from r2s.identification.contact.estimate import identify_contact
    from r2s.identification.contact.exchange import write_surface
    from r2s.identification.contact.surface_space import LOAD
    from r2s.identification.contact.validation import KNOWN
    from r2s.physics.description import write_description
    from r2s.progress import Progress
    from r2s.reporting.identification.contact import contact_figure, contact_table, press_table
    from r2s.reporting.tables import print_table

    progress = Progress("contact")
    gears = stated_stiffness(cfg, arm.robot)
    found = identify_contact(arm, data.recording, data.held_out, gears=gears, seed=cfg.seed, report=progress)
    progress.close()
    source = {"recording": data.recording.name, "calibration": cfg.calibration or str(run.folder)}
    save_contact(run.folder / "contact.yaml", arm.robot, found, source | {"run": str(run.folder)})
    for line in write_description(run.folder / "model", arm.robot, arm.space.dynamics(arm.x)):
        print(line)
    write_surface(run.folder / "model", arm.robot, (found.rigid_gears or found).surface)
    contact_figure(run.figure("contact"), found)
    print_table(console(), contact_table(found), "surface, 95 % intervals")
    print_table(console(), press_table(found), "surface against joint torques")
    if not len(found.training.t):
        share = f"{100 * KNOWN:g} % of the largest force"
        print(f"joint torques never determine the force to {share}: friction errs too much")
    low, high = found.interval("slope")
    entry = {"slope_N_per_m": found.slope, "slope_interval95_N_per_m": [low, high], "at_N": LOAD}
    entry |= {"friction": found.surface.friction, "train": found.training.summary()}
    if found.rigid_gears is not None:
        entry["rigid_gears_slope_N_per_m"] = found.rigid_gears.slope
    return entry | ({} if found.validation is None else {"validation": found.validation.summary()})


def keep_calibration(cfg, run):
    """Copy the model of `calibration=` into the run folder; a later job can then set calibration= to this folder."""
    folder = Path(cfg.calibration)
    folder = folder if folder.is_dir() else folder.parent
    for name in ARM:
        shutil.copy2(folder / name, run.folder / name)
