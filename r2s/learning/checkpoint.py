"""Where a training goes on after a stop: its whole state in one file, what it has seen in chunks beside it.

The transitions are written once, as they come; the state names how many of them count, so that a stop between two
checkpoints leaves nothing half done. Tensors, numbers and names only: torch.load(weights_only=True) reads it all.
"""

import errno
import os
import shutil
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torchrl.data import TensorDictReplayBuffer

from r2s.errors import UserError
from r2s.files import whole


class Checkpoint:
    """The checkpoint of one training, in a folder of its own."""

    def __init__(self, folder: Path):
        self.folder = folder
        self._kept, self._chunks = 0, list[str]()  # transitions in the chunks, and their names

    @property
    def env_steps(self) -> int:
        """Environment steps that it holds; 0 where there is none."""
        path = self.folder / "state.pt"
        return load_tensors(path, "resume")["seen"] if path.is_file() else 0

    def save(self, state: dict[str, Any], replay: TensorDictReplayBuffer, seen: int, size: int) -> None:
        """Write the state and the transitions since the last call.

        Args:
            state: what to go on with. replay: of `size` at most, after `seen` transitions in all.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        chunk = f"replay_{seen:012d}.pt"
        if seen - self._kept < size:
            rows, self._chunks = torch.arange(self._kept, seen) % size, [*self._chunks, chunk]
        else:  # all that was kept has been overwritten
            rows, self._chunks = torch.arange(size), [chunk]
        save_tensors(self.folder / chunk, replay[rows].to_dict())
        save_tensors(self.folder / "state.pt", state | {"seen": seen, "chunks": self._chunks})
        self._kept = seen

    def load(self, replay: TensorDictReplayBuffer, size: int) -> dict[str, Any] | None:
        """Return the state that was saved last, and fill `replay` with what it had seen; None where there is none.

        Raises:
            UserError: a file of it is missing or damaged.
        """
        path = self.folder / "state.pt"
        if not path.is_file():
            return None
        state = load_tensors(path, "resume")
        self._kept, self._chunks = state["seen"], state["chunks"]
        for chunk in self._chunks:
            rows = load_tensors(self.folder / chunk, "resume")
            replay.extend(TensorDict(rows, batch_size=[len(rows["action"])]))
        replay.writer.load_state_dict({"_cursor": self._kept % size})
        return state

    def clear(self) -> None:
        """Remove it: the training has come to its end."""
        shutil.rmtree(self.folder, ignore_errors=True)


NO_ROOM = ("PytorchStreamWriter", "iostream error", "inline_container.cc")


def save_tensors(path: Path, content: dict[str, Any]) -> None:
    """Write a file that appears only once it is whole; raises OSError where there is no room for it."""
    with whole(path) as part:
        try:
            torch.save(content, part)
        except RuntimeError as error:  # so torch says it, from one place of its writer or another
            if not any(words in str(error) for words in NO_ROOM):
                raise
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path)) from None


def load_tensors(path: Path, what: str) -> dict[str, Any]:
    """Return what `save_tensors` wrote: tensors, numbers and names, never a pickled object.

    Raises:
        UserError: the file is missing or damaged; `what` names it.
    """
    try:
        content = torch.load(path, weights_only=True)
    except Exception as error:  # reading what is damaged may fail in any way
        seen = " ".join(str(error).split())[:100]
        raise UserError(f"{what}: {path} cannot be read, it is missing or damaged ({seen})") from None
    if not isinstance(content, dict):
        raise UserError(f"{what}: {path} is not what r2s wrote")
    return content
