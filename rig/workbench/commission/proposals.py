"""What of rig.toml the findings contradict, and how it should read."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Sequence
from typing import Any

import numpy as np

from rig.config import AXIS_NAMES, RigConfig
from rig.config.axis import Axis, Scale
from rig.core.attitude import matrix_to_euler
from rig.core.faults import MotionFault
from rig.core.proof import RADIANS
from rig.workbench.commission.findings import MOUNTING_DEG, Findings

# Measured against commanded: what A may take up, and what only a wrong gearing does.
SOUND_RATIO = (0.4, 1.5)
# The same where the phone sends radians for degrees, and those are allowed for.
NEAR_UNIT = (0.3, 2.0)
UNPROVED_FACTOR = 2.0  # by which a gearing is corrected on the phone's word alone
DIGITS = 4  # of a reduction that was measured
SKEW_DEG = 20.0  # axes of a sound device read at right angles but for cross-coupling
OF_DRIVE = ("unit", "map", "pulses_per_rev", "comm_timeout_s")  # go with the cable


@dataclasses.dataclass(frozen=True)
class Change:
    """One key of rig.toml; ``key`` is such as ``axes.roll.direction``."""

    key: str
    old: Any
    new: Any
    reason: str

    def __str__(self) -> str:
        if self.new is None:
            return f"{self.key} is taken out (is {self.old!r}): {self.reason}"
        return f"{self.key} = {self.new!r} (is {self.old!r}): {self.reason}"


def ratios_of(config: RigConfig, found: Findings) -> list[float]:
    """What each drive turned the phone, as a share of what it was commanded."""
    pairs = zip(found.deg_per_pulse, config.axes, strict=True)
    return [float(abs(each * axis.pulses_per_deg)) for each, axis in pairs]


def require_unit(
    config: RigConfig, ratios: Sequence[float], proved: bool = False
) -> None:
    """The unit of the phone's angles is the configured one, by what the axes turned.

    Two gearings of the file that agree with the phone prove it: both would have to be
    wrong by 57.3. A gearing is corrected only where the unit is proved, so that no
    phone's radians are taken for a gearbox.

    Args:
        config: names the unit.
        ratios: of three axes, measured against commanded, by the drives' own registers
            where they have one.
        proved: only that all three do not turn as if the unit were the other.

    Raises:
        MotionFault: it is the other unit, or that is not clear.
    """
    unit = config.imu.unit
    other, factor = ("rad", RADIANS) if unit == "deg" else ("deg", 1.0 / RADIANS)
    seen = ", ".join(f"{ratio:.3g}" for ratio in ratios)
    seen = f"the phone turned {seen} of what pitch, yaw and roll were commanded"
    low, high = NEAR_UNIT
    if all(low <= ratio * factor <= high for ratio in ratios):
        raise MotionFault(
            f'{seen}, about {1 / factor:.3g}: rig.toml says imu.unit = "{unit}", and '
            f'the phone sends {other}. Set imu.unit = "{other}", then run `jaxcal-rig '
            "axes` again"
        )
    low, high = SOUND_RATIO
    if not proved and sum(low <= ratio <= high for ratio in ratios) < 2:
        raise MotionFault(
            f"{seen}, and none of its angles is over 6.3: either imu.unit or the "
            "gearings are wrong. Nothing was corrected. Set pulses_per_rev and "
            "reduction as the drives and the gearboxes' plates say, then run "
            "`jaxcal-rig axes` again"
        )


def require_gearing(
    config: RigConfig, ratios: Sequence[float], told: Sequence[int | None]
) -> None:
    """A gearing that is off by more than a factor of 2 has a second proof.

    That is the drive's own register, or another axis that turns as it is told: what is
    off by as much on all three may be the phone, or what the file says of all drives.

    Args:
        config, ratios: as of ``require_unit``.
        told: pulses for one turn by each drive's own word, None where it has none.

    Raises:
        MotionFault: there is none.
    """
    low, high = SOUND_RATIO
    if any(low <= ratio <= high for ratio in ratios):
        return
    for axis, ratio, register in zip(config.axes, ratios, told, strict=True):
        if register is None and max(ratio, 1.0 / ratio) > UNPROVED_FACTOR:
            seen = ", ".join(f"{each:.3g}" for each in ratios)
            raise MotionFault(
                f"the phone turned {seen} of what pitch, yaw and roll were commanded, "
                f"and the drive of {axis.name} has no register that says its pulses "
                "for a turn, so it is not known what is wrong. Nothing was corrected. "
                "Set pulses_per_rev and reduction as the drives and the gearboxes' "
                "plates say, then run `jaxcal-rig axes` again"
            )


def proposals(
    config: RigConfig, found: Findings, told: Sequence[int | None]
) -> list[Change]:
    """Corrections of the configuration.

    Args:
        config: as the moves were made, with a phone whose unit is proved.
        found: what they showed.
        told: pulses for one turn by each drive's own word, None where it has none.
    """
    tables = {table["name"]: table for table in tomllib.loads(config.text)["axes"]}
    changes: list[Change] = []
    for drive, joint in enumerate(found.joints):
        source, axis = config.axes[drive], config.axes[joint]
        own = _of_drive(source, axis, tables, told[drive])
        per_pulse = float(found.deg_per_pulse[drive])
        pulses = told[drive] or source.pulses_per_rev
        own += _of_joint(axis, per_pulse, pulses)
        if any(change.key.endswith(tuple(Scale.model_fields)) for change in own):
            own += [
                Change(f"axes.{axis.name}.{name}", value, None, "pulses mean otherwise")
                for name, value in tables[axis.name].items()
                if name in ("min_pulses", "max_pulses")
            ]
        changes += own
    if found.turned_deg > MOUNTING_DEG:
        angles = matrix_to_euler(found.mounting, "ZYX").round(2) + 0.0
        before, reason = list(config.imu.mounting_deg), "the three axes put the phone"
        reason += f" {found.turned_deg:.1f} deg from there"
        changes.append(Change("imu.mounting_deg", before, angles.tolist(), reason))
    if found.order not in (None, config.mechanism.order):
        reason = "combined moves show which joint carries which"
        order = config.mechanism.order
        changes.append(Change("mechanism.order", order, found.order, reason))
    return changes


def _of_drive(
    source: Axis, axis: Axis, tables: dict[str, Any], told: int | None
) -> list[Change]:
    """Keys of the drive that turns ``axis``, which is configured as ``source``."""
    changes = []
    for name in OF_DRIVE:
        # A map stands in the file as its name or its path.
        old, new = tables[axis.name].get(name), tables[source.name].get(name)
        reason = f"unit {source.unit} turns {axis.name}"
        if name == "pulses_per_rev" and told not in (None, new):
            new, reason = told, f"unit {source.unit} says so itself"
        if old != new:
            changes.append(Change(f"axes.{axis.name}.{name}", old, new, reason))
    return changes


def _of_joint(axis: Axis, deg_per_pulse: float, pulses_per_rev: int) -> list[Change]:
    """Direction and reduction of a joint whose drive is known."""
    changes, at = [], f"axes.{axis.name}"
    direction = 1 if deg_per_pulse > 0 else -1
    if direction != axis.direction:
        reason = f"positive pulses turn it the {_way(direction)} way"
        changes.append(Change(f"{at}.direction", axis.direction, direction, reason))
    ratio = abs(deg_per_pulse) * pulses_per_rev * axis.reduction / 360.0
    low, high = SOUND_RATIO
    if not low <= ratio <= high:
        reduction = float(f"{axis.reduction / ratio:.{DIGITS}g}")
        reason = f"it turns {ratio:.3g} of what is commanded; sound is {low:g} to "
        reason += f"{high:g}"
        changes.append(Change(f"{at}.reduction", axis.reduction, reduction, reason))
    return changes


def _way(direction: int) -> str:
    return "positive" if direction > 0 else "negative"


def lines(config: RigConfig, found: Findings) -> list[str]:
    """The findings in words, a line for each drive and each thing found."""
    text = [
        "  unit  turns   axis in the phone   off     sense     measured/commanded  "
        "play      cross-talk"
    ]
    for drive, joint in enumerate(found.joints):
        axis, unit = config.axes[joint], config.axes[drive].unit
        ratio = abs(found.deg_per_pulse[drive] * config.axes[drive].pulses_per_deg)
        others = [i for i in range(3) if i != joint]
        cross = ", ".join(
            f"{AXIS_NAMES[i]} {100 * found.cross_talk[i, drive]:+.1f} %" for i in others
        )
        vector = " ".join(f"{value:+.2f}" for value in found.axes[:, drive])
        text.append(
            f"  {unit:>4}  {axis.name:<6}  [{vector}]   {found.off_deg[drive]:4.1f}    "
            f"{_way(int(np.sign(found.deg_per_pulse[drive]))):<8}  {ratio:18.3f}  "
            f"{max(0.0, found.backlash_deg[drive]):.3f}     {cross}"
        )
    angles = matrix_to_euler(found.mounting, "ZYX")
    text.append(
        f"  phone: turned by [{' '.join(f'{angle:.1f}' for angle in angles)}] deg "
        f"about Z, Y, X, {found.turned_deg:.1f} from imu.mounting_deg"
    )
    order = found.order or "not clear from these moves"
    text.append(f"  joints from the base outwards: {order}")
    if found.mirrored:
        text.append(
            "  note: the axes are mirrored against the configuration: a direction is "
            "wrong, or two drives are exchanged"
        )
    if found.skew_deg > SKEW_DEG:
        text.append(
            f"  WARNING: the axes read {found.skew_deg:.0f} deg away from right "
            "angles. Check imu.order, imu.columns and imu.signs"
        )
    return text
