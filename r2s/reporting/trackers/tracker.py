"""What a tracker is, and what it is told of a run. One of your own is such a class and a file of conf/tracker."""

import importlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any, Protocol

from r2s.errors import UserError
from r2s.runs import write_json

KEPT = "trackers.json"  # in the run folder: what a resumed run is called by its trackers
ONE = Lock()  # thread at a time writes it


@dataclass(frozen=True)
class Tracked:
    """A run, for its trackers.

    Attributes:
        folder: of the run, runs/<stage>/<name>. stage: that made it.
        group: the sweep that it is a job of, None for a run by itself.
        config: whole, as dicts. meta: its meta.json: git commit, versions, machine.
        resumed: whether it goes on where it was stopped.
    """

    folder: Path
    stage: str
    group: str | None
    config: dict[str, Any]
    meta: dict[str, Any]
    resumed: bool

    @property
    def name(self) -> str:
        """<stage>/<name>, which no other run of the same root has."""
        return f"{self.stage}/{self.folder.name}"

    @property
    def settings(self) -> dict[str, Any]:
        """The config without levels, {"algo.lr": 5e-4, ...}, with the git commit: numbers, words and truth values."""
        git = self.meta["git"]
        plain = {k: v if isinstance(v, bool | int | float) else str(v) for k, v in flat(self.config)}
        return plain | {"git_commit": str(git["commit"]), "git_dirty": str(git["dirty"])}

    def kept(self, key: str) -> str | None:
        """Return what `keep` kept of this run when it was stopped; None where there is nothing."""
        path = self.folder / KEPT
        return json.loads(path.read_text()).get(key) if path.is_file() else None

    def keep(self, key: str, value: str | None) -> None:
        """Remember `value` in the run folder, for `kept` of a resumed run."""
        path = self.folder / KEPT
        with ONE:
            write_json(path, (json.loads(path.read_text()) if path.is_file() else {}) | {key: value})


class Tracker(Protocol):
    """Shows runs somewhere. Made from its yaml before the run folder is; the calls come from one thread, in order.

    Whatever it raises ends its part in the run, with one warning; the run goes on.
    """

    def start(self, run: Tracked) -> None:
        """Begin to show a run, or go on with it where `run.resumed`."""

    def log(self, table: str, numbers: Mapping[str, float], step: int) -> None:
        """Show a row of <table>.csv; `step` is its env_steps, or the row's number where there are none."""

    def summary(self, numbers: Mapping[str, float]) -> None:
        """Show the last word, {"best/success_1cm": 0.93, ...}."""

    def finish(self, status: str, pictures: Sequence[Path], files: Sequence[Path]) -> None:
        """Keep figures (PNG) and other files, and end: done, stopped or failed."""


def needs(package: str, tracker: str) -> None:
    """Import what a tracker needs, before there is a run folder.

    Raises:
        UserError: it is not installed.
    """
    try:
        importlib.import_module(package)
    except ImportError as error:
        raise UserError(
            f"tracker={tracker}: {package} cannot be imported ({error}); pip install 'r2s[{tracker}]' brings it"
        ) from None


def flat(node: Any, prefix: str = "", between: str = ".") -> Iterator[tuple[str, Any]]:
    """Give ("a.b", value) of nested dicts."""
    for key, value in node.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{prefix}{key}{between}", between)
        else:
            yield f"{prefix}{key}", value
