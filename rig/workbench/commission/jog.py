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
from rig.config.axis import Pulses
from rig.core.attitude import Array, angle_between_deg
from rig.core.record import SIGN_CHECKED
from rig.workbench.commission.bench import ALLOWED_DEG, Bench
from rig.workbench.commission.unproved import Reach


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
MOST_STEP_DEG = 3.0
HOLD_DEG = 30.0  # a held key goes at most so far at a time
LAG_S, NOISE_DEG = 0.2, 0.1  # of the phone, after a piece of the way
FIRST_S = 0.7  # a keyboard repeats a held key after up to so long,
REPEAT_S = 0.2  # and then at least so often: released when it is silent for longer
HELP = (
    "hold + or an arrow key to move, - for the other way; any other key stops; p, y, r "
    "choose the axis; q ends"
)


class Released(Exception):
    """The key is not held any more."""


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


def step(run: Bench, axis: int, way_deg: float, reach: Reach | None = None) -> Pulses:
    """Move one axis by so many degrees, cut at its limits; where it then stands.

    Args:
        run, axis, way_deg: what moves, and how far.
        reach: of an axis whose gearing is not proved: the way is gone in pieces that
            grow, until the phone has turned so far.
    """
    device = run.arm()
    each, here = run.config.axes[axis], list(device.positions())
    start = here[axis]
    goal = min(max(each.to_deg(start) + way_deg, each.min_deg), each.max_deg)
    low, high = each.min_pulses, each.max_pulses
    way = min(max(each.to_pulses(goal), low), high) - start
    base = _attitude(run)
    run.small.stay_near(base, max(ALLOWED_DEG, 2.0 * abs(way_deg)))
    gone = 0
    while gone < abs(way):
        piece = abs(way) - gone
        if reach is not None:
            piece = min(piece, reach.pulses(way, MOST_STEP_DEG))
            run.small.pace(axis, reach.paced(piece))
        gone += piece
        here[axis] = start + (gone if way > 0 else -gone)
        pitch, yaw, roll = here
        before = _attitude(run)
        run.small.move_to((pitch, yaw, roll), "jog")
        if reach is None:
            continue
        time.sleep(LAG_S)
        now = _attitude(run)
        reach.saw(piece, angle_between_deg(before, now), NOISE_DEG)
        turned = angle_between_deg(base, now)
        if gone < abs(way) and turned > abs(way_deg):
            run.say(
                f"  stopped: the phone has turned by {turned:.1f} deg after "
                f"{abs(each.to_deg(gone)):.2g} commanded. Check the reduction of "
                f"{each.name}"
            )
            break
    stands = device.positions()
    run.say(f"  {each.name} stands at {each.to_deg(stands[axis]):.3f} deg")
    return stands


def _attitude(run: Bench) -> Array:
    return run.observer.device.imu.latest().matrix


def unproved(run: Bench, axis: int) -> Reach | None:
    """How far an axis may go at first; None where its gearing is proved."""
    known = run.full_speed or run.record.missing(run.plain, SIGN_CHECKED) is None
    return None if known else Reach(run.plain.axes[axis])


def by_keyboard(run: Bench, axis: int) -> None:
    """Move while a key is held, until ``q``; the drives stop when it is let go."""
    device = run.arm()
    run.say(HELP)
    reaches = [unproved(run, index) for index in range(3)]
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
                    _while_held(run, axis, key, keyboard, reaches[axis])


def _while_held(
    run: Bench, axis: int, key: str, keyboard: Keyboard, reach: Reach | None
) -> None:
    device = run.arm()
    way = -HOLD_DEG if key == "-" else HOLD_DEG
    run.small.meanwhile = Held(keyboard, key).check
    try:
        step(run, axis, way, reach)
    except Released:
        device.stopper.stop("key released", latch=False)
        count = device.positions()[axis]
        name, angle = AXIS_NAMES[axis], run.config.axes[axis].to_deg(count)
        run.say(f"  {name} stands at {angle:.3f} deg")
    finally:
        run.small.meanwhile = None
