"""What benchmarks/faults.py and the mutations share: commands forked off one process that imported all."""

import os
import resource
import signal
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path

from common import ROOT

GIB = 1 << 30
PRELOADED = ("hydra", "onnxscript", "r2s.arm.deploy", "r2s.arm.twin", "r2s.engines.episodes", "r2s.reporting.pages")
PRELOADED += (
    "r2s.learning.tqc",
    "r2s.learning.train",
    "torch.export",
    "r2s.cli",
    "pandas",
    "r2s.physics.native_friction",
)


def preload() -> None:
    """Import what every command imports, and load what is compiled: seconds less for each of thousands."""
    import gc

    import torch
    from hydra import compose, initialize_config_dir

    torch.set_num_threads(1)
    for name in PRELOADED:
        import_module(name)
    import_module("r2s.physics.native_friction").install()
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        import_module("r2s.stages.train").check(compose("config", ["+experiment=toy"]))
    gc.collect()
    gc.freeze()  # what is there is neither looked through nor copied by every command


def forked(work: Callable[[], object], err: Path, *, memory: int = 8 * GIB, before: Callable[[], None] | None = None):
    """Start `work` in a process group of its own, with what it says in the file `err`; return the process' id.

    It ends with the exit status of `work`, and with 1 and a traceback where that raised.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    if pid := os.fork():
        return pid
    status = 1
    try:
        os.setsid()
        out = os.open(err, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        os.dup2(out, 1)
        os.dup2(out, 2)
        resource.setrlimit(resource.RLIMIT_AS, (memory, resource.RLIM_INFINITY))
        os.environ["COLUMNS"] = "110"
        if before:
            before()
        work()
        status = 0
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def command(words: Sequence[str], at: Path = ROOT) -> Callable[[], None]:
    """Return what is `python run.py WORDS` in the folder `at`."""

    def work() -> None:
        os.chdir(at)
        sys.argv = [str(ROOT / "run.py"), *words]
        from r2s.cli import main

        main()

    return work


def ended(pid: int, limit_s: float = 3600.0) -> int:
    """Wait for a process and return its exit status, negative for a signal; what takes longer than the limit ends."""
    until = time.monotonic() + limit_s
    try:
        while time.monotonic() < until:
            done, status = os.waitpid(pid, os.WNOHANG)
            if done:
                return os.waitstatus_to_exitcode(status)
            time.sleep(0.005)
    except KeyboardInterrupt:  # it is in a group of its own
        os.killpg(pid, signal.SIGKILL)
        raise
    os.killpg(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    return -signal.SIGALRM


def say(words: Sequence[str], err: Path, **how) -> tuple[int, str]:
    """Run a command to its end; return its exit status and all that it said."""
    status = ended(forked(command(words), err, **how))
    return status, err.read_text(errors="replace")


def one_line(text: str) -> str | None:
    """Return the line `error: ...` where it is the only one of its kind and no traceback is there."""
    lines = [line for line in text.splitlines() if line.startswith("error: ")]
    return lines[0] if len(lines) == 1 and "Traceback" not in text else None
