"""Several sensors on one arm, in one fit."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.arms.sensors.sensor import (
    AXES,
    Located,
    Reading,
    Readings,
    Sensor,
    Tip,
    hats,
    label,
    turns,
)
from jaxcal.checks import Array, array_of
from jaxcal.models.model import Model, Quantity, Rows
from jaxcal.tables import COMMANDS, of_frame


@dataclasses.dataclass(frozen=True, eq=False)
class Several(Sensor):
    """Readings of some sensors, each in units of its own noise.

    Commands have the column ``sensor``, which says of each row which one read it, and
    then the columns of all (0 where they are another's); ``SerialChain.together`` makes
    such tables. The first is at the tool; where the others are on it are parameters of
    their own, known as a tool is.

    Attributes:
        sensors: two or more.
        mounts: (S - 1, 4, 4) where the others are, seen from the tool; there when not
            given.
    """

    sensors: tuple[Sensor, ...] = ()
    mounts: ArrayLike | None = None

    kind = "several"
    joined = True
    quantities = (Quantity("times the noise"),)

    def __post_init__(self) -> None:
        given = tuple(self.sensors)
        if len(given) < 2 or not all(isinstance(one, Sensor) for one in given):
            raise ValueError(f"sensors must hold at least two sensors, got {given!r}")
        object.__setattr__(self, "sensors", given)
        frames = np.tile(np.eye(4), (len(given) - 1, 1, 1))
        if self.mounts is not None:
            frames = array_of("mounts", self.mounts, len(given) - 1, 4, 4)
        object.__setattr__(self, "mounts", frames)
        for one in given[1:]:
            if not one.mounted and getattr(given[0], "moves", "") != "board":
                raise ValueError('same_board needs a first sensor Board("board")')

    @property
    def tool(self) -> tuple[str, ...]:  # type: ignore[override]  # the first one's
        return self.sensors[0].tool

    @property
    def inputs(self) -> tuple[str, ...]:
        columns = [name for one in self.sensors for name in one.inputs]
        return ("sensor", *dict.fromkeys(columns))

    @property
    def outputs(self) -> tuple[str, ...]:
        most = max(len(one.outputs) for one in self.sensors)
        return tuple(f"reading {i + 1}" for i in range(most))

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(name for name, _ in self._named())

    @property
    def units(self) -> tuple[str, ...]:
        return tuple(unit for _, unit in self._named())

    def _named(self) -> list[tuple[str, str]]:
        """Own parameters and their units: mounting, then own, sensor after sensor."""
        kinds = [one.kind for one in self.sensors]
        named = []
        for i, one in enumerate(self.sensors):
            alone = kinds.count(one.kind) == 1
            title = one.kind if alone else f"{one.kind} {i}"
            for axis in self._axes(i):
                unit = "deg" if "r" in axis else "length"
                named.append((f"{title} tool {axis}", unit))
            names = one.names if alone else [f"{title}: {name}" for name in one.names]
            named += zip(names, one.units, strict=True)
        return named

    @property
    def nominal(self) -> Array:
        both = [[self._mounting(i), one.nominal] for i, one in enumerate(self.sensors)]
        return np.concatenate([part for pair in both for part in pair])

    def _axes(self, i: int) -> tuple[str, ...]:
        """Unknown shifts and turns of sensor ``i`` on the tool, where it is mounted."""
        return self.sensors[i].tool if i and self.sensors[i].mounted else ()

    def _mounting(self, i: int) -> Array:
        """Nominal shifts, and turns of zero, of where sensor ``i`` is on the tool."""
        shift = np.asarray(self.mounts)[i - 1, :3, 3]
        whole = dict(zip(AXES, [*shift, 0.0, 0.0, 0.0], strict=True))
        return np.array([whole[axis] for axis in self._axes(i)])

    def prior_std(self, length: float) -> Array:
        mounting = {"r": 1.7, "": 0.1 * length}  # as the tool's
        parts: list[float] = []
        for i, one in enumerate(self.sensors):
            parts += [mounting[axis[:-1]] for axis in self._axes(i)]
            parts += one.prior_std(length).tolist()
        return np.array(parts)

    def usual_noise(self, length: float) -> ArrayLike:
        return 1.0

    def unseen(self, arm: Any) -> tuple[str, ...]:
        """Names of the parameters that no sensor sees."""
        hidden = [set(one.unseen(arm)) for one in self.sensors]
        return tuple(name for name in arm.names if all(name in h for h in hidden))

    def parts(self, inputs: Array) -> Iterator[tuple[int, Sensor, Rows, Array]]:
        which = label("sensor", inputs[:, 0], len(self.sensors))
        for i, one in enumerate(self.sensors):
            rows = np.flatnonzero(which == i)
            at = [self.inputs.index(name) for name in one.inputs]
            yield i, one, rows, inputs[rows][:, at]

    def _tip(self, i: int, tip: Tip, rows: Rows, given: Array) -> Tip:
        """The place of sensor ``i`` at its rows, its mounting as ``given``."""
        tip = tip.at(rows)
        if not self._axes(i):
            return tip
        shift, turn, _ = self._mount(i, given)
        turned = np.einsum("jcn,jk->kcn", tip.frame[:3], turn)
        origin = tip.frame[3] + np.einsum("jcn,j->cn", tip.frame[:3], shift)
        return Tip(np.concatenate([turned, origin[None]]), tip.nominal, tip.length)

    def _mount(self, i: int, given: Array) -> tuple[Array, Array, Array]:
        """Shift (3,), rotation (3, 3), and the axes of its turns as columns (3, 3)."""
        whole = dict.fromkeys(AXES, 0.0)
        whole |= dict(zip(self.sensors[i].tool, given, strict=True))
        shift, angles = np.array([*whole.values()]).reshape(2, 3)
        turn, axes = turns(angles)
        return shift, turn @ np.asarray(self.mounts)[i - 1, :3, :3], axes

    def read(self, tip: Tip, inputs: Array, parameters: Array) -> Reading:
        count, q = len(inputs), len(self.outputs)
        values = np.zeros((count, q))
        by_tip, by_own = np.zeros((count, q, 6)), np.zeros((count, q, len(parameters)))
        for i, one, rows, columns in self.parts(inputs):
            own, width = self.own_of_members[i], len(one.outputs)
            mounted = slice(own.start - len(self._axes(i)), own.start)
            mount = parameters[mounted]
            place = self._tip(i, tip, rows, mount)
            reading = one.read(place, columns, parameters[own])
            scale = one.stds(tip.length)[:, None]
            values[rows, :width] = reading.values / scale[:, 0]
            scaled = reading.by_tip / scale
            by_own[rows, :width, own] = reading.by_own / scale
            if mount.size:
                shift, _, axes = self._mount(i, mount)
                rotation = tip.rotation[rows]
                moves, turned = scaled[..., :3] @ rotation, scaled[..., 3:] @ rotation
                slopes = np.concatenate([moves, np.radians(turned @ axes)], axis=-1)
                at = [AXES.index(axis) for axis in one.tool]
                by_own[rows, :width, mounted] = slopes[..., at]
                scaled[..., 3:] -= scaled[..., :3] @ hats(rotation @ shift)
            by_tip[rows, :width] = scaled
        return Reading(values, by_tip, by_own)

    def wrapped(self, off: Array, inputs: Array, length: float) -> Array:
        off = off.copy()
        for _, one, rows, columns in self.parts(inputs):
            width, scale = len(one.outputs), one.stds(length)
            its = off[..., rows, :width] * scale
            off[..., rows, :width] = one.wrapped(its, columns, length) / scale
        return off

    def located(self, tip: Tip, inputs: Array, measured: Array | None) -> Located:
        """Each of them, and where those that find it are on the tool."""
        sensors, mounts = [], np.array(self.mounts)
        tool = None
        for i, part in enumerate(self.of_members(tip, inputs, measured)):
            placed, new = part.sensor, None
            if len(part.columns):
                placed, new = placed.located(part.tip, part.columns, part.measured)
            sensors.append(placed)
            if new is not None and self._axes(i):
                mounts[i - 1] = mounts[i - 1] @ new
            elif new is not None and not i:  # the others stay where they are
                tool, mounts = new, np.linalg.inv(new) @ mounts
        return dataclasses.replace(self, sensors=tuple(sensors), mounts=mounts), tool

    @property
    def members(self) -> tuple[Sensor, ...]:
        return self.sensors

    @property
    def own_of_members(self) -> tuple[slice, ...]:
        sizes = [(len(self._axes(i)), len(x.names)) for i, x in enumerate(self.sensors)]
        ends = np.cumsum(sizes).reshape(-1, 2).tolist()
        return tuple(slice(*both) for both in ends)

    def with_member(self, i: int, sensor: Sensor) -> Self:
        sensors = (*self.sensors[:i], sensor, *self.sensors[i + 1 :])
        return dataclasses.replace(self, sensors=sensors)

    def of_members(
        self, tip: Tip, inputs: Array, measured: Array | None
    ) -> Iterator[Readings]:
        for i, one, rows, columns in self.parts(inputs):
            read, scale = None, one.stds(tip.length)
            if measured is not None:
                read = measured[rows, : len(one.outputs)] * scale
            at = self._tip(i, tip, rows, self._mounting(i))
            yield Readings(one, at, columns, read, rows, scale)

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Self:
        from jaxcal.arms.sensors import SENSORS  # which names this class

        sensors = [SENSORS[one["kind"]].from_dict(one) for one in content["sensors"]]
        return cls(tuple(sensors), content["mounts"])

    def to_dict(self) -> dict[str, Any]:
        content = super().to_dict()
        return content | {"sensors": [one.to_dict() for one in self.sensors]}


class OneTable(NamedTuple):
    """Commands and readings of one sensor or chain."""

    name: str
    number: int  # in the column that tells the rows apart
    columns: Sequence[int]  # of the commands of all
    noise: Array  # of its readings
    commands: ArrayLike
    measured: ArrayLike | None  # None for zeros


def stacked(
    model: Model, label: int, tables: Iterable[OneTable]
) -> tuple[Array, Array]:
    """Commands (N, n) and readings (N, q) in noise of all tables, one after another;
    ``label`` is the column of their numbers."""
    all_commands, all_measured = [], []
    inputs, n, q = model.inputs, model.num_inputs, model.num_outputs
    for name, number, columns, noise, given, readings in tables:
        what = f"commands of {name}"
        if inputs:
            given = of_frame(what, given, [inputs[i] for i in columns], COMMANDS)
        rows = array_of(what, given, "N", len(columns))
        commands, measured = np.zeros((len(rows), n)), np.zeros((len(rows), q))
        commands[:, label], commands[:, columns] = number, rows
        if readings is not None:
            values = array_of(f"measured of {name}", readings, len(rows), len(noise))
            measured[:, : len(noise)] = values / noise
        all_commands.append(commands)
        all_measured.append(measured)
    return np.vstack(all_commands), np.vstack(all_measured)
