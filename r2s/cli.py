"""The command line: `python run.py ...`, installed `r2s ...`. Compose the config, then call one stage.

Read it from the bottom: `main` composes and says a user's mistake as one line with exit status 2.
"""

import os
import sys
import tempfile
from importlib import import_module
from pathlib import Path

from r2s.stages.build import CONF, OPEN

STAGES = ("train", "identify", "transfer", "compare", "pipeline")


def check_overrides(words):
    """Raise UserError for an option that the config does not have, with the nearest one that it has.

    Hydra would stop too, with several lines; a sweep is checked value by value before its first job starts.
    """
    from hydra import compose, initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException
    from omegaconf import DictConfig, OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    from r2s.errors import UserError, choices, nearest

    def keys(node, prefix=""):
        for k in node:
            yield prefix + str(k)
            if not OmegaConf.is_missing(node, k) and isinstance(node[k], DictConfig):
                yield from keys(node[k], f"{prefix}{k}.")

    groups = {p.name: sorted(f.stem for f in p.glob("*.yaml")) for p in CONF.iterdir() if p.is_dir()}
    with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
        cfg = compose("config")
        known = [*keys(cfg), *groups]
        base: list[str] = []
        for word in words:
            if word.lstrip("+~").startswith(("hydra.", "hydra/")):
                continue  # Hydra's own
            try:
                parsed = OverridesParser.create().parse_override(word)
                name = parsed.key_or_group
                if parsed.is_add() and name not in groups:  # Hydra would take it, and nothing would read it
                    raise UserError(f"unknown option '{name}'{nearest(name, known)}")
                values = list(parsed.sweep_string_iterator()) if parsed.is_sweep_override() else [None]
                trials = [word if v is None else f"{word.split('=', 1)[0]}={v}" for v in values]
                for trial in trials:
                    before, cfg = cfg, compose("config", [*base, trial])
                    check_type(name, before, cfg)
                if not parsed.is_sweep_override() and name in ("data", "arm", "simulator"):
                    known = [*keys(cfg), *groups]
                base.append(trials[0])
            except (HydraException, OmegaConfBaseException) as error:
                if "=" not in word:
                    raise UserError(f"'{word}' is not KEY=VALUE{nearest(word, groups)}") from None
                key, value = word.split("=", 1)
                bare = key.lstrip("+~")
                if bare in groups:
                    options = groups[bare]
                    raise UserError(
                        f"{bare}: no option '{value}'; allowed: {choices(options)}{nearest(value, options)}"
                    ) from None
                if bare not in known:
                    raise UserError(
                        f"unknown option '{bare}'{nearest(bare, known) or '; see python run.py --help'}"
                    ) from None
                raise UserError(f"{word}: {' '.join(str(error).split())}") from None
    GlobalHydra.instance().clear()


def check_counts(cfg):
    """Raise UserError where what counts something is no such number."""
    from omegaconf import OmegaConf

    from r2s.errors import check_number

    least = {"seed": 0, "threads": 0, "arm.seed": 0, "evaluation.episodes": 1, "evaluation.env_steps": 1}
    for key, low in (least | {"algo.n_envs": 1}).items():
        if (value := OmegaConf.select(cfg, key)) is not None:
            check_number(key, value, f"[{low}, inf)", whole=True)


def check_type(key, before, after):
    """Raise UserError where a number of the config was replaced by a word."""
    from omegaconf import OmegaConf

    from r2s.errors import UserError

    def number(value):
        return isinstance(value, (int, float)) and not isinstance(value, bool)

    old, new = OmegaConf.select(before, key, throw_on_missing=False), OmegaConf.select(after, key)
    if number(old) and isinstance(new, str):
        raise UserError(f"{key}: '{new}' is not a number, such as {old:g}")


