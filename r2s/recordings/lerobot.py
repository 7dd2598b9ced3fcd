"""Read and write recordings as a LeRobotDataset v3 (Hugging Face LeRobot): parquet files and meta/info.json.

`write_dataset` stores commanded torque as `action`, and measured torque or motor torque as `observation.effort`.
`lerobot_table` recognizes angles, velocities and torques by words in the names of features and of feature elements.
"""

import json
import os
import re
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from r2s.errors import UserError, choices
from r2s.recordings.recording import Recording
from r2s.recordings.robot_logs import Table

INFO = "meta/info.json"
VERSION = "v3.0"
COUNTERS = ("frame_index", "episode_index", "index", "task_index")
QUANTILES = (1, 10, 50, 90, 99)  # %, quantiles in lerobot's stats.json
CLOCK_TOLERANCE = 1e-4  # s, lerobot's tolerance between a timestamp (float32) and frame_index / fps
FILE = "chunk-000/file-000.parquet"
WORDS = {  # word in the name of a feature or of one of its elements -> field
    **dict.fromkeys(("effort", "efforts", "torque", "torques", "tau"), "tau"),
    **dict.fromkeys(("current", "currents"), "current"),
    **dict.fromkeys(("vel", "velocity", "velocities", "speed", "dq", "qd", "qvel"), "dq"),
    **dict.fromkeys(("pos", "position", "positions", "angle", "angles", "q", "qpos"), "q"),
}
DEGREES = ("deg", "degree", "degrees")
OTHERS = ("gripper", "finger", "fingers", "hand", "jaw", "cartesian", "ee", "eef", "tcp", "pose")  # not arm joints
RADIANS = np.pi / 180


def is_dataset(path: Path) -> bool:
    """Return whether `path` is the folder of a LeRobotDataset."""
    return (path / INFO).is_file()


def dataset_files(folder: Path) -> list[Path]:
    """Return the files of a dataset that `lerobot_table` reads."""
    return [folder / INFO, *sorted((folder / "data").glob("*/*.parquet"))]


def lerobot_table(folder: Path) -> Table:
    """Return t (T,) s, trajectory (T,), joint_names (m,) and, if stored, q, dq, tau, tau_J_d, current (T, m).

    t is frame_index / fps, or the logged timestamp if this differs; `trajectory` is the episode index. A torque in
    `action` is returned as tau_J_d. Features of a gripper, hand or pose are ignored. The entry `reader_note` names
    the clock and the features that this function read.

    Raises:
        UserError: the dataset has no torque or is not version 3, or a file is damaged.
    """
    info = _info(folder)
    features = info["features"]
    channels = _channels(features)
    found: dict[str, dict[str, tuple[str, int, float]]] = {}
    for field, joint, place in channels:
        found.setdefault(field, {}).setdefault(joint, place)  # of several features for a joint's field, use the first
    torques = [field for field in ("tau", "tau_J_d", "current") if field in found]
    joints = [j for j in found.get("q", {}) if any(j in found[field] for field in torques)]
    if not joints:
        missing = "torque" if not torques else "joint angles" if "q" not in found else "joint with angle and torque"
        raise UserError(f"no {missing} in this dataset: features {choices(k for k in features if k not in COUNTERS)}")
    read = {field: places for field, places in found.items() if set(joints) <= set(places)}
    names = list(dict.fromkeys(read[field][j][0] for field in read for j in joints))
    clock = ["timestamp"] if "timestamp" in features else []
    frame = _frames(folder, [*clock, "frame_index", "episode_index", *names], int(info.get("total_frames", 0)))
    values = {x: np.array(frame[x].tolist(), dtype=float).reshape(len(frame), -1) for x in names}
    for x, value in values.items():
        if value.shape[1] != features[x]["shape"][0]:
            raise UserError(f"{x}: expected {features[x]['shape'][0]} values a frame ({INFO}), got {value.shape[1]}")
    table: Table = {"t": frame["frame_index"].to_numpy() / info["fps"], "joint_names": np.array(joints)}
    table["trajectory"] = frame["episode_index"].to_numpy()
    time = f"the clock is nominal: frame_index / {info['fps']:g} Hz"
    if clock:
        stamp = np.array(frame["timestamp"].tolist(), dtype=float).ravel()
        if np.any(np.abs(stamp - table["t"]) > np.maximum(CLOCK_TOLERANCE, np.spacing(stamp.astype(np.float32)))):
            table["t"], time = stamp, "the clock is the dataset's timestamp"
    for field, places in read.items():
        table[field] = np.stack([values[x][:, k] * factor for x, k, factor in (places[j] for j in joints)], axis=1)
    sources = {field: choices(dict.fromkeys(places[j][0] for j in joints)) for field, places in read.items()}
    table["reader_note"] = np.array(f"{time}; " + ", ".join(f"{field} from {x}" for field, x in sources.items()))
    if isinstance(own := info.get("r2s"), Mapping) and "torque" in own:
        table["torque"] = np.array(str(own["torque"]))
    return table


