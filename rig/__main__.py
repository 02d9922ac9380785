"""``jaxcal-rig`` and ``python -m rig``: the command line."""

from __future__ import annotations

import contextlib
import signal
import sys
from collections.abc import Sequence

DASHES = "-\u2010\u2011\u2012\u2013\u2014\u2015\u2212"


def stop_words(argv: Sequence[str]) -> list[str] | None:
    """The words around ``stop``, which may be behind options; None: no stop."""
    argv = [f"-{w.lstrip(DASHES)}" if w.startswith((*DASHES,)) else w for w in argv]
    words = [word.strip("-!. ").lower() for word in argv]
    behind = len(words) if argv and argv[0][:1] == "-" else 1
    if "stop" not in words[:behind] or {"-h", "-help"} & {*argv}:
        return None
    place = words.index("stop")
    return [*argv[:place], *argv[place + 1 :]]


if stop_words(sys.argv[1:]) is not None:  # nothing may keep it from the drives
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # a terminal that is closed meanwhile


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    if sys.platform == "win32":
        print("jaxcal-rig needs Linux or macOS", file=sys.stderr)
        return 2
    argv = sys.argv[1:] if argv is None else list(argv)
    if (words := stop_words(argv)) is not None:
        from rig import stopping

        return stopping.main(words)
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