def resumed(cfg, overrides):
    """Return config and overrides of the run folder `resume=`, which then goes on where it stopped."""
    from omegaconf import OmegaConf

    from r2s.errors import UserError, nearest
    from r2s.runs import is_done

    folder = Path(cfg.resume)
    if not (folder / "config.yaml").is_file():
        names = [p.name for p in folder.parent.glob("*")] if folder.parent.is_dir() else []
        raise UserError(f"resume: '{cfg.resume}' is no run folder{nearest(folder.name, names)}")
    if extra := [o for o in overrides if not o.startswith("resume=")]:
        raise UserError(f"resume: a run goes on with its own config; leave out {' '.join(extra)}")
    before = OmegaConf.load(folder / "config.yaml")
    if before.stage not in ("identify", "train"):
        raise UserError(f"resume: {folder} is a run of stage={before.stage}; allowed: identify, train")
    if is_done(folder):
        raise UserError(f"resume: {folder} is finished")
    before.resume = str(folder)
    return before, OmegaConf.to_container(OmegaConf.load(folder / "overrides.yaml"))


def is_there(cfg, overrides):
    """Return whether the run folder of this job is finished; where it was stopped, let the job go on in it."""
    from omegaconf import OmegaConf

    from r2s.errors import UserError
    from r2s.runs import is_done

    if not cfg.name:
        raise UserError("only_missing: give the run folder a name=, such as name='${algo.name}_${seed}'")
    folder = Path(cfg.root) / cfg.stage / cfg.name
    if not (folder / "meta.json").is_file():
        return False

    def typed(words):
        beside = ("stage=", "name=", "root=", "threads=", "only_missing=", "grid.")  # no part of what is computed
        return {w for w in words if not w.startswith(beside)}

    before = typed(OmegaConf.to_container(OmegaConf.load(folder / "overrides.yaml")))
    if other := sorted(before ^ typed(overrides)):
        raise UserError(f"only_missing: {folder} was made otherwise ({', '.join(other)}); give another name=")
    if is_done(folder):
        print(f"already there: {folder}")
        return True
    cfg.resume = str(folder)
    return False


def main():
    """Compose and run; a user's mistake is one line and exit status 2."""
    import hydra

    from r2s.errors import UserError

    words = [w for w in sys.argv[1:] if not w.startswith("-")]
    asked_for_help = any(
        w in ("--help", "-h", "--hydra-help", "--version", "--cfg", "-c", "--info", "-i") for w in sys.argv[1:]
    )

    @hydra.main(version_base="1.3", config_path=str(CONF.resolve()), config_name="config")
    def job(cfg):
        from hydra.core.hydra_config import HydraConfig
        from omegaconf.errors import MissingMandatoryValue

        overrides = list(HydraConfig.get().overrides.task)
        try:
            check_counts(cfg)
            if cfg.resume:
                cfg, overrides = resumed(cfg, overrides)
            elif cfg.only_missing and is_there(cfg, overrides):
                return
            with OPEN:
                getattr(import_module(f"r2s.stages.{cfg.stage}"), cfg.stage)(cfg, overrides)
        except (UserError, FloatingPointError) as error:
            failed(error)
        except MissingMandatoryValue as error:
            failed(f"{error.full_key} must be given: {error.full_key}=...")
        except KeyboardInterrupt:
            print("\ninterrupted; what was written stays in the run folder", file=sys.stderr)
            sys.exit(130)

    try:
        if not asked_for_help:
            check_overrides(words)
        with tempfile.TemporaryDirectory() as folder:
            if {"-m", "--multirun"} & set(sys.argv[1:]):  # a job that fails leaves the others alone
                os.environ["R2S_FAILED"] = str(Path(folder) / "failed.txt")
            try:
                job()
            finally:
                end_workers()
            lines = Path(folder) / "failed.txt"
            if lines.is_file():
                count = len(lines.read_text().splitlines())
                sys.exit(stop(f"{count} job{'s' * (count > 1)} of the sweep failed, see above; the others are done"))
    except UserError as error:
        sys.exit(stop(error))


def end_workers():
    """End the processes of a sweep that ran side by side: joblib would keep them for five minutes more."""
    if "joblib" in sys.modules:
        from joblib.externals.loky import get_reusable_executor

        get_reusable_executor().shutdown(wait=True)


def failed(error):
    """End a job that cannot go on: with exit status 2, or in a sweep with a note for its end."""
    status = stop(error)
    if "R2S_FAILED" not in os.environ:
        sys.exit(status)
    with open(os.environ["R2S_FAILED"], "a") as file:
        file.write(f"{error}\n")


def stop(error):
    """Print a user's mistake as one line and return the exit status."""
    print(f"error: {error}", file=sys.stderr)
    return 2
