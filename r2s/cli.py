"""The command line: `python run.py ...`, installed `r2s ...`. Compose the config, then call one stage.

Read it from the bottom: `main` composes and says a user's mistake as one line with exit status 2.
"""

import os
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path

from r2s.errors import Stopped, UserError, check_number, choices, nearest
from r2s.stages.build import CONF, GROUP, STAGES, loaded
from r2s.typed import COMMANDS, check_overrides

STOPPED = 3  # exit status of a run that a stopped arm has ended
RESUMED = ("identify", "train", "tune")
WORDS = ("root", "name", "calibration", "resume", "policy", "runs")
MOST_THREADS = 4096
LOST = "the system ended a worker of the sweep, as where memory is short; with only_missing=true it goes on, repeated"


def typed_in(folder):
    """Return what the user typed for a run folder."""
    from r2s.runs import read_meta

    words = loaded(folder / "overrides.yaml")
    if any(not isinstance(w, str) for w in words) or isinstance(words, Mapping):
        raise UserError(f"{folder / 'overrides.yaml'} is damaged: it is no list of KEY=VALUE")
    meta = read_meta(folder)
    if len(words) != meta.get("typed", len(words)):
        raise UserError(f"{folder / 'overrides.yaml'} is damaged: {len(words)} words, {meta['typed']} were typed")
    return list(words)


def resumed(cfg, overrides):
    """Return config and overrides of the run folder `resume=`, which then goes on where it stopped."""
    from r2s.runs import is_done

    folder = Path(cfg.resume)
    if not (folder / "config.yaml").is_file():
        names = [p.name for p in folder.parent.glob("*")] if folder.parent.is_dir() else []
        raise UserError(f"resume: '{cfg.resume}' is no run folder{nearest(folder.name, names)}")
    if extra := [o for o in overrides if not o.startswith("resume=")]:
        raise UserError(f"resume: a run goes on with its own config; leave out {' '.join(extra)}")
    before = loaded(folder / "config.yaml")
    if before.stage not in RESUMED:
        raise UserError(f"resume: {folder} is a run of stage={before.stage}; allowed: {choices(RESUMED)}")
    if is_done(folder):
        raise UserError(f"resume: {folder} is finished")
    before.resume = str(folder)
    return before, typed_in(folder)


def is_there(cfg, overrides):
    """Return whether the run folder of this job is finished; where it was stopped, let the job go on in it."""
    from r2s.runs import is_done

    if not cfg.name:
        raise UserError("only_missing: give the run folder a name=, such as name='${algo.name}_${seed}'")
    folder = Path(cfg.root) / cfg.stage / cfg.name
    if not (folder / "meta.json").is_file():
        return False

    def typed(words):
        # these are no part of what is computed
        beside = ("stage=", "name=", "root=", "threads=", "only_missing=", "grid.", "tracker")
        return {w for w in words if not w.startswith(beside)}

    before = typed(typed_in(folder))
    if other := sorted(before ^ typed(overrides)):
        raise UserError(f"only_missing: {folder} was made otherwise ({', '.join(other)}); give another name=")
    if is_done(folder):
        print(f"already there: {folder}")
        return True
    cfg.resume = str(folder)
    return False


def check_words(cfg):
    """Check the options that name a file or folder; a number is a name, too."""
    for key in WORDS:
        value = cfg[key]
        if value is not None and (isinstance(value, bool) or not isinstance(value, str | int | float) or value == ""):
            raise UserError(f"{key}: {value!r} is not allowed; a name or null is")
        if value is not None:
            cfg[key] = str(value)
    if cfg.root is None:
        raise UserError("root: null is not allowed; a folder is")


def run_job(cfg):
    """Call the stage of one composed config; a mistake ends the job (`failed`), a stopped arm the whole sweep."""
    from hydra.core.hydra_config import HydraConfig

    with said_in_one_line():
        overrides = list(HydraConfig.get().overrides.task)
        if cfg.stage not in STAGES:
            raise UserError(f"stage: no stage '{cfg.stage}'; allowed: {choices(STAGES)}")
        check_number("seed", cfg.seed, "[0, inf)", whole=True)
        check_number("threads", cfg.threads, f"[0, {MOST_THREADS}]", whole=True)
        check_words(cfg)
        if cfg.resume:
            cfg, overrides = resumed(cfg, overrides)
        elif cfg.only_missing and is_there(cfg, overrides):
            return
        getattr(import_module(f"r2s.stages.{cfg.stage}"), cfg.stage)(cfg, overrides)


