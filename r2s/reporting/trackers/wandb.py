"""Implement tracker=wandb, offline in the run folder; `wandb sync runs/*/*/wandb/offline-run-*` uploads the runs."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from uuid import uuid4

from torchrl.record.loggers.wandb import WandbLogger

from r2s.errors import optional_import
from r2s.reporting.trackers.tracker import LoggerTracker, Tracked


class Wandb(LoggerTracker):
    """Tracker that logs a run of a W&B project.

    Args:
        project: W&B project. entity: W&B team; if None, W&B uses your account. offline: store the run only on this
            computer.
    """

    def __init__(self, project: str = "r2s", entity: str | None = None, offline: bool = True):
        os.environ.setdefault("WANDB_ERROR_REPORTING", "false")
        os.environ.setdefault("WANDB_SILENT", "true")
        optional_import("wandb", "tracker=wandb", "trackers")
        self._where, self._offline = {"project": project, "entity": entity}, offline

    def start(self, run: Tracked) -> None:
        """Begin a W&B run, or continue the run whose id is stored in the run folder."""
        import wandb

        known = run.kept("wandb") if run.resumed else None
        name = known or uuid4().hex[:12]
        run.keep("wandb", name)
        self._folder = run.folder
        self._logger = WandbLogger(
            run.name,
            offline=self._offline,
            save_dir=run.folder,
            id=name,
            **self._where,
            group=run.group,
            job_type=run.stage,
            config=run.settings,
            log_env_packages=False,
            settings=wandb.Settings(console="off"),
        )

    def summary(self, numbers: Mapping[str, float]) -> None:
        """Log the numbers in summary.json."""
        self._logger.experiment.summary.update({f"summary/{k}": v for k, v in numbers.items()})

    def finish(self, status: str, pictures: Sequence[Path], files: Sequence[Path]) -> None:
        """Store figures and files."""
        import wandb

        run = self._logger.experiment
        if pictures:
            run.log({f"figures/{path.stem}": wandb.Image(str(path)) for path in pictures})
        for path in files:
            run.save(str(path), base_path=str(self._folder), policy="now")
        run.summary["status"] = status
        run.finish(exit_code=0 if status == "done" else 1)
        wandb.teardown()  # otherwise the service process of wandb would outlive the run
