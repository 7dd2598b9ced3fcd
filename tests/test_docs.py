"""What README.md and docs/ name is there: links, pictures, files, rooms, and the lines that they point at."""

import re
from pathlib import Path

import pytest
from test_rooms import ROOMS

ROOT = Path(__file__).parent.parent
README, ARCHITECTURE = ROOT / "README.md", ROOT / "docs" / "explanation" / "architecture.md"
PAGES = [README, *sorted((ROOT / "docs").rglob("*.md"))]
FILE = re.compile(r"\b(?:r2s|conf|docs|tests|benchmarks|notebooks)/[\w/]*\w+\.(?:py|yaml|md|png|svg|ipynb)\b")
MOST_README_LINES = 60  # a screen, beside its picture
MOST_WORDS = 20_000  # of all pages in docs/


def table(page: Path, heading: str) -> list[list[str]]:
    """Return the cells of the rows of the first table below `## heading`, its head left out."""
    below = page.read_text().split(f"## {heading}\n", 1)[1].split("\n## ")[0]
    rows = [line.strip("|").split("|") for line in below.splitlines() if line.startswith("|")]
    return [[cell.strip().strip("`") for cell in row] for row in rows[2:]]


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_links_and_pictures_are_there(page):
    """A link that is not to the web leads to a file of the repository, relative to its page."""
    links = {link.split("#")[0] for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text())}
    missing = {k for k in links if k and "://" not in k and not (page.parent / k).exists()}
    assert not missing, f"{page.name} links to what is not there: {missing}"


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_files_that_are_named_are_there(page):
    """r2s/arm/driver.py, conf/dr/paper.yaml ... in a text are files of the repository."""
    missing = {name for name in FILE.findall(page.read_text()) if not (ROOT / name).is_file()}
    assert not missing, f"{page.name} names what is not there: {missing}"


def test_every_room_is_in_the_drawing_and_nothing_else():
    """Folders and files in the drawing of the house exist, and no room is left out but the doors."""
    words = " ".join(re.findall(r">([^<]+)<", (ROOT / "docs" / "rooms.svg").read_text()))
    drawn, files = set(re.findall(r"(\w+)/", words)), set(re.findall(r"(\w+)\.py", words))
    assert {name for name in drawn if not (ROOT / name).is_dir() and not (ROOT / "r2s" / name).is_dir()} == set()
    assert {name for name in files if not (ROOT / "r2s" / f"{name}.py").is_file()} == set()
    assert set(ROOMS) - {"notebook", "__main__"} <= drawn | files


def test_the_table_of_rooms_is_the_order_that_imports_obey():
    """docs/explanation/architecture.md lists the rooms of tests/test_rooms.py, in their order."""
    listed = [row[0] for row in table(ARCHITECTURE, "The rooms")]
    assert listed == [name for name in ROOMS if name != "__main__"]


@pytest.mark.parametrize("row", table(ARCHITECTURE, "Where is the line that ...?"), ids=lambda row: row[0])
def test_a_reader_finds_the_line_in_three_hops(row):
    """Each hop exists, and the quoted line is in the file of the last one."""
    _, first, second, line = row
    assert (ROOT / first).exists()
    assert line in (ROOT / second).read_text(), f"{second} has no line with {line}"


def test_the_readme_can_be_read_at_once():
    """It stays short; details have pages of their own."""
    assert len(README.read_text().splitlines()) <= MOST_README_LINES


def test_the_pages_stay_short():
    """One fact in one place: docs/ has at most MOST_WORDS words."""
    assert sum(len(page.read_text().split()) for page in PAGES[1:]) <= MOST_WORDS
