"""Files that are there only once they are whole, and those that come with r2s."""

import os
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tokenize import TokenError

# what reading an array file raises that is cut off, altered, or another thing
DAMAGED = (
    KeyError, TypeError, ValueError, OSError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error,
    SyntaxError, TokenError,  # of an array's header, which NumPy reads as Python's words
)  # fmt: skip
OWN = "r2s:"  # a path that begins so is one of the package's own files, wherever that is installed


def located(path: str | os.PathLike) -> Path:
    """Return where a file is: `r2s:models/panda.xml` in the package, everything else as it is."""
    name = os.fspath(path)
    return Path(__file__).parent / name.removeprefix(OWN) if name.startswith(OWN) else Path(name)


@contextmanager
def whole(path: str | os.PathLike) -> Iterator[Path]:
    """Give a path beside `path` to write to; it takes the name `path` when the block has ended well.

    A block that fails, or a process that is killed in it, leaves what was at `path` as it was.
    """
    path = Path(path)
    part = path.with_name(f"{path.stem}.part{path.suffix}")  # the suffix stays: some libraries go by it
    try:
        yield part
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)
