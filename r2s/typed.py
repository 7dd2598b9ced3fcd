"""Check the words of a command line before Hydra takes them; what is wrong is one line, with the nearest word."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from r2s.errors import UserError, choices, nearest
from r2s.stages.build import CONF, STAGES, unread

COMMANDS = ("look", "list", "export")
NONE_NEEDED = ("tracker", "experiment")  # groups of which a run may have no option
GROWS = ("tune.space",)  # what + adds to: an axis that conf/stage/tune.yaml has not
SEARCHED = "hydra.searchpath"
EXTRAS = {"submitit_slurm": "slurm", "submitit_local": "slurm"}  # launchers, and the extra that each comes with


def check_overrides(words: Sequence[str], config_dir: str | None, multirun: bool = False) -> None:
    """Check what was typed; Hydra would stop too, with several lines.

    A sweep is checked before its first job, value by value.

    Args:
        words: KEY=VALUE and GROUP=OPTION. config_dir: the user's own, as --config-dir says.
        multirun: -m was typed.

    Raises:
        UserError: an option that the config does not have, with the nearest that it has; or one that no job reads;
            a grid without -m; no such folder.
    """
    from hydra import compose, initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    if config_dir and not Path(config_dir).is_dir():
        beside = [p.name for p in Path(config_dir).absolute().parent.glob("*/")]
        raise UserError(f"--config-dir: no folder '{config_dir}'{nearest(Path(config_dir).name, beside)}")
    own = [f"{SEARCHED}=[file://{Path(config_dir).resolve()}]"] if config_dir else []
    hydras = [w for w in words if w.lstrip("+~").startswith(("hydra.", "hydra/"))]  # Hydra's own
    words = [w for w in words if w not in hydras]
    with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
        loader = GlobalHydra.instance().config_loader()
        groups = {g: loader.get_group_options(g) for g in loader.list_groups("") if g != "hydra"}
        _check_hydras(
            hydras, own, {f"hydra/{g}": loader.get_group_options(f"hydra/{g}") for g in loader.list_groups("hydra")}
        )
        try:
            names, jobs = _jobs(words, own, groups)
            configs = [compose("config", job, return_hydra_config=True) for job in jobs]
        except (HydraException, OmegaConfBaseException, UnknownOption):
            raise _first_mistake(words, own, groups) from None
        if not multirun and configs[0].hydra.sweeper.get("params"):
            raise UserError(f"this is a grid of jobs, and only -m runs it: python run.py -m {' '.join(words)}")
        for cfg in configs:  # Hydra asks for it before the job does
            if cfg.get("stage") not in STAGES:
                raise UserError(f"stage: {cfg.get('stage')} is not allowed; allowed: {choices(STAGES)}")
            root = OmegaConf.to_container(cfg, resolve=False)["root"]  # type: ignore[call-overload,index]
            if isinstance(root, bool) or not isinstance(root, str | int | float):
                raise UserError(f"root: {root} is not allowed; a folder is")
        before: dict[tuple[str, ...], Any] = {}
        for cfg, job in zip(configs, jobs, strict=True):
            chosen = tuple(w for w in job if w.lstrip("+").split("=", 1)[0] in (*groups, SEARCHED))
            if chosen not in before:
                before[chosen] = compose("config", list(chosen))
            check_switches(cfg, names, before[chosen])
        for name in names:
            reasons = [unread(name, cfg) for cfg in configs if cfg.stage in STAGES]
            if reasons and all(reasons):
                raise UserError(reasons[0])
    GlobalHydra.instance().clear()


def _check_hydras(words: Sequence[str], own: list[str], groups: dict[str, list[str]]) -> None:
    """Raise UserError where Hydra would not take one of its own options, which it tells on many lines."""
    from hydra import compose
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    for k, word in enumerate(words):
        try:
            compose("config", [*own, *words[: k + 1]], return_hydra_config=True)
        except (HydraException, OmegaConfBaseException) as error:
            if word.partition("=")[2] in EXTRAS:
                package = EXTRAS[word.partition("=")[2]]
                raise UserError(f"{word}: not installed here; pip install 'r2s[{package}]'") from None
            before = compose("config", [*own, *words[:k]], return_hydra_config=True)
            known = [*(f"hydra.{key}" for key in _keys(before.hydra)), *groups]
            raise _said_in_one_line(word, error, groups, known) from None


class UnknownOption(Exception):  # noqa: N818 (whose message is made where the options are known)
    """A word adds to the config what nothing would read."""


def _jobs(words: Sequence[str], own: list[str], groups: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Return the keys and groups typed, and the words of a job with the first value of each sweep, and of one more
    for every other value.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser

    names, jobs = [], [own]
    for word in words:
        parsed = OverridesParser.create().parse_override(word)
        names.append(parsed.key_or_group)
        if parsed.is_add() and parsed.key_or_group not in (*groups, *GROWS):  # Hydra would take it
            raise UnknownOption
        if not parsed.is_sweep_override() and not parsed.is_delete() and parsed.key_or_group in groups:
            check_option(parsed.key_or_group, parsed.value(), groups[parsed.key_or_group])
        values = list(parsed.sweep_string_iterator()) if parsed.is_sweep_override() else [None]
        trials = [word if v is None else f"{word.split('=', 1)[0]}={v}" for v in values]
        first = jobs[0]
        jobs = [[*job, trials[0]] for job in jobs] + [[*first, trial] for trial in trials[1:]]
    return names, jobs


def check_switches(cfg: Any, names: Sequence[str], before: Any) -> None:
    """Raise UserError where an option of `names` that is true or false in the config `before` is neither in `cfg`."""
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    for name in names:
        try:
            was, now = OmegaConf.select(before, name), OmegaConf.select(cfg, name)
        except OmegaConfBaseException:  # `${nowhere}`: said when it is read
            continue
        if isinstance(was, bool) and not isinstance(now, bool):
            raise UserError(f"{name}: {now!r} is not allowed; true and false are")


def check_option(group: str, value: Any, options: Sequence[str]) -> None:
    """Raise UserError where the option of a group is no word: Hydra would stop with a traceback, later."""
    words = value if isinstance(value, list) else [value]
    if not all(isinstance(w, str) for w in words) or not (words or group in NONE_NEEDED):
        raise UserError(f"{group}: {value} is not allowed; allowed: {choices(options)}")


def _first_mistake(words: Sequence[str], own: list[str], groups: dict[str, list[str]]) -> UserError:
    """Return what is wrong with the first word that the config does not take after those before it."""
    from hydra import compose
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    known = [*_keys(compose("config", own)), *groups]
    for k, word in enumerate(words):
        job = [word]
        try:
            names, jobs = _jobs(words[: k + 1], own, groups)
            for job in jobs:
                cfg = compose("config", job)
        except UnknownOption:
            name = word.lstrip("+~").split("=", 1)[0]
            return UserError(f"unknown option '{name}'{nearest(name, known)}")
        except (HydraException, OmegaConfBaseException) as error:
            return _said_in_one_line(job[-1], error, groups, known)  # of a sweep the value that is not taken
        if names[-1] in groups:
            known = [*_keys(cfg), *groups]
    raise AssertionError("each word is taken, and all of them are not")


def _keys(node: Any, prefix: str = "") -> Iterator[str]:
    from omegaconf import DictConfig, OmegaConf

    for k in node:
        yield prefix + str(k)
        if not OmegaConf.is_missing(node, k) and isinstance(node._get_node(k), DictConfig) and node[k] is not None:
            yield from _keys(node[k], f"{prefix}{k}.")


def _said_in_one_line(word: str, error: Exception, groups: dict[str, list[str]], known: Sequence[str]) -> UserError:
    """Return what is wrong with a word that Hydra does not take."""
    if "=" not in word:
        return UserError(f"'{word}' is not KEY=VALUE{nearest(word, [*groups, *COMMANDS])}")
    key, value = word.split("=", 1)
    bare = key.lstrip("+~")
    for option in [v.strip() for v in value.strip("[]").split(",")] if value.startswith("[") else [value]:
        if bare in groups and option not in groups[bare]:
            return UserError(
                f"{bare}: no option '{option}'; allowed: {choices(groups[bare])}{nearest(option, groups[bare])}"
            )
    if bare not in known:
        return UserError(f"unknown option '{bare}'{nearest(bare, known) or '; see python run.py --help'}")
    return UserError(f"{word}: {' '.join(str(error).split())}")
