"""Generate the home page from README.md and one API page per room (hooks of mkdocs).

The table in docs/explanation/architecture.md gives the rooms, their order and their descriptions.
"""

import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parent.parent
ARCHITECTURE = (ROOT / "docs" / "explanation" / "architecture.md").read_text()
ROOMS = dict(re.findall(r"^\| `(\w+)` \| (.+) \|$", ARCHITECTURE, flags=re.M))


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Append the API to the navigation."""
    assert config.nav is not None
    config.nav.append({"API": [f"api/{page}.md" for page in ("index", *ROOMS)]})
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages."""
    pages = {"index.md": (ROOT / "README.md").read_text().replace("](docs/", "]("), "api/index.md": rooms()}
    pages |= {f"api/{name}.md": room(name) for name in ROOMS}
    for name, text in pages.items():
        files.append(File.generated(config, name, content=text))
    return files


def rooms() -> str:
    """Return the index of the rooms."""
    rows = [f"| [`r2s.{name}`]({name}.md) | {content} |" for name, content in ROOMS.items()]
    intro = (
        "Generated from the docstrings. A module imports only from its own room and from rooms above it in this "
        "table. Arrays are NumPy arrays unless a signature states otherwise; the text gives shapes and units."
    )
    return "\n".join(["# API", "", intro, "", "| room | what is in it |", "|---|---|", *rows, ""])


def room(name: str) -> str:
    """Return the page of a room: its modules, including those of its folders."""
    at = ROOT / "r2s" / name
    paths = sorted(at.rglob("*.py")) if at.is_dir() else [at.with_suffix(".py")]
    modules = [".".join(p.relative_to(ROOT).with_suffix("").parts) for p in paths if p.name != "__init__.py"]
    content = ROOMS[name][0].upper() + ROOMS[name][1:]
    head = ["---", f"title: {name}", "---", f"# `r2s.{name}`", "", f"{content}.", ""]
    return "\n".join([*head, *(f"::: {module}\n" for module in modules)])
