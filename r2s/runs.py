"""Run folders: runs/<stage>/<name>/ with the config, who ran what where, tables that grow, and the last word.

meta.json says `running` from the first moment, so a killed run is seen for what it was. A folder appears whole, and
belongs to one process at a time: the lock on its overrides.yaml ends with the process, however that ends.
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
from collections.abc import Callable, Iterable, Mapping
from datetime import datetime
from pathlib import Path
from typing import Any, Protocol, Self

import numpy as np

from r2s.errors import Stopped, UserError
from r2s.files import DAMAGED, whole
from r2s.provenance import git, machine, packages, sha256


class Watcher(Protocol):
    """Who is told what a run writes, such as r2s/reporting/trackers; it neither raises nor waits for long."""

    def log(self, table: str, row: Mapping[str, Any]) -> None:
        """Take a row of a table."""

    def summary(self, document: Mapping[str, Any]) -> None:
        """Take the last word."""

    def finish(self, status: str) -> None:
        """Take the end: done, stopped or failed."""


class Run:
    """One run folder, open while its stage runs: `with Run(...) as run`. Its `watcher`, if any, hears what it writes.

    Args:
        root: where run folders live. stage, name: runs/<stage>/<name>; the name gets a number where it is taken.
        only: the name gets no number; a name that is taken is a mistake.
        config: the composed config as YAML. overrides: what the user typed.
        seed: of the run. threads: as asked for.
        inputs: files it reads, for their sha256. parents: run folders it starts from.
        resume: a run folder to go on in, instead of making one; its inputs must be what they were.

    Raises:
        UserError: the folder cannot be made, another process has it, or what is in it cannot be gone on with.
    """

    def __init__(
        self,
        root: Path,
        stage: str,
        name: str | None,
        *,
        config: str,
        overrides: Iterable[str],
        seed: int,
        threads: int,
        inputs: Iterable[str | Path] = (),
        parents: Iterable[str | Path] = (),
        resume: str | Path | None = None,
        only: bool = False,
    ):
        overrides = list(overrides)
        self._began = time.monotonic()  # the clock of the wall may jump
        self._tables: dict[str, Any] = {}
        self.watcher: Watcher | None = None
        self._meta: dict[str, Any] = {
            "status": "running",
            "stage": stage,
            "start": datetime.now().astimezone().isoformat(timespec="seconds"),
            "wall_clock_s": 0.0,
            "seed": seed,
            "threads": threads or os.cpu_count(),
            "process": {"host": platform.node(), "pid": os.getpid()},
            "git": git(),
            "packages": packages(),
            "machine": machine(),
            "inputs": {str(p): sha256(p) for p in inputs},
            "parents": [str(p) for p in parents],
            "typed": len(overrides),  # of overrides.yaml, which is cut off where it has fewer
        }
        if resume:
            self.folder = Path(resume)
            self._lock = _lock(self.folder)
            try:
                self._check_inputs(read_meta(self.folder)["inputs"])
                with whole(self.folder / "config.yaml") as part:
                    part.write_text(config)
                self._write_meta()
            except BaseException:
                os.close(self._lock)
                raise
            return
        parent = root / stage
        try:
            self.folder = _begin(parent)
            try:
                (self.folder / "config.yaml").write_text(config)
                typed = "".join(f"- {json.dumps(o)}\n" for o in overrides) or "[]\n"
                (self.folder / "overrides.yaml").write_text(typed)
                self._write_meta()
                self._lock = _lock(self.folder)
                self.folder = _take_name(self.folder, parent, name or default_name(overrides), only)
            except BaseException:
                shutil.rmtree(self.folder, ignore_errors=True)
                raise
        except OSError as error:
            raise UserError(f"root: no run folder can be made in {parent}: {error.strerror or error}") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: object) -> None:
        self._meta["wall_clock_s"] = round(time.monotonic() - self._began, 3)
        interrupted = kind in (KeyboardInterrupt, Stopped)
        self._meta["status"] = "done" if kind is None else "stopped" if interrupted else "failed"
        if error is not None:
            self._meta["error"] = f"{kind.__name__ if kind else ''}: {error}".strip(": ")
        try:
            for _, file in self._tables.values():
                file.close()
            self._write_meta()
        except OSError:  # the disk is full: meta.json stays as it was, as that of a killed run does
            if error is None:
                raise
        finally:
            os.close(self._lock)
        if self.watcher:
            self.watcher.finish(self._meta["status"])

    def _check_inputs(self, before: Mapping[str, str]) -> None:
        for path, digest in self._meta["inputs"].items():
            if before.get(path) != digest:
                raise UserError(f"resume: {path} is not what {self.folder} was started with")

    def memo(self, name: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """Return the arrays that `make` returns, or that it returned when this run did this step before.

        They are kept in checkpoints/<name>.npz, so that a resumed run goes on after its last whole step.

        Raises:
            UserError: the file is not what was written; the step is done again where it is removed.
        """
        path = self.folder / "checkpoints" / f"{name.replace(' ', '_')}.npz"
        if not path.is_file():
            done = {k: np.asarray(v) for k, v in make().items()}
            path.parent.mkdir(exist_ok=True)
            with whole(path) as part:
                np.savez(part, **done)  # type: ignore[arg-type]
        return load_arrays(path)

    def figure(self, name: str) -> Path:
        """Return the path of a figure, figures/<name>.png."""
        (self.folder / "figures").mkdir(exist_ok=True)
        return self.folder / "figures" / f"{name}.png"

    def log(self, table: str, row: Mapping[str, Any]) -> dict[str, Any]:
        """Append a row to <table>.csv; the first row sets the columns. Return it with the digits that it keeps there.

        A run that chooses by those chooses as one that was interrupted and has read them (`rewind`).
        """
        kept = {k: float(f"{v:.7g}") if isinstance(v, float) else v for k, v in row.items()}
        self._append(table, kept)
        self.told(table, row)
        return kept

    def told(self, table: str, row: Mapping[str, Any]) -> None:
        """Tell the watcher a row of a table that is written otherwise."""
        if self.watcher:
            self.watcher.log(table, row)

    def _append(self, table: str, row: Mapping[str, Any]) -> None:
        if table not in self._tables:
            file = open(self.folder / f"{table}.csv", "w", newline="")  # noqa: SIM115 (closed in __exit__)
            writer = csv.DictWriter(file, list(row))
            writer.writeheader()
            self._tables[table] = writer, file
        writer, file = self._tables[table]
        writer.writerow({k: f"{v:.7g}" if isinstance(v, float) else v for k, v in row.items()})
        file.flush()

    def rewind(self, table: str, column: str, most: float) -> list[dict[str, float]]:
        """Keep the rows of <table>.csv whose `column` is at most that, go on after them, and return them.

        A last row that was cut off is none. The rows stay as they were written.
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
            # what a run that had come to its end evaluated once more, at the same step, comes again
            last = next((k for k, row in enumerate(kept) if row[column] == most), len(kept))
            del kept[last + 1 :]
        except ValueError as error:
            raise UserError(f"resume: {path} is damaged ({error})") from None
        with whole(path) as part, open(part, "w", newline="") as file:
            file.writelines(lines[: 1 + len(kept)])
        file = open(path, "a", newline="")  # noqa: SIM115 (closed in __exit__)
        self._tables[table] = csv.DictWriter(file, head), file
        return kept

    def summary(self, document: Mapping[str, Any]) -> None:
        """Write summary.json, the last word."""
        write_json(self.folder / "summary.json", document)
        if self.watcher:
            self.watcher.summary(document)

    @property
    def meta(self) -> dict[str, Any]:
        """What meta.json says."""
        return self._meta

    def _write_meta(self) -> None:
        write_json(self.folder / "meta.json", self._meta)


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write JSON so that the name appears only once the file is whole; numbers that are not finite become null."""

    def finite(node: Any) -> Any:
        if isinstance(node, Mapping):
            return {k: finite(v) for k, v in node.items()}
        if isinstance(node, list):
            return [finite(v) for v in node]
        return None if isinstance(node, float) and not math.isfinite(node) else node

    with whole(path) as part:
        part.write_text(json.dumps(finite(document), indent=1) + "\n")


def load_arrays(path: Path) -> dict[str, Any]:
    """Return the arrays of a file of checkpoints.

    Raises:
        UserError: it is not what a run wrote.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            return {k: file[k] for k in file.files}
    except DAMAGED as error:
        seen = " ".join(str(error).split())
        raise UserError(f"resume: {path} is damaged ({seen}); remove it, and this step is done again") from None


