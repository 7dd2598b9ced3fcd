"""Check overrides before Hydra runs, so that a wrong override prints one line with the nearest valid name."""

import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from r2s.errors import UserError, choices, instead_of, nearest, nearest_file
from r2s.stages.build import CONF, STAGES, unread
from r2s.stages.run_config import PROGRAM

COMMANDS = ("look", "list", "export", "check", "convert", "engines")
OPTIONAL = ("tracker", "experiment")  # config groups that may remain without a selected option
EXTENSIBLE = ("tune.space",)  # keys under which + may add new keys
STATED = re.compile(r"identify\.prior\.(?!(?:commanded|measured|motor)\b)[A-Za-z_]\w*(?:\.\w+)?=")
NO_OPTION = "base"  # name of the file that a group's options share; the file is no option itself
SEARCHPATH = "hydra.searchpath"
# {old name: new name} of keys and values
RENAMED = {
    "arm.friction": "arm.friction_scale",
    "arm.late": "arm.extra_delay_s",
    "arm.load": "arm.declared_payload",
    "arm.make": "arm.variant",
    "arm.make=1": "arm.variant=rigid",
    "arm.make=2": "arm.variant=elastic",
    "friction.hold": "friction.stiction_model",
    "identify.extra": "identify.candidate_terms",
    "identify.spare": "identify.prunable_terms",
    "only_missing": "skip_completed",
    "reward.limited": "reward.filter_penalty",
    "reward.limited_most": "reward.max_filter_rate",
    "stage=watch": "stage=estimate",
    "task.bandwidth": "control.bandwidth, with control=computed_torque",
    "task.base": "control",
    "task.base=model": "control=computed_torque",
    "task.base=none": "control=torque",
    "task.residual": "control.residual, with control=computed_torque",
    "watch": "estimate",
}
# options of Hydra that set output folders; r2s refuses them, because a run folder is <root>/<stage>/<name>
PLACES = ("hydra.sweep", "hydra.run", "hydra.output_subdir", "hydra.job.chdir")
PLAIN = re.compile(r"[A-Za-z0-9_/\-\\+.$%*@?|: ]")  # characters that Hydra allows in a value without quotes
SUBMITIT = ("submitit_slurm", "submitit_local")  # launchers of the extra `sweeps`


def extended(words: Sequence[str]) -> list[str]:
    """Add ++ to overrides `identify.prior.PARAMETER`, because no file in conf/ contains these keys."""
    return [f"++{w}" if STATED.match(w) else w for w in words]


def check_overrides(words: Sequence[str], config_dir: str | None, multirun: bool = False) -> None:
    """Check the overrides of a job, or of all jobs of a sweep.

    Args:
        words: overrides KEY=VALUE and GROUP=OPTION. config_dir: folder of --config-dir. multirun: whether -m is set.

    Raises:
        UserError: an option is unknown or read by no job, -m is missing for a sweep, or a folder is missing.
    """
    from hydra import compose, initialize_config_dir
    from hydra.core.global_hydra import GlobalHydra
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    if config_dir and not Path(config_dir).is_dir():
        raise UserError(f"--config-dir: no folder '{config_dir}'{nearest_file(Path(config_dir).absolute(), '*/')}")
    own = [f"{SEARCHPATH}=[file://{Path(config_dir).resolve()}]"] if config_dir else []
    of_hydra = [w for w in words if w.lstrip("+~").startswith(("hydra.", "hydra/"))]
    words = [w for w in words if w not in of_hydra]
    with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
        loader = GlobalHydra.instance().config_loader()

        def options(group: str) -> list[str]:
            return [o for o in loader.repository.get_group_options(group) if o != NO_OPTION]  # type: ignore[attr-defined]

        groups = {g: options(g) for g in loader.list_groups("") if g != "hydra"}
        experiments = [w for w in words if w.lstrip("+").startswith("experiment=")]  # these may set a launcher
        of_groups = {f"hydra/{g}": options(f"hydra/{g}") for g in loader.list_groups("hydra")}
        if of_hydra:
            _check_hydra(of_hydra, [*own, *experiments], of_groups)
        try:
            names, jobs = _jobs(words, own, groups, multirun)
            configs = [compose("config", job, return_hydra_config=True) for job in jobs]
        except (HydraException, OmegaConfBaseException, UnknownOption):
            raise _first_mistake(words, own, groups, multirun) from None
        if not multirun and configs[0].hydra.sweeper.get("params"):
            raise UserError(f"this is a grid of jobs, and only -m runs it: {PROGRAM} -m {' '.join(words)}")
        _check_configs(configs, jobs, names, groups)
    GlobalHydra.instance().clear()


