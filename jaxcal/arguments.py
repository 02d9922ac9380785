"""Command lines made of the signatures of functions, and errors said in one line.

A command is a function, its docstring its help. A parameter is an argument, a
keyword-only one an option; one whose type is a dataclass stands for options, its
fields. ``Annotated[T, ...]`` says more of one: its help and, where the type does not
tell, what stands for its value; two numbers are its range, a list its choices, a
function makes the value of a text. An underscore at the end is no part of a name.
Options of a dataclass with a ``TITLE`` stand under it in the help, and under its
``ABOUT``, if any; ``RARE``, True or names of its fields, are those that only ``--help
all`` shows. ``Was(name)`` is a name that an option had in 0.2: it works, and warns,
until 0.4.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import inspect
import io
import logging
import math
import os
import pathlib
import re
import sys
import typing
from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, Any, Literal, NoReturn, TypeVar

from jaxcal.checks import nearest
from jaxcal.extras import MissingExtraError, typed

T = TypeVar("T")
_METAVARS = {int: "N", float: "X", pathlib.Path: "FILE"}


class Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, and keeps the layout of its texts."""

    def __init__(self, **fields: Any) -> None:
        fields.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        super().__init__(allow_abbrev=False, **fields)
        self.rare: dict[argparse.Action, str | None] = {}  # with its help
        self.renamed: dict[str, str] = {}  # options by their old names
        if self.add_help:
            version = f"jaxcal {sys.modules['jaxcal'].__version__}"
            text = argparse.SUPPRESS if " " in self.prog else "print the version"
            named = "-V", "--version"
            self.add_argument(*named, action="version", version=version, help=text)

    def of(self, function: Callable[..., Any]) -> Parser:
        """Itself, for the arguments of a function, or a dataclass called ``options``:
        a function's own come before those of its dataclasses."""
        self.set_defaults(function=function)
        groups: dict[type, Any] = {}
        arguments = sorted(_arguments(function), key=lambda one: bool(one[0]))
        for owner, name, hint, *option in arguments:
            kind = owner and owner[1]
            if kind not in groups:
                title = getattr(kind, "TITLE", None)
                about = getattr(kind, "ABOUT", None)
                groups[kind] = self.add_argument_group(title, about) if title else self
            action = _add(groups[kind], name, hint, *option)
            for old in getattr(hint, "__metadata__", ()):
                if isinstance(old, Was):
                    self.renamed[f"--{old.name}"] = action.option_strings[-1]
            rare: Any = getattr(kind, "RARE", ())
            if rare is True or (rare and name in rare):
                self.rare[action], action.help = action.help, argparse.SUPPRESS
        needed = [
            " ".join([*action.option_strings[:1], str(action.metavar or action.dest)])
            for action in self._actions
            if action.required or not action.option_strings
        ]
        self.usage = self.usage or " ".join(["%(prog)s", *needed, "[options]"])
        return self

    def format_help(self) -> str:
        hidden = sum(action.help == argparse.SUPPRESS for action in self.rare)
        more = f"\n{hidden} more options: --help all\n" if hidden else ""
        groups = self._action_groups
        self._action_groups = [
            group
            for group in groups
            if any(x.help != argparse.SUPPRESS for x in group._group_actions)
        ]
        text = super().format_help() + more
        self._action_groups = groups
        return text

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        words = sys.argv[1:] if args is None else [*args]
        if words[:1] == ["help"] and self._subparsers is not None:
            words = [*words[1:], "--help"]
        if words[-1:] == ["all"] and words[-2:-1] in (["-h"], ["--help"]):
            for action, text in self.rare.items():
                action.help = text
        for place, word in enumerate(words):
            old, *value = word.split("=", 1)
            if new := self.renamed.get(old):
                outdated(self.prog, old, new)
                words[place] = "=".join([new, *value])
        if sys.stdout is None:  # jaxcal ... >&-
            self.exit(2, f"{self.prog}: standard output is closed\n")
        self.words = words
        parsed, unknown = super().parse_known_args(words, namespace)
        if unknown and self.exit_on_error and self._subparsers is None:
            self._correct(unknown)
            if unknown[0].isdecimal() and "-k" in self._option_string_actions:
                self.error(
                    "there is no option {0}; did you mean -k {0}?".format(*unknown)
                )
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return parsed, unknown

    def _correct(self, words: Sequence[str]) -> None:
        """Refuse a mistyped option by the nearest; -o by one that begins --o."""
        options = self._option_string_actions
        for flag in (word.partition("=")[0] for word in words):
            if flag.startswith("-") and flag not in options:
                begins = [x for x in options if x.startswith("-" + flag)]
                short = flag[1:2].isalpha() and min(begins, key=len, default="")
                if like := short or nearest(flag, options):
                    self.error(f"there is no option {flag}; did you mean {like}?")

    def error(self, message: str) -> NoReturn:
        if "are required" in message:
            words, self.words = self.words, []  # once
            self._correct(words)
        if match := re.match(r"argument (?:.*/)?(--[\w-]+): expected one", message):
            message += f"; write {match[1]}=VALUE if the value begins with a minus"
        message = re.sub(r"invalid \w+ value: ", "cannot read ", message)
        choice = r"argument (.+): invalid choice: '(.*)' \(choose from (.*)\)"
        if match := re.match(choice, message):
            if like := nearest(match[2], re.findall(r"[^\s',]+", match[3])):
                what = match[1].lower()
                message = f"there is no {what} {match[2]!r}; did you mean {like}?"
        self.exit(2, f"{self.prog}: {message}; see --help\n")


