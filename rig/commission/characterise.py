"""The play of one axis, by measurements each of which follows from the last.

The axis comes to the start from one side, turns back and goes on to a posture; how far
the phone then stands from it says how wide the play is. Posture and direction are those
that are expected to say most, :mod:`jaxcal.adaptive`. Nothing is computed in a moving
step: JAX compiles before the drives are armed, and while the next posture is sought the
device stands under the guards of a session.
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
from jaxcal.adaptive.rules import Gain
from jaxcal.adaptive.tasks.backlash import backlash, backlash_bins
from rig.attitude import Array, mean_rotation
from rig.commission.axes import ROOM_DEG, SEEN_DEG
from rig.commission.bench import Bench
from rig.commission.stands import Stand, turn
from rig.config import AXIS_NAMES
from rig.faults import MotionFault, Refused

MOST_DEG = 1.5  # of play
FAR_DEG = 1.5 * MOST_DEG  # from where the axis comes, so that the play is taken up
ENOUGH_DEG = 0.02  # width of the interval
LEVEL = 0.95
MOST = 20  # measurements
LEAST_SIGMA_DEG = 0.002  # finer than this the cells of the width are not

T = TypeVar("T")


def characterise(run: Bench, axis: int) -> Estimate:
    """Measure the play of an axis, in degrees of its commands.

    Raises:
        Refused: the axis stands too near to a limit; nothing was moved.
        MotionFault: it does not turn the phone, or has more play than is looked for.
    """
    name, each = AXIS_NAMES[axis], run.config.axes[axis]
    propose(_task(0.01), [(0, 0)])  # compiles
    device = run.arm()
    start = device.positions()
    here = each.to_deg(start[axis])
    room = min(here - each.min_deg, each.max_deg - here) - ROOM_DEG
    if room < FAR_DEG:
        raise Refused(
            f"{name} stands {room + ROOM_DEG:.2f} deg from a limit; its play is sought "
            f"{FAR_DEG:g} deg either way. Move it inwards: jaxcal-rig jog {name}"
        )

    def go(way_deg: float) -> Any:
        target = list(start)
        target[axis] += each.to_pulses(way_deg)
        pitch, yaw, roll = target
        run.signals.check_pause()
        run.small.move_to((pitch, yaw, roll), name)
        return pitch, yaw, roll

    def stand(label: str, *ways_deg: float) -> Stand:
        for way in ways_deg:
            target = go(way)
        measured = run.observer.measure(target, label)
        run.emit("stand", sync=True, name=label, **measured)
        return Stand.of(measured)

    run.small.stay_near(device.imu.latest().matrix, FAR_DEG)
    up = [stand("up", -FAR_DEG, 0.0), stand("top", FAR_DEG)]
    down = [stand("down", 0.0), stand("bottom", -FAR_DEG)]
    middle = mean_rotation([up[0].attitude, down[0].attitude])
    line, rate = _line(name, middle, up, down)

    def read(found: Stand) -> float:
        """Commanded degrees, by the phone, from the middle of the play."""
        return float(turn(middle, found.attitude) @ line / rate)

    first = read(down[0]) - read(up[0])
    if first > 0.9 * MOST_DEG:
        raise MotionFault(
            f"{name} has {first:.2f} deg of play; at most {MOST_DEG:g} deg is looked "
            "for. Look for a loose coupling"
        )
    std = max(found.std_deg / found.samples**0.5 for found in (*up, *down))
    task = meanwhile(run, lambda: _task(std / rate))
    history: list[tuple[int, int]] = []
    while True:
        proposal = meanwhile(run, lambda: propose(task, history))
        width = estimates(task, proposal.belief, LEVEL)["width"]
        if proposal.design is None or width.width <= ENOUGH_DEG:
            break
        posture, direction = map(float, proposal.coordinates)
        label = f"{name}:{len(history) + 1}"
        found = stand(label, direction * FAR_DEG, 0.0, direction * posture)
        off = read(found) - each.to_deg(found.pulses[axis] - start[axis])
        history.append((proposal.design, _bins(std / rate).outcome(off)))
    go(0.0)
    result = {
        "axis": name, "backlash_deg": round(width.mean, 5), "level": LEVEL,
        "low_deg": round(width.low, 5), "high_deg": round(width.high, 5),
        "measurements": 4 + len(history),
    }  # fmt: skip
    run.emit("backlash", sync=True, **result)
    run.say(
        f"{name}: play {width.mean:.4f} deg of its commands, {LEVEL:.0%} in "
        f"{width.low:.4f}..{width.high:.4f}, from {4 + len(history)} measurements"
    )
    return width


def propose(task: GridTask, history: list[tuple[int, int]]) -> Proposal:
    """The posture and direction that are expected to say most."""
    return next_measurement(task, history, Gain())


def meanwhile(run: Bench, function: Callable[[], T]) -> T:
    """What a function computes, while the standing device stays under guard."""
    device = run.arm()
    with ThreadPoolExecutor(1) as pool:
        result = pool.submit(function)
        while not result.done():
            run.device_guard()
            device.statuses()
            time.sleep(run.config.motion.poll_s)
        return result.result()


def _task(sigma: float) -> GridTask:
    sigma, offset, bin_width = _scales(sigma)
    return backlash(
        MOST_DEG, offset, cells=300, offset_cells=9,
        postures=np.linspace(0.0, FAR_DEG, 7), sigma=sigma, bin_width=bin_width,
        measurements=MOST,
    )  # fmt: skip


def _bins(sigma: float) -> Any:
    _, offset, bin_width = _scales(sigma)
    return backlash_bins(MOST_DEG, offset, bin_width)


def _scales(sigma: float) -> tuple[float, float, float]:
    """Noise, largest offset of the middle, and bins, in commanded degrees."""
    sigma = max(sigma, LEAST_SIGMA_DEG)
    return sigma, 0.05, 0.01


def _line(
    name: str, middle: Array, up: list[Stand], down: list[Stand]
) -> tuple[Array, float]:
    """(3,) direction in which the axis turns the phone, and how far for a degree.

    From two moves within which no direction changes, so that no play enters.
    """
    ways = [
        turn(middle, up[1].attitude) - turn(middle, up[0].attitude),
        turn(middle, down[0].attitude) - turn(middle, down[1].attitude),
    ]
    each = np.mean(ways, axis=0) / FAR_DEG
    rate = float(np.linalg.norm(each))
    if rate * FAR_DEG < SEEN_DEG:
        raise MotionFault(
            f"{name} was moved by {FAR_DEG:g} deg and the phone turned "
            f"{rate * FAR_DEG:.3f}. Check the axes first: jaxcal-rig axes"
        )
    return each / rate, rate
