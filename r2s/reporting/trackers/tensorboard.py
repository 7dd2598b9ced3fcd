"""Implement tracker=tensorboard: event files in the run folder; `tensorboard --logdir runs` shows all runs."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from torchrl.record.loggers.tensorboard import TensorboardLogger

from r2s.errors import optional_import
from r2s.reporting.trackers.tracker import LoggerTracker, Tracked


class Tensorboard(LoggerTracker):
    """Tracker that writes event files: scalars, settings, figures, and the paths of other files."""

    def __init__(self) -> None:
        optional_import("tensorboard", "tracker=tensorboard", "trackers")

    def start(self, run: Tracked) -> None:
        """Write into <run folder>/tensorboard."""
        self._run, self._resumes, self._begins = run, run.resumed, not run.resumed
        self._logger = TensorboardLogger("tensorboard", str(run.folder))
        if not run.resumed:
            self._logger.experiment.add_text("group", run.group or "none")
        self._logger.flush()

    def log(self, table: str, numbers: Mapping[str, float], step: int) -> None:
        """Log a row of <table>.csv."""
        if self._resumes:
            self._resumes = False
            self._hide_from(step)
        if self._begins:
            self._begins = False
            self._settings()
        super().log(table, numbers, step)
        self._logger.flush()  # otherwise a killed run would lose its rows of the last two minutes

    def finish(self, status: str, pictures: Sequence[Path], files: Sequence[Path]) -> None:
        """Log the figures, the paths of the files, and the status."""
        import numpy as np
        from PIL import Image

        writer = self._logger.experiment
        for path in pictures:
            with Image.open(path) as picture:
                writer.add_image(f"figures/{path.stem}", np.asarray(picture.convert("RGB")), dataformats="HWC")
        writer.add_text("files", "  \n".join(str(path.absolute()) for path in files))
        writer.add_text("status", status)
        self._logger.shutdown()

    def _settings(self) -> None:
        """Log the settings, and the measure by which TensorBoard compares runs; add_hparams would begin a new run."""
        from torch.utils.tensorboard.summary import hparams

        metric = {f"summary/best/{self._run.measures.selection[0]}": 0}
        for summary in hparams(self._run.settings, metric if self._run.stage == "train" else {}):
            self._logger.experiment.file_writer.add_summary(summary)

    def _hide_from(self, step: int) -> None:
        """Hide the rows of the stopped run from `step` on, because the resumed run logs these rows again."""
        from tensorboard.compat.proto.event_pb2 import Event, SessionLog

        begin = Event(step=step, session_log=SessionLog(status=SessionLog.START))
        self._logger.experiment.file_writer.add_event(begin, step)
