"""Run the command line, `python run.py ...` or the installed `r2s ...`: compose the config and call one stage.

After a user's mistake, r2s prints one line on stderr and ends with exit status 2.
"""

import os
import signal
import sys
import tempfile
from collections.abc import Mapping
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from r2s.errors import FAILED, Stopped, UserError, check_number, choices, nearest_file
from r2s.override_checks import COMMANDS, check_overrides, extended
from r2s.stages.build import GROUP, STAGES
from r2s.stages.run_config import CONF, PROGRAM, TRUST, loaded, modules, replayed, run_config

STOPPED = 3  # exit status of a run that ended because the arm stopped
INTERRUPTED = 130
RESUMABLE = ("identify", "train", "tune", "results")
PATHS = ("root", "name", "calibration", "resume", "policy", "runs")
MOST_THREADS = 4096
MOST_SEED = 2**32 - 1  # largest seed that all generators of NumPy accept
ABSENT = "not there"
# keys that may differ from an earlier run with skip_completed: run folder, display, number of cores and so on
FREE = ("name", "root", "resume", "skip_completed", "threads", "tracker", "trust", "grid")


def main():
    """Run the command or the job that the user typed."""
    if find_spec("hydra") is None:
        problem = f"{sys.executable} lacks the packages of r2s"
        sys.exit(fail(f"{problem}; type `make setup` once, then `source .venv/bin/activate`"))
    from hydra._internal.utils import get_args_parser

    signal.signal(signal.SIGTERM, signal.default_int_handler)  # `kill` ends a run as Ctrl-C does
    try:
        if sys.argv[1:2] and sys.argv[1] in COMMANDS:
            from r2s.commands import run_command

            return run_command(sys.argv[1:])
        sys.path.append(os.getcwd())  # a config may name modules in the working folder
        sys.argv[1:] = extended(sys.argv[1:])
        parser = get_args_parser()
        parser.error = lambda message: sys.exit(fail(f"{message}; see {PROGRAM} --help"))  # type: ignore[method-assign]
        run_hydra(parser.parse_args())
    except UserError as error:
        sys.exit(fail(error))
    except OSError as error:  # raised by Hydra before any job
        sys.exit(fail(describe(error)))
    except KeyboardInterrupt:
        print("\ninterrupted", file=sys.stderr)
        sys.exit(INTERRUPTED)
    finally:
        end_workers()


def run_hydra(typed):
    """Check the overrides and let Hydra compose and run the job, or all jobs of a sweep."""
    import hydra

    from r2s.runs import default_name

    job = hydra.main(version_base="1.3", config_path=str(CONF.resolve()), config_name="config")(run_job)
    if not (typed.help or typed.hydra_help or typed.cfg or typed.info):
        check_overrides(typed.overrides, typed.config_dir, typed.multirun)
    with tempfile.TemporaryDirectory() as folder:
        errors = Path(folder) / "failed.txt"
        if typed.multirun:  # a job that fails does not stop the others
            os.environ[FAILED] = str(errors)
            os.environ["HYDRA_FULL_ERROR"] = "1"  # otherwise Hydra prints exceptions of launchers and exits
            os.environ.setdefault(GROUP, default_name(typed.overrides))
        else:  # without a sweep, a failed job ends this process
            os.environ.pop(FAILED, None)
        try:
            job()
        except Exception as error:
            if type(error).__name__ != "TerminatedWorkerError":  # joblib's error
                raise
            raise UserError(
                "the system ended a worker of the sweep, probably because memory is short; repeat the command with "
                "skip_completed=true to continue"
            ) from None
        finally:
            end_workers()
        if errors.is_file():
            count = len(errors.read_text().splitlines())
            raise UserError(f"{count} job{'s' * (count > 1)} of the sweep failed, see above; the others are done")


def run_job(cfg):
    """Check a composed config and call its stage."""
    from hydra.core.hydra_config import HydraConfig

    with errors_in_one_line():
        cfg, overrides = replayed(cfg), list(HydraConfig.get().overrides.task)
        if cfg.stage not in STAGES:
            raise UserError(f"stage: no stage '{cfg.stage}'; allowed: {choices(STAGES)}")
        check_number("seed", cfg.seed, f"[0, {MOST_SEED}]", whole=True)
        check_number("threads", cfg.threads, f"[0, {MOST_THREADS}]", whole=True)
        check_paths(cfg)
        if cfg.resume:
            cfg, overrides = resumed(cfg, overrides)
        elif cfg.skip_completed and is_completed(cfg):
            return
        getattr(import_module(f"r2s.stages.{cfg.stage}"), cfg.stage)(cfg, overrides)


def check_paths(cfg):
    """Check the options that name a file or folder; convert names that YAML read as numbers to strings."""
    for key in PATHS:
        value = cfg[key]
        if value is not None and (isinstance(value, bool) or not isinstance(value, str | int | float) or value == ""):
            raise UserError(f"{key}: expected a name or null, got {value!r}")
        if value is not None:
            cfg[key] = str(value)
    if cfg.root is None:
        raise UserError("root: expected a folder, got null")


