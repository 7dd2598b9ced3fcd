"""Implement tracker=mlflow: write to an SQLite store next to the run folders, or to a server.

The command `mlflow ui --backend-store-uri sqlite:///runs/mlflow.db` shows the SQLite store. `mlflow ui` needs the
package mlflow; r2s[trackers] installs only mlflow-skinny, which writes the store but cannot show it.
"""

import logging
import os
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

from filelock import FileLock
from torchrl.record.loggers.mlflow import MLFlowLogger

from r2s.errors import optional_import
from r2s.reporting.trackers.tracker import LoggerTracker, Tracked

SQLITE = "sqlite:///"
STATUS = {"done": "FINISHED", "stopped": "KILLED"}
BATCH = 100  # parameters per call: MLflow's limit


class Logger(MLFlowLogger):
    """TorchRL's MLflow logger; it passes `start` to mlflow.start_run, and so can continue a run."""

    def __init__(self, *args: Any, start: dict[str, Any], **kwargs: Any):
        self._start = start
        super().__init__(*args, **kwargs)

    def _create_experiment(self) -> Any:
        import mlflow

        found = mlflow.get_experiment_by_name(self._mlflow_kwargs["name"])
        self.id = found.experiment_id if found else mlflow.create_experiment(**self._mlflow_kwargs)
        return mlflow.start_run(experiment_id=self.id, **self._start)


class Mlflow(LoggerTracker):
    """Tracker that logs a run of an MLflow experiment.

    Args:
        uri: address of the store, sqlite:///FILE or http://HOST:PORT. experiment: name of the experiment.
    """

    def __init__(self, uri: str, experiment: str = "r2s"):
        os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
        optional_import("mlflow", "tracker=mlflow", "trackers")
        optional_import("sqlalchemy", "tracker=mlflow", "trackers")
        logging.getLogger("mlflow").setLevel(logging.WARNING)
        logging.getLogger("alembic").setLevel(logging.WARNING)
        self._uri, self._experiment = uri, experiment

    def start(self, run: Tracked) -> None:
        """Begin an MLflow run, or continue the run whose id is stored in the run folder."""
        tags = {"stage": run.stage, "folder": str(run.folder.absolute()), "mlflow.source.type": "LOCAL"}
        tags |= {"group": run.group} if run.group else {}
        tags |= {"mlflow.source.git.commit": commit} if (commit := run.meta["git"]["commit"]) else {}
        known = run.kept("mlflow") if run.resumed else None

        lock: AbstractContextManager[Any] = nullcontext()
        artifacts = None
        if self._uri.startswith(SQLITE):
            store = Path(self._uri.removeprefix(SQLITE)).absolute()
            store.parent.mkdir(parents=True, exist_ok=True)
            lock, artifacts = FileLock(f"{store}.lock"), str(store.parent / "mlartifacts")
        with lock:  # otherwise, two jobs of a sweep may create the database tables at the same time
            start = {"run_id": known} if known else {"run_name": run.name, "tags": tags}
            self._logger = Logger(self._experiment, self._uri, artifact_location=artifacts, start=start)
        run.keep("mlflow", self._logger.experiment.info.run_id)
        if not known:
            settings = list(run.settings.items())
            for k in range(0, len(settings), BATCH):
                self._logger.log_hparams(dict(settings[k : k + BATCH]))

    def finish(self, status: str, pictures: Sequence[Path], files: Sequence[Path]) -> None:
        """Store figures and files as artifacts."""
        import mlflow

        for path in pictures:
            mlflow.log_artifact(str(path), "figures")
        for path in files:
            mlflow.log_artifact(str(path))
        mlflow.end_run(STATUS.get(status, "FAILED"))