@dataclasses.dataclass(frozen=True)
class Was:
    """The name that an option had in jaxcal 0.2, without its dashes."""

    name: str


def values_of(args: argparse.Namespace) -> dict[str, Any]:
    """The arguments of ``args.function`` that were parsed."""
    given: dict[Any, dict[str, Any]] = {None: {}}
    for owner, name, *_ in _arguments(args.function):
        given.setdefault(owner, {})[name] = getattr(args, name)
    made = {name: kind(**given[name, kind]) for name, kind in filter(None, given)}
    return given[None] | made


def _arguments(function: Callable[..., Any]) -> Iterator[tuple[Any, ...]]:
    """Parameter and dataclass of a field, or None; name, type, default and whether it
    is an option."""
    if isinstance(function, type):
        yield from _options("options", function)
        return
    hints = typing.get_type_hints(function, include_extras=True)
    for name, parameter in inspect.signature(function).parameters.items():
        if dataclasses.is_dataclass(kind := hints[name]):
            yield from _options(name, kind)
        else:
            option = parameter.kind is parameter.KEYWORD_ONLY
            yield None, name, hints[name], parameter.default, option


def _options(parameter: str, kind: Any) -> Iterator[tuple[Any, ...]]:
    """Options from the fields of a dataclass, those of its bases last."""
    hints = typing.get_type_hints(kind, include_extras=True)
    fields = {each.name: each for each in dataclasses.fields(kind) if each.init}
    bases = [vars(base).get("__annotations__", {}) for base in inspect.getmro(kind)]
    for each in (fields[name] for base in bases for name in base if name in fields):
        yield (parameter, kind), each.name, hints[each.name], each.default, True


def _add(
    parser: Any, name: str, hint: Any, default: Any, option: bool
) -> argparse.Action:
    kind: Any = hint
    said: tuple[Any, ...] = ()
    while (optional := type(None) in (parts := typing.get_args(kind))) or (
        typing.get_origin(kind) is typing.Annotated
    ):
        kind, said = parts[0], said if optional else parts[1:]
    text, metavar, *_ = *(word for word in said if isinstance(word, str)), "", ""
    parse = next(filter(callable, said), None)
    limits: tuple[float, ...] = next((x for x in said if isinstance(x, tuple)), ())
    choices: Sequence[str] = next((x for x in said if isinstance(x, list)), ())
    origin, one = typing.get_origin(kind), kind
    if origin in (list, tuple):
        one = parts[0]
    more: dict[str, Any] = {}
    if origin is Literal or choices:
        more["choices"] = choices or parts
    elif kind is not bool:
        more["type"] = parse or (
            number_type(one, *limits) if one in (int, float) else one
        )
        shown = metavar or _METAVARS.get(one, name.upper())
        more["metavar"] = shown if option or metavar else name
    if kind is bool:
        more["action"] = "store_true"
    elif origin is list and (parse is None or typing.get_origin(one) is list):
        more["action"] = "append"
    elif origin is tuple and parts[-1] is Ellipsis:
        more |= {"nargs": "+", "action": "extend"} if option else {"nargs": "*"}
        default = [] if default == () else default
    elif origin is tuple:
        more["nargs"] = len(parts)
    if default in (inspect.Parameter.empty, dataclasses.MISSING):
        more |= {"required": True} if option else {}
    else:
        more["default"] = default
        if not option:
            more.setdefault("nargs", "?")
        if default not in (None, "", []) and default is not False:
            text += f" (default {default})"
    long = f"--{name.rstrip('_').replace('_', '-')}"
    names = [f"-{name}", long] if len(name) == 1 else [long]
    more |= {"dest": name, "help": text.replace("%", "%%")}
    action: argparse.Action = parser.add_argument(*names if option else (), **more)
    return action


