"""Moving one axis by hand: a step, or as long as a key is held."""

from __future__ import annotations

import os
import select
import sys
import termios
import time
import tty
from collections.abc import Callable
from typing import Any

from rig.config import AXIS_NAMES
from rig.core.attitude import angle_between_deg
from rig.core.device import Device, Posture
from rig.core.motion import move
from rig.core.proof import ALLOWED_DEG
from rig.workbench.run import Run


class Keyboard:
    """A terminal that gives each key at once; Ctrl-C still is a signal."""

    def __enter__(self) -> Keyboard:
        self._fd = sys.stdin.fileno()
        self._before: list[Any] = termios.tcgetattr(self._fd)
        tty.setcbreak(self._fd)
        return self

    def __exit__(self, *_: object) -> None:
        termios.tcsetattr(self._fd, termios.TCSADRAIN, self._before)

    def keys(self, wait_s: float = 0.0) -> list[str]:
        """Keys pressed since the last call; arrows are ``+`` and ``-``."""
        if not select.select([self._fd], [], [], wait_s)[0]:
            return []
        text = os.read(self._fd, 1024).decode(errors="replace")
        for arrow, key in ARROWS.items():
            text = text.replace(arrow, key)
        return list(text)


ARROWS = {"\x1b[A": "+", "\x1b[C": "+", "\x1b[B": "-", "\x1b[D": "-"}
HOLD_DEG = 30.0  # a held key goes at most so far at a time
FIRST_S = 0.7  # a keyboard repeats a held key after up to so long,
REPEAT_S = 0.2  # and then at least so often: released when it is silent for longer
HELP = (
    "hold + or an arrow key to move, - for the other way; any other key stops; p, y, r "
    "choose the axis; q ends"
)


class Released(Exception):
    """The key is not held any more."""


class Enough(Exception):
    """The phone has turned as far as the whole way was to turn it."""


class Held:
    """Whether a key is still held, by how long it is since it last repeated."""

    def __init__(
        self, keyboard: Keyboard, key: str, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._keyboard, self._key, self._clock = keyboard, key, clock
        self._until = clock() + FIRST_S

    def check(self) -> None:
        """Released where the key was let go or another one was pressed."""
        keys = self._keyboard.keys()
        if any(key != self._key for key in keys):
            raise Released
        if keys:
            self._until = self._clock() + REPEAT_S
        if self._clock() > self._until:
            raise Released


def step(run: Run, device: Device, axis: int, way_deg: float) -> None:
    """Move one axis by so many degrees, cut at its limits.

    Where its gearing is not proved it stops once the phone has turned so far.

    Raises:
        Released: as its key was let go.
    """
    each, here = run.config.axes[axis], list(device.positions())
    start, checked = here[axis], device.proof.reaches[axis].checked
    goal = min(max(each.to_deg(start) + way_deg, each.min_deg), each.max_deg)
    here[axis] = min(max(each.to_pulses(goal), each.min_pulses), each.max_pulses)
    base, held = device.attitude(), device.meanwhile
    device.proof.stay_near(base, max(ALLOWED_DEG, 2.0 * abs(way_deg)))

    def look() -> None:
        held()
        turned = angle_between_deg(base, device.imu.latest().matrix)
        if turned > abs(way_deg) and not checked:
            raise Enough(f"{turned:.1f}")

    device.meanwhile = look
    try:
        move(device, Posture("jog", tuple(here)))
    except Enough as turned:
        device.stopper.stop("the phone has turned far enough", latch=False)
        gone = abs(each.to_deg(device.positions()[axis] - start))
        run.say(
            f"  stopped: the phone has turned by {turned} deg after {gone:.2g} "
            f"commanded. Check the reduction of {each.name}"
        )
    except Released:
        device.stopper.stop("key released", latch=False)
    finally:
        device.meanwhile = held
    run.say(f"  {each.name} stands at {each.to_deg(device.positions()[axis]):.3f} deg")


def by_keyboard(run: Run, device: Device, axis: int) -> None:
    """Move while a key is held, until ``q``; the drives stop when it is let go."""
    run.say(HELP)
    with Keyboard() as keyboard:
        while True:
            device.guard()
            device.statuses()  # alarms, and the line is kept alive
            run.signals.check_pause()
            for key in keyboard.keys(0.1)[-1:]:
                if key == "q":
                    return
                if key in ("p", "y", "r"):
                    axis = [name[0] for name in AXIS_NAMES].index(key)
                    run.say(f"  {AXIS_NAMES[axis]}")
                if key in ("+", "=", "-"):
                    device.meanwhile = Held(keyboard, key).check
                    step(run, device, axis, -HOLD_DEG if key == "-" else HOLD_DEG)
                    device.meanwhile = lambda: None
