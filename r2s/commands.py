"""Run the commands of r2s that create no run folder.

`r2s list`, `r2s look` and `r2s export` read run folders. `r2s convert` writes a recording for ROS 2 or LeRobot.
`r2s check` checks a recording or an arm. `r2s engines` lists the physics engines.
"""

import os
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from r2s.errors import UserError, choices, instead_of, nearest, nearest_file

PORT = 9090
CONVERTED = ("robot", "data", "calibration", "friction", "inertia")  # config groups that `convert` reads
JUDGED = (*CONVERTED, "identify")
ARM = ("robot", "friction", "inertia")  # config groups of an arm; friction and inertia have one value per joint
TRUSTED = "modules that a run may execute beside r2s, with commas between, also trust=MODULES"


class Parser(ArgumentParser):
    """Argument parser that raises UserError for a wrong argument."""

    def error(self, message: str) -> NoReturn:
        """Raise UserError with the parser's message and a hint at --help."""
        raise UserError(f"{self.prog.removeprefix('r2s ')}: {message}; see {self.prog} --help")


def run_command(words: Sequence[str]) -> None:
    """Run the r2s command in `words`: the command's name, then its arguments.

    Raises:
        UserError: an argument or a run folder is wrong.
    """
    parser = Parser(prog="r2s")
    commands = parser.add_subparsers(dest="command", required=True)
    listing = commands.add_parser("list", help="table of runs: status, result, age")
    listing.add_argument("--root", default="runs", help="folder of all runs")
    listing.add_argument("--stage", help="only runs of this stage")
    listing.add_argument("--failed", action="store_true", help="only failed and killed runs")
    looking = commands.add_parser("look", help="viewer on one run, or on several side by side")
    looking.add_argument("run", nargs="+", type=Path, metavar="RUN", help="a run folder")
    looking.add_argument("--trust", help=TRUSTED)
    looking.add_argument("--web", action="store_true", help="serve the viewer to a browser on this computer")
    looking.add_argument("--port", type=int, default=PORT, help=f"of --web, default {PORT}; also uses the next one")
    exporting = commands.add_parser("export", help="bundle of a policy, which runs without r2s")
    exporting.add_argument("run", type=Path, metavar="RUN", help="run folder of a finished training")
    exporting.add_argument("--to", type=Path, help="new folder, also to=FOLDER; default RUN/bundle")
    exporting.add_argument("--trust", help=TRUSTED)
    checking = commands.add_parser("check", help="verdict on a recording before a fit, or on an arm before a motion")
    words_of_check = "data=recording data.path=FILE ..., or arm=panda arm.address=...; robot=..."
    checking.add_argument("override", nargs="+", metavar="KEY=VALUE", help=words_of_check)
    checking.add_argument("--seconds", type=float, default=10.0, help="of reading states, default 10; 0: none")
    checking.add_argument("--to", type=Path, help="of a recording: also to=FILE.json; default runs/check/NAME.json")
    converting = commands.add_parser("convert", help="write a recording as MCAP (ROS 2) or as a LeRobotDataset")
    converting.add_argument("file", type=Path, metavar="FILE", help="a recording, or episodes_*.npz of a transfer")
    converting.add_argument("override", nargs="*", metavar="KEY=VALUE", help="robot=, data.torque=, data.columns.q=")
    converting.add_argument(
        "--to", type=Path, required=True, help="also to=FILE.mcap, or to=FOLDER, a LeRobotDataset"
    )
    converting.add_argument("--trust", help=TRUSTED)
    commands.add_parser("engines", help="the physics engines: version, or how to install it")
    options = [f"--{w}" for w in words[1:] if w.startswith(("to=", "trust="))]  # before KEY=VALUE ...
    others = [w for w in words[1:] if not w.startswith(("to=", "trust="))]
    typed, unknown = parser.parse_known_args([words[0], *options, *others])
    if unknown:
        own = commands.choices[typed.command].format_usage().replace("[", " ").replace("]", " ").split()
        options = [w for w in own if w.startswith("--")]
        raise UserError(
            f"{typed.command}: no argument '{unknown[0]}'; allowed: {choices(options) or 'none'}"
            f"{nearest(unknown[0], options)}"
        )
    run = {"list": list_runs, "look": look, "export": export, "check": check, "convert": convert, "engines": engines}
    run[typed.command](typed)


