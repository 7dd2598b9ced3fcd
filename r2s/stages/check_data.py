"""`r2s check data=...` judges recordings before an identification; stage=identify begins with the same checks."""

from pathlib import Path

from r2s.errors import UserError
from r2s.stages.build import base_dynamics, console, make_robot
from r2s.stages.data import check_other_motion, read_file
from r2s.stages.prior import make_settings
from r2s.stages.recordings import labels_of, of_one_reader, recording_files


def check_data(cfg, to):
    """Print the verdict on each recording of `cfg`, and write the verdict to a JSON file.

    to: JSON file for a single recording; if None, r2s writes ROOT/check/NAME.json for each recording.

    Raises:
        UserError: a file cannot be read, or a recording has the verdict fail.
    """
    if cfg.data.kind != "recording":
        raise UserError("check: expected data=recording data.path=FILE, or data=kinova_gen3")
    if to is not None and to.suffix != ".json":
        raise UserError(f"to: expected FILE.json, got {to}")
    robot, files, validation = make_robot(cfg), recording_files(cfg), recording_files(cfg, "validation")
    if len(files) > 1 and to is not None:
        raise UserError(f"to: {len(files)} recordings have a file each, in {cfg.root}/check; leave to={to} out")
    verdicts = {}
    for label, file in zip(labels_of(files), of_one_reader(files), strict=True):
        verdict, recording = judged(cfg, robot, file, of_one_reader([files[0], *validation])[1:])
        name = label.replace("/", "_")
        write_verdict(robot, verdict, recording, file.path, to or Path(cfg.root) / "check" / f"{name}.json")
        verdicts[file.path] = verdict
    for path, verdict in verdicts.items():
        verdict.refuse(f"{path}: " if len(files) > 1 else "")


def judged(cfg, robot, file, validation):
    """Return the verdict on the recording that `file` (`FileData`) describes, and the recording."""
    from r2s.identification.checks import check_recording
    from r2s.identification.verdict import judge, with_validation

    recording = read_file(robot, file, file.path)
    settings = make_settings(cfg, recording.torque)
    recording = recording if file.period else recording.in_phase()
    verdict = judge(robot, base_dynamics(cfg, robot), recording, settings)
    for other in validation:
        error = None
        try:
            held_out = read_file(robot, other, other.path)
            check_recording(robot, held_out)
            check_other_motion(recording, held_out)
        except UserError as found:
            error = found
        verdict = with_validation(verdict, error, other.path if len(validation) > 1 else "")
    return verdict, recording


def write_verdict(robot, verdict, recording, path, to):
    """Print the tables of a verdict, and write the verdict to the JSON file `to`."""
    from r2s.reporting.identification.verdict import print_verdict
    from r2s.runs import write_json

    print_verdict(console(), robot, verdict, f"{path}, robot={robot.name}")
    to.parent.mkdir(parents=True, exist_ok=True)
    what = {"recording": str(path), "robot": robot.name, "torque": recording.torque}
    write_json(to, what | verdict.document())
    print(f"written: {to}")
