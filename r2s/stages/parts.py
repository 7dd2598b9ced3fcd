"""Make the objects that config nodes name in `_target_`; error messages name settings as the user types them."""

import inspect
import logging
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, get_args, get_type_hints

from r2s.errors import UserError, nearest


def part(node: Any, group: str, *given: Any, beside: Iterable[str] = ()) -> Any:
    """Make a part: call the class or function that a config node's `_target_` names, and return the result.

    Args:
        node: config node whose keys are arguments of the target.
        group: path of the node in the config, for error messages.
        given: positional arguments of the target; the config contains only keyword arguments.
        beside: keys of the node that are not passed to the target.

    Raises:
        UserError: the target does not exist or refuses an argument.
    """
    make = target(node, group)  # raises if the node is no mapping
    settings = {k: v for k, v in plain(node).items() if k not in ("_target_", "name", *beside)}
    return called(make, group, settings, *given)


def target(node: Any, group: str) -> Callable[..., Any]:
    """Return the class or function that a config node's `_target_` names."""
    from hydra.utils import get_object

    path = node.get("_target_") if isinstance(node, Mapping) else None
    if not isinstance(path, str) or not path:
        raise UserError(f"{group}: expected a yaml with _target_ (dotted path of a class or function), got none")
    logging.getLogger("hydra.utils").disabled = True  # otherwise Hydra prints the error too
    try:
        return get_object(path)
    except Exception as error:  # the import of a user's module may raise any exception
        cause = error.__cause__ or error
        while cause.__cause__ is not None:
            cause = cause.__cause__
        reason = " ".join(str(cause).split())
        raise UserError(f"{group}._target_: cannot load '{path}': {type(cause).__name__}: {reason}") from None


def called(make: Callable[..., Any], group: str, settings: Mapping[str, Any], *given: Any) -> Any:
    """Return the result of make(*given, **settings); error messages name settings as the user types them.

    Raises:
        UserError: an argument is unknown, missing or of a wrong type, or `make` raises UserError.
    """
    check_types(make, group, settings)
    known, name = arguments(make), getattr(make, "__name__", make)
    for key in settings:
        if key not in known and "**" not in known:
            raise UserError(f"{group}: {name} has no argument '{key}'{nearest(key, known)}")
    try:
        inspect.signature(make).bind(*given, **settings)
    except TypeError as error:
        raise UserError(f"{group}: {name}: {error}") from None
    try:
        return make(*given, **settings)
    except UserError as error:
        first = str(error).split(":")[0].split(".")[0]
        if first in settings and first != group:  # the message lacks the group, which the target does not know
            raise UserError(f"{group}.{error}") from None
        raise


def arguments(make: Callable[..., Any]) -> dict[str, Any]:
    """Return {argument: type hint} of a function or class.

    If an __init__ has **kwargs, add the arguments of the next class in the MRO. If a function has **kwargs, add "**".
    """
    found: dict[str, Any] = {}
    for owner in make.__mro__[:-1] if inspect.isclass(make) else (make,):
        function = vars(owner).get("__init__") if inspect.isclass(make) else owner
        if function is None:
            continue
        try:
            hints = get_type_hints(function)
        except (NameError, TypeError):  # annotations that only type checkers resolve, or no plain function
            hints = {}
        parameters = inspect.signature(function).parameters.values()
        found = {p.name: hints.get(p.name) for p in parameters if not p.kind.name.startswith("VAR")} | found
        if not any(p.kind is p.VAR_KEYWORD for p in parameters):
            return found
        if not inspect.isclass(make):
            return found | {"**": None}
    return found or dict.fromkeys(inspect.signature(make).parameters)  # a class without __init__


def check_types(make: Callable[..., Any], group: str, settings: Mapping[str, Any]) -> None:
    """Raise UserError if a setting is a string, but the argument's type is a number or a list of numbers."""
    hints = arguments(make)
    for key, value in settings.items():
        kinds = set(_kinds(hints.get(key)))
        strings = [v for v in (value if isinstance(value, list) else [value]) if isinstance(v, str)]
        if strings and kinds & {int, float} and not kinds & {str, Any}:
            raise UserError(f"{group}.{key}: expected a number, got '{strings[0]}'")


def _kinds(hint: Any) -> Iterator[Any]:
    inner = get_args(hint)
    for kind in inner:
        yield from _kinds(kind)
    if not inner:
        yield hint


def plain(node):
    """Return a config node as plain dicts, lists and values; return other objects unchanged."""
    from omegaconf import OmegaConf

    if not OmegaConf.is_config(node):
        return node
    return OmegaConf.to_container(node, resolve=True, throw_on_missing=True)
