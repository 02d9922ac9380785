"""A command line made of the signatures of its functions.

A command is a function, its docstring its help. A parameter is an argument, a
keyword-only one an option; one whose type is a dataclass stands for options, its
fields. ``Annotated[T, ...]`` says more of one: a text is its help, two numbers are its
range, a function makes the value of a text.
"""

from __future__ import annotations

import argparse
import dataclasses
import inspect
import typing
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal

EPILOG = """\
exit codes: 0 done; 1 done, but the error says calibrate (again); 2 bad input, nothing
moved; 3 stopped by a fault; 4 paused by Ctrl-C; 128 + signal stopped by a signal.
After 3, 4 and signals `resume RUN` goes on.

Research software, not a medical device. Calibrate with no patient attached; a hardware
emergency stop is required.
"""


def parser_of(
    commands: Sequence[Callable[..., int]], only: str | None
) -> argparse.ArgumentParser:
    """The parser of all commands, or of one alone, which is made quicker."""
    parser = argparse.ArgumentParser(
        prog="jaxcal-rig",
        description="Calibrate a three-axis device over Modbus and a phone's IMU.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    added = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for function in [each for each in commands if each.__name__ == only] or commands:
        name, text = function.__name__, function.__doc__
        command = added.add_parser(name, help=text, description=text)
        command.set_defaults(function=function)
        for _, *one in sorted(_arguments(function), key=lambda each: bool(each[0])):
            _add(command, *one)  # its own come first
    return parser


def call(args: argparse.Namespace) -> int:
    """Run the command that was parsed."""
    given: dict[Any, dict[str, Any]] = {None: {}}
    for owner, name, *_ in _arguments(args.function):
        given.setdefault(owner, {})[name] = getattr(args, name)
    made = {name: kind(**given[name, kind]) for name, kind in filter(None, given)}
    code: int = args.function(**given[None], **made)
    return code


def _arguments(function: Callable[..., int]) -> Iterator[tuple[Any, ...]]:
    """Parameter and dataclass of a field, or None; name, type, default and whether it
    is an option."""
    hints = typing.get_type_hints(function, include_extras=True)
    for name, found in inspect.signature(function).parameters.items():
        if dataclasses.is_dataclass(kind := hints[name]):
            of = typing.get_type_hints(kind, include_extras=True)
            bases = [
                getattr(each, "__annotations__", {})
                for each in inspect.getmro(typing.cast(type, kind))
            ]
            fields = {each.name: each for each in dataclasses.fields(kind)}
            for each in (fields[one] for base in bases for one in base):
                yield (name, kind), each.name, of[each.name], each.default, True
        else:
            option = found.kind is found.KEYWORD_ONLY
            yield None, name, kind, found.default, option


def _add(
    parser: argparse.ArgumentParser, name: str, kind: Any, default: Any, option: bool
) -> None:
    if type(None) in (parts := typing.get_args(kind)):
        kind = parts[0]
    more: dict[str, Any] = {"help": ""}
    limits: tuple[float, float] | None = None
    if typing.get_origin(kind) is typing.Annotated:
        kind, *said = typing.get_args(kind)
        for each in said:
            if isinstance(each, tuple):
                limits = each
            else:
                more["help" if isinstance(each, str) else "type"] = each
    origin, parts = typing.get_origin(kind), typing.get_args(kind)
    if kind is bool:
        more["action"] = "store_true"
    elif origin is Literal:
        more |= {"choices": parts}
    elif origin is tuple:
        more = {"type": parts[0], "nargs": len(parts)} | more
    elif origin is list and "type" not in more:
        more["action"] = "append"
    else:
        more.setdefault("type", kind)
    if limits:
        more["type"] = _within(more["type"], *limits)
    if type(default) in (int, float):
        more["help"] += f" (default {default:g})"
    if default is inspect.Parameter.empty:
        more |= {"required": True} if option else {}
    else:
        more |= {"default": default} if option else {"default": default, "nargs": "?"}
    parser.add_argument(f"--{name.replace('_', '-')}" if option else name, **more)


def _within(kind: type, low: float, high: float) -> Callable[[str], Any]:
    def number(text: str) -> Any:
        if not low <= (value := kind(text)) <= high:
            raise argparse.ArgumentTypeError(f"must be in [{low:g}, {high:g}]: {text}")
        return value

    return number
