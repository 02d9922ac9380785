"""Fields of a configuration: a default, the line that explains it, and its checks."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import typing
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

__all__ = ["Setting", "installed", "require", "setting", "settings_of"]


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


def installed(group: str) -> dict[str, importlib.metadata.EntryPoint]:
    """What installed packages offer under an entry-point group, by name."""
    return {p.name: p for p in importlib.metadata.entry_points(group=group)}
