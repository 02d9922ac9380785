"""Play, dead zone and breakaway of one axis.

The play comes first, away from where a dead zone may be: the difference of the readings
at one place that is reached from either side. Then the dead zone, always from below, so
that the play shifts all alike: the difference of the readings on its two sides. Both
are repeated until their intervals are narrow. Then the breakaway: steps from rest, on
in the direction in which the axis came, so that no play enters; there every step
follows from the last, by a belief of :mod:`jaxcal.adaptive`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy import special

from jaxcal.adaptive.estimates import Estimate
from jaxcal.adaptive.grid import GridTask
from jaxcal.adaptive.tasks.breakaway import Cautious, breakaway
from rig.core.attitude import mean_rotation
from rig.core.device import Device
from rig.core.faults import MotionFault
from rig.workbench.commission.probe import ENOUGH_DEG, LEVEL, Probe, propose
from rig.workbench.run import Run

MOST_DEG = 1.5  # of play
FAR_DEG = 1.5 * MOST_DEG  # of a move after which play and friction are taken up
ZONE_DEG = 0.8  # of the dead zone at most
CENTRE_DEG = 0.2  # of its centre from where the axis stands, at most
REACH_DEG = 0.5 * ZONE_DEG + CENTRE_DEG + 0.2  # either way, to be past the zone
BASE_DEG = FAR_DEG + REACH_DEG + MOST_DEG / 2.0  # where the play is measured
STEPS = 64  # of a breakaway; its threshold is looked for under so many
STEP_DEG = 0.01  # or the next whole number of pulses
OVERSHOOT_DEG = 0.1  # by which a step may exceed the threshold
RISK = 0.05  # that it exceeds it by more
LEAST, MOST = 3, 20  # pairs of readings of the play, and of the dead zone
MOST_STEPS = 40
LEAST_SIGMA_DEG = 0.002  # of a reading: finer is not believed


def characterise(run: Run, device: Device, axis: int) -> dict[str, Any]:
    """Measure an axis; what a calibration keeps of it, in degrees of its commands.

    Raises:
        Refused: the axis stands too near to a limit; nothing was moved.
        MotionFault: it does not turn the phone, or has more than is looked for.
    """
    propose(_step_task(0.01, STEP_DEG), [(0, 0)], Cautious())  # compiles it
    probe = Probe(run, device, axis, BASE_DEG + FAR_DEG, REACH_DEG + FAR_DEG)
    play, sigma = _play(probe)
    zone, centre = _zone(probe, play.mean, sigma)
    up, down = _breakaway(probe, sigma)
    probe.go(0.0)
    result = {
        "axis": probe.name,
        "level": LEVEL,
        "backlash_deg": _kept(play),
        "dead_zone_deg": _kept(zone),
        "dead_zone_at_deg": round(probe.here_deg + probe.side * centre, 5),
        "breakaway_deg": [_kept(each) for each in (up, down)[:: probe.side]],
        "measurements": probe.count,
    }
    run.emit("characterised", sync=True, **result)
    told = (("play", play), ("dead zone", zone), ("breakaway up", up),
            ("breakaway down", down))  # fmt: skip
    run.say(
        *(
            f"{probe.name}: {name} {each.mean:.4f} deg of its commands, {LEVEL:.0%} in "
            f"{each.low:.4f}..{each.high:.4f}"
            for name, each in told
        ),
        f"from {probe.count} measurements",
    )
    return result


def _kept(found: Estimate) -> dict[str, float]:
    each = {"value": found.mean, "low": found.low, "high": found.high}
    return {name: round(value, 5) for name, value in each.items()}


def _too_much(probe: Probe, what: str, deg: float, most: float) -> MotionFault:
    return MotionFault(
        f"{probe.name} has {deg:.2f} deg of {what}; at most {most:.3g} deg is looked "
        "for. Look for a loose coupling, or a joint that binds"
    )


def _repeated(measure: Callable[[int], float], sigma: float) -> Estimate:
    """The mean of what a measurement says, again until its interval is narrow.

    Each says as much as any other, so there is nothing to choose between them.

    Args:
        measure: the number of a measurement, from 1 on, to its value.
        sigma: least standard deviation of one value.
    """
    values: list[float] = []
    while len(values) < MOST:
        values.append(measure(len(values) + 1))
        count = len(values)
        if count >= LEAST:
            spread = max(sigma, float(np.std(values, ddof=1)))
            half = special.stdtrit(count - 1, 0.5 + LEVEL / 2) * spread / count**0.5
            if half <= ENOUGH_DEG / 2:
                break
    mean = max(0.0, float(np.mean(values)))
    return Estimate(mean, max(0.0, mean - half), mean + half)


def _play(probe: Probe) -> tuple[Estimate, float]:
    """The play, and the noise of a reading."""
    at, far = BASE_DEG, FAR_DEG
    up = [probe.stand("up", at - far, at), probe.stand("top", at + far)]
    down = [probe.stand("down", at), probe.stand("bottom", at - far)]
    middle = mean_rotation([up[0].attitude, down[0].attitude])
    probe.learn(middle, [(up[0], up[1]), (down[1], down[0])])
    first = probe.read(down[0]) - probe.read(up[0])
    if first > 0.9 * MOST_DEG:
        raise _too_much(probe, "play", first, MOST_DEG)
    sigma = max(probe.noise(*up, *down), LEAST_SIGMA_DEG)

    def measure(number: int) -> float:
        above = probe.stand(f"{probe.name}:down:{number}", at + far, at)
        below = probe.stand(f"{probe.name}:up:{number}", at - far, at)
        return probe.off(above) - probe.off(below)

    return _repeated(measure, 2.0**0.5 * sigma), sigma


def _zone(probe: Probe, play: float, sigma: float) -> tuple[Estimate, float]:
    """Width and centre of the dead zone; the play, taken up from below, is put back."""

    def off(label: str, command: float) -> float:
        """Reading less command."""
        way = command + play / 2.0
        return probe.off(probe.stand(f"{probe.name}:{label}", way - FAR_DEG, way))

    aboves: list[float] = []

    def measure(number: int) -> float:
        aboves.append(off(f"above:{number}", REACH_DEG))
        return off(f"below:{number}", -REACH_DEG) - aboves[-1]

    width = _repeated(measure, 2.0**0.5 * sigma)
    if width.high > 0.98 * ZONE_DEG:
        raise _too_much(probe, "dead zone", width.mean, ZONE_DEG)
    if width.low == 0.0:
        return width, 0.0
    # Across it the joint stays, so that a command there is off by its distance.
    commands = np.linspace(-CENTRE_DEG, CENTRE_DEG, 5)
    seen = [off(f"across:{i}", c) - np.mean(aboves) for i, c in enumerate(commands)]
    centres = np.linspace(-CENTRE_DEG, CENTRE_DEG, 401)
    told = np.clip(width.mean / 2 - (commands - centres[:, None]), 0.0, width.mean)
    errors = ((told - seen) ** 2).sum(axis=1)
    return width, float(np.mean(centres[errors <= errors.min() + sigma**2]))


def _breakaway(probe: Probe, sigma: float) -> tuple[Estimate, Estimate]:
    """Steps up and down that the joint does not answer, on the probe's side."""
    per_deg = abs(probe.scale.pulses_per_deg)
    least = math.ceil(STEP_DEG * per_deg) / per_deg

    def measure(label: str, design: Any) -> int:
        step, direction = design
        before = probe.stand(label, BASE_DEG - direction * FAR_DEG, BASE_DEG)
        after = probe.stand(f"{label}:on", BASE_DEG + direction * step)
        return int((probe.read(after) - probe.read(before)) * direction > step / 2.0)

    careful = Cautious(OVERSHOOT_DEG, RISK)
    noise = 2.0**0.5 * sigma
    found = probe.seek(
        lambda: _step_task(noise, least), measure, ("up", "down"), careful
    )
    for name in ("up", "down"):
        if found[name].high > (STEPS - 0.5) * least:
            raise _too_much(probe, "breakaway", found[name].mean, STEPS * least)
    return found["up"], found["down"]


def _step_task(sigma: float, least: float) -> GridTask:
    return breakaway(
        STEPS * least, STEPS, sigma=sigma, spread=least / 2.5, measurements=MOST_STEPS
    )
