"""stage=results: a page made again in a clean clone, and each of its cells beside the committed one."""

import json
import re
import subprocess

import pytest
import yaml
from cli_runs import r2s, succeed
from conftest import ROOT

from r2s.reporting.page_comparison import MISSING, compare_all, compare_pages, table_cells, without_rows

BEFORE = """# A page

Words | no table.

## Arms

| arm | error, mm | share, % |
| --- | --- | --- |
| one | 1.0 [0.8, 1.2] | 97 |
| two | 2.0 [1.8, 2.2] | 98 |
| two | 3.0 [2.8, 3.2] | 99 |

Text.

## Others

| arm | stops |
|---|---:|
| one | 1,024 |
"""
PAGES = yaml.safe_load((ROOT / "conf/stage/results.yaml").read_text())["results"]["pages"]


def test_a_page_equals_itself_and_paragraphs_do_not_count():
    found = compare_pages(BEFORE, BEFORE.replace("Text.", "Other words.\n\nMore of them."))
    assert (found["verdict"] == "equal").all()
    assert len(found) == 7
    assert table_cells(BEFORE)["Arms", "two (2)", "share, %"] == "99"


def test_a_cell_differs_where_its_interval_does():
    """With an interval, without, by a last digit; a row that is gone, a row that is new; the relative change."""
    now = BEFORE.replace("1.0 [0.8, 1.2]", "1.1 [1.0, 1.3]").replace("2.0 [1.8, 2.2]", "4.0 [3.9, 4.1]")
    now = now.replace("| one | 1,024 |", "| three | 7 |").replace("97", "95").replace("99", "98")
    found = compare_pages(BEFORE, now).set_index(["section", "row", "column"])
    assert found.loc["Arms", "one", "error, mm"]["verdict"] == "within intervals"
    assert found.loc["Arms", "two", "error, mm"]["verdict"] == "beyond intervals"
    assert found.loc["Arms", "two", "error, mm"]["change"] == pytest.approx(2.1 / 3.9)  # 1.8 -> 3.9
    assert found.loc["Arms", "one", "share, %"]["verdict"] == "without interval"
    assert found.loc["Arms", "two (2)", "share, %"]["verdict"] == "last digit"
    assert found.loc["Others", "one", "stops"]["verdict"] == MISSING
    assert found.loc["Others", "three", "stops"]["verdict"] == "new"


def test_a_table_that_is_not_made_again_shows_it():
    """Before its scripts run, a page loses the rows of its tables and nothing else."""
    bare = without_rows(BEFORE)
    assert not table_cells(bare)
    assert set(BEFORE.splitlines()) - set(bare.splitlines()) == {
        x for x in BEFORE.splitlines() if x[2:5] in ("one", "two")
    }
    assert set(compare_pages(BEFORE, bare)["verdict"]) == {MISSING}


def test_pages_of_one_run_stay_apart():
    """Two pages with equal sections are compared each with itself."""
    other = BEFORE.replace("one", "none")
    cells = compare_all({"a": BEFORE, "b": other}, {"a": BEFORE, "b": without_rows(other)})
    verdicts = cells.groupby(cells["section"].str[:2])["verdict"].agg(set).to_dict()
    assert verdicts == {"a:": {"equal"}, "b:": {MISSING}}


@pytest.mark.parametrize("page", sorted(p.stem for p in (ROOT / "benchmarks/results").glob("*.md")))
def test_every_page_is_read(page):
    """Each committed page has cells, and equals itself."""
    text = (ROOT / f"benchmarks/results/{page}.md").read_text()
    assert table_cells(text)
    assert set(compare_pages(text, text)["verdict"]) == {"equal"}


def test_the_experiment_makes_every_page():
    """Its list is that of the stage; every script exists and writes its page."""
    experiment = (ROOT / "conf/experiment/results.yaml").read_text()
    assert yaml.safe_load(experiment)["hydra"]["sweeper"]["params"]["results.page"].split(",") == list(PAGES)
    for pages, commands in PAGES.items():
        scripts = [ROOT / line.split()[0] for line in commands if not line.startswith("make ")]
        assert all(path.is_file() for path in scripts)
        for page in pages.split("+"):
            assert any(re.search(rf'"{page}(\.md)?"', path.read_text()) for path in scripts), page


@pytest.mark.long
@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="needs a git checkout")
def test_a_page_is_made_in_a_clone_and_resumes(tmp_path):
    """Its commands run in a clone of the commit; after a failure the run goes on where it ended."""
    gate = tmp_path / "gate"
    first = (
        "import pathlib as p; p.Path('benchmarks/results/law.md').write_text('# L\\n\\n|a|b|\\n|---|---|\\n|x|1|\\n')"
    )
    second = f"import sys; from pathlib import Path; sys.exit(not Path('{gate}').exists() and 'error: no gate')"
    commands = json.dumps([f'-c "{first}"', f'-c "{second}"'])
    words = ["stage=results", "results.page=law", f"results.pages.law={commands}", f"root={tmp_path}", "name=law"]
    words.append("skip_completed=true")
    failed = r2s(*words)
    assert failed.returncode == 2
    assert failed.stderr.strip().endswith("no gate")
    run = tmp_path / "results" / "law"
    assert (run / "checkout" / "r2s" / "cli.py").is_file()
    gate.touch()
    assert "1 new" in succeed(*words)
    assert (run / "log.txt").read_text().count("write_text") == 1
    summary = json.loads((run / "summary.json").read_text())
    assert (summary["new"], summary["equal"]) == (1, 0)
    assert summary[MISSING] == len(table_cells((ROOT / "benchmarks/results/law.md").read_text()))
    assert "| law |" in (tmp_path / "results" / "report.md").read_text()
    saved = run / "config.yaml"  # neither another page's commands nor a group that no page reads are its settings
    saved.write_text(saved.read_text().replace("benchmarks/pipeline.py", "old.py").replace("kind: arm", "kind: old"))
    made = saved.read_text()
    assert "old.py" in made
    succeed(*words)
    assert (run / "log.txt").read_text().count("write_text") == 1
    assert saved.read_text() == made
    head = subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert head.strip() in (run / "report.md").read_text()


@pytest.mark.long
@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["results.page=pipline"], r"results.page: expected one of .*did you mean 'pipeline'"),
        (["results.page=real_panda"], "results.data: real_panda needs recordings that do not ship with r2s"),
        (["results.page=wrench", "results.data=/no/such"], "results.data: no folder /no/such"),
    ],
)
def test_a_wrong_setting_is_one_line(words, line, tmp_path):
    done = r2s("stage=results", *words, f"root={tmp_path}")
    assert done.returncode == 2
    assert re.search(line, done.stderr), done.stderr
    assert not any(tmp_path.iterdir())
