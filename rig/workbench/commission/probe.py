"""One axis moved, measured and read along its own turn, for `characterise`.

Ways are degrees of the axis's commands from where it stood, on the side that has room.
Nothing is computed in a moving step: while the next measurement is sought the device
stands under the guards of a session.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import numpy as np

from jaxcal.adaptive.estimates import Estimate, estimates
from jaxcal.adaptive.grid import GridTask
from jaxcal.adaptive.loop import Proposal, next_measurement
from jaxcal.adaptive.session import Decider
from rig.config import AXIS_NAMES
from rig.core.attitude import Array
from rig.core.device import Device, Posture
from rig.core.faults import MotionFault, Refused
from rig.core.measure import measure
from rig.core.motion import Standing, move
from rig.core.proof import ALLOWED_DEG
from rig.workbench.commission.axes import ROOM_DEG, SEEN_DEG
from rig.workbench.commission.findings import Stand, turn
from rig.workbench.run import Run

LEVEL = 0.95
ENOUGH_DEG = 0.02  # width of an interval
T = TypeVar("T")


class Probe:
    """The axis, where it began, and what its readings mean once that is known."""

    def __init__(
        self, run: Run, device: Device, axis: int, up_deg: float, down_deg: float
    ) -> None:
        self.run, self.axis, self.name = run, axis, AXIS_NAMES[axis]
        self.scale = run.config.axes[axis]
        self.device = device
        self.start = self.device.positions()
        self.here_deg = self.scale.to_deg(self.start[axis])
        above = self.scale.max_deg - self.here_deg - ROOM_DEG
        below = self.here_deg - self.scale.min_deg - ROOM_DEG
        self.side = 1 if min(above / up_deg, below / down_deg) >= 1.0 else -1
        if self.side < 0 and (below < up_deg or above < down_deg):
            raise Refused(
                f"{self.name} stands at {self.here_deg:.2f} deg, between its limits "
                f"{self.scale.min_deg:g} and {self.scale.max_deg:g}; {up_deg:g} deg of "
                f"room one way and {down_deg:g} the other are needed. Move it inwards: "
                f"jaxcal-rig jog {self.name}"
            )
        self.count = 0  # measurements
        self._base: Array | None = None  # (3, 3) attitude that readings are from
        self._line, self._rate = np.zeros(3), 1.0
        allowed = max(ALLOWED_DEG, 2.0 * up_deg)
        device.proof.stay_near(device.attitude(), allowed)

    def stand(self, label: str, *ways_deg: float, samples: int = 1) -> Stand:
        """Go the ways one after the other, and measure at the last."""
        for way in ways_deg:
            standing = self.go(way, label)
        measured = measure(standing, samples * self.run.config.settle.samples)
        self.run.emit("stand", sync=True, name=label, **measured)
        self.count += 1
        return Stand.of(measured)

    def go(self, way_deg: float, label: str = "back") -> Standing:
        """Move the axis."""
        target = list(self.start)
        target[self.axis] += self.scale.to_pulses(self.side * way_deg)
        pitch, yaw, roll = target
        self.run.signals.check_pause()
        return move(self.device, Posture(label, (pitch, yaw, roll)))

    def way(self, found: Stand) -> float:
        """Degrees commanded from where the axis stood."""
        pulses = round(found.pulses[self.axis] - self.start[self.axis])
        return self.side * self.scale.to_deg(pulses)

    def learn(self, base: Array, moves: list[tuple[Stand, Stand]]) -> None:
        """How far and about what the axis turns the phone, from moves of one length.

        Within none of them does the direction change, so that no play enters.
        """
        ways = [turn(base, b.attitude) - turn(base, a.attitude) for a, b in moves]
        deg = abs(float(np.mean([self.way(b) - self.way(a) for a, b in moves])))
        each = np.mean(ways, axis=0) / deg
        rate = float(np.linalg.norm(each))
        if rate * deg < SEEN_DEG:
            raise MotionFault(
                f"{self.name} was moved by {deg:g} deg and the phone turned "
                f"{rate * deg:.3f}. Check the axes first: jaxcal-rig axes"
            )
        self._base, self._line, self._rate = base, each / rate, rate

    def read(self, found: Stand) -> float:
        """Commanded degrees along the axis, by the phone."""
        assert self._base is not None
        return float(turn(self._base, found.attitude) @ self._line / self._rate)

    def off(self, found: Stand) -> float:
        """Reading less command, degrees of the commands."""
        return self.read(found) - self.way(found)

    def noise(self, *stands: Stand) -> float:
        """Standard deviation of a reading in commanded degrees."""
        return max(s.std_deg / s.samples**0.5 for s in stands) / self._rate

    def seek(
        self,
        make: Callable[[], GridTask],
        measure: Callable[[str, Any], int],
        what: tuple[str, ...],
        decider: Decider,
    ) -> dict[str, Estimate]:
        """Measure what is expected to say most, until the intervals are narrow.

        Args:
            make: the task; it is made while the device stands under guard.
            measure: a label and a design's coordinates to the outcome.
            what: unknowns whose intervals are to be narrow.
            decider: what chooses the next.
        """
        task = self.meanwhile(make)
        history: list[tuple[int, int]] = []
        while True:
            proposal = self.meanwhile(lambda: propose(task, history, decider))
            found = estimates(task, proposal.belief, LEVEL)
            widest = max(found[name].width for name in what)
            if proposal.design is None or widest <= ENOUGH_DEG:
                return found
            label = f"{self.name}:{what[0]}:{len(history) + 1}"
            outcome = measure(label, [float(c) for c in proposal.coordinates])
            history.append((proposal.design, outcome))

    def meanwhile(self, function: Callable[[], T]) -> T:
        """What a function computes, while the standing device stays under guard."""
        with ThreadPoolExecutor(1) as pool:
            result = pool.submit(function)
            while not result.done():
                self.device.guard()
                self.device.statuses()
                time.sleep(self.run.config.motion.poll_s)
            return result.result()


def propose(
    task: GridTask, history: list[tuple[int, int]], decider: Decider
) -> Proposal:
    """What is expected to say most."""
    return next_measurement(task, history, decider)
