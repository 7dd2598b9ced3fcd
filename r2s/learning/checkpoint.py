"""Checkpoints of a training run: state in one file, and transitions of the replay buffer in files called chunks.

Each checkpoint writes one chunk: the transitions added since the previous checkpoint. The state file lists the chunks
of the checkpoint and is replaced last, so an interrupted write does not damage the previous checkpoint. r2s deletes a
chunk when the replay buffer has overwritten all transitions of the chunk. The oldest chunk can therefore contain some
overwritten transitions. All files contain only tensors, numbers and names, so torch.load(weights_only=True) can read
the files.
"""

import errno
import os
import shutil
from pathlib import Path
from typing import Any

import torch

from r2s.errors import UserError
from r2s.files import atomic_write
from r2s.learning.replay import Replay


class Checkpoint:
    """The checkpoint of one training run, in a separate folder."""

    def __init__(self, folder: Path):
        self.folder = folder
        self._chunks = list[int]()  # `Replay.seen` at the end of each chunk

    @property
    def env_steps(self) -> int:
        """Number of env steps at the checkpoint; 0 without a checkpoint."""
        path = self.folder / "state.pt"
        return load_tensors(path, "resume")["seen"] if path.is_file() else 0

    def save(self, state: dict[str, Any], replay: Replay) -> None:
        """Write the state and the new transitions; delete chunks whose transitions the buffer has overwritten."""
        self.folder.mkdir(parents=True, exist_ok=True)
        seen, first = replay.seen, replay.seen - len(replay)
        begin = max(self._chunks[-1] if self._chunks else 0, first)
        save_tensors(self._path(seen), replay.transitions(begin, seen))
        chunks = [*(end for end in self._chunks if end > first), seen]
        save_tensors(self.folder / "state.pt", state | {"seen": seen, "chunks": [self._path(k).name for k in chunks]})
        self._chunks = chunks
        for path in {*self.folder.glob("replay_*.pt")} - {*map(self._path, chunks)}:
            path.unlink()

    def load(self, replay: Replay) -> dict[str, Any] | None:
        """Fill the empty buffer `replay` with the saved transitions; return the state, or None without a checkpoint.

        Each transition gets its previous row of the buffer, so a resumed training run draws the same batches as an
        uninterrupted run.

        Raises:
            UserError: a file of the checkpoint is missing or damaged.
        """
        path = self.folder / "state.pt"
        if not path.is_file():
            return None
        state = load_tensors(path, "resume")
        seen, self._chunks = state["seen"], [int(Path(c).stem.removeprefix("replay_")) for c in state["chunks"]]
        replay.seen = first = max(0, seen - replay.size)
        for end in self._chunks:
            rows = load_tensors(self._path(end), "resume")
            overwritten = max(0, first - (end - len(rows["action"])))
            if overwritten < len(rows["action"]):
                replay.extend({name: row[overwritten:] for name, row in rows.items()})
        return state

    def _path(self, end: int) -> Path:
        """Return the path of the chunk whose last transition has the number `end` - 1."""
        return self.folder / f"replay_{end:012d}.pt"

    def clear(self) -> None:
        """Remove the checkpoint of a finished training run."""
        shutil.rmtree(self.folder, ignore_errors=True)


# torch raises one of several RuntimeErrors on a full disk; each contains one of these words
DISK_FULL = ("PytorchStreamWriter", "iostream error", "inline_container.cc")


def save_tensors(path: Path, content: dict[str, Any]) -> None:
    """Write tensors atomically; raise OSError if the disk is full."""
    with atomic_write(path) as part:
        try:
            torch.save(content, part)
        except RuntimeError as error:
            if not any(words in str(error) for words in DISK_FULL):
                raise
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path)) from None


def load_tensors(path: Path, option: str) -> dict[str, Any]:
    """Load a file that `save_tensors` wrote: tensors, numbers and names, never a pickled object.

    Raises:
        UserError: the file is missing or damaged; the message begins with `option`.
    """
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)  # the tensors may come from a GPU
    except Exception as error:  # a damaged file may raise anything
        reason = " ".join(str(error).split())[:100]
        raise UserError(f"{option}: {path} cannot be read, it is missing or damaged ({reason})") from None
    if not isinstance(content, dict):
        raise UserError(f"{option}: {path} is damaged: expected a dict of tensors, got {type(content).__name__}")
    return content