@contextlib.contextmanager
def told(at_end: bool = False) -> Iterator[None]:
    """What jaxcal logs inside the block is shown on standard error; ``at_end``, and not
    where it fails: an error is then the only line."""
    lines: Any = io.StringIO() if at_end else sys.stderr
    log, shown = logging.getLogger("jaxcal"), logging.StreamHandler(lines)
    level = log.level
    log.setLevel(logging.INFO)
    log.addHandler(shown)
    try:
        yield
        if at_end and sys.stderr is not None:
            sys.stderr.write(lines.getvalue())
    finally:
        log.setLevel(level)
        log.removeHandler(shown)


def typed_line(program: str) -> str:
    """``train.py``, where the script that runs is, or ``jaxcal train`` as it is typed
    in this shell."""
    name, *more = program.split()
    if not name.endswith(".py"):
        return " ".join([typed(name), *more])
    running = pathlib.Path(sys.argv[0])
    scripts = ("train.py", "evaluate.py")
    folder = running.parent if running.name in scripts else pathlib.Path()
    return f"{typed('python')} {folder / name}"


def refused(program: str, error: Exception) -> int:
    """Print an error in one line on standard error; the exit code, 2."""
    text = " ".join(str(error).split()) or type(error).__name__
    if isinstance(error, OSError) and error.strerror and error.filename is not None:
        text = f"{error.filename}: {error.strerror}"
    print(f"{program}: {text}", file=sys.stderr)
    return 2


def outdated(program: str, old: str, new: str) -> None:
    """A line on standard error about a name that 0.2 had."""
    text = f"{old} is {new} since jaxcal 0.3; the old name goes with 0.4"
    print(f"{program}: {text}", file=sys.stderr)


def exit_code(
    command: Callable[[], int | None], program: str, interrupted: str = ""
) -> int:
    """Run a command: what it returns or 0; 2 where something given is bad, 130 where it
    is interrupted, 143 where terminated; ``interrupted`` says what was kept."""
    try:
        return command() or 0
    except KeyboardInterrupt as stop:
        how = str(stop) or "interrupted"
        more = f", {interrupted}" if interrupted else ""
        print(f"{program}: {how}{more}", file=sys.stderr)
        return 143 if how == "terminated" else 130
    except BrokenPipeError:  # the reader of a pipe, such as head, has left
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except (ValueError, OSError, MissingExtraError) as error:
        return refused(program, error)


def number_type(
    kind: type, low: float = -math.inf, high: float = math.inf
) -> Callable[[str], Any]:
    """Reads an int or float, not below ``low`` nor above ``high``."""
    rule = "a whole number" if kind is int else "a number"
    if high < math.inf:
        rule += f" in [{low:g}, {high:g}]"
    elif low > -math.inf:
        rule += f" of at least {low:g}"

    def parse(text: str) -> Any:
        try:
            value = kind(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"must be {rule}, got {text!r}")
        return value

    return parse


def several(kind: Callable[[str], T], what: str) -> Callable[[str], list[T]]:
    """Values separated by commas, called ``what`` where one is not of the kind."""

    def parse(text: str) -> list[T]:
        try:
            return [kind(part) for part in text.split(",") if part.strip()]
        except ValueError:
            raise argparse.ArgumentTypeError(
                f"must be {what} separated by commas, got {text!r}"
            ) from None

    return parse


def levels(text: str) -> float | list[float]:
    """One number, or a list of one for each output; 1,5 is neither."""
    if re.fullmatch(r"\s*\d+,\d+\s*", text):
        whole = text.strip()
        point, two = whole.replace(",", "."), whole.replace(",", ".0,") + ".0"
        raise argparse.ArgumentTypeError(
            f"{whole!r} may be one number or two: write {point}, or {two}"
        )
    values: list[float] = several(number_type(float), "numbers")(text)
    return values[0] if len(values) == 1 else values


Numbers = Annotated[float | list[float] | None, levels]
