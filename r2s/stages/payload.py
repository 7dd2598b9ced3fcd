"""stage=identify data.loaded=FILE: identify a payload from a recording of the loaded arm; write payload.yaml."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from r2s.errors import UserError
from r2s.files import located, run_file
from r2s.stages.build import console
from r2s.stages.data import check_cutoff, read_file


@dataclass(frozen=True)
class LoadedData:
    """Recording of the loaded arm, declared payload of the arm (or None), and files of the recording."""

    recording: Any
    declared: Any
    files: list[Path]


def loaded_data(cfg, robot, file, torque=None):
    """Return the `LoadedData` of data.loaded, or None without data.loaded.

    Args:
        file: `FileData` of the config. torque: kind of torque; if None, data.torque applies.

    Raises:
        UserError: data.declared_payload or data.contact contradicts data.loaded, or the file is invalid.
    """
    from r2s.identification.checks import check_recording
    from r2s.physics.payload import payload_of

    if not file.loaded:
        if file.declared_payload is not None:
            raise UserError("data.declared_payload: there is no data.loaded= for which it was declared")
        return None
    if file.contact:
        raise UserError("data.loaded: identify the payload first, then the surface of data.contact in a second run")
    path = located(file.loaded)
    recording = read_file(robot, file, path, torque=torque)
    check_recording(robot, recording)
    check_cutoff(cfg.identify.cutoff_hz, (recording,))
    if file.declared_payload is not None and recording.torque != "commanded":
        raise UserError(
            f"data.declared_payload: {recording.torque} torque contains the weight of the payload, whatever was "
            "declared; leave it out"
        )
    declared = payload_of(file.declared_payload, robot.payload_max, "data.declared_payload")
    return LoadedData(recording, declared, [path])


def torque_of_calibration(cfg, given):
    """Return the kind of torque from which calibration= was identified; data.loaded needs the same kind of torque.

    given: value of data.torque, or None if unset.

    Raises:
        UserError: data.torque is set to another kind of torque.
    """
    from r2s.stages.adapter_factory import PARAMETERS, TORQUE
    from r2s.stages.run_config import loaded

    path = run_file(cfg.calibration, PARAMETERS, "calibration")
    torque = (loaded(path).get("source") or {}).get("torque", TORQUE)
    if given not in (None, torque):
        raise UserError(
            f"data.torque: expected {torque}, from which calibration={cfg.calibration} was identified, got {given}"
        )
    return torque


def identify_load(cfg, run, arm, data, label=""):
    """Identify a payload; write payload.yaml and figure, print the tables, return the entry for summary.json.

    label: label of the recording, given if there are several recordings; payload.yaml is then in payload_LABEL/.
    """
    from r2s.identification.payload.estimate import identify_payload
    from r2s.identification.payload.payload_file import save_payload
    from r2s.progress import Progress
    from r2s.reporting.identification.payload import load_error_table, payload_figure, payload_table
    from r2s.reporting.tables import print_table

    progress = Progress("payload")
    how = {"declared": data.declared, "cutoff_hz": cfg.identify.cutoff_hz, "seed": cfg.seed}
    found = identify_payload(arm, data.recording, **how, report=progress)
    progress.close()
    source = {"recording": data.recording.name, "torque": data.recording.torque}
    source |= {"calibration": cfg.calibration or str(run.folder), "run": str(run.folder)}
    name = f"payload_{label.replace('/', '_')}" if label else "payload"
    folder = run.folder / name if label else run.folder
    folder.mkdir(exist_ok=True)
    save_payload(folder / "payload.yaml", arm.robot, found, source)
    payload_figure(run.figure(name), found)
    of = f" of {label}" if label else ""
    print_table(console(), payload_table(found), f"payload{of} at {arm.robot.ee_site}, 95 % intervals")
    print_table(console(), load_error_table(found), label or "loaded recording")
    entry = {"seconds": data.recording.duration}
    for name, unit in (("mass", "kg"), ("centre", "m"), ("inertia", "kg_m2")):
        entry |= {f"{name}_{unit}": found.values[name].tolist()}
        entry |= {f"{name}_interval95_{unit}": found.interval(name).tolist()}
    errors = {"torque_rmse_Nm": found.predicted, "without_payload_torque_rmse_Nm": found.without}
    return entry | {name: [None if e != e else e for e in found.rmse(x).tolist()] for name, x in errors.items()}
