"""What the mutations share: how many, from which seeds, damaged bytes, and how a case is judged."""

import contextlib
import io
import traceback
import warnings
from collections.abc import Callable

from faulty import one_line
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import seed as seeded
from hypothesis import strategies as st

COUNTS = {"recordings": 700, "files": 700, "commands": 600}
SEEDS = {"recordings": 191, "files": 192, "commands": 193}


def damaged(draw, content: bytes) -> tuple[bytes, str]:
    """Return changed bytes, and what was done to them."""
    kind = draw(st.sampled_from(["cut", "flip", "insert", "noise", "zeros", "empty", "double"]))
    n = len(content)
    at = draw(st.integers(0, max(0, n - 1)))
    if kind == "cut":
        return content[:at], f"cut off at byte {at} of {n}"
    if kind == "flip":
        bit = 1 << draw(st.integers(0, 7))
        return content[:at] + bytes([content[at] ^ bit]) + content[at + 1 :], f"bit {bit} of byte {at} flipped"
    if kind == "insert":
        extra = draw(st.binary(min_size=1, max_size=40))
        return content[:at] + extra + content[at:], f"{extra!r} at byte {at}"
    if kind == "noise":
        extra = draw(st.binary(min_size=1, max_size=200))
        return content[:at] + extra + content[at + len(extra) :], f"{len(extra)} bytes from {at} overwritten"
    if kind == "zeros":
        return content[:at] + b"\0" * (n - at), f"zeros from byte {at}"
    return (b"", "empty") if kind == "empty" else (content + content, "twice itself")


def drawn(kind: str, one: Callable, count: int) -> None:
    """Call `one(draw)` so many times, with what hypothesis draws from the seed of this kind."""

    @seeded(SEEDS[kind])
    @settings(
        max_examples=count, database=None, deadline=None, phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(st.data())
    def run(data):
        one(data.draw)

    run()


def judged(work: Callable[[], str]) -> tuple[str, str]:
    """Do `work`; return how it ended and what it said.

    `work` returns "" where what was accepted may stand, else why it is nonsense.
    """
    from r2s.errors import UserError

    out = io.StringIO()
    try:
        with contextlib.redirect_stderr(out), contextlib.redirect_stdout(out), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            reason = work()
    except UserError as error:
        return ("refused" if "\n" not in str(error) else "traceback"), str(error)
    except SystemExit as end:  # of a command
        line = one_line(out.getvalue())
        return ("refused", line) if end.code == 2 and line else ("traceback", out.getvalue())
    except BaseException:
        return "traceback", traceback.format_exc()[-1500:]
    return ("nonsense", reason) if reason else ("stands", "")
