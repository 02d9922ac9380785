"""``jaxcal-rig`` and ``python -m rig``: the command line."""

from __future__ import annotations

import importlib
import importlib.util
import pathlib
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
    command = args.command
    if command == "stop":
        return stop(args.config)
    from jaxcal.extras import MissingExtraError, needs
    from rig.journal import JournalError

    module, _, function = args.function.partition(":")
    try:
        with needs("rig", "the rig"):
            for name in (*NEEDED, *REPORTS, *CORRECTS.get(command, ())):
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


def stop(path: pathlib.Path | None) -> int:
    """Stop every drive; the session is asked before anything heavy is loaded."""
    from rig.stopping import stop_device

    for name in NEEDED:
        if importlib.util.find_spec(name) is None:
            text = f"jaxcal-rig: stop needs {name}: pip install 'jaxcal[rig]'"
            print(text, file=sys.stderr)
            return 2
    try:
        return stop_device(path or pathlib.Path("rig.toml"), path is not None)
    except (ValueError, OSError, RuntimeError, ImportError) as error:
        print(f"jaxcal-rig: {error}", file=sys.stderr)
        return 3


if __name__ == "__main__":
    sys.exit(main())
