"""Atomic file writes, and paths of the files that come with the package."""

import os
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tokenize import TokenError

# Exceptions that NumPy, pandas, h5py and zipfile raise for a truncated, altered or foreign array file.
DAMAGED = (
    KeyError, TypeError, ValueError, OSError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error,
    SyntaxError, TokenError,  # NumPy parses an array's header as a Python literal
)  # fmt: skip
OWN = "r2s:"  # prefix of paths inside the package


def located(path: str | os.PathLike) -> Path:
    """Return the path of a file; `r2s:models/panda.xml` is a file of the package."""
    name = os.fspath(path)
    return Path(__file__).parent / name.removeprefix(OWN) if name.startswith(OWN) else Path(name)


@contextmanager
def atomic_write(path: str | os.PathLike) -> Iterator[Path]:
    """Yield a temporary path and rename it to `path` at the end of the block.

    If the block raises or the process is killed, the file at `path` keeps its old content.
    """
    path = Path(path)
    part = path.with_name(f"{path.stem}.part{path.suffix}")  # some libraries choose the format by the suffix
    try:
        yield part
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)
