"""The tracker interface. A tracker of your own is a class with this interface and a file in conf/tracker."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any, Protocol

from r2s.files import write_json
from r2s.reporting.measures import measures_of
from r2s.tasks.measures import MeasureTable

FILE = "trackers.json"  # in the run folder: ids that a resumed run continues
WRITING = Lock()  # trackers run in threads of their own and share FILE


@dataclass(frozen=True)
class Tracked:
    """A run that trackers show.

    Attributes:
        folder: runs/<stage>/<name>. stage: of the run. group: the sweep that it belongs to, or None.
        config: composed config as dicts. meta: content of meta.json: git commit, versions, machine.
        resumed: whether the run continues a stopped one.
    """

    folder: Path
    stage: str
    group: str | None
    config: dict[str, Any]
    meta: dict[str, Any]
    resumed: bool

    @property
    def name(self) -> str:
        """<stage>/<name>, unique below the folder of all runs."""
        return f"{self.stage}/{self.folder.name}"

    @property
    def settings(self) -> dict[str, Any]:
        """The flat config, {"algo.lr": 5e-4, ...}, and the git commit; values are numbers, strings and booleans."""
        git = self.meta["git"]
        plain = {k: v if isinstance(v, bool | int | float) else str(v) for k, v in flat(self.config)}
        return plain | {"git_commit": str(git["commit"]), "git_dirty": str(git["dirty"])}

    @property
    def measures(self) -> MeasureTable:
        """The measures of the run's task; trainings and transfers write them to the folder before their first row."""
        return measures_of(self.folder)

    def kept(self, key: str) -> str | None:
        """Return what `keep` stored before the run was stopped, or None."""
        path = self.folder / FILE
        return json.loads(path.read_text()).get(key) if path.is_file() else None

    def keep(self, key: str, value: str | None) -> None:
        """Store `value` in the run folder for `kept` of the resumed run."""
        path = self.folder / FILE
        with WRITING:
            write_json(path, (json.loads(path.read_text()) if path.is_file() else {}) | {key: value})


class Tracker(Protocol):
    """Shows a run in another tool. Hydra creates it before the run folder. One thread makes all calls, in order.

    After an exception the tracker gets no more calls; the run prints one warning and continues.
    """

    def start(self, run: Tracked) -> None:
        """Begin to show a run, or continue it if `run.resumed`."""

    def log(self, table: str, numbers: Mapping[str, float], step: int) -> None:
        """Show a row of <table>.csv; `step` is its env_steps, else the row's number."""

    def summary(self, numbers: Mapping[str, float]) -> None:
        """Show the numbers of summary.json, {"best/success_1cm": 0.93, ...}."""

    def finish(self, status: str, pictures: Sequence[Path], files: Sequence[Path]) -> None:
        """Store figures (PNG) and other files, and end the run with this status: done, stopped or failed."""


class LoggerTracker:
    """A tracker that logs rows and summary with a logger of TorchRL; `start` sets this as `_logger`."""

    _logger: Any

    def log(self, table: str, numbers: Mapping[str, float], step: int) -> None:
        """Show a row of <table>.csv."""
        self._logger.log_metrics({f"{table}/{k}": v for k, v in numbers.items()}, step)

    def summary(self, numbers: Mapping[str, float]) -> None:
        """Show the numbers of summary.json."""
        self._logger.log_metrics({f"summary/{k}": v for k, v in numbers.items()}, 0)


def flat(node: Any, prefix: str = "", between: str = ".") -> Iterator[tuple[str, Any]]:
    """Yield ("a.b", value) of nested dicts."""
    for key, value in node.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{prefix}{key}{between}", between)
        else:
            yield f"{prefix}{key}", value
