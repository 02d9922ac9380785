"""What the paper's commands share: exit codes and types of arguments."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable

from jaxcal.arguments import at_least, refused

__all__ = ["one_of", "positive", "run", "seed"]

seed = at_least(0)  # for ``type=``
positive = at_least(1)


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
        code = refused(name, error)
        return 3 if isinstance(error, RuntimeError) else code
    return 0