def _check_configs(
    configs: Sequence[Any], jobs: Sequence[list[str]], names: Sequence[str], groups: Mapping[str, Any]
) -> None:
    """Check stage, root and booleans of the configs, and that at least one job reads each option in `names`."""
    from hydra import compose
    from omegaconf import OmegaConf

    for cfg in configs:  # Hydra uses `root` before a job can check this option
        if cfg.get("stage") not in STAGES:
            raise UserError(f"stage: expected one of {choices(STAGES)}, got {cfg.get('stage')}")
        root = OmegaConf.to_container(cfg, resolve=False)["root"]  # type: ignore[call-overload,index]
        if isinstance(root, bool) or not isinstance(root, str | int | float):
            raise UserError(f"root: expected a folder, got {root}")
    defaults: dict[tuple[str, ...], Any] = {}
    for cfg, job in zip(configs, jobs, strict=True):
        selected = tuple(w for w in job if w.lstrip("+").split("=", 1)[0] in (*groups, SEARCHPATH))
        if selected not in defaults:
            defaults[selected] = compose("config", list(selected))
        _check_switches(cfg, names, defaults[selected])
    for name in names:
        reasons = [unread(name, cfg) for cfg in configs]
        if reasons and all(reasons):
            raise UserError(reasons[0])


def _check_hydra(words: Sequence[str], own: list[str], groups: dict[str, list[str]]) -> None:
    """Raise UserError if `words` contains a Hydra option that Hydra refuses or r2s does not support.

    own: overrides to apply before `words`; if Hydra refuses one of these overrides, a later check reports the error.
    """
    from hydra import compose
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    try:
        compose("config", own, return_hydra_config=True)
    except (HydraException, OmegaConfBaseException):
        return
    for k, word in enumerate(words):
        key, _, value = word.lstrip("+~").partition("=")
        if any(key == place or key.startswith(f"{place}.") for place in PLACES):
            raise UserError(f"{key}: a run folder is ROOT/STAGE/NAME; give root= and name= instead")
        if key == "hydra/sweeper" and value in ("optuna", "ax", "nevergrad"):
            raise UserError(f"{word}: r2s searches by +experiment=tune, with Optuna; leave hydra/sweeper= out")
        try:
            compose("config", [*own, *words[: k + 1]], return_hydra_config=True)
        except (HydraException, OmegaConfBaseException) as error:
            if word.partition("=")[2] in SUBMITIT:
                raise UserError(f"{word} needs submitit, which is not installed: pip install 'r2s[sweeps]'") from None
            before = compose("config", [*own, *words[:k]], return_hydra_config=True)
            known = [*(f"hydra.{key}" for key in _keys(before.hydra)), *groups]
            raise _mistake(word, error, groups, known) from None


class UnknownOption(Exception):  # noqa: N818 (its message is made where the options are known)
    """An override adds a key that conf/ lacks; no stage reads added keys."""


def _jobs(
    words: Sequence[str], own: list[str], groups: Mapping[str, Any], multirun: bool
) -> tuple[list[str], list[list[str]]]:
    """Return the keys and groups in `words`, and a few jobs that together contain every value of each sweep.

    Raises:
        UserError: -m is missing for a sweep, or the value of a group is wrong.
        UnknownOption, HydraException: an override is refused; `_first_mistake` then makes the message for the user.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser

    names, jobs = [], [own]
    for word in words:
        parsed = OverridesParser.create().parse_override(word)
        names.append(parsed.key_or_group)
        if parsed.is_add() and parsed.key_or_group not in (*groups, *EXTENSIBLE):  # Hydra accepts any new key
            raise UnknownOption
        if not parsed.is_sweep_override() and not parsed.is_delete() and parsed.key_or_group in groups:
            check_option(parsed.key_or_group, parsed.value(), groups[parsed.key_or_group])
        if parsed.is_sweep_override() and not multirun:
            raise UserError(f"{word}: several values make a sweep, which only -m runs; {quoted(word)} is one value")
        values = list(parsed.sweep_string_iterator()) if parsed.is_sweep_override() else [None]
        trials = [word if v is None else f"{word.split('=', 1)[0]}={v}" for v in values]
        first = jobs[0]
        jobs = [[*job, trials[0]] for job in jobs] + [[*first, trial] for trial in trials[1:]]
    return names, jobs


def _check_switches(cfg: Any, names: Sequence[str], defaults: Any) -> None:
    """Raise UserError if an option in `names` is a boolean in `defaults`, but not a boolean in `cfg`."""
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    for name in names:
        try:
            default, value = OmegaConf.select(defaults, name), OmegaConf.select(cfg, name)
        except OmegaConfBaseException:  # an interpolation without a target; the stage reports this error
            continue
        if isinstance(default, bool) and not isinstance(value, bool):
            raise UserError(f"{name}: expected true or false, got {value!r}")


def check_option(group: str, value: Any, options: Sequence[str]) -> None:
    """Raise UserError unless a group's value is a string or strings; Hydra prints a traceback for other values."""
    words = value if isinstance(value, list) else [value]
    if not all(isinstance(w, str) for w in words) or not (words or group in OPTIONAL):
        raise UserError(f"{group}: expected one of {choices(options)}, got {value}")


