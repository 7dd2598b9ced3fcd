"""Progress is a bar on a terminal and plain lines elsewhere."""

import os
import re
import subprocess
import sys
from contextlib import suppress
from types import SimpleNamespace

import pytest

from r2s.progress import Progress


def test_a_bar_goes_on_after_it_was_full(monkeypatch):
    """An identification has several searches: each begins at zero, and the time goes on."""
    monkeypatch.setenv("FORCE_COLOR", "1")  # makes rich see a terminal
    progress = Progress("identify")
    (task,) = progress._bar.tasks
    progress(1.0)
    assert task.finished
    before = task.elapsed
    progress(0.3)
    assert not task.finished
    assert task.elapsed > before
    progress.close()


PROGRESS = """
from r2s.progress import Progress
progress = Progress("train [tqc]")
progress(0.25, "12k env steps, 50 % < 1 cm")
"""


def test_progress_is_plain_lines_where_nobody_watches():
    """Share, elapsed and text; nothing that only a terminal understands."""
    done = subprocess.run([sys.executable, "-c", PROGRESS + "progress.close('9 s')"], capture_output=True, text=True)
    first, last = done.stderr.splitlines()
    assert first.startswith("train [tqc]  25 %  0:00")
    assert first.endswith("12k env steps, 50 % < 1 cm")
    assert last == "train [tqc] done in 0:00  9 s"


def test_the_time_left_is_that_of_the_share_since_the_begin(capsys, monkeypatch):
    """A resumed run begins at a share that an earlier process has done."""
    now = [100.0]
    monkeypatch.setattr("r2s.progress.time", SimpleNamespace(perf_counter=lambda: now[0]))
    progress = Progress("train", every_s=0.0)
    progress(0.78)
    now[0] += 20.0
    progress(0.80)  # 0.02 in 20 s, so 0.2 more take 200 s
    first, second = capsys.readouterr().err.splitlines()
    assert "left" not in first
    assert re.search(r"3:(19|20) left", second)  # rounded down


@pytest.mark.skipif(sys.platform == "win32", reason="no pseudo-terminals")
@pytest.mark.parametrize("end", ["progress.close('9 s')", "raise SystemExit(2)"])
def test_progress_is_a_bar_on_a_terminal_and_gives_the_cursor_back(end):
    """Also where the work fails."""
    ours, theirs = os.openpty()
    environment = os.environ | {"COLUMNS": "100", "TERM": "xterm"}
    subprocess.run([sys.executable, "-c", PROGRESS + end], stderr=theirs, env=environment)
    os.close(theirs)
    parts = []
    with suppress(OSError):  # EIO: all has been read; one read may return a part
        while part := os.read(ours, 100_000):
            parts.append(part)
    text = b"".join(parts).decode()
    os.close(ours)
    assert "25%" in text
    assert "12k env steps" in text
    assert ("done in" in text) == ("close" in end)
    assert text.rindex("\x1b[?25h") > text.rindex("\x1b[?25l")
