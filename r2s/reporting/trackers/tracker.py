"""Define the interface of trackers; a new tracker needs a class with this interface and a file in conf/tracker."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any, Protocol

from r2s.files import write_json
from r2s.reporting.measures import measures_of
from r2s.tasks.measures import MeasureTable

FILE = "trackers.json"  # file in the run folder: {tracker: id of the run}, which a resumed run needs
WRITING = Lock()  # every tracker has its own thread, and all threads write FILE


@dataclass(frozen=True)
class Tracked:
    """Information about a run for its trackers.

    Attributes:
        folder: runs/<stage>/<name>. stage: the run's stage. group: name of the run's sweep or pipeline, or None.
        config: composed config as nested dicts. meta: content of meta.json (git commit, versions, machine).
        resumed: whether the run continues a stopped run.
    """

    folder: Path
    stage: str
    group: str | None
    config: dict[str, Any]
    meta: dict[str, Any]
    resumed: bool

    @property
    def name(self) -> str:
        """Name <stage>/<name> of the run, unique below the folder of all runs."""
        return f"{self.stage}/{self.folder.name}"

    @property
    def settings(self) -> dict[str, Any]:
        """The config as a flat dict {"algo.lr": 5e-4, ...} of scalars and strings, with the git commit."""
        git = self.meta["git"]
        plain = {k: v if isinstance(v, bool | int | float) else str(v) for k, v in flat(self.config)}
        return plain | {"git_commit": str(git["commit"]), "git_dirty": str(git["dirty"])}

    @property
    def measures(self) -> MeasureTable:
        """Measures of the run's task; trainings and transfers write them to measures.json before they log a row."""
        return measures_of(self.folder)

    def kept(self, key: str) -> str | None:
        """Return the value that `keep` stored for `key` before the run was stopped, or None."""
        path = self.folder / FILE
        return json.loads(path.read_text()).get(key) if path.is_file() else None

    def keep(self, key: str, value: str | None) -> None:
        """Store `value` for `key` in the run folder, where `kept` finds the value when the run is resumed."""
        path = self.folder / FILE
        with WRITING:
            write_json(path, (json.loads(path.read_text()) if path.is_file() else {}) | {key: value})


class Tracker(Protocol):
    """Interface to a tool that shows runs.

    r2s constructs a tracker before the run folder exists, and calls all methods of the tracker from one thread. After
    an exception in a tracker, the run prints one warning, does not call the tracker again, and continues.
    """

    def start(self, run: Tracked) -> None:
        """Begin to log the run, or continue to log a stopped run if `run.resumed`."""

    def log(self, table: str, numbers: Mapping[str, float], step: int) -> None:
        """Log a row of <table>.csv; `step` is the row's env_steps, or the row number in tables without env_steps."""

    def summary(self, numbers: Mapping[str, float]) -> None:
        """Log the numbers in summary.json as {"best/success_1cm": 0.93, ...}."""

    def finish(self, status: str, pictures: Sequence[Path], files: Sequence[Path]) -> None:
        """Store figures (PNG) and other files, and end the run with `status`: done, stopped or failed."""


class LoggerTracker:
    """A tracker that logs rows and summary with a TorchRL logger; a subclass sets `_logger` in its method `start`."""

    _logger: Any

    def log(self, table: str, numbers: Mapping[str, float], step: int) -> None:
        """Log a row of <table>.csv."""
        self._logger.log_metrics({f"{table}/{k}": v for k, v in numbers.items()}, step)

    def summary(self, numbers: Mapping[str, float]) -> None:
        """Log the numbers in summary.json."""
        self._logger.log_metrics({f"summary/{k}": v for k, v in numbers.items()}, 0)


def flat(node: Any, prefix: str = "", between: str = ".") -> Iterator[tuple[str, Any]]:
    """Yield ("a.b", value) for each value in nested dicts; `between` replaces the dot."""
    for key, value in node.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{prefix}{key}{between}", between)
        else:
            yield f"{prefix}{key}", value
