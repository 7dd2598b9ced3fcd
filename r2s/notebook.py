"""Functions for notebooks: run a command of r2s, and show the figures of a run."""

import os
import re
import subprocess
import sys
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path

from r2s.errors import UserError

FIGURES_ONLY = "R2S_FIGURES"  # if this environment variable is set, `look` shows figures instead of the viewer


def r2s(*words: str) -> Path:
    """Run the command `r2s WORDS`, print its output, and return its run folder.

    Raises:
        UserError: the command fails; the error message is the last line that the command writes to stderr.
    """
    command = [sys.executable, "-m", "r2s", *words]
    env = os.environ | {
        "COLUMNS": "100",
        "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent.parent), *sys.path]),
    }
    done = subprocess.run(command, capture_output=True, text=True, env=env)
    if done.returncode:
        lines = [line for line in done.stderr.splitlines() if line.strip()]
        raise UserError(lines[-1].removeprefix("error: ") if lines else f"exit status {done.returncode}")
    out = re.sub(r"\x1b\[[0-9;]*m", "", done.stdout)  # remove the escape sequences for bold and dim text
    print("\n".join(line.rstrip() for line in out.splitlines()))
    return Path(re.findall(r"^written: (\S+)", out, flags=re.M)[-1])


def look(folder: str | Path, *figures: str, width: int = 900, height: int = 520) -> None:
    """Show a run in the notebook: in the Rerun viewer, or as figures if rerun-notebook is not installed.

    Args:
        folder: run folder. figures: names of the figures to show, such as "torque"; without names, show all.
        width, height: size of the viewer, pixels; `width` is also the width of the figures.
    """
    from IPython.display import Image, display

    folder = Path(folder)
    if find_spec("rerun_notebook") and not os.environ.get(FIGURES_ONLY):
        import rerun as rr

        stream = rr.RecordingStream(f"r2s notebook {folder.name}")
        stream.log_file_from_path(folder / "recording.rrd")
        stream.notebook_show(width=width, height=height)
        return
    paths = [folder / "figures" / f"{name}.png" for name in figures] or sorted((folder / "figures").glob("*.png"))
    if missing := [str(path) for path in paths if not path.is_file()]:
        raise UserError(f"look: no figure {missing[0]}")
    for path in paths:
        display(Image(_small(path, width)))


def _small(path: Path, width: int) -> bytes:
    """Return a figure as a PNG of `width` pixels and 64 colors, small enough for a notebook file."""
    from PIL import Image

    with Image.open(path) as picture:
        size = (width, round(picture.height * width / picture.width))
        drawn = picture.convert("RGB").resize(size, Image.Resampling.LANCZOS)
    out = BytesIO()
    drawn.quantize(64).save(out, "PNG", optimize=True)
    return out.getvalue()
