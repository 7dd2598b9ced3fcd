"""Write files atomically, write JSON, and find files inside the package."""

import json
import math
import os
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tokenize import TokenError
from typing import Any

from r2s.errors import UserError, nearest_file

# Exceptions that NumPy, pandas, h5py and zipfile raise if a file is truncated, altered or has a wrong format.
DAMAGED = (
    KeyError, TypeError, ValueError, OSError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error,
    SyntaxError, TokenError,  # NumPy parses an array's header as a Python literal
)  # fmt: skip
OWN = "r2s:"  # prefix of paths inside the package


def located(path: str | os.PathLike) -> Path:
    """Return `path`, with the package's folder in place of a prefix `r2s:` (example: r2s:models/panda.xml)."""
    name = os.fspath(path)
    return Path(__file__).parent / name.removeprefix(OWN) if name.startswith(OWN) else Path(name)


@contextmanager
def atomic_write(path: str | os.PathLike) -> Iterator[Path]:
    """Yield the path of a temporary file; at the end of the `with` block, rename this file to `path`.

    If the `with` block raises an exception or the process is killed, the file at `path` does not change.
    """
    path = Path(path)
    part = path.with_name(f"{path.stem}.part{path.suffix}")  # some libraries choose the format by the suffix
    try:
        yield part
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def run_file(folder: str | Path, name: str, option: str) -> Path:
    """Return the path of the file `name` in `folder`, or `folder` itself if it is a file; errors begin with `option`.

    Raises:
        UserError: the file does not exist.
    """
    path = Path(folder) / name if Path(folder).is_dir() else Path(folder)
    if not path.is_file():
        raise UserError(f"{option}: no {name} at {folder}{nearest_file(Path(folder))}")
    return path


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write JSON atomically; numbers that are not finite become null."""

    def finite(node: Any) -> Any:
        if isinstance(node, Mapping):
            return {k: finite(v) for k, v in node.items()}
        if isinstance(node, list):
            return [finite(v) for v in node]
        return None if isinstance(node, float) and not math.isfinite(node) else node

    with atomic_write(path) as part:
        part.write_text(json.dumps(finite(document), indent=1) + "\n")
