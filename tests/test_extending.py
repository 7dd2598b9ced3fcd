"""docs/extending.md: what it shows is written down as it stands, and its commands are run."""

import re
import shlex

import pytest
from conftest import ROOT
from test_cli import TOY, succeed

PAGE = (ROOT / "docs" / "extending.md").read_text()
EXAMPLES = {part.split("\n")[0]: part for part in re.split(r"^## ", PAGE, flags=re.M)[1:]}
LINES = 60  # about a screen


@pytest.mark.parametrize("example", EXAMPLES)
def test_a_part_is_one_file_one_yaml_and_one_command(example, tmp_path, monkeypatch):
    """The files of an example, in an empty folder, and its command in that folder: the run ends well.

    +experiment=toy names a family, so the example's own is said again, after it.
    """
    assert len(EXAMPLES[example].splitlines()) <= LINES
    blocks = re.findall(r"```(\w+)\n(.*?)```", EXAMPLES[example], flags=re.S)
    commands = [text for kind, text in blocks if kind == "bash"]
    for kind, text in blocks:
        if kind != "bash":
            path = tmp_path / re.sub(r"^(#|<!--) *| *-->$", "", text.splitlines()[0])
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
    assert len(blocks) - len(commands) == 2
    for command in commands:
        words = shlex.split(command.removeprefix("python run.py"))
        words += [
            f"friction.family={family}" for family in re.findall(r"^family: (\S+)", EXAMPLES[example], flags=re.M)
        ]
        out = succeed(*words, *TOY, at=tmp_path)
        (folder,) = re.findall(r"written: (\S+)", out)
        assert (tmp_path / folder / "summary.json").is_file()