@contextmanager
def said_in_one_line():
    """End a job (`failed`) with one line where a mistake, a full disk or Ctrl-C ends what is done in here."""
    from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

    try:
        yield
    except (UserError, FloatingPointError) as error:
        failed(" ".join(str(error).split()))
    except MissingMandatoryValue as error:
        failed(f"{error.full_key} must be given: {error.full_key}=...")
    except OmegaConfBaseException as error:
        failed(" ".join(str(error).split()))
    except OSError as error:  # a full disk, a folder that may not be written
        if error.errno is None:
            raise
        failed(f"{error.strerror}{f': {error.filename}' if error.filename else ''}; what was whole before is still")
    except RuntimeError as error:
        if "no locator available" not in str(error):  # so numba says it
            raise
        failed("neither r2s's own folder nor ~/.cache may be written; NUMBA_CACHE_DIR=FOLDER says what may")
    except MemoryError as error:
        failed(f"not enough memory: {' '.join(str(error).split())}")
    except Stopped as reason:
        print(f"stopped: {' '.join(str(reason).split())}", file=sys.stderr)
        sys.exit(STOPPED)
    except KeyboardInterrupt:
        print("\ninterrupted; what was written stays in the run folder", file=sys.stderr)
        sys.exit(130)


def main():
    """Do what was typed; Ctrl-C before a run has begun is one line too."""
    try:
        compose_and_run()
    except KeyboardInterrupt:
        print("\ninterrupted", file=sys.stderr)
        sys.exit(130)


def compose_and_run():
    """Compose and run; a user's mistake is one line and exit status 2."""
    import hydra
    from hydra._internal.utils import get_args_parser

    from r2s.runs import default_name

    if sys.argv[1:2] and sys.argv[1] in COMMANDS:
        sys.exit(command(sys.argv[1:]))
    sys.path.append(os.getcwd())  # a user's own parts are modules of the folder that he is in
    parser = get_args_parser()
    parser.error = lambda message: sys.exit(stop(f"{message}; see python run.py --help"))  # type: ignore[method-assign]
    typed = parser.parse_args()
    job = hydra.main(version_base="1.3", config_path=str(CONF.resolve()), config_name="config")(run_job)
    try:
        if not (typed.help or typed.hydra_help or typed.cfg or typed.info):
            check_overrides(typed.overrides, typed.config_dir, typed.multirun)
        with tempfile.TemporaryDirectory() as folder:
            if typed.multirun:  # a job that fails leaves the others alone
                os.environ["R2S_FAILED"] = str(Path(folder) / "failed.txt")
                os.environ["HYDRA_FULL_ERROR"] = "1"  # else Hydra prints what a launcher raises, and exits
                os.environ.setdefault(GROUP, default_name(typed.overrides))
            try:
                job()
            except Exception as error:
                if type(error).__name__ != "TerminatedWorkerError":  # joblib's
                    raise
                raise UserError(LOST) from None
            finally:
                end_workers()
            lines = Path(folder) / "failed.txt"
            if lines.is_file():
                count = len(lines.read_text().splitlines())
                sys.exit(stop(f"{count} job{'s' * (count > 1)} of the sweep failed, see above; the others are done"))
    except UserError as error:
        sys.exit(stop(error))
    except OSError as error:  # of Hydra, before any job
        sys.exit(stop(f"{error.strerror}{f': {error.filename}' if error.filename else ''}"))
    finally:
        end_workers()


def command(words: Sequence[str]) -> int:
    """Do one of COMMANDS, which read run folders and compose no config; return the exit status."""
    from r2s.commands import run_command

    try:
        run_command(words)
    except UserError as error:
        return stop(" ".join(str(error).split()))
    except OSError as error:  # a full disk, a folder that may not be written
        return stop(f"{error.strerror}{f': {error.filename}' if error.filename else ''}")
    except KeyboardInterrupt:
        return 130
    return 0


def end_workers():
    """End the processes of a sweep that ran side by side: joblib would keep them for five minutes more."""
    if "joblib" in sys.modules:
        from joblib.externals.loky import get_reusable_executor

        get_reusable_executor().shutdown(wait=True)


def failed(message):
    """End a job that cannot go on: with exit status 2, or in a sweep with a note for its end."""
    status = stop(message)
    if "R2S_FAILED" not in os.environ:
        sys.exit(status)
    with open(os.environ["R2S_FAILED"], "a") as file:
        file.write(f"{message}\n")


def stop(message):
    """Print a user's mistake as one line and return the exit status."""
    print(f"error: {message}", file=sys.stderr)
    return 2
