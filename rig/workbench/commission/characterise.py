"""Play, dead zone and breakaway of one axis, in a closed loop.

Every measurement follows from the last, by a belief of :mod:`jaxcal.adaptive`. The play
comes first, away from where a dead zone may be; it is the difference of the readings at
one place that is reached from either side. Then the dead zone, always from below, so
that the play shifts all alike. Then the breakaway: steps from rest, on in the direction
in which the axis came, so that no play enters.
"""

from __future__ import annotations

import math
from typing import Any

from jaxcal.adaptive.estimates import Estimate
from jaxcal.adaptive.grid import GridTask
from jaxcal.adaptive.tasks.backlash import (
    backlash,
    backlash_bins,
    dead_zone,
    dead_zone_bins,
)
from jaxcal.adaptive.tasks.breakaway import Cautious, breakaway
from rig.core.attitude import mean_rotation
from rig.core.faults import MotionFault
from rig.workbench.commission.bench import Bench
from rig.workbench.commission.probe import LEVEL, Probe, propose

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
MOST = 20  # measurements of the play, and of the dead zone
MOST_STEPS = 40
LEAST_SIGMA_DEG = 0.002  # finer than this the cells of the widths are not
BIN_DEG, OFFSET_DEG = 0.01, 0.05


def characterise(run: Bench, axis: int) -> dict[str, Any]:
    """Measure an axis; what a calibration keeps of it, in degrees of its commands.

    Raises:
        Refused: the axis stands too near to a limit; nothing was moved.
        MotionFault: it does not turn the phone, or has more than is looked for.
    """
    for task in (_play_task(0.01), _zone_task(0.01), _step_task(0.01, STEP_DEG)):
        propose(task, [(0, 0)], Cautious() if task.design_names[0] == "step" else None)
    probe = Probe(run, axis, BASE_DEG + FAR_DEG, REACH_DEG + FAR_DEG)
    play, sigma = _play(probe)
    zone, centre = _zone(probe, play.mean, sigma)
    up, down = _breakaway(probe, sigma)
    probe.go(0.0)
    result = {
        "axis": probe.name,
        "level": LEVEL,
        "backlash_deg": _kept(play),
        "dead_zone_deg": _kept(zone),
        "dead_zone_at_deg": round(probe.here_deg + probe.side * centre.mean, 5),
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


def _play(probe: Probe) -> tuple[Estimate, float]:
    """The play, and the noise of a reading."""
    at, far = BASE_DEG, FAR_DEG
    up = [
        probe.stand("up", at - far, at, samples=4),
        probe.stand("top", at + far),
    ]
    down = [
        probe.stand("down", at, samples=4),
        probe.stand("bottom", at - far),
    ]
    middle = mean_rotation([up[0].attitude, down[0].attitude])
    probe.learn(middle, [(up[0], up[1]), (down[1], down[0])])
    first = probe.read(down[0]) - probe.read(up[0])
    if first > 0.9 * MOST_DEG:
        raise _too_much(probe, "play", first, MOST_DEG)
    sigma = max(probe.noise(up[1], down[1]), LEAST_SIGMA_DEG)
    bins = backlash_bins(MOST_DEG, OFFSET_DEG, BIN_DEG)

    def measure(label: str, design: Any) -> int:
        posture, direction = design
        ways = at + direction * far, at, at + direction * posture
        found = probe.stand(label, *ways)
        return bins.outcome(probe.read(found) - probe.way(found) + probe.way(up[0]))

    found = probe.seek(lambda: _play_task(sigma), measure, ("width",))
    return found["width"], sigma


def _zone(probe: Probe, play: float, sigma: float) -> tuple[Estimate, Estimate]:
    """Width and centre of the dead zone; the play, taken up from below, is put back."""

    def off(label: str, command: float, samples: int = 1) -> float:
        """Reading less command."""
        way = command + play / 2.0
        found = probe.stand(label, way - FAR_DEG, way, samples=samples)
        return probe.read(found) - probe.way(found)

    above = off("above", REACH_DEG, 4)
    bins = dead_zone_bins(ZONE_DEG, REACH_DEG, BIN_DEG, relative=True)

    def measure(label: str, design: Any) -> int:
        return bins.outcome(off(label, design[0]) - above)

    found = probe.seek(lambda: _zone_task(1.12 * sigma), measure, ("width",))
    if found["width"].high > 0.98 * ZONE_DEG:
        raise _too_much(probe, "dead zone", found["width"].mean, ZONE_DEG)
    return found["width"], found["centre"]


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


def _play_task(sigma: float) -> GridTask:
    # Between the two a joint that yields late stands elsewhere than its play says.
    return backlash(
        MOST_DEG, OFFSET_DEG, cells=300, offset_cells=9, postures=[0.0, FAR_DEG],
        sigma=sigma, bin_width=BIN_DEG, measurements=MOST,
    )  # fmt: skip


def _zone_task(sigma: float) -> GridTask:
    return dead_zone(
        ZONE_DEG, CENTRE_DEG, cells=160, offset_cells=16, reach=REACH_DEG,
        reference=REACH_DEG, num_postures=17, sigma=sigma, bin_width=BIN_DEG,
        measurements=MOST,
    )  # fmt: skip


def _step_task(sigma: float, least: float) -> GridTask:
    return breakaway(
        STEPS * least, STEPS, sigma=sigma, spread=least / 2.5, measurements=MOST_STEPS
    )
