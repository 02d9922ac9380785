"""What of rig.toml the findings contradict, and how it should read."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Sequence
from typing import Any

import numpy as np

from rig.attitude import matrix_to_euler
from rig.commission.findings import MOUNTING_DEG, Findings
from rig.config import AXIS_NAMES, RigConfig

# Measured against commanded: what A may take up, and what only a wrong gearing does.
SOUND_RATIO = (0.4, 1.5)
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


def proposals(
    config: RigConfig, found: Findings, told: Sequence[int | None]
) -> list[Change]:
    """Corrections of the configuration.

    Args:
        config: as the moves were made.
        found: what they showed.
        told: pulses for one turn by each drive's own word, None where it has none.
    """
    changes: list[Change] = []
    tables = tomllib.loads(config.text)["axes"]
    written = {table["name"]: table["map"] for table in tables}  # a name or a path
    for drive, joint in enumerate(found.joints):
        source, axis = config.axes[drive], config.axes[joint]
        at = f"axes.{axis.name}"
        values = {name: getattr(source, name) for name in OF_DRIVE}
        values["map"] = written[source.name]
        old = {name: getattr(axis, name) for name in OF_DRIVE} | {
            "map": written[axis.name]
        }
        reasons = dict.fromkeys(OF_DRIVE, f"unit {source.unit} turns {axis.name}")
        if told[drive] not in (None, values["pulses_per_rev"]):
            values["pulses_per_rev"] = told[drive]
            reasons["pulses_per_rev"] = (
                f"unit {source.unit} says so itself, register "
                f"0x{source.map.pulses_per_rev.address:04X}"
            )
        changes += [
            Change(f"{at}.{name}", old[name], values[name], reasons[name])
            for name in OF_DRIVE
            if values[name] != old[name]
        ]
        per_pulse = float(found.deg_per_pulse[drive])
        direction = 1 if per_pulse > 0 else -1
        if direction != axis.direction:
            changes.append(
                Change(
                    f"{at}.direction", axis.direction, direction,
                    f"positive pulses turn it the {_way(direction)} way",
                )
            )  # fmt: skip
        ratio = abs(per_pulse) * values["pulses_per_rev"] * axis.reduction / 360.0
        if not SOUND_RATIO[0] <= ratio <= SOUND_RATIO[1]:
            changes.append(
                Change(
                    f"{at}.reduction", axis.reduction,
                    float(f"{axis.reduction / ratio:.{DIGITS}g}"),
                    f"it turns {ratio:.3g} of what is commanded; sound is "
                    f"{SOUND_RATIO[0]:g} to {SOUND_RATIO[1]:g}",
                )
            )  # fmt: skip
    for table in tables:
        at, scales = (
            f"axes.{table['name']}",
            ("pulses_per_rev", "reduction", "direction"),
        )
        if any(change.key == f"{at}.{name}" for change in changes for name in scales):
            changes += [
                Change(f"{at}.{name}", table[name], None, "pulses have a new scale")
                for name in ("min_pulses", "max_pulses")
                if name in table
            ]
    if found.turned_deg > MOUNTING_DEG:
        angles = matrix_to_euler(found.mounting, "ZYX").round(2) + 0.0
        changes.append(
            Change(
                "imu.mounting_deg", list(config.imu.mounting_deg), angles.tolist(),
                f"the three axes put the phone {found.turned_deg:.1f} deg from there",
            )
        )  # fmt: skip
    if found.order not in (None, config.mechanism.order):
        changes.append(
            Change(
                "mechanism.order", config.mechanism.order, found.order,
                "combined moves show which joint carries which",
            )
        )  # fmt: skip
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
        f"  phone: turned by [{' '.join(f'{angle:.1f}' for angle in angles)}] deg about "
        f"Z, Y, X, {found.turned_deg:.1f} from imu.mounting_deg"
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
            f"  WARNING: the axes read {found.skew_deg:.0f} deg away from right angles. "
            "Check imu.order, imu.columns and imu.signs"
        )
    return text