def read_summary(folder: str | Path, what: str) -> dict[str, Any]:
    """Return the summary.json of a run folder; `what` names it in the UserError when there is none."""
    path = Path(folder) / "summary.json"
    if not path.is_file():
        raise UserError(f"{what}: {folder} is no finished run folder (it has no summary.json)")
    return _read_json(path)


def read_meta(folder: Path) -> dict[str, Any]:
    """Return the meta.json of a run folder.

    Raises:
        UserError: it is not what a run writes.
    """
    meta = _read_json(folder / "meta.json")
    if not {"status", "inputs"} <= meta.keys():
        raise UserError(f"{folder / 'meta.json'} is not of a run: it has no status or no inputs")
    return meta


def _read_json(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise UserError(f"{path} cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if not isinstance(document, dict):
        raise UserError(f"{path} is damaged: it holds no names and values")
    return document


def is_done(folder: Path) -> bool:
    """Return whether a run is finished; raises UserError if a process still writes into it."""
    meta = read_meta(folder)
    if meta["status"] == "running":
        os.close(_lock(folder))
    return meta["status"] == "done"


def _lock(folder: Path) -> int:
    """Take a run folder for this process; return what holds it, a file descriptor to close.

    The system lets go of it when the process ends. A file system without locks (some of networks) refuses none.

    Raises:
        UserError: another process has it.
    """
    path = folder / "overrides.yaml"
    try:
        lock = os.open(path, os.O_RDWR)  # NFS locks only what may be written
    except OSError as error:
        raise UserError(f"resume: {path} cannot be opened: {error.strerror}") from None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(lock)
        process = read_meta(folder).get("process", {})
        who = f"process {process.get('pid')} of {process.get('host')}"
        raise UserError(f"{folder}: {who} is still at it; wait for it, or stop it") from None
    except OSError:
        pass
    return lock


def status_of(meta: Mapping[str, Any]) -> str:
    """Return done, stopped, failed, running, or killed: meta.json says running, and its process is gone.

    Of a process on another computer only meta.json is known.
    """
    process = meta.get("process", {})
    if meta["status"] != "running" or process.get("host") != platform.node():
        return str(meta["status"])
    try:
        os.kill(process["pid"], 0)
    except ProcessLookupError:
        return "killed"
    except PermissionError:
        pass  # another user's
    return "running"


def default_name(overrides: Iterable[str]) -> str:
    """Return a name made of the time and the overrides, fit for a folder."""
    typed = ",".join(o for o in overrides if not o.startswith(("stage=", "name=", "root=", "tracker")))
    readable = re.sub(r"[^A-Za-z0-9.-]+", "_", typed)[:60].strip("_")  # also a value that Hydra takes unquoted
    return "_".join(p for p in (datetime.now().strftime("%Y-%m-%d_%H-%M-%S"), readable) if p)


def _begin(parent: Path) -> Path:
    """Return a new folder in `parent` that is no run folder yet: a process that is killed now leaves none."""
    parent.mkdir(parents=True, exist_ok=True)
    folder = parent / f".{os.getpid()}_{time.time_ns()}"
    folder.mkdir()
    return folder


def _take_name(folder: Path, parent: Path, name: str, only: bool) -> Path:
    """Give a folder its name, the first that is free of name, name_2, ...; with `only` the name itself."""
    if not re.fullmatch(r"[^/\\\x00-\x1f]+", name) or name.startswith("."):
        raise UserError(f"name: {name!r} cannot be a folder's name")
    for k in range(1, 2 if only else 1000):
        final = parent / (name if k == 1 else f"{name}_{k}")
        try:
            os.rename(folder, final)  # over an empty folder, too; whoever comes second finds it full
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
                raise
            continue
        return final
    taken = "is" if only else "and its numbered followers are all"
    raise UserError(f"name: {parent / name} {taken} taken")
