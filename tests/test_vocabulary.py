"""One vocabulary: names in code and config are the field's (docs/glossary.md), and functions fit on a screen."""

import ast
import re
from pathlib import Path

import pytest
import yaml
from conftest import ROOT

MODULES = sorted((ROOT / "r2s").rglob("*.py"))
CONFIGS = sorted((ROOT / "conf").rglob("*.yaml"))
# parts of names, split at underscores and capitals, that say nothing to a robotics engineer
REFUSED = {
    *(
        "told",
        "tell",
        "tells",
        "telling",
        "said",
        "saying",
        "heard",
        "hear",
        "hears",
        "listen",
        "listens",
        "listener",
    ),
    *("listeners", "believed", "believe", "believes", "believing", "thing", "things", "nobody", "whoever", "turn"),
    *("turns", "lacks", "lacking", "learnt", "wants", "wanted", "balance", "doubts", "league"),
}
MAX_LINES, MAX_ARGUMENTS = 70, 8
LONG = {"r2s.control.impedance.cartesian_impedance"}  # half of its 92 lines are its settings and what they mean
YAML = "its arguments are the keys of a yaml of conf/, one by one, so that each is checked by name"
# function: why it takes more arguments than the limit
REASONS = {
    "r2s.control.impedance.cartesian_impedance": YAML,
    "r2s.control.impedance.joint_impedance": YAML,
    "r2s.arm.clients.emulated.emulated_arm": YAML,
    "r2s.arm.clients.panda.Panda.__init__": YAML,
    "r2s.arm.twins.make_twin.make_twin": YAML,
    "r2s.arm.twins.twin_base.TwinBase.__init__": YAML,
    "r2s.learning.learner.Learner.__init__": YAML,
    "r2s.physics.dynamics.nominal_dynamics": YAML,
    "r2s.physics.robot.load_robot": YAML,
    "r2s.recordings.readers.read": "its arguments are the keys of conf/data/recording.yaml; files need few of them",
    "r2s.physics.user_laws.control_address.function": "a C function has pointers and sizes for the arrays of a law",
    "r2s.arm.driver.DriverBatch.__init__": "settings of a driver that callers combine freely, all but three named",
}


def parts(name: str) -> set[str]:
    """Return the lower-case words of an identifier."""
    return {word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)}


def identifiers(tree: ast.AST) -> set[str]:
    """Return every name that a module defines or assigns: functions, classes, arguments, variables, attributes."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.arg):
            found.add(node.arg)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            found.add(node.id)
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            found.add(node.attr)
        elif isinstance(node, ast.alias) and node.asname:
            found.add(node.asname)
    return found


def keys(node: object) -> set[str]:
    """Return all keys of nested mappings."""
    if isinstance(node, dict):
        return {str(k) for k in node} | {key for value in node.values() for key in keys(value)}
    return {key for value in node for key in keys(value)} if isinstance(node, list) else set()


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(ROOT)))
def test_names_are_the_fields(path: Path):
    """No identifier of r2s has a refused word in it."""
    tree = ast.parse(path.read_text())
    found = {name: words for name in identifiers(tree) if (words := parts(name) & REFUSED)}
    assert not found, f"{path.relative_to(ROOT)}: {found}; see docs/glossary.md"
    assert not parts(path.stem) & REFUSED


@pytest.mark.parametrize("path", CONFIGS, ids=lambda p: str(p.relative_to(ROOT)))
def test_config_keys_are_the_fields(path: Path):
    text = re.sub(r"\$\{[^}]*\}", "0", path.read_text())
    found = {key for key in keys(yaml.safe_load(text)) if parts(key) & REFUSED}
    assert not found, f"{path.relative_to(ROOT)}: {found}; see docs/glossary.md"


def functions() -> dict[str, tuple[int, int]]:
    """Return {module.function: (lines, arguments)} of every function, methods with their class."""
    found = {}

    def visit(node: ast.AST, name: str) -> None:
        for child in ast.iter_child_nodes(node):
            inner = f"{name}.{child.name}" if isinstance(child, ast.FunctionDef | ast.ClassDef) else name
            if isinstance(child, ast.FunctionDef):
                own = (*child.args.posonlyargs, *child.args.args, *child.args.kwonlyargs)
                count = len([a for a in own if a.arg not in ("self", "cls")])
                assert child.end_lineno is not None
                found[inner] = (child.end_lineno - child.lineno + 1, count)
            visit(child, inner)

    for path in MODULES:
        visit(ast.parse(path.read_text()), ".".join(path.relative_to(ROOT).with_suffix("").parts))
    return found


def test_functions_fit_on_a_screen():
    """At most 70 lines, but for a list of 17 settings; at most 8 arguments or a reason; a needless reason fails."""
    found = functions()
    assert {name for name, (lines, _) in found.items() if lines > MAX_LINES} == LONG
    many = {name for name, (_, count) in found.items() if count > MAX_ARGUMENTS}
    assert many == set(REASONS), f"without a reason: {many - set(REASONS)}; needless: {set(REASONS) - many}"


def test_the_glossary_defines_each_term_once():
    """A term is a bold word at the start of a line, followed by one definition."""
    text = (ROOT / "docs" / "glossary.md").read_text()
    terms = [match.lower() for match in re.findall(r"^\*\*(.+?)\*\*", text, flags=re.M)]
    assert len(terms) >= 60
    assert len(terms) == len(set(terms)), sorted({t for t in terms if terms.count(t) > 1})
