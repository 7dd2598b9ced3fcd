"""Make, resume and read run folders runs/<stage>/<name>/ with config, provenance, tables and summary.

The status in meta.json is `running` from the start, and remains `running` if the process is killed. A run folder
receives its final name when config, overrides and meta.json are complete. A lock on overrides.yaml allows only one
process to write in a run folder.
"""

import csv
import errno
import fcntl
import json
import math
import os
import platform
import re
import shutil
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Self

import numpy as np

from r2s.errors import Stopped, UserError
from r2s.files import DAMAGED, atomic_write, write_json
from r2s.provenance import git, machine, packages, sha256

# keys of meta.json for each part of a run; every resume begins a new part
PART = ("start", "wall_clock_s", "status", "process", "threads", "device", "git", "packages", "machine")
NOTE_S = 30.0  # s between updates of wall_clock_s in meta.json, from which the duration of a killed run is known


@dataclass(frozen=True)
class Job:
    """Description of a job, stored in the job's run folder.

    Attributes:
        stage, name: run folder runs/<stage>/<name>. r2s adds a number to an existing name; None selects the result of
            `default_name`.
        config: composed config as YAML text. overrides: overrides as the user typed them.
        seed: seed of the run. threads: number of threads; 0: one per core. device: device of the learner.
        inputs: files that the run reads; meta.json records their SHA-256. parents: run folders that the run uses.
    """

    stage: str
    name: str | None
    config: str
    overrides: Sequence[str]
    seed: int
    threads: int
    inputs: Sequence[str | Path] = ()
    parents: Sequence[str | Path] = ()
    device: str = "cpu"


