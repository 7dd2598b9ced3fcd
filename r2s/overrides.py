"""What a user typed, held against the config before anything starts: one clear line for a slip of the hand."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from r2s.errors import UserError, choices, nearest


def check_overrides(words: Sequence[str], conf: Path) -> None:
    """Raise UserError for an option that the config does not have, with the nearest one that it has.

    Hydra would stop too, with several lines; a sweep is checked value by value before its first job starts.

    Args:
        words: KEY=VALUE, as typed. conf: the folder of config.yaml and its groups.
    """
    groups = {p.name: sorted(f.stem for f in p.glob("*.yaml")) for p in conf.iterdir() if p.is_dir()}
    with initialize_config_dir(str(conf.resolve()), version_base="1.3"):
        cfg = compose("config")
        known = [*_keys(cfg), *groups]
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
                    _check_number(name, before, cfg)
                if not parsed.is_sweep_override() and name in ("data", "arm", "simulator"):
                    known = [*_keys(cfg), *groups]
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


def _keys(node: DictConfig, prefix: str = "") -> Iterator[str]:
    """Yield the dotted names of everything below `node`."""
    for k in map(str, node):
        yield prefix + k
        if not OmegaConf.is_missing(node, k) and isinstance(node[k], DictConfig):
            yield from _keys(node[k], f"{prefix}{k}.")


def _check_number(key: str, before: DictConfig, after: DictConfig) -> None:
    """Raise UserError where a number of the config was replaced by a word."""

    def number(value):
        return isinstance(value, (int, float)) and not isinstance(value, bool)

    old, new = OmegaConf.select(before, key, throw_on_missing=False), OmegaConf.select(after, key)
    if number(old) and isinstance(new, str):
        raise UserError(f"{key}: '{new}' is not a number, such as {old:g}")
