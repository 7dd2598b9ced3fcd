"""The verdict on a recording before a fit, `r2s check data=...`; stage=identify begins with the same."""

from pathlib import Path

from r2s.errors import UserError
from r2s.stages.build import console, make_dynamics, make_robot
from r2s.stages.data import check_other_motion, file_data, read_file
from r2s.stages.identify import make_settings


def check_data(cfg, to):
    """Print the verdict on the recording of `cfg`, and write it to the JSON file `to` (None: runs/check/NAME.json).

    Raises:
        UserError: a file that cannot be read, or a fail.
    """
    from r2s.identification.checks import check_recording
    from r2s.identification.verdict import judge, with_validation
    from r2s.reporting.identification.verdict import print_verdict
    from r2s.runs import write_json

    if cfg.data.kind != "recording":
        raise UserError("check: expected data=recording data.path=FILE, or data=kinova_gen3")
    if to is not None and to.suffix != ".json":
        raise UserError(f"to: expected FILE.json, got {to}")
    robot, file = make_robot(cfg), file_data(cfg)
    recording = read_file(robot, file, file.path)
    settings = make_settings(cfg, recording.torque)
    recording = recording if file.period else recording.in_phase()
    verdict = judge(robot, make_dynamics(cfg, robot), recording, settings)
    if file.validation:
        error = None
        try:
            validation = read_file(robot, file, file.validation)
            check_recording(robot, validation)
            check_other_motion(recording, validation)
        except UserError as found:
            error = found
        verdict = with_validation(verdict, error)
    print_verdict(console(), robot, verdict, f"{file.path}, robot={robot.name}")
    to = to or Path(cfg.root) / "check" / f"{Path(file.path).stem}.json"
    to.parent.mkdir(parents=True, exist_ok=True)
    what = {"recording": str(file.path), "robot": robot.name, "torque": recording.torque}
    write_json(to, what | verdict.document())
    print(f"written: {to}")
    verdict.refuse()
