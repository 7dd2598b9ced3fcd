"""List the physics engines: the versions of installed engines, and how to install missing engines."""

from collections.abc import Callable, Iterator
from importlib.metadata import PackageNotFoundError, version

from r2s.engines import gazebo, gazebo_classic
from r2s.errors import UserError


def installed() -> Iterator[tuple[str, str, str]]:
    """Yield (`simulator=` value, name and version, "") for each installed engine.

    For a missing engine, yield (`simulator=` value, "missing", how to install the engine).
    """
    engines: dict[str, Callable[[], str]] = {
        "mujoco": lambda: f"MuJoCo {_package('mujoco')}",
        "dart": lambda: f"DART {_package('dartpy')}",
        "gazebo_classic": lambda: f"Gazebo Classic {gazebo_classic.version()} (ODE, DART)",
        "gazebo": lambda: f"gz-sim, bindings {gazebo.bindings().__name__}",
    }
    for name, engine in engines.items():
        try:
            yield name, engine(), ""
        except UserError as error:
            yield name, "missing", str(error).removeprefix(f"simulator={name}: ")


def _package(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        raise UserError(f"pip install {name}") from None
