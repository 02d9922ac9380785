"""``jaxcal-rig`` and ``python -m rig``: the command line."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Sequence

from rig.arguments import make_parser

# Looked for before any port opens; finding is quicker than importing.
NEEDED = ("pydantic", "pymodbus")
REPORTS = ("jinja2",)  # the report is written last
CORRECTS = {"setup": ("tomlkit",), "imu": ("tomlkit",), "axes": ("tomlkit",)}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    args = make_parser().parse_args(argv)
    from jaxcal.extras import MissingExtraError, needs
    from rig.journal import JournalError

    command = args.command
    names = NEEDED + REPORTS * (command != "stop") + CORRECTS.get(command, ())
    module, _, function = args.function.partition(":")
    try:
        with needs("rig", "the rig"):
            for name in names:
                if importlib.util.find_spec(name) is None:
                    raise ModuleNotFoundError(name, name=name)
            run = getattr(importlib.import_module(module), function)
        code: int = run(args)
        return code
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        return 141  # the reader of our output went away, as `| head` does
    except (ValueError, OSError, RuntimeError, MissingExtraError) as error:
        print(f"jaxcal-rig: {error}", file=sys.stderr)
        if isinstance(error, JournalError):
            return 2 if command == "resume" else 3
        return 3 if isinstance(error, RuntimeError) else 2


if __name__ == "__main__":
    sys.exit(main())
