"""Define exceptions that end a run with one line of text (exit status 2: a user's mistake, 3: a stopped arm)."""

import importlib
import math
from collections.abc import Collection, Iterable
from difflib import get_close_matches
from numbers import Integral, Real
from pathlib import Path
from types import ModuleType

FAILED = "R2S_FAILED"  # environment variable that a sweep sets: path of the file for the errors of its jobs


class UserError(ValueError):
    """A user's mistake; the message states option or file, expected value, actual value and nearest allowed name."""


class Stopped(Exception):  # noqa: N818 (a stopped arm is not a bug)
    """The arm stopped, and the operator did not resume; the run saves its results and has the status `stopped`."""


def nearest(name: object, allowed: Iterable[str]) -> str:
    """Return "; did you mean 'x'?" for the closest of the allowed names, or "" if none is close."""
    match = get_close_matches(str(name), [str(a) for a in allowed], n=1, cutoff=0.5)
    return f"; did you mean '{match[0]}'?" if match else ""


def nearest_file(path: Path, pattern: str = "*") -> str:
    """Return the suggestion of `nearest` for a missing file, from files that match `pattern` in the same folder."""
    return nearest(path.name, (p.name for p in path.parent.glob(pattern)))


def choices(allowed: Iterable[str]) -> str:
    """Return the allowed names as "a, b, c"."""
    return ", ".join(str(a) for a in allowed)


def instead_of(name: object, allowed: Collection[str]) -> str:
    """Return "allowed: a, b, c; did you mean 'a'?" for a name that is not allowed."""
    return f"allowed: {choices(allowed)}{nearest(name, allowed)}"


def optional_import(module: str, needed_by: str, extra: str) -> ModuleType:
    """Import a module that only an extra of r2s installs (docs/how_to/install.md).

    Args:
        module: name such as "panda_py". needed_by: option or file that needs the module. extra: name of the extra.

    Raises:
        UserError: the module, or a module that it imports, is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        package = module.split(".")[0]
        raise UserError(f"{needed_by} needs {package}, {import_failure(error, package, f'r2s[{extra}]')}") from None


def import_failure(error: ImportError, package: str, install: str) -> str:
    """Return why an import failed: the package, a package that it needs, or a shared library is missing.

    Args:
        error: exception that the import raised: a ModuleNotFoundError if a package is missing, another ImportError if
            a shared library such as libGL is missing.
        install: argument of `pip install` that installs the package.
    """
    if not isinstance(error, ModuleNotFoundError):
        return f"which does not import ({error})"
    absent = (error.name or "").split(".")[0] == package
    why = "which is not installed" if absent else f"which does not import ({error})"
    return f"{why}: pip install {install if install == package else repr(install)}"


def check_number(name: str, value: object, interval: str, whole: bool = False) -> None:
    """Check that a setting is a number in an interval.

    Args:
        name, value: name and value of the setting.
        interval: allowed interval, such as "(0, 1]".
        whole: whether `value` must be an integer.

    Raises:
        UserError: the value is not a number, or is outside the interval.
    """
    low, high = (float(end) for end in interval[1:-1].split(","))
    if isinstance(value, Integral if whole else Real) and not isinstance(value, bool):
        try:
            x = float(value)  # type: ignore[arg-type]
        except OverflowError:  # an integer of more than 308 digits
            x = math.inf
        if (low < x or (x == low and interval[0] == "[")) and (x < high or (x == high and interval[-1] == "]")):
            return
    kind = "whole number" if whole else "number"
    raise UserError(f"{name}: expected a {kind} in {interval}, got {value!r}")
