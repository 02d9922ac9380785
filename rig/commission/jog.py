"""Moving one axis by hand: a step, or as long as a key is held."""

from __future__ import annotations

import time
from collections.abc import Callable

from rig.commission.bench import Bench
from rig.commission.keyboard import Keyboard
from rig.config import AXIS_NAMES
from rig.config.axis import Pulses

MOST_STEP_DEG = 3.0
HOLD_DEG = 30.0  # a held key goes at most so far at a time
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


def step(run: Bench, axis: int, way_deg: float) -> Pulses:
    """Move one axis by so many degrees, cut at its limits; where it then stands."""
    device = run.arm()
    each = run.config.axes[axis]
    here = list(device.positions())
    goal = min(max(each.to_deg(here[axis]) + way_deg, each.min_deg), each.max_deg)
    low, high = each.min_pulses, each.max_pulses
    here[axis] = min(max(each.to_pulses(goal), low), high)
    pitch, yaw, roll = here
    run.small.stay_near(run.observer.device.imu.latest().matrix, abs(way_deg))
    run.small.move_to((pitch, yaw, roll), "jog")
    stands = device.positions()
    run.say(f"  {each.name} stands at {each.to_deg(stands[axis]):.3f} deg")
    return stands


def by_keyboard(run: Bench, axis: int) -> None:
    """Move while a key is held, until ``q``; the drives stop when it is let go."""
    device = run.arm()
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
                    _while_held(run, axis, key, keyboard)


def _while_held(run: Bench, axis: int, key: str, keyboard: Keyboard) -> None:
    device = run.arm()
    way = -HOLD_DEG if key == "-" else HOLD_DEG
    run.small.meanwhile = Held(keyboard, key).check
    try:
        step(run, axis, way)
    except Released:
        device.stopper.stop("key released", latch=False)
        count = device.positions()[axis]
        name, angle = AXIS_NAMES[axis], run.config.axes[axis].to_deg(count)
        run.say(f"  {name} stands at {angle:.3f} deg")
    finally:
        run.small.meanwhile = None
