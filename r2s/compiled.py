"""Provide numba's `njit`, `cfunc` and `vectorize` with a compilation cache that notices changes in other modules.

numba caches a compiled function and recompiles the function when its source file changes. But numba does not notice
changes in other files whose functions the cached code calls. After a change in physics/safety_filter.py, numba would
therefore run arm/driver.py with the old filter. This module makes numba recompile all functions of a package, such as
r2s/arm, after a change in a compiled module of this package or of r2s/physics. A change in a module from which a
compiled module imports constants also causes this recompilation. Compiled code of a package may therefore call only
functions of this package and of r2s/physics.
"""

import hashlib
import os
import re
import sys
from functools import cache
from pathlib import Path
from threading import Timer

from numba import cfunc, config, njit, vectorize
from numba.core import event
from numba.core.caching import InTreeCacheLocator, UserProvidedCacheLocator, UserWideCacheLocator

__all__ = ["cfunc", "njit", "vectorize"]
PACKAGE = Path(__file__).parent
RELAYED = "R2S_RELAYED"  # environment variable, set if another process prints this process's output
LONG_S = 2.0  # s, duration of a compilation after which the user gets a message


@cache
def _sources(room: Path) -> bytes:
    """Return a hash of the source files on which the compiled code in the package folder `room` may depend."""
    if PACKAGE in room.parents:  # a subfolder belongs to its package
        names = room.relative_to(PACKAGE).parts[0], "physics"
        paths = {path for name in names for path in (PACKAGE / name).rglob("*.py")}
    else:
        paths = set(room.glob("*.py"))
    compiled = {path for path in paths if b"r2s.compiled" in path.read_bytes()}
    constants = {PACKAGE.joinpath(*name[1:]).with_suffix(".py") for path in compiled for name in _imports(path)}
    found = hashlib.sha256()
    for path in sorted(compiled | {path for path in constants if path.is_file()}):
        found.update(path.name.encode() + path.read_bytes())
    return found.digest()


def _imports(path: Path) -> list[list[str]]:
    """Return the r2s modules from which a file imports; each module is a list like ["r2s", "physics", "robot"]."""
    return [name.split(".") for name in re.findall(r"^from (r2s[\w.]+) import", path.read_text(), re.MULTILINE)]


class _Sources:
    """Mixin for numba's cache locators: add the hash of `_sources` to the stamp by which numba detects changes."""

    _py_file: str

    def get_source_stamp(self) -> tuple:
        return super().get_source_stamp(), _sources(Path(self._py_file).resolve().parent)  # type: ignore[misc]


class Provided(_Sources, UserProvidedCacheLocator):
    """Store compiled code in the folder that the environment variable NUMBA_CACHE_DIR names."""


class Beside(_Sources, InTreeCacheLocator):
    """Store compiled code in the folder `__pycache__` beside the source file."""


class UserWide(_Sources, UserWideCacheLocator):
    """Store compiled code in the user's cache folder, for a read-only installation."""


_own = ",".join(f"{__name__}.{kind.__name__}" for kind in (Provided, Beside, UserWide))
config.CACHE_LOCATOR_CLASSES = f"{_own},IPythonCacheLocator,ZipCacheLocator"  # type: ignore[attr-defined]


class _Announce(event.Listener):
    """Print a message, once per process, if a compilation takes longer than LONG_S."""

    def __init__(self):
        self._printed = False
        self._timers: list[Timer] = []

    def on_start(self, event: event.Event) -> None:
        timer = Timer(LONG_S, self._print)
        timer.daemon = True
        timer.start()
        self._timers.append(timer)

    def on_end(self, event: event.Event) -> None:
        self._timers.pop().cancel()

    def _print(self) -> None:
        if not self._printed:
            self._printed = True
            print("compiling numeric code: once after an installation, for one to three minutes", file=sys.stderr)


if sys.stderr.isatty() or RELAYED in os.environ:
    event.register("numba:compile", _Announce())
