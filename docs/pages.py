"""Pages of the site that nobody writes: README.md as the home page, and the API, a page per room (hooks of mkdocs).

The rooms, their order and what is said of each are the table of docs/architecture.md.
"""

import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parent.parent
ROOMS = dict(re.findall(r"^\| `(\w+)` \| (.+) \|$", (ROOT / "docs" / "architecture.md").read_text(), flags=re.M))


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Put the API at the end of the navigation."""
    assert config.nav is not None
    config.nav.append({"API": [f"api/{page}.md" for page in ("index", *ROOMS)]})
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are made."""
    made = {"index.md": (ROOT / "README.md").read_text().replace("](docs/", "]("), "api/index.md": rooms()}
    made |= {f"api/{name}.md": room(name) for name in ROOMS}
    for name, text in made.items():
        files.append(File.generated(config, name, content=text))
    return files


def rooms() -> str:
    """Return the page that lists the rooms."""
    rows = [f"| [`r2s.{name}`]({name}.md) | {words} |" for name, words in ROOMS.items()]
    words = (
        "From the docstrings. A module imports only from its own room and from rooms above it in this table. Arrays "
        "are NumPy's unless a signature says otherwise; shapes and units stand in the text."
    )
    return "\n".join(["# API", "", words, "", "| room | what is in it |", "|---|---|", *rows, ""])


def room(name: str) -> str:
    """Return the page of a room: its modules, those of its folders included."""
    at = ROOT / "r2s" / name
    paths = sorted(at.rglob("*.py")) if at.is_dir() else [at.with_suffix(".py")]
    modules = [".".join(p.relative_to(ROOT).with_suffix("").parts) for p in paths if p.name != "__init__.py"]
    words = ROOMS[name][0].upper() + ROOMS[name][1:]
    head = ["---", f"title: {name}", "---", f"# `r2s.{name}`", "", f"{words}.", ""]
    return "\n".join([*head, *(f"::: {module}\n" for module in modules)])
