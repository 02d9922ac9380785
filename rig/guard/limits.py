"""Soft limits in degrees and pulses, for a whole plan and for every single move."""

from __future__ import annotations

from collections.abc import Iterable

from rig.config.axis import Pulses
from rig.config.config import RigConfig
from rig.guard.faults import LimitError


def outside(config: RigConfig, target: Pulses) -> list[str]:
    """What of (3,) pulses leaves its limits, in words; empty where nothing does."""
    faults = []
    for axis, pulses in zip(config.axes, target, strict=True):
        angle = axis.to_deg(pulses)
        rounding = 0.51 / abs(axis.pulses_per_deg)
        if not (
            axis.min_pulses <= pulses <= axis.max_pulses
            and axis.min_deg - rounding <= angle <= axis.max_deg + rounding
        ):
            faults.append(
                f"{axis.name} to {pulses} pulses ({angle:.3f} deg), limits "
                f"{axis.min_pulses}..{axis.max_pulses} pulses and "
                f"{axis.min_deg:g}..{axis.max_deg:g} deg"
            )
    return faults


def approach_point(config: RigConfig, target: Pulses) -> Pulses:
    """Where a target is approached from: below it on every axis, or itself."""
    overshoot = config.motion.approach_overshoot_deg
    if not overshoot:
        return target
    return config.to_pulses(config.to_deg(target) - overshoot)


def check_plan(config: RigConfig, targets: Iterable[Pulses]) -> None:
    """Every target, and the point it is approached from, lies inside the limits.

    Raises:
        LimitError: lists each that does not.
    """
    faults: list[str] = []
    for target in targets:
        via = approach_point(config, target)
        for point in (target,) if via == target else (via, target):
            faults += outside(config, point)
    if faults:
        raise LimitError("the plan leaves the limits: " + "; ".join(faults))