class Run:
    """A run folder that is open during the block `with Run(...) as run`.

    Attributes:
        folder: path of the folder. tracker: None, or r2s.reporting.trackers.async_tracker.Trackers; the methods of
            Trackers neither raise errors nor block.

    Args:
        root: folder of all runs. job: see `Job`. exact_name: whether an existing name is an error.
        resume: existing run folder to continue; the input files of the run must be unchanged.

    Raises:
        UserError: the folder cannot be made or resumed, or another process is using it.
    """

    def __init__(self, root: Path, job: Job, *, resume: str | Path | None = None, exact_name: bool = False):
        self._began = self._noted = time.monotonic()  # monotonic: the wall clock may jump
        self._earlier: list[dict[str, Any]] = []  # earlier parts of a resumed run
        self._tables: dict[str, Any] = {}
        self.tracker: Any = None
        self._meta: dict[str, Any] = {
            "status": "running",
            "stage": job.stage,
            "start": datetime.now().astimezone().isoformat(timespec="seconds"),
            "wall_clock_s": 0.0,
            "seed": job.seed,
            "threads": job.threads or os.cpu_count(),
            "device": job.device,
            "process": {"host": platform.node(), "pid": os.getpid()},
            "git": git(),
            "packages": packages(),
            "machine": machine(),
            "inputs": {str(p): sha256(p) for p in job.inputs},
            "parents": [str(p) for p in job.parents],
            "typed": len(job.overrides),  # detects a truncated overrides.yaml
        }
        self._start = self._meta["start"]
        if resume:
            self._resume(Path(resume))
            return
        parent = root / job.stage
        try:
            self._create(parent, job, exact_name)
        except OSError as error:
            raise UserError(f"root: no run folder can be made in {parent}: {error.strerror or error}") from None

    def _create(self, parent: Path, job: Job, exact_name: bool) -> None:
        """Make the folder under a hidden name, and rename it when its first files are complete."""
        parent.mkdir(parents=True, exist_ok=True)
        self.folder = parent / f".{os.getpid()}_{time.time_ns()}"
        self.folder.mkdir()
        try:
            (self.folder / "config.yaml").write_text(job.config)
            typed = "".join(f"- {json.dumps(o)}\n" for o in job.overrides) or "[]\n"
            (self.folder / "overrides.yaml").write_text(typed)
            self._write_meta()
            self._lock = _lock(self.folder)
            self.folder = _take_name(self.folder, parent, job.name or default_name(job.overrides), exact_name)
        except BaseException:
            shutil.rmtree(self.folder, ignore_errors=True)
            raise

    def _resume(self, folder: Path) -> None:
        """Lock a run folder and add a part to its meta.json; the files of config and overrides stay unchanged."""
        self.folder = folder
        self._lock = _lock(folder)
        try:
            before = read_meta(folder)
            for path, digest in self._meta["inputs"].items():
                if before["inputs"].get(path, digest) != digest:
                    raise UserError(f"resume: {path} has changed since {folder} was started")
            self._earlier = parts_of(before)
            if self._earlier[-1]["status"] == "running":
                self._earlier[-1]["status"] = "killed"
            self._meta |= {k: before[k] for k in ("start", "parents", "typed") if k in before}
            self._meta["inputs"] = before["inputs"] | self._meta["inputs"]
            self._write_meta()
        except BaseException:
            os.close(self._lock)
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: object) -> None:
        interrupted = kind in (KeyboardInterrupt, Stopped)
        self._meta["status"] = "done" if kind is None else "stopped" if interrupted else "failed"
        if error is not None:
            self._meta["error"] = f"{kind.__name__ if kind else ''}: {error}".strip(": ")
        if isinstance(error, KeyboardInterrupt):
            self._meta["error"] = "interrupted"
            error.args = (str(self.folder),)  # r2s/cli.py prints the folder
        try:
            for _, file in self._tables.values():
                file.close()
            self._write_meta()
        except OSError:  # on a full disk, the status in meta.json remains running, as after a kill
            if error is None:
                raise
        finally:
            os.close(self._lock)
        if self.tracker:
            self.tracker.finish(self._meta["status"])

    @property
    def meta(self) -> dict[str, Any]:
        """The content of meta.json."""
        return self._meta

    def memo(self, name: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """Return the arrays that `make` computes, or read them from checkpoints/<name>.npz if this file exists.

        A resumed run skips computations whose results are saved.

        Raises:
            UserError: the file is damaged.
        """
        path = self.folder / "checkpoints" / f"{name.replace(' ', '_')}.npz"
        if not path.is_file():
            done = {k: np.asarray(v) for k, v in make().items()}
            path.parent.mkdir(exist_ok=True)
            with atomic_write(path) as part:
                np.savez(part, **done)  # type: ignore[arg-type]
            self._write_meta()
        return load_arrays(path)

    def figure(self, name: str) -> Path:
        """Return the path of a figure, figures/<name>.png."""
        (self.folder / "figures").mkdir(exist_ok=True)
        return self.folder / "figures" / f"{name}.png"

    def log(self, table: str, row: Mapping[str, Any]) -> dict[str, Any]:
        """Append a row to <table>.csv, and return the row as rounded in the file; the first row defines the columns.

        Callers must base decisions on the returned row, because a resumed run reads that row from the file.
        """
        rounded = {k: float(f"{v:.7g}") if isinstance(v, float) else v for k, v in row.items()}
        if table not in self._tables:
            file = open(self.folder / f"{table}.csv", "w", newline="")  # noqa: SIM115 (closed in __exit__)
            writer = csv.DictWriter(file, list(rounded))
            writer.writeheader()
            self._tables[table] = writer, file
        writer, file = self._tables[table]
        writer.writerow({k: f"{v:.7g}" if isinstance(v, float) else v for k, v in rounded.items()})
        file.flush()
        if time.monotonic() - self._noted > NOTE_S:
            self._write_meta()
        self.track(table, row)
        return rounded

    def track(self, table: str, row: Mapping[str, Any]) -> None:
        """Send a row of a table to the tracker without writing it to <table>.csv."""
        if self.tracker:
            self.tracker.log(table, row)

    def rewind(self, table: str, column: str, most: float) -> list[dict[str, float]]:
        """Remove the rows of <table>.csv whose value of `column` exceeds `most`; return the remaining rows.

        An incomplete last row is also removed. The text of the remaining rows does not change; `log` appends to them.
        """
        path = self.folder / f"{table}.csv"
        if not path.is_file():
            return []
        with open(path, newline="") as file:
            lines = file.readlines()
        if lines and not lines[-1].endswith("\n"):
            del lines[-1]
        if not lines:
            return []
        head = next(csv.reader(lines[:1]))
        try:
            rows = [[float(v) if v else math.nan for v in row] for row in csv.reader(lines[1:])]
            kept = [dict(zip(head, row, strict=True)) for row in rows if row[head.index(column)] <= most]
            # a finished run has two evaluations at its last step: drop the second, which a resumed run repeats
            last = next((k for k, row in enumerate(kept) if row[column] == most), len(kept))
            del kept[last + 1 :]
        except ValueError as error:
            raise UserError(f"resume: {path} is damaged ({error})") from None
        with atomic_write(path) as part, open(part, "w", newline="") as file:
            file.writelines(lines[: 1 + len(kept)])
        file = open(path, "a", newline="")  # noqa: SIM115 (closed in __exit__)
        self._tables[table] = csv.DictWriter(file, head), file
        return kept

    def summary(self, document: Mapping[str, Any]) -> None:
        """Write summary.json."""
        write_json(self.folder / "summary.json", document)
        if self.tracker:
            self.tracker.summary(document)

    def _write_meta(self) -> None:
        """Write meta.json, which contains all parts of a resumed run and the sum of the parts' durations."""
        self._noted = time.monotonic()
        own = round(self._noted - self._began, 3)
        self._meta["wall_clock_s"] = round(own + sum(p["wall_clock_s"] for p in self._earlier), 3)
        if self._earlier:
            part = {k: self._meta.get(k) for k in PART} | {"start": self._start, "wall_clock_s": own}
            self._meta["parts"] = [*self._earlier, part]
        write_json(self.folder / "meta.json", self._meta)


def load_arrays(path: Path) -> dict[str, Any]:
    """Return the arrays of a checkpoint file.

    Raises:
        UserError: the file is damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            return {k: file[k] for k in file.files}
    except DAMAGED as error:
        reason = " ".join(str(error).split())
        raise UserError(f"resume: {path} is damaged ({reason}); remove it to repeat this step") from None


def read_summary(folder: str | Path, option: str) -> dict[str, Any]:
    """Return the content of summary.json of a run folder; if the file is missing, raise UserError naming `option`."""
    path = Path(folder) / "summary.json"
    if not path.is_file():
        raise UserError(f"{option}: {folder} is no finished run folder (it has no summary.json)")
    return _read_json(path)


def read_meta(folder: Path) -> dict[str, Any]:
    """Return the content of meta.json of a run folder.

    Raises:
        UserError: the file cannot be read, or has no status or inputs.
    """
    meta = _read_json(folder / "meta.json")
    if not {"status", "inputs"} <= meta.keys():
        raise UserError(f"{folder / 'meta.json'} is damaged: it has no status or no inputs")
    return meta


def parts_of(meta: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return start, duration, code and machine of each part of a run; each resume of the run begins a new part.

    Raises:
        UserError: meta.json is damaged.
    """
    parts = meta.get("parts") or [{k: meta.get(k) for k in PART}]
    try:
        return [{k: part[k] for k in PART} | {"wall_clock_s": float(part["wall_clock_s"] or 0)} for part in parts]
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"meta.json is damaged: parts of the run: {error!r}") from None


