"""Fields of a configuration: a default, the line that explains it, and its checks."""

from __future__ import annotations

import dataclasses
import importlib
import importlib.util
import sys
import typing
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

__all__ = [
    "Setting",
    "named",
    "path_of",
    "require",
    "setting",
    "settings_of",
]


_OWN = "jaxcal.own "  # before the path of a file, in the name of its module


class Setting(NamedTuple):
    """One field of a configuration, as a command shows it."""

    name: str
    kind: type  # bool, int, float or str
    help: str


def setting(default: Any, help: str) -> Any:
    """A dataclass field with a default and a line of help; commands print the line."""
    return dataclasses.field(default=default, metadata={"help": help})


def settings_of(config: type) -> Iterator[Setting]:
    """The fields of a configuration class that were made by ``setting``."""
    kinds = typing.get_type_hints(config)
    for field in dataclasses.fields(config):
        if "help" in field.metadata:
            yield Setting(field.name, kinds[field.name], field.metadata["help"])


def require(config: Any, rule: str, holds: Callable[[Any], bool], *names: str) -> None:
    """Refuse a configuration in which one of the named fields breaks a rule.

    Raises:
        ValueError: naming the field, the rule and the value.
    """
    for name in names:
        value = getattr(config, name)
        if not holds(value):
            raise ValueError(f"{name} must be {rule}, got {value}")


def path_of(thing: type) -> str:
    """``module:Name`` or ``file.py:Name`` of a class, by which ``named`` finds it."""
    return f"{thing.__module__.removeprefix(_OWN)}:{thing.__qualname__}"


def named(path: str) -> Any:
    """What ``module:Name`` or ``file.py:Name`` names.

    Raises:
        ValueError: there is no such module or file, or no such name in it.
    """
    place, _, name = path.rpartition(":")
    try:
        if place.endswith(".py"):
            spec = importlib.util.spec_from_file_location(f"{_OWN}{place}", place)
            assert spec is not None and spec.loader is not None  # it is a Python file
            module = sys.modules.get(spec.name)
            if module is None:
                module = importlib.util.module_from_spec(spec)
                sys.modules[spec.name] = module  # dataclasses look up the module there
                spec.loader.exec_module(module)
        else:
            module = importlib.import_module(place)
        return getattr(module, name)
    except (ImportError, AttributeError, OSError) as error:
        raise ValueError(
            f"{path} must be MODULE:NAME or FILE.py:NAME that is there: {error}"
        ) from error
