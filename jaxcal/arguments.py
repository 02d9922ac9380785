"""Command lines: a parser, types of values, and errors, each said in one line."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Iterable
from typing import Any, NoReturn, TypeVar

__all__ = [
    "Flag",
    "Parser",
    "at_least",
    "exit_code",
    "flag",
    "refused",
    "seconds",
    "several",
]

T = TypeVar("T")
Flag = tuple[tuple[str, ...], dict[str, Any]]  # what ``add_argument`` takes


def flag(
    name: str,
    help: str,
    metavar: str = "FILE",
    type: Callable[[str], Any] | None = None,
    *,
    long: str = "",
    on: bool = False,
    **more: Any,
) -> Flag:
    """A flag (``on``: without a value), or an argument where the name has no dash."""
    given = {"help": help, **more}
    if on:
        given["action"] = "store_true"
    elif "choices" not in more:
        given |= {"metavar": metavar, "type": type or str}
    return ((name, long) if long else (name,)), given


class Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, and keeps the layout of its texts."""

    def __init__(self, **fields: Any) -> None:
        fields.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        super().__init__(allow_abbrev=False, **fields)

    def with_flags(self, flags: Iterable[Flag]) -> Parser:
        """Itself, with these flags."""
        for names, fields in flags:
            self.add_argument(*names, **fields)
        return self

    def error(self, message: str) -> NoReturn:
        if found := re.match(r"argument (?:.*/)?(--[\w-]+): expected one", message):
            message += f"; write {found[1]}=VALUE where it begins with a minus"
        self.exit(2, f"{self.prog}: {message}; see --help\n")


def refused(program: str, error: Exception) -> int:
    """Print an error in one line on standard error; the exit code, 2."""
    text = " ".join(str(error).split()) or type(error).__name__
    if isinstance(error, OSError) and error.strerror and error.filename is not None:
        text = f"{error.filename}: {error.strerror}"
    print(f"{program}: {text}", file=sys.stderr)
    return 2


def exit_code(command: Callable[[], None], program: str, interrupted: str) -> int:
    """Run a command: 0; 2 where something given is bad, 130 where it is interrupted."""
    try:
        command()
    except KeyboardInterrupt:
        print(f"{program}: interrupted; {interrupted}", file=sys.stderr)
        return 130
    except (ValueError, OSError) as error:
        return refused(program, error)
    return 0


def at_least(least: int) -> Callable[[str], int]:
    """A whole number of at least ``least``."""

    def parse(text: str) -> int:
        try:
            number = int(text)
        except ValueError:
            number = least - 1
        if number < least:
            raise argparse.ArgumentTypeError(
                f"must be a whole number of at least {least}, got {text!r}"
            )
        return number

    return parse


def seconds(text: str) -> float:
    """A finite time above 0."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"must be seconds above 0, got {text!r}")
    return value


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
