"""What the paper's commands share: errors of one line, exit codes, common arguments."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable
from typing import NoReturn

from jaxcal.arguments import at_least

__all__ = ["Parser", "one_of", "positive", "run", "seed"]

seed = at_least(0)  # for ``type=``
positive = at_least(1)


class Parser(argparse.ArgumentParser):
    """Reports a bad argument in one line and keeps the layout of its texts."""

    def __init__(self, prog: str, description: str, epilog: str = "") -> None:
        layout = argparse.RawDescriptionHelpFormatter
        super().__init__(
            prog,
            description=description,
            epilog=epilog,
            formatter_class=layout,
            allow_abbrev=False,
        )

    def error(self, message: str) -> NoReturn:
        print(f"{self.prog}: error: {message}; see --help", file=sys.stderr)
        sys.exit(2)


def one_of(names: Iterable[str]) -> Callable[[str], str]:
    """For ``type=``: one of the names."""

    def parse(text: str) -> str:
        if text not in names:
            known = ", ".join(names)
            raise argparse.ArgumentTypeError(f"must be one of {known}, got {text!r}")
        return text

    return parse


def run(command: Callable[[], None], name: str, interrupted: str) -> int:
    """Run a command; its exit code.

    Args:
        command: what it does.
        name: in front of an error.
        interrupted: what an interruption leaves.

    Returns:
        0; 2 where an argument, a file or a folder is bad, 3 where a program that it
        started failed, 130 where it was interrupted.
    """
    try:
        command()
    except KeyboardInterrupt:
        print(f"{name}: interrupted; {interrupted}", file=sys.stderr)
        return 130
    except (ValueError, OSError, RuntimeError) as error:
        text = " ".join(str(error).split())
        if isinstance(error, OSError) and error.strerror and error.filename:
            text = f"{error.filename}: {error.strerror}"
        print(f"{name}: error: {text}", file=sys.stderr)
        return 3 if isinstance(error, RuntimeError) else 2
    return 0