def resumed(cfg, overrides):
    """Return the config and overrides of the run that `resume=FOLDER` continues."""
    from r2s.runs import is_done

    folder = Path(cfg.resume)
    if not (folder / "config.yaml").is_file():
        raise UserError(f"resume: '{cfg.resume}' is no run folder{nearest_file(folder)}")
    if extra := [o for o in overrides if not o.startswith(("resume=", "trust=", "device="))]:
        raise UserError(f"resume: a run continues with its own config; leave out {' '.join(extra)}")
    before = run_config(folder, cfg.trust)
    if before.stage == "tune":  # trainings of a search reuse the overrides in the search's folder
        os.environ[TRUST] = ",".join(modules(cfg.trust))
    if before.stage not in RESUMABLE:
        raise UserError(f"resume: {folder} is a run of stage={before.stage}; allowed: {choices(RESUMABLE)}")
    if is_done(folder):
        raise UserError(f"resume: {folder} is finished")
    before.resume = str(folder)
    if any(o.startswith("device=") for o in overrides):  # a run that began on a GPU can continue on a CPU
        before.device = cfg.device
    return before, typed_overrides(folder)


def is_completed(cfg):
    """Return whether the job's run has finished; set `cfg.resume` if the job has to continue an unfinished run."""
    from r2s.runs import is_done
    from r2s.stages.build import unread

    if not cfg.name:
        raise UserError("skip_completed: give the run folder a name=, such as name='${algo.name}_${seed}'")
    folder = Path(cfg.root) / cfg.stage / cfg.name
    if not (folder / "meta.json").is_file():
        return False

    saved = loaded(folder / "config.yaml")
    if not isinstance(saved, Mapping):
        raise UserError(f"skip_completed: {folder / 'config.yaml'} is damaged: expected settings by name")
    if other := differing(saved, cfg, counts=lambda key: unread(key, cfg) is None):
        raise UserError(f"skip_completed: {folder} has other settings: {'; '.join(other)}; give another name=")
    if is_done(folder):
        print(f"already finished: {folder}")
        return True
    cfg.resume = str(folder)
    return False


def differing(saved, cfg, most=3, counts=lambda key: True):
    """Return a line for each key that differs between `saved` and `cfg` and for which `counts` returns True.

    The first `most` keys get a line; a last line contains the number of further keys.
    """
    from omegaconf import OmegaConf

    from r2s.reporting.trackers.tracker import flat

    both: Any = [OmegaConf.to_container(c, resolve=True) for c in (saved, cfg)]
    before, now = (dict(flat({k: v for k, v in c.items() if k not in FREE})) for c in both)
    keys = [k for k in dict.fromkeys([*before, *now]) if before.get(k) != now.get(k) and counts(k)]
    words = [f"{k} was {str(before.get(k, ABSENT))[:60]}, is {str(now.get(k, ABSENT))[:60]}" for k in keys[:most]]
    return words + [f"and {len(keys) - most} more"] * (len(keys) > most)


def typed_overrides(folder):
    """Return the overrides with which the user started the run in the run folder `folder`."""
    from r2s.runs import read_meta

    words = loaded(folder / "overrides.yaml")
    if any(not isinstance(w, str) or w.lstrip("+~").startswith("hydra") for w in words) or isinstance(words, Mapping):
        raise UserError(f"{folder / 'overrides.yaml'} is damaged: it is no list of KEY=VALUE")
    count = read_meta(folder).get("typed", len(words))
    if len(words) != count:
        raise UserError(f"{folder / 'overrides.yaml'} is damaged: expected {count} overrides, got {len(words)}")
    return list(words)


@contextmanager
def errors_in_one_line():
    """End the job with a one-line message after a user's mistake, a full disk, a stopped arm or Ctrl-C."""
    from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

    try:
        yield
    except MissingMandatoryValue as error:
        end_job(f"{error.full_key} must be given: {error.full_key}=...")
    except (UserError, FloatingPointError, OmegaConfBaseException) as error:
        end_job(error)
    except OSError as error:  # a full disk, a folder without write permission
        if error.errno is None:
            raise
        end_job(f"{describe(error)}; files that were complete before are intact")
    except RuntimeError as error:
        if "no locator available" not in str(error):  # numba's message
            raise
        end_job("r2s's own folder and ~/.cache are not writable; give a writable one: NUMBA_CACHE_DIR=FOLDER")
    except MemoryError as error:
        end_job(f"not enough memory: {error}")
    except Stopped as reason:
        print(f"stopped: {in_one_line(reason)}", file=sys.stderr)
        sys.exit(STOPPED)
    except KeyboardInterrupt as stop:
        folder = str(stop)  # set in r2s/runs.py; empty if no run folder exists yet
        again = f"; resume={folder} goes on" if Path(folder).parent.name in RESUMABLE else ""
        print(f"\ninterrupted{f'; {folder} keeps what was written{again}' if folder else ''}", file=sys.stderr)
        sys.exit(INTERRUPTED)


def end_workers():
    """End the worker processes of a parallel sweep, because joblib would keep them alive for five minutes."""
    if "joblib" in sys.modules:
        from joblib.externals.loky import get_reusable_executor

        get_reusable_executor().shutdown(wait=True)


def end_job(error):
    """Print an error, then exit with status 2; in a sweep, append the error to the sweep's error file instead."""
    status = fail(error)
    if FAILED not in os.environ:
        sys.exit(status)
    with open(os.environ[FAILED], "a") as file:
        file.write(f"{in_one_line(error)}\n")


def describe(error: OSError) -> str:
    """Return a system error's message with the name of the file that caused the error."""
    return f"{error.strerror}{f': {error.filename}' if error.filename else ''}"


def in_one_line(error) -> str:
    """Return a message without line breaks."""
    return " ".join(str(error).split())


def fail(error) -> int:
    """Print an error as one line on stderr and return the exit status 2."""
    print(f"error: {in_one_line(error)}", file=sys.stderr)
    return 2
