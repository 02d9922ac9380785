"""What each sensor of an arm read: the parts that a verdict is made of."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxcal.arms.sensors import Sensor
from jaxcal.checks import Array

if TYPE_CHECKING:
    from jaxcal.arms.verdict import ArmFit as Fit


class Part(NamedTuple):
    """What one sensor of an arm read: of ``Several`` each, else the only one.

    Or of arms that share it.
    """

    member: int  # number of it
    sensor: Sensor
    kind: str  # of it, for a message
    title: str  # that, "" where there are no others
    rows: NDArray[np.intp]  # (K,) measurements that are used
    columns: Array  # (K, e) of their commands
    points: Array  # (K, 3) where the arm as described has it
    own: slice | NDArray[np.intp]  # of the parameters
    scale: Array  # (q,) its unit in that of the calibration's readings
    judged: NDArray[np.bool_] | None = None  # (D,) distances, of one of the arms alone

    def groups(self) -> list[NDArray[np.intp]]:
        """Rows of each socket, plane or anchor, in the order of measuring."""
        which = self.sensor.of_rows(self.columns)
        return [self.rows[which == i] for i in range(self.sensor.num_places)]

    def touched(self) -> NDArray[np.bool_]:
        """(D,) distances both of whose sockets have contacts of this arm."""
        pairs = np.array(getattr(self.sensor, "distances", ())).reshape(-1, 4)[:, :2]
        labels = self.sensor.of_rows(self.columns)
        return np.asarray(np.isin(pairs, labels).all(axis=1))


def parts_of(calibration: Fit, used: NDArray[np.intp]) -> list[Part]:
    """Readings of each sensor that has some."""
    model, commands = calibration.model, calibration.commands[used]
    tip, inputs = model.nominal_tip(commands), commands[:, model.num_joints :]
    kinds, parts = [one.kind for one in model.sensor.members], []
    several = [*model.sensor.of_members(tip, inputs, None)]
    alone = sum(len(read.rows) > 0 for read in several) == 1
    for i, read in enumerate(several):
        twice = kinds.count(read.sensor.kind) > 1
        kind = f"sensor {i}'s {read.sensor.kind}" if twice else read.sensor.kind
        if len(read.rows):
            parts.append(
                Part(
                    i,
                    read.sensor,
                    kind,
                    "" if alone else kind,
                    used[read.rows],
                    read.columns,
                    read.tip.position,
                    model.own(i),
                    read.scale,
                )
            )
    return parts


def unit_after(calibration: Fit) -> str:
    """The unit of lengths after a number, where it is known."""
    unit = calibration.model.length_unit(calibration.measured_unit)
    return f" {unit}" if unit else ""
