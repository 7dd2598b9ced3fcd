"""`njit` and `cfunc` of numba, with a rule for when what they keep between processes is compiled again.

numba keeps a compiled function beside its source and compiles it again when that file has changed. A function holds
the code of those that it calls, though, and those lie in other files: the driver's cycle (arm/driver.py) would go on
with the limits (physics/limits.py) of yesterday. Here all compiled code of the function's room and of
`physics` counts as its source, so any change there compiles both again. Compiled code calls no other room's.
"""

import hashlib
from functools import cache
from pathlib import Path

from numba import cfunc, config, njit
from numba.core.caching import InTreeCacheLocator, UserProvidedCacheLocator, UserWideCacheLocator

__all__ = ["cfunc", "njit"]
PACKAGE = Path(__file__).parent


@cache
def _sources(room: Path) -> bytes:
    """Return a hash of the compiled modules that a function in folder `room` can be made of."""
    rooms = (room, PACKAGE / "physics") if PACKAGE in room.parents else (room,)
    found = hashlib.sha256()
    for path in sorted({path for r in rooms for path in r.glob("*.py")}):
        if b"r2s.compiled" in (text := path.read_bytes()):
            found.update(path.name.encode() + text)
    return found.digest()


class _Sources:
    """The part of a numba cache locator that says of which source a compiled function is."""

    _py_file: str

    def get_source_stamp(self) -> tuple:
        return super().get_source_stamp(), _sources(Path(self._py_file).resolve().parent)  # type: ignore[misc]


class Provided(_Sources, UserProvidedCacheLocator):
    """In the folder that NUMBA_CACHE_DIR names."""


class Beside(_Sources, InTreeCacheLocator):
    """In `__pycache__` beside the source."""


class Kept(_Sources, UserWideCacheLocator):
    """In the user's cache folder, where the source's own cannot be written."""


_own = ",".join(f"{__name__}.{kind.__name__}" for kind in (Provided, Beside, Kept))
config.CACHE_LOCATOR_CLASSES = f"{_own},IPythonCacheLocator,ZipCacheLocator"  # type: ignore[attr-defined]
