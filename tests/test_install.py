"""What an installation brings: uv's versions are pip's, and whatever is missing names the pip line that brings it."""

import ast
import os
import re
import shutil
import subprocess
import sys
import tomllib
from importlib.machinery import EXTENSION_SUFFIXES
from importlib.metadata import packages_distributions
from importlib.util import find_spec
from pathlib import Path

import pytest
from conftest import ROOT
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from pins import pins, with_pins

from r2s.errors import UserError, optional_import
from r2s.override_checks import check_overrides
from r2s.recordings.ros_bag import write_mcap
from r2s.reporting.trackers.mlflow import Mlflow
from r2s.reporting.trackers.tensorboard import Tensorboard
from r2s.reporting.trackers.trackio import Trackio
from r2s.reporting.trackers.wandb import Wandb
from r2s.stages.tune import tune

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
EXTRAS = PROJECT["project"]["optional-dependencies"]
PAGE = (ROOT / "docs/how_to/install.md").read_text()
OWN = [p for name in ("r2s", "conf", "docs", "hydra_plugins", "notebooks") for p in (ROOT / name).rglob("*.*")]


def test_uv_takes_the_versions_of_pip():
    """Uv's constraints are those of constraints.txt; `make uv.lock` writes them."""
    text = (ROOT / "pyproject.toml").read_text()
    assert PROJECT["tool"]["uv"]["constraint-dependencies"] == pins()
    assert with_pins(text, pins()) == text
    assert tomllib.loads(with_pins(text, ["a==1"]))["tool"]["uv"]["constraint-dependencies"] == ["a==1"]


@pytest.mark.slow
def test_a_lock_of_uv_has_the_versions_of_pip(tmp_path):
    """`uv lock` succeeds and locks every version of constraints.txt once; what else it locks belongs to torch."""
    uv = shutil.which("uv") or pytest.skip("no uv here: pip install uv")
    for name in ("pyproject.toml", "constraints.txt"):
        shutil.copy(ROOT / name, tmp_path)
    for package in PROJECT["tool"]["setuptools"]["packages"]:
        (tmp_path / package.replace("r2s.conf", "conf").replace(".", "/")).mkdir(parents=True, exist_ok=True)
    subprocess.run([uv, "lock", "--quiet"], cwd=tmp_path, check=True)
    locked = tomllib.loads((tmp_path / "uv.lock").read_text())["package"]
    found = sorted((p["name"], p["version"]) for p in locked)
    pinned = sorted((canonicalize_name(line.split("==")[0]), line.split("==")[1]) for line in pins())
    assert not set(pinned) - set(found)
    others = {n for n, _ in set(found) - set(pinned) if not re.match("nvidia|cuda|triton", n)}
    assert others <= {"r2s", "appnope", "httpx2-jsfetch"}  # the latter two: of other systems
    assert len(found) == len({name for name, _ in found}), "a package has two versions"


def test_every_extra_is_on_one_page():
    """The table of the page about installation lists the extras, and every line in r2s and its pages names one."""
    assert re.findall(r"^\|`(\w+)`\|", PAGE, re.MULTILINE) == list(EXTRAS)
    named = {
        (p.name, extra)
        for p in OWN
        if p.suffix in (".py", ".md", ".yaml")
        for extra in re.findall(r"pip install 'r2s\[([a-z]\w+)\]'", p.read_text())
    }
    assert len(named) > 10
    assert not [(name, extra) for name, extra in named if extra not in EXTRAS]


MISSING = {  # package -> what needs it, how the message begins, the extra
    "rosbags": (lambda: write_mcap(Path("a.mcap"), *[None] * 3), "a.mcap", "recordings"),
    "optuna": (lambda: tune(None, []), "stage=tune", "sweeps"),
    "tensorboard": (Tensorboard, "tracker=tensorboard", "trackers"),
    "mlflow": (lambda: Mlflow("sqlite:///a.db"), "tracker=mlflow", "trackers"),
    "wandb": (Wandb, "tracker=wandb", "trackers"),
    "trackio": (lambda: Trackio(Path()), "tracker=trackio", "trackers"),
}


@pytest.mark.parametrize("package", MISSING)
def test_a_missing_extra_is_one_line(package, monkeypatch):
    """It names who needs what, and the pip line; tests of readers, clients and Ray do the same for theirs."""
    for name in {package, *(m for m in sys.modules if m.split(".")[0] == package)}:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setattr(os, "environ", dict(os.environ))
    call, needed_by, extra = MISSING[package]
    with pytest.raises(UserError) as error:
        call()
    assert str(error.value) == f"{needed_by} needs {package}, which is not installed: pip install 'r2s[{extra}]'"


@pytest.mark.skipif(find_spec("hydra_plugins.hydra_submitit_launcher") is not None, reason="submitit is here")
def test_a_missing_launcher_is_one_line():
    with pytest.raises(UserError, match=r"^hydra/launcher=submitit_slurm needs submitit, .*'r2s\[sweeps\]'"):
        check_overrides(["hydra/launcher=submitit_slurm"], None, multirun=True)


def test_a_package_that_does_not_import_says_why(tmp_path, monkeypatch):
    """It is installed, and what it imports itself is not."""
    (tmp_path / "half.py").write_text("import no_such_package")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(UserError, match=r"^arm=x needs half, which does not import \(No module named 'no_such_pack"):
        optional_import("half", "arm=x", "panda")


def test_an_extension_that_misses_a_library_says_which(tmp_path, monkeypatch):
    """It is installed: the error of the dynamic linker, and no pip line."""
    (tmp_path / f"half{EXTENSION_SUFFIXES[0]}").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(UserError, match=r"^arm=x needs half, which does not import \(.*half.*\)$"):
        optional_import("half", "arm=x", "panda")


@pytest.mark.long
def test_no_import_is_left_to_chance():
    """Each package that r2s imports is a dependency, or comes with an extra through `optional_import`."""
    files = [*(ROOT / "r2s").rglob("*.py"), *(ROOT / "hydra_plugins").glob("*.py")]
    imported = {}
    for path in files:
        for node in ast.walk(ast.parse(path.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) and node.module and not node.level else []
            imported |= {name.split(".")[0]: path for name in names}
    brought = {Requirement(line).name.lower() for line in PROJECT["project"]["dependencies"]}
    provided = {module for module, names in packages_distributions().items() if brought & {n.lower() for n in names}}
    optional = {m.split(".")[0] for p in files for m in re.findall(r'optional_import\(\s*f?"([\w.]+)', p.read_text())}
    elsewhere = {
        "r2s",
        "dartpy",
        "joblib",
        "yaml",
        "PIL",
        "filelock",
        "llvmlite",
    }  # of what a dependency needs itself
    elsewhere |= {"onnxruntime", "IPython"}  # in a bundle, in a notebook
    assert not imported.keys() - provided - optional - elsewhere - set(sys.stdlib_module_names)
