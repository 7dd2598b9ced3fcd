"""tracker=tensorboard: event files in the run folder; `tensorboard --logdir runs` shows all runs."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from torchrl.record.loggers.tensorboard import TensorboardLogger

from r2s.reporting.trackers.tracker import Tracked, needs


class Tensorboard:
    """Scalars, settings and figures; files that it cannot hold are named in its texts."""

    def __init__(self) -> None:
        needs("tensorboard", "tensorboard")

    def start(self, run: Tracked) -> None:
        """Write into <run folder>/tensorboard."""
        from torch.utils.tensorboard.summary import hparams

        self._again = run.resumed
        self._logger = TensorboardLogger("tensorboard", str(run.folder))
        if not run.resumed:
            for summary in hparams(
                run.settings, {"summary/best/success_1cm": 0}
            ):  # add_hparams makes another run of it
                self._logger.experiment.file_writer.add_summary(summary)
            self._logger.experiment.add_text("group", run.group or "none")
        self._logger.flush()

    def log(self, table: str, numbers: Mapping[str, float], step: int) -> None:
        """Show a row of <table>.csv."""
        if self._again:
            self._again = False
            self._forget_from(step)
        self._logger.log_metrics({f"{table}/{k}": v for k, v in numbers.items()}, step)
        self._logger.flush()  # else a killed run loses two minutes

    def summary(self, numbers: Mapping[str, float]) -> None:
        """Show the last word."""
        self._logger.log_metrics({f"summary/{k}": v for k, v in numbers.items()}, 0)

    def finish(self, status: str, pictures: Sequence[Path], files: Sequence[Path]) -> None:
        """Show the figures, name the files."""
        import numpy as np
        from PIL import Image

        writer = self._logger.experiment
        for path in pictures:
            with Image.open(path) as picture:
                writer.add_image(f"figures/{path.stem}", np.asarray(picture.convert("RGB")), dataformats="HWC")
        writer.add_text("files", "  \n".join(str(path.absolute()) for path in files))
        writer.add_text("status", status)
        self._logger.shutdown()

    def _forget_from(self, step: int) -> None:
        """Hide what a stopped run wrote from here on: it comes again."""
        from tensorboard.compat.proto.event_pb2 import Event, SessionLog

        begin = Event(step=step, session_log=SessionLog(status=SessionLog.START))
        self._logger.experiment.file_writer.add_event(begin, step)
