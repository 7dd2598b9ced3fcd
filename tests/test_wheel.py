"""What `pip install .` brings: the wheel has all that a run needs, and runs from any folder."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import ROOT


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """Return a folder that the wheel of this checkout is installed in, without what it depends on."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    for name in ("r2s", "conf", "hydra_plugins"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", source)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    subprocess.run([*pip, "wheel", str(source), "--no-deps", "--no-build-isolation", "-w", str(folder)], check=True)
    (wheel,) = folder.glob("*.whl")
    subprocess.run([*pip, "install", "--no-deps", "--target", str(folder / "site"), str(wheel)], check=True)
    return folder / "site"


def test_the_wheel_has_every_module_and_every_number(installed):
    """All of r2s and of conf is in it, and nothing else of the checkout."""
    for name, at in (("r2s", "r2s"), ("conf", "r2s/conf")):
        kinds = ("py", "yaml", "xml", "json", "npz", "md", "typed", "cc", "sh")
        own = {p.relative_to(ROOT / name) for kind in kinds for p in (ROOT / name).rglob(f"*.{kind}")}
        there = {p.relative_to(installed / at) for p in (installed / at).rglob("*.*") if "__pycache__" not in str(p)}
        assert {p for p in there if p.parts[0] != "conf"} == own if name == "r2s" else there == own
    assert "r2s = r2s.cli:main" in next(installed.glob("*.dist-info/entry_points.txt")).read_text()


def surroundings(installed: Path, folder: Path) -> dict[str, str]:
    """Return the variables under which Python finds the installed r2s and modules of a folder, not the checkout."""
    return {"PYTHONPATH": f"{installed}{os.pathsep}{folder}", "PYTHONSAFEPATH": "1", "COLUMNS": "110"}


def called(installed: Path, folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Call the installed `r2s WORDS` in a folder; nothing that it loaded of r2s is of the checkout."""
    own = "[m for k, m in list(sys.modules.items()) if k.split('.')[0] == 'r2s' and getattr(m, '__file__', None)]"
    seen = f"import atexit, sys\natexit.register(lambda: print('FROM', *{{m.__file__ for m in {own}}}))\n"
    (folder / "r2s_seen.py").write_text(seen)
    code = "import r2s_seen, sys; sys.argv[0] = 'r2s'; from r2s.cli import main; main()"
    here = os.environ | surroundings(installed, folder)
    command = [sys.executable, "-c", code, *words]
    done = subprocess.run(command, cwd=folder, env=here, capture_output=True, text=True)
    modules = done.stdout.split("FROM")[1].split()
    assert modules
    assert all(Path(m).is_relative_to(installed) for m in modules)
    return done


@pytest.mark.long
def test_installed_it_finds_its_settings(installed, tmp_path):
    """`r2s` and `python -m r2s` compose from the conf of the wheel, whatever the folder."""
    done = called(installed, tmp_path, "algo=tqq")
    assert (done.returncode, "did you mean 'tqc'" in done.stderr) == (2, True), done.stdout + done.stderr
    here = os.environ | surroundings(installed, tmp_path)
    command = [sys.executable, "-m", "r2s", "--help"]
    script = subprocess.run(command, cwd=tmp_path, env=here, capture_output=True, text=True)
    assert (script.returncode, "stage=identify" in script.stdout) == (0, True), script.stdout + script.stderr


@pytest.mark.slow
def test_installed_it_runs_from_any_folder(installed, tmp_path):
    """`r2s stage=identify` writes runs/ where it is called, and takes nothing from the checkout."""
    done = called(installed, tmp_path, "stage=identify", "+experiment=toy")
    assert done.returncode == 0, done.stdout + done.stderr
    (folder,) = re.findall(r"written: (\S+)", done.stdout)
    assert (tmp_path / folder / "parameters.yaml").is_file()
    assert len(done.stdout.split("FROM")[1].split()) > 30


@pytest.mark.slow
def test_installed_its_pipeline_ends_for_another_arm(installed, tmp_path):
    """`r2s robot=other robot.mjcf=FILE stage=pipeline` in an empty folder: six joints, nothing else typed of them."""
    words = ["robot=other", f"robot.mjcf={Path(__file__).parent / 'models' / 'six_joints.xml'}", "stage=pipeline"]
    words += ["pipeline.train_minutes=null", "name=six", "+experiment=toy"]
    here = os.environ | surroundings(installed, tmp_path)
    command = [sys.executable, "-m", "r2s", *words]
    done = subprocess.run(command, cwd=tmp_path, env=here, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    for model in ("identified", "nominal"):
        assert f"{model} model, twin" in done.stdout
        assert (tmp_path / "runs" / "transfer" / f"six_{model}" / "summary.json").is_file()
