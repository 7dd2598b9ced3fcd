"""The pages of docs/ as a reader uses them: typed from the first command to the last, and built as a site."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
import yaml
from cli_runs import TOY, recording, succeed  # noqa: F401 (a fixture)
from conftest import ROOT, in_blocks
from test_extending import EXAMPLES

DOCS = ROOT / "docs"
OWN = "extending.md"  # test_extending.py types it
PAGES = [ROOT / "README.md", *(p for p in sorted(DOCS.rglob("*.md")) if p.name != OWN)]
PROGRAM = r"(?:python|r2s|make|pip|pytest|rerun|source|mlflow|wandb|tensorboard|TRACKIO_DIR=\S+) "
ELSEWHERE = {  # what this file does not type, and why
    r"make \w+": "sets up from the network; what it then does is stage=pipeline, these tests, the site below",
    r"pip install": "from the network",
    r"(source|rerun|mlflow|wandb|tensorboard|TRACKIO_DIR=\S+) ": "the shell; programs of others, which wait",
    r"python benchmarks/": "takes minutes to hours; its page names the machine that it ran on",
    r"python examples/": "test_envs.py and test_gym.py run them for some hundred steps",
    r"python( -m r2s| run.py)$": "names of doors: test_wheel.py, and every other command",
    r"(python run.py|r2s) (list|look|export)( RUN| runs/train/NAME)?$": "named alone: test_look.py, test_export.py",
    r"r2s check$": "named alone: test_verdict.py",
    r"(python bundle/r2s_runtime.py|g\+\+) ": "test_export.py; the loop itself needs an arm",
    r"pytest -m gazebo$": "needs Gazebo",
    r"sudo |export R2S_GAZEBO_ROOT=": "packages of the system, as root; the shell",
    r"python run.py .*simulator=gazebo_classic": "needs Gazebo Classic: test_gazebo_classic.py",
    r"python run.py resume=": "test_cli.py kills a run first",
    r"python run.py -m \+experiment=paper_grid": "144 jobs; test_cli_sweeps.py runs two of them",
    r"python run.py \+experiment=tune": "test_tune.py",
    r"python run.py \+experiment=paper_reward": "test_cli_sweeps.py, at toy size",
    r"python run.py .*data\.path=(logs/|\[a\.csv)": "recordings that a reader has: test_known.py",
    r"python run.py .*identify\.prior\.": "a recording of three joints: test_known.py",
    r"python run.py .*(UNLOADED|LOADED)": "an arm with and without a payload: test_loaded.py",
    r"python run.py .*data\.gears=": "an arm with elastic gears: test_gears.py",
    r"python run.py .*TOOL\.json": "an arm at a surface: test_contact_identification.py, test_presses.py",
}
INSTEAD = {  # of what no test has
    "arm=panda arm.address=172.16.0.2": "arm=panda_emulated",
    "arm.realtime=true": "arm.realtime=false",  # a machine that runs tests is no real-time one
}
TRACKERS = ("tensorboard", "mlflow", "wandb", "trackio")


def commands(page: Path) -> list[str]:
    """Return the commands on a page, in order: lines of ```bash blocks, and what begins with a program in a text."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.S | re.M)
    inline = [c for c in re.findall(r"`([^`\n]+)`", text) if re.match(PROGRAM, c)]
    return list(dict.fromkeys([*in_blocks(page), *inline]))


LISTED = set(in_blocks(DOCS / "reference" / "commands.md"))  # test_cli.py types them; test_look.py, test_export.py
TYPED = {
    page: [c for c in commands(page) if c not in LISTED and not any(re.match(k, c) for k in ELSEWHERE)]
    for page in PAGES
}


def test_every_command_is_typed_by_a_test():
    """What is left is a command of r2s, so that it can be; and no reason is there without its command."""
    left = [c for typed in TYPED.values() for c in typed]
    assert not [c for c in left if not c.startswith(("python run.py ", "r2s "))]
    others = {page.name: re.findall(r"^```(?!bash)\w*\n(.*?)^```", page.read_text(), re.S | re.M) for page in PAGES}
    assert not [(k, b) for k, blocks in others.items() for b in blocks if re.search(f"^{PROGRAM}", b, re.M)]
    everything = [c for page in PAGES for c in commands(page)]
    assert not [k for k in ELSEWHERE if not any(re.match(k, c) for c in everything)]
    assert not [k for k in INSTEAD if not any(k in c for c in everything)]


@pytest.mark.slow
@pytest.mark.parametrize("page", [p for p, typed in TYPED.items() if typed], ids=lambda p: p.stem)
def test_a_page_is_typed_from_its_first_command_to_its_last(page, recording, tmp_path):  # noqa: F811
    """Each ends well, at toy size, in one folder, as a reader would; an arm and its clock are the emulator's."""
    xml = re.findall(r"```xml\n(.*?)```", EXAMPLES["A robot"], flags=re.S)[0]
    (tmp_path / "my_arm.xml").write_text(xml.split("\n", 1)[1])
    for command in TYPED[page]:
        line = command.replace("FILE", str(recording))
        for asked, instead in INSTEAD.items():
            line = line.replace(asked, instead)
        words = shlex.split(line)[1 if line.startswith("r2s ") else 2 :]
        wanted = [t for t in TRACKERS if any(w.startswith("tracker=") and t in w for w in words)]
        if [t for t in wanted if not find_spec(t)]:
            continue  # an extra that is not installed here
        if words[0] not in ("list", "look", "check", "export", "convert", "engines", "--help"):
            words += TOY
            name = next((w.removeprefix("name=") for w in words if w.startswith("name=")), None)
            named = name and f"runs/identify/{name}/ramps.npz" in page.read_text()
            if named and "stage=identify" in words and "data=recording" not in words:
                words.append("data.ramp_poses=1")
        succeed(*words, at=tmp_path)


def test_the_site_leads_to_every_page():
    """mkdocs.yml names each page of docs/ once, besides the generated ones; no page links outside docs/."""
    nav = yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"]
    found = re.findall(r"(\S+\.md)$", yaml.safe_dump(nav), flags=re.M)
    pages = sorted(DOCS.rglob("*.md"))
    assert sorted(found) == sorted(["index.md", *(p.relative_to(DOCS).as_posix() for p in pages)])
    links = {(p, link) for p in pages for link in re.findall(r"\]\(([^)\s#]+)", p.read_text()) if "://" not in link}
    assert not [(p.name, link) for p, link in links if not (p.parent / link).resolve().is_relative_to(DOCS)]


def opened(browser: str, page: str, picture: Path, folder: Path) -> tuple[str, list[str]]:
    """Return what a page is in a browser, its scripts having run, and what it says to the console; draw it too."""
    words = ["--headless=new", "--no-sandbox", "--disable-gpu", f"--user-data-dir={folder}", "--window-size=1300,900"]
    words += ["--enable-logging=stderr", "--virtual-time-budget=8000", f"--screenshot={picture}", "--dump-dom", page]
    done = subprocess.run([browser, *words], capture_output=True, text=True, timeout=300)
    return done.stdout, [line for line in done.stderr.splitlines() if ":CONSOLE" in line]


@pytest.mark.slow
def test_the_site_and_a_report_open_without_a_word_on_the_console(tmp_path):
    """Built strictly, without a warning; home, a how-to, the gallery, a room and a report open; the search finds."""
    pytest.importorskip("mkdocs", reason="pip install 'r2s[docs]' builds the site")
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    env = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(build, cwd=ROOT, capture_output=True, text=True, env=env)
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
    assert not [
        p
        for p in (tmp_path / "site").glob("**/*.html")
        if re.search(r'(src|href)="https?:.*\.(js|css)', p.read_text())
    ]
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if browser is None:
        pytest.skip("no Chromium here: the site was built, and not opened")
    succeed("stage=identify", "name=seen", *TOY, at=tmp_path)
    pages = [
        tmp_path / "site" / f"{name}.html" for name in ("index", "tutorials/without_arm", "gallery", "api/physics")
    ]
    for page in [*pages, tmp_path / "runs/identify/seen/report.html"]:
        seen, said = opened(browser, page.as_uri(), tmp_path / f"{page.stem}.png", tmp_path / "browser")
        assert said == [], page
        assert "<h1" in seen
    found, said = opened(browser, f"{pages[0].as_uri()}?q=friction", tmp_path / "search.png", tmp_path / "browser")
    assert said == []
    assert re.search(r"\d+ matching documents", found)