def _read_json(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise UserError(f"{path} cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if not isinstance(document, dict):
        raise UserError(f"{path} is damaged: expected a JSON object, got {type(document).__name__}")
    return document


def is_done(folder: Path) -> bool:
    """Return whether a run is finished; raise UserError if a process is still writing in its folder."""
    meta = read_meta(folder)
    if meta["status"] == "running":
        os.close(_lock(folder))
    return meta["status"] == "done"


def is_locked(folder: Path) -> bool:
    """Return whether a process has locked a run folder in order to write there."""
    try:
        with open(folder / "overrides.yaml", "r+") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        pass
    return False


def _lock(folder: Path) -> int:
    """Lock a run folder for this process; return the file descriptor of the lock.

    The operating system releases the lock when the process ends. On a network file system without locks, every
    attempt to lock succeeds.

    Raises:
        UserError: another process has locked the folder.
    """
    path = folder / "overrides.yaml"
    try:
        lock = os.open(path, os.O_RDWR)  # NFS locks only writable files
    except OSError as error:
        raise UserError(f"resume: {path} cannot be opened: {error.strerror}") from None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(lock)
        process = read_meta(folder).get("process", {})
        name = f"process {process.get('pid')} on {process.get('host')}"
        raise UserError(f"{folder}: {name} is still writing; wait for it, or stop it") from None
    except OSError:
        pass
    return lock


def status_of(meta: Mapping[str, Any]) -> str:
    """Return the status of a run; it is `killed` if meta.json says `running`, but the process has ended.

    r2s cannot check a process on another computer; the status is then that in meta.json.
    """
    process = meta.get("process", {})
    if meta["status"] != "running" or process.get("host") != platform.node():
        return str(meta["status"])
    try:
        os.kill(process["pid"], 0)
    except ProcessLookupError:
        return "killed"
    except PermissionError:
        pass  # the process of another user
    return "running"


def default_name(overrides: Iterable[str]) -> str:
    """Return a folder name that consists of date, time and overrides."""
    typed = ",".join(o for o in overrides if not o.startswith(("stage=", "name=", "root=", "tracker")))
    readable = re.sub(r"[^A-Za-z0-9.-]+", "_", typed)[:60].strip("_")  # Hydra accepts such a name without quotes
    return "_".join(p for p in (datetime.now().strftime("%Y-%m-%d_%H-%M-%S"), readable) if p)


def _take_name(folder: Path, parent: Path, name: str, exact_name: bool) -> Path:
    """Rename a folder to `name`, or to name_2, name_3, ... if `name` exists; exact_name allows only `name`."""
    if not re.fullmatch(r"[^/\\\x00-\x1f]+", name) or name.startswith("."):
        raise UserError(f"name: {name!r} cannot be a folder's name")
    for k in range(1, 2 if exact_name else 1000):
        final = parent / (name if k == 1 else f"{name}_{k}")
        try:
            os.rename(folder, final)  # replaces even an empty folder; if two processes rename, the second fails
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
                raise
            continue
        return final
    taken = "is" if exact_name else "and its numbered followers are all"
    raise UserError(f"name: {parent / name} {taken} taken")
