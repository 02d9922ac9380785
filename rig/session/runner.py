"""Running a procedure so that, whatever happens, the drives end up stopped."""

from __future__ import annotations

from collections.abc import Callable

from rig.device.bus import BusError
from rig.device.imu import ImuError
from rig.guard.faults import (
    EXIT_BAD_INPUT,
    EXIT_FAULT,
    EXIT_PAUSED,
    LimitError,
    MotionFault,
    PauseRequested,
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
    with run.signals:
        try:
            code = procedure(run)
            event, reason = "end", ""
        except PauseRequested as pause:
            code, event, reason = EXIT_PAUSED, "paused", str(pause)
        except StopRequested as stop:
            code, event, reason = stop.exit_code, "stopped", str(stop)
        except KeyboardInterrupt:
            code, event, reason = 130, "stopped", "SIGINT"
        except (Refused, LimitError) as error:
            moved = bool(run.journal.events("command"))
            code = EXIT_FAULT if moved else EXIT_BAD_INPUT
            event, reason = "fault" if moved else "refused", str(error)
        except (MotionFault, BusError, ImuError, JournalError) as error:
            reason = str(error)
        except OSError as error:
            reason = f"cannot write to {run.folder}: {error.strerror or error}"
        except Exception as error:
            reason = f"{type(error).__name__}: {error}"
        finally:
            run.signals.armed = run.motion is not None
            if event != "end":
                run.stop(reason, latch=event != "paused")
            elif run.motion is not None:
                run.stop("", latch=False)
            run.disarm()
    try:
        run.journal.write(event, sync=True, code=code, reason=reason)
    except JournalError as error:
        run.say(f"the journal could not be closed with a last line: {error}")
    if event != "end":
        run.say(f"{event}: {reason}")
        if event != "refused":
            run.say(f"to go on: python -m rig resume {run.folder}")
    run.close()
    return code