def list_runs(typed: Namespace) -> None:
    """Print a table of run folders."""
    from r2s.reporting.run_list import print_runs, run_rows
    from r2s.stages.build import STAGES, console

    if typed.stage not in (None, *STAGES):
        raise UserError(f"--stage: no stage '{typed.stage}'; {instead_of(typed.stage, STAGES)}")
    table = run_rows(typed.root, stage=typed.stage, failed=typed.failed)
    if table.empty:
        kind = " that failed or was killed" * typed.failed
        print(f"no run{f' of stage={typed.stage}' if typed.stage else ''}{kind} in {typed.root}/")
        return
    print_runs(console(), table, f"{len(table)} run{'s' * (len(table) > 1)} in {typed.root}/")


def look(typed: Namespace) -> None:
    """Open the viewer on one or several runs; without a screen, print the paths of the runs' figures."""
    from r2s.reporting.viewer.look import has_screen, open_native, show_in_browser, side_by_side

    folders = [viewable(run) for run in typed.run]
    sys.path.append(os.getcwd())
    robot = robot_of(folders, typed.trust)
    recording, pictures = folders[0] / "recording.rrd", sorted((folders[0] / "figures").glob("*.png"))
    if len(folders) > 1:
        out = folders[0].parent.parent / "look" / "_and_".join(f.name[:30] for f in folders)
        labels = [
            f.name if len({g.name for g in folders}) == len(folders) else f"{f.parent.name} {f.name}" for f in folders
        ]
        pictures = side_by_side(out, robot, dict(zip(labels, folders, strict=True)))
        recording = out / "recording.rrd"
    if typed.web:
        show_in_browser([recording], typed.port)
    elif has_screen():
        open_native([recording])
    else:
        print(f"no screen (neither DISPLAY nor WAYLAND_DISPLAY is set); --web serves {recording} to a browser")
        for path in pictures:
            print(f"  {path}")


def export(typed: Namespace) -> None:
    """Write the bundle of a trained policy."""
    from r2s.export.bundle import write_bundle
    from r2s.learning.policy import load_policy
    from r2s.stages.build import CONF, is_learner, make_dynamics, make_robot, make_task, plain
    from r2s.stages.transfer import trained_config

    sys.path.append(os.getcwd())  # a config may name modules in the working folder
    source, trained = trained_config(Namespace(policy=typed.run, trust=typed.trust), "export")
    if not is_learner(trained):
        raise UserError(f"export: algo={trained.algo.name} has no network to export ({source})")
    robot = make_robot(trained)
    center = make_dynamics(trained, robot)
    task = make_task(trained, robot, center)
    policy, to = load_policy(source, robot, task), typed.to or source / "bundle"
    places = [path.stem for group in ("simulator", "arm") for path in (CONF / group).glob("*.yaml")]
    write_bundle(to, source, robot, task, center, policy, plain(trained), places)
    print(f"written: {to}")


def check(typed: Namespace) -> None:
    """Check recordings or an arm: print the findings, and raise UserError if a check fails."""
    from r2s.stages.check_data import check_data

    if not any(word.split("=")[0].split(".")[0] == "data" for word in typed.override):
        check_arm(typed)
        return
    sys.path.append(os.getcwd())  # a config may name modules in the working folder
    check_data(composed("check", typed.override, JUDGED), typed.to)


def composed(command: str, words: Sequence[str], groups: Sequence[str]) -> Any:
    """Return the config of stage=identify with the overrides `words`, which may set only keys in `groups`.

    Raises:
        UserError: an override sets a key outside `groups`, or names an option that does not exist.
    """
    from hydra import compose, initialize_config_dir

    from r2s.override_checks import check_overrides, extended
    from r2s.stages.build import CONF

    if other := [w for w in words if w.split("=")[0].split(".")[0] not in groups]:
        raise UserError(f"{command}: expected {choices(f'{g}=' for g in groups)} and their keys, got '{other[0]}'")
    check_overrides(words := ["stage=identify", *extended(words)], None)
    with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
        return compose("config", words)


def check_arm(typed: Namespace) -> None:
    """Check an arm without moving it: connect, print the findings, and raise UserError if a check fails."""
    from omegaconf import OmegaConf
    from pandas import DataFrame

    from r2s.arm.clients.computer_check import computer_findings, network_findings
    from r2s.arm.clients.connection_check import Finding, refuse
    from r2s.arm.interface import ArmStopped
    from r2s.reporting.tables import print_table
    from r2s.stages.build import console, make_robot, opened_arm

    cfg = composed("check", typed.override, ("arm", "robot"))
    if "collision_torque" not in cfg.arm:
        raise UserError(
            f"check: arm={cfg.arm.name} has no connection; allowed: panda, fr3, panda_emulated, fr3_emulated"
        )
    if OmegaConf.is_missing(cfg.arm, "address"):
        raise UserError("arm.address must be given: arm.address=...")
    with opened_arm(cfg, make_robot(cfg), moves=False) as arm:
        found = [*arm.findings, *computer_findings("address" in cfg.arm and cfg.arm.realtime)]
        if cfg.arm.live and typed.seconds > 0:  # only a live arm has a clock to measure
            try:
                found += network_findings(*arm.watch(typed.seconds))
            except ArmStopped as lost:
                found.append(Finding("states", "one per ms", str(lost), refused=True))
    rows = {f.name: {"r2s": f.expected, "arm or computer": f.found, "": "REFUSED" * f.refused} for f in found}
    print_table(console(), DataFrame.from_dict(rows, orient="index"), f"arm={cfg.arm.name}, robot={arm.robot.name}")
    refuse(found, f"arm={cfg.arm.name} is refused")


