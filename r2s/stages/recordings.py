"""Find, read or make the recordings for stage=identify and `r2s check`; each file has one kind of torque.

`data.path` and `data.validation` each name a file, a pattern such as "logs/*.csv", a dict such as
{path: FILE, torque: motor}, or a list of these. A key of the dict overrides the setting of the same name in `data`.
"""

import glob
import os
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from r2s.errors import Stopped, UserError, choices, nearest, nearest_file
from r2s.files import located
from r2s.stages.data import check_other_motion, file_data, read_file
from r2s.stages.parts import plain

OWN = ("torque", "torque_constant", "command_hz", "period", "max_gap_s", "columns", "topic", "joints", "payload")
FIND = "find"  # value of `payload` for a recording whose payload is to be identified
ORDER = ("measured", "motor", "commanded")  # order of fits; the last identifies the friction that commands overcome


@dataclass(frozen=True)
class Group:
    """Recordings with one kind of torque; `train` and `validation` are {label: recording}.

    loaded: {label: recording} of the arm with an unknown payload, which r2s identifies.
    """

    torque: str
    train: dict[str, Any]
    validation: dict[str, Any]
    loaded: dict[str, Any] = field(default_factory=dict)


def recording_files(cfg, key="path"):
    """Return a `FileData` for each recording of data.path or data.validation.

    Raises:
        UserError: a pattern matches no file, an entry has an unknown key, or a file is named twice.
    """
    from omegaconf import OmegaConf

    value = plain(cfg.data[key])
    files = []
    for entry in value if isinstance(value, list) else [] if value is None else [value]:
        own = dict(entry) if isinstance(entry, dict) else {"path": entry}
        where = f"data.{key}"
        for name in own:
            if name not in ("path", *OWN):
                raise UserError(f"{where}: expected the keys path, {choices(OWN)}, got '{name}'{nearest(name, OWN)}")
        if not isinstance(own.get("path"), str | int | float) or isinstance(own["path"], bool):
            raise UserError(f"{where}: expected FILE, a pattern, or {{path: FILE, torque: ...}}, got {entry!r}")
        for path in _matching(where, str(own["path"])):
            node = OmegaConf.merge(cfg, {"data": {**own, "validation": None}})
            files.append(file_data(node, path))
    paths = [os.path.realpath(f.path) for f in files]
    if twice := [f.path for f, path in zip(files, paths, strict=True) if paths.count(path) > 1]:
        raise UserError(f"data.{key}: {twice[0]} is named twice")
    return files


def _matching(where: str, path: str) -> Iterator[str]:
    """Yield the files that match `path` in alphabetical order, or `path` itself if it exists or is no pattern."""
    if not glob.has_magic(path) or located(path).exists():
        yield path
        return
    if not (found := sorted(glob.glob(os.path.expanduser(path)))):
        raise UserError(f"{where}: no file matches '{path}'{nearest_file(Path(path))}")
    yield from found


def of_one_reader(files):
    """Return the files; if the first file is a bag, unset `topic` and `joints` of each file that is not a bag."""
    from r2s.recordings.readers import is_bag

    if not is_bag(Path(files[0].path)):
        return files
    return [f if is_bag(Path(f.path)) else replace(f, topic=None, joints=None) for f in files]


def labels_of(files):
    """Return a label for each file: the stem of the file name, or the path if several files have the same stem."""
    stems = [Path(f.path).stem for f in files]
    return [stem if stems.count(stem) == 1 else f.path for f, stem in zip(files, stems, strict=True)]


