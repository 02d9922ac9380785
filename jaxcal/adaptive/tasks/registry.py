"""Tasks by name: those of jaxcal, of installed packages, and of a user's own file.

A task is one file with a function that makes it and ``ENTRY = Entry(function, ...)``.
It is found by its name in the entry points ``jaxcal.tasks``, or as ``path/to/file.py``.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from jaxcal.adaptive.rules import Priced, StateRule
from jaxcal.extras import installed
from jaxcal.learning.config import named, of_file

_GROUP = "jaxcal.tasks"  # entry points
_OWN = {"knee": "jaxcal.adaptive.tasks.knee:ENTRY"}

FREE = {"priced": Priced(1.0, 0.0, 0.0), "state": StateRule(1.0, 0.0, 0.0)}
"""Rules of a task whose measurements cost nothing: the largest gain."""


@dataclasses.dataclass(frozen=True)
class Entry:
    """A task that commands know by its name."""

    make: Callable[..., Any]  # options, all with defaults -> the task
    about: str = ""  # one line for --help
    rules: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Deciders with constants tuned on the default task, such as ``priced``."""
    methods: tuple[str, ...] = ()
    """What ``evaluate.py`` compares by default; all quick methods when empty."""
    episodes: int = 4096
    """Sessions that ``evaluate.py`` plays by default."""


def names() -> list[str]:
    """Tasks of jaxcal and of installed packages."""
    return sorted({*_OWN, *installed(_GROUP)})


def load(name: str) -> Entry:
    """A task's entry, by its name as registered or in a Python file that defines
    ``ENTRY``; a ValueError where there is no such task, or a file that fails or has no
    entry."""
    if name.endswith(".py"):
        entry = getattr(of_file(name), "ENTRY", None)
        if entry is None:
            raise ValueError(f"task file {name} must define ENTRY = Entry(...)")
    elif name in _OWN:
        entry = named(_OWN[name])
    elif name in installed(_GROUP):
        entry = installed(_GROUP)[name].load()
    else:
        raise ValueError(
            f"task must be one of {', '.join(names())}, or a Python file that defines "
            f"ENTRY, as those in examples/tasks do, got {name!r}"
        )
    if not isinstance(entry, Entry):
        raise ValueError(f"task {name} must be an Entry, got {type(entry).__name__}")
    return entry


def options_from(entry: Entry, given: Sequence[str]) -> dict[str, Any]:
    """Options of a task from a command line, such as ``sigma=0.05``; refused where one
    is not NAME=VALUE, or a name that the task does not have."""
    defaults = {
        name: parameter.default
        for name, parameter in inspect.signature(entry.make).parameters.items()
        if parameter.kind is not parameter.VAR_KEYWORD
    }
    options: dict[str, Any] = {}
    for text in given:
        name, equals, value = text.partition("=")
        if not equals or name not in defaults:
            raise ValueError(
                f"--with must be NAME=VALUE with NAME of {', '.join(defaults)}, "
                f"got {text!r}"
            )
        try:
            options[name] = ast.literal_eval(value)
        except (ValueError, SyntaxError):
            options[name] = value
        default = defaults[name]
        if isinstance(default, int | float) and not isinstance(
            options[name], int | float
        ):
            raise ValueError(
                f"--with {name} must be a number, as {default:g}, got {value!r}"
            )
    return options