def convert(typed: Namespace) -> None:
    """Write a recording, or the episodes of a transfer, as MCAP or as a LeRobotDataset."""
    from r2s.physics.description import chain
    from r2s.recordings.lerobot import write_dataset
    from r2s.recordings.ros_bag import write_mcap
    from r2s.stages.build import make_dynamics, make_robot
    from r2s.stages.data import file_data, read_episodes, read_file, read_reference

    if typed.to.suffix not in ("", ".mcap"):
        raise UserError(f"to: expected FILE.mcap, or a folder for a LeRobotDataset, got {typed.to}")
    if typed.to.exists():
        raise UserError(f"to: {typed.to} exists")
    sys.path.append(os.getcwd())  # a config may name modules in the working folder
    cfg = composed("convert", ["data=recording", *typed.override], CONVERTED)
    groups = {w.lstrip("+~").split("=")[0].split(".")[0] for w in typed.override}
    if (typed.file.parent / "config.yaml").is_file() and "robot" not in groups:
        own = arm_config(typed.file.parent, typed.trust)
        for group in ARM:
            if group in own and group not in groups:
                cfg[group] = own[group]
    robot = make_robot(cfg)
    dynamics, more = make_dynamics(cfg, robot), None
    if typed.file.name.startswith("episodes_") and typed.file.suffix == ".npz":
        recording, more = read_episodes(typed.file)
    else:
        recording = read_file(robot, file_data(cfg, str(typed.file)), str(typed.file))
    typed.to.parent.mkdir(parents=True, exist_ok=True)
    if typed.to.suffix:
        notes = write_mcap(typed.to, robot, recording, dynamics, read_reference(typed.file, robot.n))
    else:
        joints = [link.joint for link in chain(robot, dynamics, friction=False)[0]]
        notes = write_dataset(typed.to, recording, joints, robot.name, more)
    for note in notes:
        print(note)
    print(f"{len(recording.t)} rows, {len(recording.stretches)} trajectories, {recording.torque} torque")
    print(f"written: {typed.to}")


def engines(typed: Namespace) -> None:
    """Print a line for each physics engine: the engine's version, or how to install the engine."""
    from r2s.engines.installed import installed

    for name, found, needs in installed():
        print(f"simulator={name:16}{found}{needs and f': {needs}'}")


def viewable(folder: Path) -> Path:
    """Return the run folder; raise UserError if the folder has no recording for the viewer."""
    if (folder / "recording.rrd").is_file():
        return folder
    if (folder / "meta.json").is_file():
        raise UserError(f"look: {folder} has no recording.rrd; the run did not reach its end")
    raise UserError(f"look: '{folder}' is no run folder{nearest_file(folder)}")


def arm_config(folder: Path, trust: str | None = None) -> Any:
    """Return the config of a run's robot: the training's config if the run is a transfer, otherwise the run's config.

    Raises:
        UserError: the file cannot be read or names an untrusted module.
    """
    from omegaconf import OmegaConf

    from r2s.stages.run_config import checked, loaded, run_config

    path = folder / "policy.yaml"  # a transfer's config.yaml contains only the default robot
    if not path.is_file():
        return run_config(folder, trust)
    cfg = loaded(path)
    return checked(OmegaConf.masked_copy(cfg, [k for k in ARM if k in cfg]), path, trust)  # only the arm


def robot_of(folders: Sequence[Path], trust: str | None = None):
    """Return the robot of the runs; raise UserError if the runs have different robots or untrusted modules."""
    from r2s.stages.build import make_robot

    configs = [arm_config(folder, trust) for folder in folders]
    for folder, cfg in zip(folders, configs, strict=True):
        if cfg.robot != configs[0].robot:
            raise UserError(f"look: {folder} has another robot than {folders[0]}; view them one by one")
    return make_robot(configs[0])
