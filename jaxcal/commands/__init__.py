"""The console command ``jaxcal``: one module for each of its commands."""

from __future__ import annotations

import sys

__all__ = ["main"]


def main(argv: list[str] | None = None) -> int:
    """``program.run``; Ctrl-C while that loads is one line too."""
    try:
        from jaxcal.commands.program import run

        return run(argv)
    except KeyboardInterrupt:
        print("jaxcal: interrupted", file=sys.stderr)
        return 130