def read_groups(robot, files, validation, share, cutoff_hz):
    """Read the recordings; return one `Group` per kind of torque, in the order in which r2s fits the groups.

    Args:
        files, validation: `FileData` of each file. share: fraction at the end of each recording, or of each period,
            that r2s holds out if `validation` is empty. cutoff_hz: Hz, cut-off frequency for `without_payload`.
    """
    made: dict[str, Group] = {}

    def group(torque):
        return made.setdefault(torque, Group(torque, {}, {}))

    validation = of_one_reader([files[0], *validation])[1:]
    for label, file in zip(labels_of(files), of_one_reader(files), strict=True):
        r = _read(robot, file, len(files) + len(validation) > 1, cutoff_hz)
        if file.payload == FIND:
            group(r.torque).loaded[label] = r
            continue
        if file.period is None and (periodic := r.in_phase()) is not r:
            r = periodic
            if not validation:
                print(f"the motion repeats after {r.period:.2f} s: validation holds out a phase of every period")
        train, held = (r, None) if validation else _split(r, share, label if len(files) > 1 else "")
        own = group(train.torque)
        own.train[label] = train
        if held is not None:
            own.validation[label] = held
    for label, file in zip(labels_of(validation), validation, strict=True):
        if os.path.realpath(file.path) in {os.path.realpath(f.path) for f in files}:
            raise UserError("data.validation is the training file itself: it must hold other motion")
        r = _read(robot, file, len(files) + len(validation) > 1, cutoff_hz)
        if not (own := group(r.torque)).train:
            raise UserError(
                f"data.validation: {file.path} holds {r.torque} torque, and no recording of data.path does"
            )
        for other in own.train.values():
            check_other_motion(other, r)
        own.validation[label] = r
    if missing := [torque for torque, own in made.items() if not own.train]:
        raise UserError(f"data.path: a payload is found on top of the arm: name a {missing[0]} recording without one")
    if missing := [torque for torque, own in made.items() if not own.validation]:
        raise UserError(f"data.validation: no recording of {missing[0]} torque; name one, or leave validation=null")
    return [made[torque] for torque in ORDER if torque in made]


def _read(robot, file, several, cutoff_hz):
    """Read and check a recording, and subtract the torque of a known payload; if `several`, errors name the file."""
    from r2s.identification.checks import check_recording
    from r2s.identification.payload.unloaded import without_payload
    from r2s.physics.payload import payload_of

    try:
        recording = read_file(robot, file, file.path)
        carried = None if file.payload == FIND else payload_of(file.payload, robot.payload_max, "payload")
        if carried is not None:
            recording = without_payload(robot, recording, carried, cutoff_hz)
        check_recording(robot, recording)
    except UserError as error:
        if not several or str(error).startswith(file.path):
            raise
        raise UserError(f"{file.path}: {error}") from None
    return recording


def _split(recording, share, label):
    try:
        return recording.split(share)
    except UserError as error:
        raise UserError(f"{label}: {error}" if label else str(error)) from None


def whole(recordings, label=""):
    """Join the recordings {label: recording}, and return the joined recording."""
    from r2s.recordings.joined import joined

    own = [replace(r, name=r.name or label) for label, r in recordings.items()]
    return joined(own) if len(own) > 1 else next(iter(recordings.values()))


def recorded_once(run, name, label, record):
    """Return the recording NAME.npz of a run; record it first unless a resumed run already contains this file.

    Args:
        label: what the arm does, for progress and messages.
        record: function of a `Progress` and a `Timing` that returns a recording of commanded torque.

    Raises:
        Stopped: the arm stopped; NAME_until_stop.npz contains the motions completed before the stop, if any.
    """
    from r2s.arm.interface import ArmStopped
    from r2s.arm.realtime import Timing
    from r2s.progress import Progress
    from r2s.recordings.readers import read

    path = run.folder / f"{name}.npz"
    if not path.is_file():
        progress, timing = Progress(label, in_cycle=True), Timing()
        try:
            out = record(progress, timing)
        except ArmStopped as stop:
            if stop.recording is not None:
                stop.recording.save(run.folder / f"{name}_until_stop.npz")
            raise Stopped(f"{label}: {stop}; resume={run.folder} records again") from None
        finally:
            for row in timing.table():
                run.log("timing", {"motion": name, **row})
        out.save(path)
        progress.close(f"{out.duration:.1f} s recorded")
    return read(path, torque="commanded")
