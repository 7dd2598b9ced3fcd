"""The order of the rooms: a module imports only from its own room or from rooms before it."""

import ast
import subprocess
import sys
from pathlib import Path
from statistics import median

import pytest

from r2s import compiled

ROOT = Path(__file__).parent.parent
# in the order in which data flows; a file of r2s/ itself is a room of its own
ROOMS = [
    *("errors", "files", "progress", "provenance", "runs", "compiled"),
    *("physics", "control", "recordings", "excitation", "identification", "adaptation"),
    *("tasks", "learning", "engines", "arm", "reporting", "export"),
    *("stages", "override_checks", "commands", "cli", "envs", "notebook", "__main__"),
]
SEES_A_CONFIG = ("stages", "override_checks", "commands", "cli", "envs", "__main__")
MODULES = sorted((ROOT / "r2s").rglob("*.py"))
MOST_LINES = 400
FRONT_DOOR_LINES = 120


def name_of(path):
    """Return "arm.twin" for r2s/arm/twins/rigid_twin.py, "arm" for its __init__, "" for r2s itself."""
    parts = path.relative_to(ROOT / "r2s").with_suffix("").parts
    return ".".join(p for p in parts if p != "__init__")


def imports(path):
    """Return the full names that a file imports anywhere, also inside functions: {"numpy", "r2s.errors", ...}."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports by relative path"
            own = ROOT / node.module.replace(".", "/")
            modules = {a.name for a in node.names if own.is_dir() and (own / f"{a.name}.py").is_file()}
            found |= {f"{node.module}.{m}" for m in modules}
            if len(modules) < len(node.names):
                found.add(node.module)
    return found


def ours(path):
    """Return the names within r2s of what a file imports from r2s."""
    return {module.removeprefix("r2s.") for module in imports(path) if module.startswith("r2s.")}


def room(name):
    """Return the number of a module's room."""
    first = name.split(".")[0]
    assert first in ROOMS, f"r2s.{name} is in no room of {Path(__file__).name}"
    return ROOMS.index(first)


@pytest.mark.parametrize("path", [p for p in MODULES if name_of(p)], ids=name_of)
def test_a_module_imports_only_from_its_own_room_or_from_rooms_before_it(path):
    name = name_of(path)
    later = {module for module in ours(path) if room(module) > room(name)}
    assert not later, f"r2s.{name} imports from a room after its own: {later}"


def test_a_policy_needs_no_adapter():
    """Tasks and learning load without the room adaptation: adapters run on an arm, below any policy."""
    for path in MODULES:
        if name_of(path).split(".")[0] in ("tasks", "learning"):
            assert not {m for m in ours(path) if m.startswith("adaptation")}, path


def test_nothing_imports_in_a_circle():
    """The modules can be put in an order in which each imports only earlier ones."""
    left = {name_of(path): ours(path) for path in MODULES}
    while left:
        free = {name for name, before in left.items() if not before & left.keys()}
        assert free, f"a circle among {sorted(left)}"
        left = {name: before for name, before in left.items() if name not in free}


def test_what_is_compiled_is_kept_by_the_rule_of_compiled():
    """By its own `njit` numba would go on with the compiled code of a module that has changed."""
    for path in MODULES:
        found = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ImportFrom)]
        names = {alias.name for node in found if node.module == "numba" for alias in node.names}
        assert name_of(path) == "compiled" or not names & {"njit", "jit", "cfunc", "vectorize"}, path


def test_a_change_in_physics_makes_what_is_compiled_of_it_new(tmp_path, monkeypatch):
    """Also in another room; a module that compiles nothing changes nothing."""
    rooms = [tmp_path / "arm", tmp_path / "physics"]
    for folder in rooms:
        folder.mkdir()
        (folder / "law.py").write_text("from r2s.compiled import njit\n")
    monkeypatch.setattr(compiled, "PACKAGE", tmp_path)
    stamps = lambda: [compiled._sources.__wrapped__(folder) for folder in rooms]  # noqa: E731
    before = stamps()
    (rooms[0] / "other.py").write_text("x = 1\n")
    assert stamps() == before
    (rooms[1] / "law.py").write_text("from r2s.compiled import njit\nRATE = 2\n")
    assert all(new != old for new, old in zip(stamps(), before, strict=True))
    (rooms[0] / "law.py").write_text("from r2s.arm.other import x\nfrom r2s.compiled import njit\n")
    before = stamps()
    (rooms[0] / "other.py").write_text("x = 2\n")  # a constant of a compiled module
    assert stamps()[0] != before[0]


def test_every_room_is_there_and_says_what_it_is():
    """No room is listed that does not exist, and each begins with a sentence."""
    for name in ROOMS:
        at = ROOT / "r2s" / name
        path = at / "__init__.py" if at.is_dir() else at.with_suffix(".py")
        assert ast.get_docstring(ast.parse(path.read_text())), f"{path} says nothing of itself"


def test_files_fit_on_a_few_screens():
    """No module has more than 400 lines, half of them have about 130 at most, and run.py is a door."""
    lines = {name_of(path): len(path.read_text().splitlines()) for path in MODULES}
    assert {name: n for name, n in lines.items() if n > MOST_LINES} == {}
    assert median(n for name, n in lines.items() if n > 1) <= 140
    assert len((ROOT / "run.py").read_text().splitlines()) <= FRONT_DOOR_LINES


@pytest.mark.parametrize("path", [p for p in MODULES if name_of(p)], ids=name_of)
def test_data_and_physics_need_neither_torch_nor_hydra(path):
    """Up to identification NumPy, SciPy and MuJoCo do: recordings are identified without a learning library."""
    heads = {module.split(".")[0] for module in imports(path)}
    if room(name_of(path)) <= ROOMS.index("identification"):
        assert not heads & {"torch", "tensordict", "torchrl", "rerun", "matplotlib"}
    if name_of(path).split(".")[0] not in SEES_A_CONFIG:
        assert not heads & {"hydra", "omegaconf"}, "only stages and the command line see a config"


@pytest.mark.long
@pytest.mark.parametrize(
    "what",
    [
        "run",
        "r2s.identification.identify, r2s.identification.search.least_squares, r2s.arm.recorder, r2s.arm.simulated",
    ],
)
def test_importing_does_not_load_torch(what):
    """`import run` answers at once, and Real2Sim runs without torch being loaded."""
    code = f"import sys, {what}; print([m for m in ('torch', 'hydra', 'matplotlib', 'rerun') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"
