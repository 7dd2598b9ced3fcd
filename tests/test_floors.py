"""A module imports only from its own floor or lower ones, and heavy libraries stay where they belong."""

import ast
import subprocess
import sys
from fnmatch import fnmatch
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
# from the bottom up; a new module goes into one of them
FLOORS = [
    [
        *("errors", "recording", "readers", "readers_robot", "robot", "regressor", "friction", "actuation"),
        *("parameters", "simulator", "excitation", "motion_checks"),
    ],
    [
        *("randomization", "breakaway", "windows", "replay_residual", "torque_residual", "least_squares"),
        *("problem", "validation", "identified", "identify", "search_*", "rewards", "env"),
    ],
    ["networks", "ddpg", "td3", "sac", "tqc", "checkpoint", "policy", "oracle", "train", "evaluate"],
    ["engines", "engines.*", "arm", "arm.*"],
    ["runs", "report", "report_figures", "report_identification", "viewer", "tell", "pipeline", "comparison"],
]
MODULES = sorted((ROOT / "r2s").rglob("*.py"))


def name_of(path):
    """Return "arm.twin" for r2s/arm/twin.py, "arm" for its __init__, "" for r2s itself."""
    parts = path.relative_to(ROOT / "r2s").with_suffix("").parts
    return ".".join(p for p in parts if p != "__init__")


def imports(path):
    """Return the full names that a file imports anywhere, also inside functions: {"numpy", "r2s.robot", ...}."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports by relative path"
            found |= {node.module} if node.module != "r2s" else {f"r2s.{alias.name}" for alias in node.names}
    return found


def floor(name):
    """Return the number of a module's floor."""
    at = [i for i, rooms in enumerate(FLOORS) if any(fnmatch(name, room) for room in rooms)]
    assert len(at) == 1, f"r2s.{name} must be on exactly one floor of {Path(__file__).name}; it is on {len(at)}"
    return at[0]


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_imports_go_down(path):
    """Every r2s module that a module imports is on its own floor or below."""
    name = name_of(path)
    below = {module.removeprefix("r2s.") for module in imports(path) if module.split(".")[0] == "r2s"}
    if not name:
        assert not below
        return
    above = {module for module in below if floor(module) > floor(name)}
    assert not above, f"r2s.{name} imports from a floor above: {above}"


def graph():
    return {
        name_of(path): {m.removeprefix("r2s.") for m in imports(path) if m.startswith("r2s.")} for path in MODULES
    }


def test_nothing_imports_in_a_circle():
    """The modules can be put in an order in which each imports only earlier ones."""
    left = graph()
    while left:
        free = {name for name, below in left.items() if not below & left.keys()}
        assert free, f"a circle among {sorted(left)}"
        left = {name: below for name, below in left.items() if name not in free}


def test_every_floor_lists_modules_that_exist():
    """No room is listed that is not there."""
    names = [name_of(path) for path in MODULES]
    for rooms in FLOORS:
        for room in rooms:
            assert any(fnmatch(name, room) for name in names), room


@pytest.mark.parametrize("path", [p for p in MODULES if name_of(p) and floor(name_of(p)) == 0], ids=name_of)
def test_data_and_physics_need_neither_torch_nor_hydra(path):
    """The lowest floor is NumPy, SciPy and MuJoCo: recordings and identification run without a learning library."""
    heads = {module.split(".")[0] for module in imports(path)}
    assert not heads & {"torch", "tensordict", "torchrl", "hydra", "omegaconf", "pymoo", "rerun", "matplotlib"}


def test_only_the_front_door_knows_hydra():
    """No module of r2s imports hydra or omegaconf; run.py does."""
    for path in MODULES:
        assert not {module.split(".")[0] for module in imports(path)} & {"hydra", "omegaconf"}, path
    assert "hydra" in imports(ROOT / "run.py")


@pytest.mark.parametrize("what", ["run", "r2s.identify, r2s.search_least_squares, r2s.arm.record, r2s.arm.simulated"])
def test_importing_does_not_load_torch(what):
    """`import run` answers at once, and Real2Sim runs without torch being loaded."""
    code = f"import sys, {what}; print([m for m in ('torch', 'hydra', 'matplotlib', 'rerun') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"
