"""Read config.yaml of a run folder safely: r2s refuses code that is neither part of r2s nor trusted by the user."""

import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from r2s.errors import UserError
from r2s.stages.parts import target

PACKAGE = Path(__file__).parent.parent
CONF = PACKAGE / "conf" if (PACKAGE / "conf").is_dir() else PACKAGE.parent / "conf"  # in a wheel, or in a checkout
PROGRAM = "python run.py" if CONF.parent != PACKAGE else "r2s"  # how the user starts r2s
TRUST = "R2S_TRUST"  # environment variable with the value of `trust=` for the trainings of a resumed search
# matches resolvers such as ${oc.env:HOME}, nested ${a${b}} that may become a resolver, and an escaped $
RESOLVER = re.compile(r"\$\{\s*(\w*)[^}]*(?::|\$\{)|\\\$")


def loaded(path):
    """Return the content of a YAML file of a run folder as a config.

    Raises:
        UserError: the file cannot be read or is no YAML.
    """
    import yaml
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    try:
        return OmegaConf.load(path)
    except (OSError, ValueError, yaml.YAMLError, OmegaConfBaseException) as error:
        raise UserError(f"{path} cannot be read: {' '.join(str(error).split())}") from None


def modules(trust) -> list[str]:
    """Return the module names in the option `trust=`: a name, comma-separated names, a list, or None.

    Raises:
        UserError: the option is neither a string, nor a list of strings, nor None.
    """
    names = trust.strip("[]").split(",") if isinstance(trust, str) else trust
    if names is None:
        return []
    if not isinstance(names, Sequence) or not all(isinstance(name, str) for name in names):
        raise UserError(f"trust: expected names of modules, such as trust=my_parts, got {trust!r}")
    return [name.strip() for name in names if name.strip()]


def run_config(folder, trust=None):
    """Read config.yaml of a run folder, check it with `checked`, and return it.

    Raises:
        UserError: the file cannot be read, or names code that is neither in r2s nor in a module of `trust`.
    """
    return checked(loaded(Path(folder) / "config.yaml"), Path(folder) / "config.yaml", trust)


def replayed(cfg):
    """Return a composed config; in the trainings of a resumed search, check the config with `checked` first."""
    return checked(cfg, "resume", os.environ[TRUST]) if TRUST in os.environ else cfg


def checked(cfg, where, trust=None):
    """Return a run folder's config with resolved interpolations; raise UserError for untrusted code.

    r2s calls each class or function that a config names as `_target_`. A target is allowed only if conf/ names the
    target in the same group, or if a module in `trust` defines the target. Resolvers such as ${oc.env:X} need `oc` in
    `trust`.

    Args:
        where: file name for error messages. trust: value of `trust=` (see `modules`) that replaces `cfg.trust`.

    Raises:
        UserError: the config names untrusted code; r2s has neither imported nor called this code.
    """
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    trusted, foreign = modules(trust), dict[str, tuple[Any, str]]()
    for key, text in _leaves(OmegaConf.to_container(cfg, resolve=False)):
        if (found := RESOLVER.search(str(text))) and (found[1] or "oc") not in trusted:
            foreign[".".join(key)] = text, found[1] or "oc"
    try:
        settings = OmegaConf.to_container(cfg, resolve=not foreign)
    except OmegaConfBaseException as error:
        raise UserError(f"{where} cannot be read: {' '.join(str(error).split())}") from None
    if not isinstance(settings, dict):
        raise UserError(f"{where} cannot be read: expected settings by name")
    for key, value in _leaves(settings):
        if not _is_own(key, value) and not _is_defined_in(key, value, trusted):
            foreign[".".join(key)] = value, str(value).split(".")[0]
    if foreign:
        path, (name, _) = next(iter(foreign.items()))
        needed = sorted({*trusted, *(module for _, module in foreign.values())})
        words = needed[0] if len(needed) == 1 else f"[{','.join(needed)}]"
        raise UserError(
            f"{where}: {path} is '{name}', no part of r2s, and r2s would run it; if you trust it, add trust={words}"
        )
    return OmegaConf.create(settings | {"trust": trusted})


def _leaves(node, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield (keys, value) for each value in nested settings."""
    if not isinstance(node, dict | list):
        yield path, node
        return
    for key, value in node.items() if isinstance(node, dict) else enumerate(node):
        yield from _leaves(value, (*path, str(key)))


def _is_own(key, value) -> bool:
    """Return whether a setting names no code, or is a `_target_` that a conf/ file of the same group names."""
    if key == ("friction", "family"):
        return "." not in str(value)
    if key[-1:] != ("_target_",):
        return True
    own = (re.findall(r"_target_: *(\S+)", path.read_text()) for path in CONF.glob(f"{key[0]}/*.yaml"))
    return any(value in targets for targets in own)


def _is_defined_in(key, value, trusted) -> bool:
    """Return whether a trusted module defines, rather than only imports, the object at a dotted path."""
    head = str(value).split(".")[0]
    if head not in trusted or key[-1] != "_target_":
        return head in trusted
    return str(getattr(target({"_target_": value}, ".".join(key[:-1])), "__module__", "")).split(".")[0] == head
