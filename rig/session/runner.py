"""Running a procedure so that, whatever happens, the drives end up stopped."""

from __future__ import annotations

from collections.abc import Callable

from rig.faults import (
    EXIT_BAD_INPUT,
    EXIT_FAULT,
    EXIT_OK,
    EXIT_PAUSED,
    Fault,
    PauseRequested,
    PlanOnly,
    Refused,
    StopRequested,
)
from rig.outputs.journal import JournalError
from rig.session.run import Run


def run_safely(run: Run, procedure: Callable[[Run], int]) -> int:
    """Run a procedure; whatever happens, the drives are told to stop and it is said.

    Returns:
        The exit code.
    """
    code, event, reason = EXIT_FAULT, "fault", ""
    moved = len(run.journal.events("command"))
    with run.signals:
        try:
            code = procedure(run)
            event = "end"
        except PlanOnly:
            code, event = EXIT_OK, "end"
            run.say("dry run: nothing was sent to the bus")
        except PauseRequested as pause:
            code, event, reason = EXIT_PAUSED, "paused", str(pause)
        except StopRequested as stop:
            code, event, reason = stop.exit_code, "stopped", str(stop)
        except KeyboardInterrupt:
            code, event, reason = 130, "stopped", "SIGINT"
        except Refused as error:
            reason = str(error)
            if len(run.journal.events("command")) == moved:
                code, event = EXIT_BAD_INPUT, "refused"
        except Fault as error:
            reason = str(error)
        except OSError as error:
            reason = f"cannot write to {run.folder}: {error.strerror or error}"
        except Exception as error:
            reason = f"{type(error).__name__}: {error}"
        finally:
            run.signals.ending = True
            run.stop(reason, latch=event not in ("end", "paused"))
            run.disarm()
        try:
            run.emit(event, sync=True, code=code, reason=reason)
        except JournalError as error:
            run.say(f"the journal could not be closed with a last line: {error}")
        if event != "end":
            run.say(f"{event}: {reason}")
            if event != "refused":
                run.say(f"to go on: {run.to_go_on}")
        run.close()
    return code
