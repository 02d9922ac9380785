"""Soft limits in degrees and pulses, for a whole plan and for every single move."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from rig.config.axis import Pulses
from rig.config.config import RigConfig
from rig.faults import LimitError


def outside(config: RigConfig, target: Pulses) -> Iterator[str]:
    """What of (3,) pulses leaves its limits, in words."""
    for axis, pulses in zip(config.axes, target, strict=True):
        angle = axis.to_deg(pulses)
        rounding = 0.51 / abs(axis.pulses_per_deg)
        if not (
            axis.min_pulses <= pulses <= axis.max_pulses
            and axis.min_deg - rounding <= angle <= axis.max_deg + rounding
        ):
            yield (
                f"{axis.name} to {pulses} pulses ({angle:.3f} deg), limits "
                f"{axis.min_pulses}..{axis.max_pulses} pulses and "
                f"{axis.min_deg:g}..{axis.max_deg:g} deg"
            )


def approach(config: RigConfig, target: Pulses) -> list[Pulses]:
    """The way to a target: from below it on every axis, or itself alone."""
    overshoot = config.motion.approach_overshoot_deg
    if not overshoot:
        return [target]
    return [config.to_pulses(config.to_deg(target) - overshoot), target]


def check_plan(config: RigConfig, targets: Iterable[Pulses]) -> None:
    """LimitError lists each target, or point it is approached from, that is outside."""
    points = (point for target in targets for point in approach(config, target))
    faults = [fault for point in points for fault in outside(config, point)]
    if faults:
        raise LimitError("the plan leaves the limits: " + "; ".join(faults))