def _info(folder: Path) -> dict[str, Any]:
    """Check meta/info.json, and return the content of this file."""
    try:
        info = json.loads((folder / INFO).read_text())
        version, fps = str(info["codebase_version"]), info["fps"]
        numeric = isinstance(fps, int | float) and fps > 0
        described = all(isinstance(x, dict) and {"dtype", "shape"} <= x.keys() for x in info["features"].values())
    except (ValueError, KeyError, TypeError, AttributeError, OSError) as error:
        raise UserError(f"{INFO} is damaged: {type(error).__name__} {str(error)[:80]}") from None
    if not version.startswith("v3"):
        raise UserError(
            f"{INFO}: expected codebase_version v3.x, got {version}; lerobot has a script that converts it"
        )
    if not numeric or not described:
        raise UserError(f"{INFO}: expected fps > 0 and features with dtype and shape, got fps {fps}")
    return info


def _channels(features: Mapping[str, Any]) -> list[tuple[str, str, tuple[str, int, float]]]:
    """Return (field, joint, (feature, element index, factor to SI units)) for each element of the arm's joints."""
    out = []
    for feature, spec in features.items():
        shape = spec["shape"]
        if spec["dtype"] not in ("float32", "float64") or len(shape) != 1 or feature == "timestamp":
            continue
        of = re.findall(r"[a-z]+", feature.lower())
        for k, element in enumerate(_elements(spec.get("names"), shape[0])):
            words = re.findall(r"[a-z]+", element.lower())
            # words in the feature's name have priority: a feature of effort may have elements such as `elbow.pos`
            field = next((WORDS[w] for w in [*reversed(of), *reversed(words)] if w in WORDS), None)
            field, action = field or ("q" if "state" in of else None), "action" in of
            if field is None or set(OTHERS) & {*words, *of} or (action and field != "tau"):
                continue
            degrees = field in ("q", "dq") and bool(set(DEGREES) & {*words, *of})
            joint = _joint(element) or f"joint{k + 1}"
            out.append(("tau_J_d" if action else field, joint, (feature, k, RADIANS if degrees else 1.0)))
    return out


def _elements(names: Any, size: int) -> list[str]:
    """Return the names of a feature's elements: `names` (a list or {key: list}), or else joint1, joint2, ..."""
    if isinstance(names, Mapping):
        names = next((x for x in names.values() if isinstance(x, list)), None)
    if isinstance(names, list) and len(names) == size:
        return [str(x) for x in names]
    return [f"joint{k + 1}" for k in range(size)]


def _joint(element: str) -> str:
    """Return an element's name without words for field and unit: `elbow` for `elbow.pos`, `joint2` for `tau_2`."""
    known = {*WORDS, *DEGREES, "rad", "nm"}
    numbered = re.fullmatch(r"([a-z]+)[._ -]?(\d+)", element.lower())
    if numbered and numbered[1] in known:
        return f"joint{numbered[2]}"
    parts = re.findall(r"[^._/ -]+|[._/ -]", element)
    while parts and parts[-1].lower() in known:
        parts = parts[:-2]
    while parts and parts[0].lower() in known:
        parts = parts[2:]
    return "".join(parts)


def _frames(folder: Path, columns: Sequence[str], total: int) -> pd.DataFrame:
    """Return the given columns of all files in data/, sorted by episode and frame."""
    files = dataset_files(folder)[1:]
    if not files:
        raise UserError("no data/*/*.parquet: the dataset was not downloaded whole")
    try:
        frame = pd.concat([pq.read_table(file, columns=list(columns)).to_pandas() for file in files])
    except (pa.ArrowException, OSError, ValueError, KeyError) as error:
        raise UserError(f"data/*/*.parquet cannot be read: {' '.join(str(error).split())[:150]}") from None
    if missing := [x for x in columns if x not in frame]:
        raise UserError(f"no column '{missing[0]}' in data/*/*.parquet; columns: {choices(frame.columns)}")
    if total and len(frame) != total:
        raise UserError(f"expected {total} frames, as {INFO} says, got {len(frame)}: files of data/ are missing")
    return frame.sort_values(["episode_index", "frame_index"], ignore_index=True)


