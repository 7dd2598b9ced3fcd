"""Implement tracker=trackio: write SQLite files, which `TRACKIO_DIR=runs/trackio trackio show` displays."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from torchrl.record.loggers.trackio import TrackioLogger

from r2s.errors import optional_import
from r2s.reporting.trackers.tracker import Tracked


class Trackio:
    """Tracker that logs a run of a Trackio project.

    Args:
        folder: folder of the databases, one per project; the environment variable TRACKIO_DIR overrides `folder`.
        project: name of the project.
    """

    def __init__(self, folder: str, project: str = "r2s"):
        os.environ.setdefault("HF_HUB_DISABLE_TELEMETRY", "1")
        os.environ.setdefault("TRACKIO_DIR", str(Path(folder).absolute()))  # trackio reads the variable at import
        optional_import("trackio", "tracker=trackio", "trackers")
        self._project = project

    def start(self, run: Tracked) -> None:
        """Begin a Trackio run, or continue the run whose name is stored in the run folder."""
        import trackio

        for module in (trackio, trackio.run, trackio.utils):
            vars(module)["print"] = lambda *args, **kwargs: None  # keep trackio's messages out of the output
        resume = "must" if run.resumed and run.kept("trackio") else "never"
        config = run.settings | {"folder": str(run.folder.absolute())}
        quiet = {"auto_log_gpu": False, "auto_log_cpu": False}
        start = {"resume": resume, "group": run.group, "config": config, "embed": False, **quiet}
        self._logger = TrackioLogger(run.name, self._project, **start)
        run.keep("trackio", run.name)

    def log(self, table: str, numbers: Mapping[str, float], step: int) -> None:
        """Log a row of <table>.csv."""
        self._logger.experiment.log({f"{table}/{k}": v for k, v in numbers.items()}, step=step)

    def summary(self, numbers: Mapping[str, float]) -> None:
        """Log the numbers in summary.json."""
        self._logger.experiment.log({f"summary/{k}": v for k, v in numbers.items()})

    def finish(self, status: str, pictures: Sequence[Path], files: Sequence[Path]) -> None:
        """Store figures and files."""
        import trackio

        run = self._logger.experiment
        if pictures:
            run.log({f"figures/{path.stem}": trackio.Image(path) for path in pictures})
        for path in files:
            run.log_artifact(path, name=path.name, type=path.suffix.lstrip("."))
        run.log({"status": status})
        run.finish()
