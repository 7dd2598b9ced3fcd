"""Run folders: runs/<stage>/<name>/ with the config, who ran what where, tables that grow, and the last word.

meta.json says `running` from the first moment, so a killed run is seen for what it was.
"""

import csv
import hashlib
import json
import math
import os
import platform
import re
import subprocess
import time
from collections.abc import Callable, Iterable, Mapping
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Protocol, Self

import numpy as np

from r2s.errors import UserError
from r2s.files import whole

PACKAGES = (
    "mujoco",
    "torch",
    "torchrl",
    "tensordict",
    "hydra-core",
    "pymoo",
    "dartpy",
    "numba",
    "numpy",
    "scipy",
)


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
        config: the composed config as YAML. overrides: what the user typed.
        seed: of the run. threads: as asked for.
        inputs: files it reads, for their sha256. parents: run folders it starts from.
        resume: a run folder to go on in, instead of making one; its inputs must be what they were.
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
    ):
        overrides = list(overrides)
        self.folder = Path(resume) if resume else _make_folder(root / stage, name or default_name(overrides))
        self._began = time.time()
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
            "git": _git(),
            "packages": {p: _version(p) for p in PACKAGES} | {"python": platform.python_version()},
            "machine": {"cpu": _cpu(), "cores": os.cpu_count(), "system": platform.platform(terse=True)},
            "inputs": {str(p): sha256(p) for p in inputs},
            "parents": [str(p) for p in parents],
        }
        if resume:
            self._check_inputs(json.loads((self.folder / "meta.json").read_text())["inputs"])
        (self.folder / "config.yaml").write_text(config)
        (self.folder / "overrides.yaml").write_text("".join(f"- {json.dumps(o)}\n" for o in overrides) or "[]\n")
        self._write_meta()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: object) -> None:
        for _, file in self._tables.values():
            file.close()
        self._meta["wall_clock_s"] = round(time.time() - self._began, 3)
        interrupted = kind is KeyboardInterrupt
        self._meta["status"] = "done" if kind is None else "stopped" if interrupted else "failed"
        if error is not None:
            self._meta["error"] = f"{kind.__name__ if kind else ''}: {error}".strip(": ")
        self._write_meta()
        if self.watcher:
            self.watcher.finish(self._meta["status"])

    def _check_inputs(self, before: Mapping[str, str]) -> None:
        for path, digest in self._meta["inputs"].items():
            if before.get(path) != digest:
                raise UserError(f"resume: {path} is not what {self.folder} was started with")

    def memo(self, name: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """Return the arrays that `make` returns, or that it returned when this run did this step before.

        They are kept in checkpoints/<name>.npz, so that a resumed run goes on after its last whole step.
        """
        path = self.folder / "checkpoints" / f"{name.replace(' ', '_')}.npz"
        if not path.is_file():
            done = {k: np.asarray(v) for k, v in make().items()}
            path.parent.mkdir(exist_ok=True)
            with whole(path) as part:
                np.savez(part, **done)  # type: ignore[arg-type]
        with np.load(path) as file:
            return {k: file[k] for k in file.files}

    def figure(self, name: str) -> Path:
        """Return the path of a figure, figures/<name>.png."""
        (self.folder / "figures").mkdir(exist_ok=True)
        return self.folder / "figures" / f"{name}.png"

    def log(self, table: str, row: Mapping[str, Any]) -> None:
        """Append a row to <table>.csv; the first row sets the columns."""
        self._append(table, row)
        self.told(table, row)

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
        """Keep the rows of <table>.csv whose `column` is at most that, go on after them, and return them."""
        path = self.folder / f"{table}.csv"
        if not path.is_file():
            return []
        with open(path, newline="") as file:
            rows = [{k: float(v) if v else math.nan for k, v in row.items()} for row in csv.DictReader(file)]
        path.unlink()
        kept = [row for row in rows if row[column] <= most]
        for row in kept:
            self._append(table, {k: int(v) if v.is_integer() else v for k, v in row.items()})
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


def read_summary(folder: str | Path, what: str) -> dict[str, Any]:
    """Return the summary.json of a run folder; `what` names it in the UserError when there is none."""
    path = Path(folder) / "summary.json"
    if not path.is_file():
        raise UserError(f"{what}: {folder} is no finished run folder (it has no summary.json)")
    return json.loads(path.read_text())


def is_done(folder: Path) -> bool:
    """Return whether a run is finished; raises UserError if a process of this computer still writes into it."""
    meta = json.loads((folder / "meta.json").read_text())
    process = meta.get("process", {})
    own = process.get("host") == platform.node()
    if status_of(meta) == "running" and own and process["pid"] != os.getpid():
        raise UserError(f"{folder}: process {process['pid']} is still at it; wait for it, or stop it")
    return meta["status"] == "done"


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


def sha256(path: str | Path) -> str:
    """Return the hex digest of a file."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _make_folder(parent: Path, name: str) -> Path:
    if not re.fullmatch(r"[^/\\]+", name):
        raise UserError(f"name: '{name}' cannot be a folder's name")
    parent.mkdir(parents=True, exist_ok=True)
    for k in range(1, 1000):
        folder = parent / (name if k == 1 else f"{name}_{k}")
        try:
            folder.mkdir()
        except FileExistsError:
            continue
        return folder
    raise UserError(f"name: {parent / name} and its numbered followers are all taken")


def _git() -> dict[str, Any]:
    root = Path(__file__).parent.parent
    if not (root / ".git").exists():  # installed, perhaps within somebody else's repository
        return {"commit": None, "dirty": None}

    def ask(*words: str) -> str | None:
        try:
            done = subprocess.run(["git", "-C", str(root), *words], capture_output=True, text=True, timeout=10)
        except (OSError, subprocess.TimeoutExpired):
            return None
        return done.stdout.strip() if done.returncode == 0 else None

    changes = ask("status", "--porcelain")
    return {"commit": ask("rev-parse", "HEAD"), "dirty": None if changes is None else bool(changes)}


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _cpu() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