def write_dataset(
    folder: Path,
    recording: Recording,
    joints: Sequence[str],
    robot: str,
    more: Mapping[str, np.ndarray] | None = None,
    task: str = "recording",
) -> list[str]:
    """Write a recording as a new folder for `lerobot`: one episode per trajectory, in float32, with statistics.

    A recording whose clock is not frame_index / fps is resampled, and a returned note reports the resampling.

    Args:
        joints: n joint names. robot: name of the arm. task: task description, the same for all episodes.
        more: {feature: (T, k)}, values of further features, which cannot be resampled.

    Raises:
        UserError: the folder exists, or the recording needs resampling, but `more` cannot be resampled.
    """
    if folder.exists():
        raise UserError(f"to: {folder} exists; a LeRobotDataset needs a new folder")
    steps, notes = len(recording.t) - len(recording.stretches), []
    if not steps:
        raise UserError("every trajectory is a single row: the recording has no rate")
    fps = max(1, round(steps / recording.duration))  # from the mean step, because steps may alternate
    nominal = [(recording.t[s] - recording.t[s][0]) * fps for s in recording.stretches]
    if max(np.abs(x - np.arange(len(x))).max() for x in nominal) / fps > CLOCK_TOLERANCE:
        if more:
            raise UserError(f"expected an even clock of {fps} Hz beside {choices(more)}")
        recording = recording.resample(1 / fps)
        notes.append(f"resampled: a LeRobotDataset has the clock frame_index / fps, here {fps} Hz")
    lengths = np.array([s.stop - s.start for s in recording.stretches])
    torque = "action" if recording.torque == "commanded" else "observation.effort"
    names = {"observation.state": [f"{j}.{x}" for x in ("pos", "vel") for j in joints]}
    names[torque] = [f"{j}.effort" for j in joints]
    columns = {"observation.state": np.hstack([recording.q, recording.dq]), torque: recording.tau, **(more or {})}
    frame = np.concatenate([np.arange(n) for n in lengths])
    data = {k: x.reshape(len(x), -1).astype(np.float32) for k, x in {**columns, "timestamp": frame / fps}.items()}
    features = {k: {"dtype": "float32", "shape": [x.shape[1]], "names": names.get(k)} for k, x in data.items()}
    features |= {k: {"dtype": "int64", "shape": [1], "names": None} for k in COUNTERS}
    counted = (
        frame,
        np.repeat(np.arange(len(lengths)), lengths),
        np.arange(len(frame)),
        np.zeros(len(frame), np.int64),
    )
    data |= {k: x[:, None] for k, x in zip(COUNTERS, counted, strict=True)}
    info = {
        "codebase_version": VERSION, "robot_type": robot, "total_episodes": len(lengths), "total_frames": len(frame),
        "total_tasks": 1, "chunks_size": 1000, "data_files_size_in_mb": 100, "video_files_size_in_mb": 200,
        "fps": fps, "splits": {"train": f"0:{len(lengths)}"}, "video_path": None, "features": features,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "r2s": {"torque": recording.torque},
    }  # fmt: skip
    with tempfile.TemporaryDirectory(dir=folder.parent) as part:
        _write_files(Path(part) / "new", info, data, task)
        os.replace(Path(part) / "new", folder)
    return notes


def _write_files(folder: Path, info: Mapping[str, Any], data: Mapping[str, np.ndarray], task: str) -> None:
    """Write the files of a dataset; `data` is {feature: (T, k)}, `info` the content of meta/info.json."""
    for place in ("data", "meta/episodes"):
        (folder / place / FILE).parent.mkdir(parents=True)
    columns = {
        k: x[:, 0] if x.shape[1] == 1 else pa.FixedSizeListArray.from_arrays(pa.array(x.ravel()), x.shape[1])
        for k, x in data.items()
    }
    pq.write_table(pa.table(columns), folder / "data" / FILE)
    episode, rows = data["episode_index"][:, 0], []
    for k in range(info["total_episodes"]):
        at = np.flatnonzero(episode == k)
        rows.append(
            {"episode_index": k, "tasks": [task], "length": len(at)}
            | {"dataset_from_index": int(at[0]), "dataset_to_index": int(at[-1]) + 1}
            | {f"{x}/{y}_index": 0 for x in ("data", "meta/episodes") for y in ("chunk", "file")}
            | {f"stats/{x}/{y}": v for x, of in data.items() for y, v in _statistics(of[at]).items()}
        )
    pq.write_table(pa.Table.from_pylist(rows), folder / "meta" / "episodes" / FILE)
    pd.DataFrame({"task_index": [0]}, index=[task]).to_parquet(folder / "meta" / "tasks.parquet")
    statistics = {k: _statistics(x) for k, x in data.items()}
    (folder / "meta" / "stats.json").write_text(json.dumps(statistics, indent=4))
    (folder / INFO).write_text(json.dumps(info, indent=4))


def _statistics(x: np.ndarray) -> dict[str, list[float]]:
    """Return the statistics that lerobot stores for values (T, k)."""
    out = {"min": x.min(0), "max": x.max(0), "mean": x.mean(0, dtype=float), "std": x.std(0, dtype=float)}
    out |= {f"q{p:02d}": np.percentile(x, p, axis=0) for p in QUANTILES}
    return {**{k: v.tolist() for k, v in out.items()}, "count": [len(x)]}
