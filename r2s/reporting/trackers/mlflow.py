"""tracker=mlflow: an SQLite store beside the run folders, or a server.

Look: `mlflow ui --backend-store-uri sqlite:///runs/mlflow.db`, in an environment that has all of MLflow; the extra
brings only what writes.
"""

import logging
import os
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

from filelock import FileLock
from torchrl.record.loggers.mlflow import MLFlowLogger

from r2s.reporting.trackers.tracker import Tracked, needs

SQLITE = "sqlite:///"
STATUS = {"done": "FINISHED", "stopped": "KILLED"}
BATCH = 100  # parameters that MLflow takes at once


class Logger(MLFlowLogger):
    """TorchRL's, which would begin a new run each time. `how`: arguments of mlflow.start_run."""

    def __init__(self, *args: Any, how: dict[str, Any], **kwargs: Any):
        self._how = how
        super().__init__(*args, **kwargs)

    def _create_experiment(self) -> Any:
        import mlflow

        found = mlflow.get_experiment_by_name(self._mlflow_kwargs["name"])
        self.id = found.experiment_id if found else mlflow.create_experiment(**self._mlflow_kwargs)
        return mlflow.start_run(experiment_id=self.id, **self._how)


class Mlflow:
    """A run of an MLflow experiment.

    Args:
        uri: of the store, sqlite:///FILE or http://HOST:PORT. experiment: that the runs belong to.
    """

    def __init__(self, uri: str, experiment: str = "r2s"):
        os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
        needs("mlflow", "mlflow")
        needs("sqlalchemy", "mlflow")
        logging.getLogger("mlflow").setLevel(logging.WARNING)
        logging.getLogger("alembic").setLevel(logging.WARNING)
        self._uri, self._experiment = uri, experiment

    def start(self, run: Tracked) -> None:
        """Begin a run, or go on with the one that the run folder names."""
        tags = {"stage": run.stage, "folder": str(run.folder.absolute()), "mlflow.source.type": "LOCAL"}
        tags |= {"group": run.group} if run.group else {}
        tags |= {"mlflow.source.git.commit": commit} if (commit := run.meta["git"]["commit"]) else {}
        known = run.kept("mlflow") if run.resumed else None

        lock: AbstractContextManager[Any] = nullcontext()
        beside = None
        if self._uri.startswith(SQLITE):
            store = Path(self._uri.removeprefix(SQLITE)).absolute()
            store.parent.mkdir(parents=True, exist_ok=True)
            lock, beside = FileLock(f"{store}.lock"), str(store.parent / "mlartifacts")
        with lock:  # the jobs of a sweep would all make its tables
            how = {"run_id": known} if known else {"run_name": run.name, "tags": tags}
            self._logger = Logger(self._experiment, self._uri, artifact_location=beside, how=how)
        run.keep("mlflow", self._logger.experiment.info.run_id)
        if not known:
            settings = list(run.settings.items())
            for k in range(0, len(settings), BATCH):
                self._logger.log_hparams(dict(settings[k : k + BATCH]))

    def log(self, table: str, numbers: Mapping[str, float], step: int) -> None:
        """Show a row of <table>.csv."""
        self._logger.log_metrics({f"{table}/{k}": v for k, v in numbers.items()}, step)

    def summary(self, numbers: Mapping[str, float]) -> None:
        """Show the last word."""
        self._logger.log_metrics({f"summary/{k}": v for k, v in numbers.items()}, 0)

    def finish(self, status: str, pictures: Sequence[Path], files: Sequence[Path]) -> None:
        """Keep figures and files as artifacts."""
        import mlflow

        for path in pictures:
            mlflow.log_artifact(str(path), "figures")
        for path in files:
            mlflow.log_artifact(str(path))
        mlflow.end_run(STATUS.get(status, "FAILED"))
