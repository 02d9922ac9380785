"""``python -m rig`` and ``jaxcal-rig``: the command line."""

from __future__ import annotations

import importlib.util
import pathlib
import sys
from collections.abc import Sequence

from rig.arguments import make_parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    args = make_parser().parse_args(argv)
    if args.command == "stop":
        return _stop(args.config)
    from jaxcal.extras import MissingExtraError, needs
    from rig.journal import JournalError

    try:
        with needs("rig", "the rig"):
            _check_packages("pydantic", "pymodbus")
            _check_packages("jinja2")  # of the report, which is written last
            if args.command in ("setup", "imu", "axes"):
                _check_packages("tomlkit")  # of the corrections to rig.toml
            from rig import commands
        return commands.run(args)
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        return 141  # the reader of our output went away, as `| head` does
    except (ValueError, OSError, RuntimeError, MissingExtraError) as error:
        print(f"rig: {error}", file=sys.stderr)
        if isinstance(error, JournalError):
            return 2 if args.command == "resume" else 3
        return 3 if isinstance(error, RuntimeError) else 2


def _stop(path: pathlib.Path | None) -> int:
    """Stop every drive; the session is asked before anything heavy is loaded."""
    from rig.stopping import stop_device

    for name in ("pydantic", "pymodbus"):
        if importlib.util.find_spec(name) is None:
            text = f"rig: stop needs {name}: pip install 'jaxcal[rig]'"
            print(text, file=sys.stderr)
            return 2
    try:
        return stop_device(path or pathlib.Path("rig.toml"), path is not None)
    except (ValueError, OSError, RuntimeError, ImportError) as error:
        print(f"rig: {error}", file=sys.stderr)
        return 3


def _check_packages(*names: str) -> None:
    """Before any port opens; finding is quicker than importing."""
    for name in names:
        if importlib.util.find_spec(name) is None:
            raise ModuleNotFoundError(name, name=name)


if __name__ == "__main__":
    sys.exit(main())
