"""``jaxcal-rig`` and ``python -m rig``: the command line."""

from __future__ import annotations

import contextlib
import signal
import sys
from collections.abc import Sequence

if sys.argv[1:2] == ["stop"]:  # nothing may keep it from the drives
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # a terminal that is closed meanwhile


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    if sys.platform == "win32":
        print("jaxcal-rig needs Linux or macOS", file=sys.stderr)
        return 2
    argv = sys.argv[1:] if argv is None else list(argv)
    if argv[:1] == ["stop"] and not {"-h", "--help"} & {*argv}:
        from rig import stopping

        return stopping.main(argv[1:])
    from jaxcal.arguments import values_of
    from jaxcal.files import require_kept
    from rig import faults
    from rig.commands import make_parser, resolved
    from rig.parts import require

    argv, note = resolved(argv)
    command, code = argv[0] if argv else None, faults.EXIT_BAD_INPUT
    try:
        if note:
            print(note, file=sys.stderr)
        args = make_parser(command).parse_args(argv)
        require(args.command, getattr(args, "simulate", False))
        require_kept(vars(args))
        code = args.function(**values_of(args))
        return code
    except KeyboardInterrupt:
        return faults.EXIT_INTERRUPTED
    except BrokenPipeError:
        return 141  # the reader of our output went away, as `| head` does
    except (ValueError, OSError, RuntimeError, ImportError) as error:
        with contextlib.suppress(OSError, UnicodeError):  # the exit code says it too
            print(f"jaxcal-rig: {faults.told(error)}", file=sys.stderr)
        if isinstance(error, faults.JournalError) and command == "resume":
            return faults.EXIT_BAD_INPUT
        return faults.EXIT_FAULT if isinstance(error, RuntimeError) else code


if __name__ == "__main__":
    sys.exit(main())
