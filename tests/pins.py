"""Copy the versions of constraints.txt into pyproject.toml, where uv reads them: `make uv.lock`.

pip takes a file of constraints, uv only a list in pyproject.toml (`tool.uv.constraint-dependencies`). uv.lock itself
is not committed: it contains the addresses of a package index, which is the user's own choice.
"""

import re
from pathlib import Path
from textwrap import fill

ROOT = Path(__file__).resolve().parents[1]
LIST = re.compile(r"^constraint-dependencies = \[\n.*?^\]\n", re.MULTILINE | re.DOTALL)


def pins(root: Path = ROOT) -> list[str]:
    """Return the lines of constraints.txt, such as "numpy==2.4.6"."""
    return (root / "constraints.txt").read_text().split()


def with_pins(project: str, versions: list[str]) -> str:
    """Return the text of a pyproject.toml with uv's constraints replaced."""
    words, four = ", ".join(f'"{v}"' for v in versions), " " * 4
    lines = fill(words, 117, initial_indent=four, subsequent_indent=four, break_on_hyphens=False)
    return LIST.sub(f"constraint-dependencies = [\n{lines},\n]\n", project)


if __name__ == "__main__":
    path = ROOT / "pyproject.toml"
    path.write_text(with_pins(path.read_text(), pins()))