def _first_mistake(words: Sequence[str], own: list[str], groups: dict[str, list[str]], multirun: bool) -> UserError:
    """Add the overrides one by one, and return the error for the first override that Hydra refuses."""
    from hydra import compose
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    known = [*_keys(compose("config", own)), *groups]
    for k, word in enumerate(words):
        job = [word]
        try:
            names, jobs = _jobs(words[: k + 1], own, groups, multirun)
            for job in jobs:
                cfg = compose("config", job)
        except UnknownOption:
            name = word.lstrip("+~").split("=", 1)[0]
            return UserError(renamed(word) or f"unknown option '{name}'{nearest(name, known)}")
        except (HydraException, OmegaConfBaseException) as error:
            return _mistake(job[-1], error, groups, known)  # in a sweep, job[-1] contains the refused value
        if names[-1] in groups:
            known = [*_keys(cfg), *groups]
    raise AssertionError("Hydra accepts each override, but not all of them")


def renamed(override: str) -> str | None:
    """Return a message with the new name of a renamed key or value; None if the override contains no old name."""
    word = override.lstrip("+~")
    if word in RENAMED:
        return f"{word} is now {RENAMED[word]}"
    key = word.split("=", 1)[0]
    for old, new in RENAMED.items():
        if key == old or key.startswith(f"{old}."):
            return f"{key} is now {new}{key.removeprefix(old)}"
    return None


def _keys(node: Any, prefix: str = "") -> Iterator[str]:
    from omegaconf import DictConfig, OmegaConf

    for k in node:
        yield prefix + str(k)
        if not OmegaConf.is_missing(node, k) and isinstance(node._get_node(k), DictConfig) and node[k] is not None:
            yield from _keys(node[k], f"{prefix}{k}.")


def _mistake(word: str, error: Exception, groups: dict[str, list[str]], known: Sequence[str]) -> UserError:
    """Return the `UserError` for the override `word`, which Hydra refuses with `error`."""
    if "=" not in word:
        return UserError(f"'{word}' is not KEY=VALUE{nearest(word, [*groups, *COMMANDS])}")
    key, value = word.split("=", 1)
    bare = key.lstrip("+~")
    if (line := renamed(word)) and (bare not in known or word in RENAMED):
        return UserError(line)
    for option in [v.strip() for v in value.strip("[]").split(",")] if value.startswith("[") else [value]:
        if bare in groups and option not in groups[bare]:
            return UserError(f"{bare}: no option '{option}'; {instead_of(option, groups[bare])}")
    special = PLAIN.sub("", value)
    if special and value[0] not in "[{\"'" and not _parses(word):
        return UserError(f"{bare}: a value with {special[0]} needs quotes: {quoted(word)}")
    if bare not in known:
        return UserError(f"unknown option '{bare}'{nearest(bare, known) or f'; see {PROGRAM} --help'}")
    return UserError(f"{word}: {' '.join(str(error).split())}")


def _parses(word: str) -> bool:
    """Return whether Hydra can parse an override."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    try:
        OverridesParser.create().parse_override(word)
    except HydraException:
        return False
    return True


def quoted(word: str) -> str:
    """Quote an override for the shell so that its value is a single string: 'data.path="a=b.csv"'."""
    key, _, value = word.partition("=")
    inner = value.replace("\\", "\\\\").replace('"', '\\"')
    return shlex.quote(f'{key}="{inner}"')
