"""stage=results: reproduce a page of benchmarks/results in a clean clone of this commit; compare both versions.

`python run.py -m +experiment=results` reproduces all pages that docs/results.md cites.
"""

import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

from r2s.errors import UserError, choices, nearest
from r2s.stages.build import console, open_run
from r2s.stages.parts import plain

WHY: dict[str, str] = {}
ROOT = Path(__file__).resolve().parents[2]
PAGES = Path("benchmarks/results")
CLONE = "checkout"  # name of the clone in the run folder


def reads(cfg):
    """Return the config keys that stage=results reads; of `results.pages`, the stage reads only the chosen page."""
    return {"results.page", "results.data", f"results.pages.{cfg.results.page}"}


def commands_of(settings):
    """Return the commands, as lists of words, that produce `results.page`; {data} becomes the folder `results.data`.

    A command begins with `make`, or consists of arguments for python.

    Raises:
        UserError: the page does not exist, r2s is not a checkout, or the data for the page are missing.
    """
    page, pages, data = (settings[k] for k in ("page", "pages", "data"))
    if page not in pages:
        raise UserError(f"results.page: expected one of {choices(pages)}, got {page!r}{nearest(page, pages)}")
    if not (ROOT / ".git").exists() or shutil.which("git") is None:
        raise UserError("stage=results: needs git and a checkout of r2s; an installed package has no benchmarks")
    lines = pages[page]
    if any("{data}" in line for line in lines):
        if data is None:
            raise UserError(f"results.data: {page} needs recordings that do not ship with r2s; give their folder")
        if not Path(data).is_dir():
            raise UserError(f"results.data: no folder {data}")
        lines = [line.replace("{data}", shlex.quote(str(Path(data).resolve()))) for line in lines]
    return [shlex.split(line) for line in lines]


def results(cfg, overrides):
    """Reproduce a page of benchmarks/results; write the new page, differences.csv and report.md."""
    from r2s.progress import Progress
    from r2s.provenance import git
    from r2s.reporting.page_comparison import compare_all
    from r2s.reporting.results import page_report

    settings = plain(cfg.results)
    commands = commands_of(settings)
    paths = [PAGES / f"{name}.md" for name in settings["page"].split("+")]
    with open_run(cfg, overrides) as run:
        clone = run.folder / CLONE
        before, commit = cloned(clone, paths)
        if git()["dirty"]:
            print("uncommitted changes are not part of the clone")
        progress = Progress(settings["page"])
        for k, words in enumerate(commands):
            progress(k / len(commands), shlex.join(words)[:70])
            run.memo(f"command_{k}", lambda words=words: execute(words, clone, run.folder / "log.txt"))
        progress.close()
        for path in paths:
            shutil.copy(clone / path, run.folder)
        now = {path.stem: (clone / path).read_text() for path in paths}
        run.summary(page_report(console(), run, settings["page"], commit, compare_all(before, now)))
    print(f"written: {run.folder}")


def cloned(clone, paths):
    """Clone this commit unless the clone exists; return {page: committed text, or ""} and the hash of the commit.

    r2s removes the rows of all tables in the clone's pages, so a table that no command fills stays empty. The clone
    has a temporary name until the clone is complete.
    """
    from r2s.reporting.page_comparison import without_rows

    if not clone.is_dir():
        part = clone.with_name(f"{clone.name}.part")
        shutil.rmtree(part, ignore_errors=True)
        subprocess.run(["git", "clone", "--quiet", str(ROOT), str(part)], check=True)
        for page in (part / path for path in paths):
            if page.is_file():
                page.write_text(without_rows(page.read_text()))
        part.rename(clone)

    def output(*words):
        done = subprocess.run(["git", *words], cwd=clone, capture_output=True, text=True, check=False)
        return done.stdout if done.returncode == 0 else ""

    return {p.stem: output("show", f"HEAD:{p}") for p in paths}, output("rev-parse", "HEAD").strip()


def execute(words, clone, log):
    """Run `make ...` or `python WORDS` in the clone, with the clone's r2s; append the output to the file `log`.

    Raises:
        UserError: the command fails; the message quotes the last line of output.
    """
    command = words if words[0] == "make" else [sys.executable, *words]
    with open(log, "a+") as file:
        file.write(f"$ {shlex.join([Path(command[0]).name, *command[1:]])}\n")
        file.flush()
        env = os.environ | {"PYTHONPATH": str(clone.resolve())}
        done = subprocess.run(command, cwd=clone, env=env, stdout=file, stderr=subprocess.STDOUT, check=False)
    if done.returncode:
        *_, last = log.read_text(errors="replace").splitlines()
        raise UserError(f"{words[0]} failed ({log}): {last.removeprefix('error: ')}")
    return {"returncode": 0}
