"""What every sensor answers: readings of the tip's pose, and their derivatives."""

from __future__ import annotations

import abc
import dataclasses
import functools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from jaxcal.checks import Array, Indices, Mask, levels
from jaxcal.models.model import Quantity, Rows, within_half

AXES = ("x", "y", "z", "rx", "ry", "rz")
BASE = tuple(f"base {axis}" for axis in AXES)


def plain_fields(of: Any) -> dict[str, Any]:
    """Fields of a dataclass, arrays as lists."""
    values = {field.name: getattr(of, field.name) for field in dataclasses.fields(of)}
    arrays = {n: x.tolist() for n, x in values.items() if isinstance(x, np.ndarray)}
    return values | arrays


@dataclasses.dataclass(frozen=True)
class Tip:
    """The tip of the arm at N postures, in the measuring frame."""

    frame: Array  # (4, 3, N) its axes x, y, z and its origin
    nominal: Callable[[], Array]  # () -> (N, 3, 3), the nominal arm's rotation there
    length: float  # of the arm

    @functools.cached_property
    def position(self) -> Array:
        """(N, 3)."""
        return np.ascontiguousarray(self.frame[3].T)

    @functools.cached_property
    def rotation(self) -> Array:
        """(N, 3, 3) from the tip to the measuring frame."""
        return np.ascontiguousarray(self.frame[:3].transpose(2, 1, 0))

    def at(self, rows: Rows) -> Tip:
        """At some of the postures."""
        return Tip(self.frame[:, :, rows], lambda: self.nominal()[rows], self.length)

    @staticmethod
    def together(tips: Sequence[Tip]) -> Tip:
        """At the postures of all, which may be of different arms."""
        frame = np.concatenate([tip.frame for tip in tips], axis=2)
        return Tip(
            frame,
            lambda: np.concatenate([tip.nominal() for tip in tips]),
            tips[0].length,
        )


class Readings(NamedTuple):
    """What a sensor measured at N postures."""

    sensor: Sensor
    tip: Tip  # where it was, of the nominal arm
    columns: Array  # (N, e) of the commands that are its own
    measured: Array | None  # (N, q), None of candidates
    rows: Rows  # (N,) of all that the arm measured
    scale: Array  # (q,) its unit in that of the arm's readings
    member: int = 0  # its number among the arm's
    kind: str = ""  # of it, for a message
    title: str = ""  # that, "" where there are no others
    own: Any = slice(0)  # of the arm's parameters
    judged: Any = np.False_  # (D,) distances, of one of several arms alone

    def groups(self) -> list[Rows]:
        """Rows of each socket, plane or anchor, in the order of measuring."""
        which = self.sensor.of_rows(self.columns)
        return [self.rows[which == i] for i in range(self.sensor.num_places)]

    def touched(self) -> Mask:
        """(D,) distances both of whose sockets have contacts of this arm."""
        pairs = np.array(getattr(self.sensor, "distances", ())).reshape(-1, 4)[:, :2]
        labels = self.sensor.of_rows(self.columns)
        return np.asarray(np.isin(pairs, labels).all(axis=1))

    def at(self, rows: Rows) -> Readings:
        """Some of them."""
        return self._replace(
            tip=self.tip.at(rows),
            columns=self.columns[rows],
            measured=None if self.measured is None else self.measured[rows],
            rows=self.rows[rows],
        )


class Reading(NamedTuple):
    """What a sensor reads at N postures."""

    values: Array  # (N, q)
    by_tip: Array  # (N, q, 6) by a shift of the tip, and by its turn in radians
    by_own: Array  # (N, q, s) by the sensor's own parameters


def facts_of(
    members: Iterable[tuple[Sensor, Any]], parameters: Array
) -> tuple[Array, Array]:
    """``Sensor.facts`` of sensors whose parameters are at places among (p,): (F,) off,
    (F, p) derivative."""
    offs, rows = [np.zeros(0)], [np.zeros((0, len(parameters)))]
    for sensor, at in members:
        off, slopes = sensor.facts(parameters[at])
        offs.append(off)
        rows.append(np.zeros((len(off), len(parameters))))
        rows[-1][:, at] = slopes
    return np.concatenate(offs), np.concatenate(rows)


# A sensor where it stands, and where its tool is seen from the nominal one (4, 4), if
# that is new.
Located = tuple["Sensor", Array | None]


@dataclasses.dataclass(frozen=True, eq=False)
class Sensor(abc.ABC):
    """A sensor of an arm; this one has no parameters and no column of its own.

    A sensor of one's own is a frozen dataclass of this kind: ``read`` says what it
    reads, the rest names what it has. Lengths are in the arm's unit.

    Attributes:
        noise: standard deviation of a reading: one number or (q,); the sensor's usual
            one when not given.
    """

    noise: float | tuple[float, ...] | None = dataclasses.field(
        default=None, kw_only=True
    )

    kind: ClassVar[str]  # in files and for the command line
    tool: ClassVar[tuple[str, ...]] = ("x", "y", "z")  # what of the tool it sees
    zeros: ClassVar[bool] = False  # what is measured is always zero
    lengths: ClassVar[bool] = False  # every reading is a length
    compliant: ClassVar[bool] = False  # shown to be better with joints that yield
    local: ClassVar[bool] = False  # of few places: harmonics are fitted if they gain
    stands: ClassVar[bool] = False  # what is read stands at a place that it finds
    positions: ClassVar[bool] = False  # its first three readings are the tip's place
    relative: ClassVar[bool] = False  # the others are turns from the nominal ones
    views: ClassVar[bool] = False  # it sees a board, or is one, by a camera
    joined: ClassVar[bool] = False  # it is several sensors in one table
    needed: ClassVar[int] = 1  # readings that find a place
    # How well the tool is known, by the arm's length: it may hang anywhere; 0.4 % where
    # readings hardly show it and would put it anywhere.
    mounting: ClassVar[float] = 0.1
    misfit: ClassVar[float] = 0.0  # what they leave, by the arm's length, in a choice
    # What follows a property may give.
    inputs: ClassVar[Any] = ()  # columns of the commands after the joints
    names: ClassVar[Any] = ()  # s of its own parameters
    units: ClassVar[Any] = ()  # s: "length", "deg" and the like
    num_places: ClassVar[Any] = 0  # sockets, planes or anchors around the arm
    mounted: ClassVar[Any] = True  # in ``Several`` it has its own place on the tool
    # (q,) of readings that wrap, 360 of an angle in degrees, inf of the others.
    periods: ClassVar[tuple[float, ...] | None] = None

    @property
    @abc.abstractmethod
    def outputs(self) -> tuple[str, ...]:
        """q names of the readings."""

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """What it reads, by unit; "length" stands for the unit of the arm's lengths."""
        return (Quantity("length" if self.lengths else ""),)

    @property
    def nominal(self) -> Array:
        """(s,) its own parameters as far as they are known."""
        return np.zeros(len(self.names))

    def prior_std(self, length: float) -> Array:
        """(s,) of its own parameters, for an arm of this length."""
        return np.full(len(self.names), np.inf)

    @abc.abstractmethod
    def usual_noise(self, length: float) -> ArrayLike:
        """() or (q,) standard deviation of a reading, for an arm of this length."""

    def unseen(self, arm: Any) -> tuple[str, ...]:
        """Parameters of ``arm`` that no posture shows; held but by a prior."""
        return ()

    @abc.abstractmethod
    def read(self, tip: Tip, inputs: Array, parameters: Array) -> Reading:
        """Readings at N postures, with columns ``inputs`` (N, e) and parameters."""

    def wrapped(self, off: Array, inputs: Array, length: float) -> Array:
        """(..., N, q) differences of readings, those that wrap within half a period."""
        return within_half(off, self.periods)

    def located(self, tip: Tip, inputs: Array, measured: Array | None) -> Located:
        """This sensor where nominal postures (and readings) say that it stands, and
        where its tool is seen from the nominal one (4, 4), if that is new."""
        return self, None

    def seen_poses(self, inputs: Array, read: Array) -> tuple[Array, Array] | None:
        """Rotations (N, 3, 3) and places (N, 3) of what it sees, None: it sees none."""
        return None

    @property
    def standing(self) -> Sensor:
        """This sensor, its place found by another arm: what ``located`` has to find."""
        return self

    def of_rows(self, inputs: Array) -> Indices:
        """(N,) which of the things that stand around each row is of."""
        return np.zeros(len(inputs), dtype=np.int64)

    def lacking(self, inputs: Array) -> tuple[int, ...]:
        """Things of which something is known and none of the rows (N, e) is."""
        return ()

    @property
    def contacts(self) -> bool:
        """Whether all that is measured is zero."""
        return all(one.zeros for one in self.members)

    @property
    def members(self) -> tuple[Sensor, ...]:
        """Sensors with things of their own."""
        return (self,)

    @property
    def own_of_members(self) -> tuple[slice, ...]:
        """Where their own parameters are among the own parameters."""
        return (slice(0, len(self.names)),)

    def with_member(self, i: int, sensor: Sensor) -> Sensor:
        """This sensor with another in the place of its member ``i``."""
        return sensor

    def parts(self, inputs: Array) -> Iterator[tuple[int, Sensor, Rows, Array]]:
        """Each of them and its number, its rows, and its columns there."""
        yield 0, self, np.arange(len(inputs)), inputs

    def of_members(
        self, tip: Tip, inputs: Array, measured: Array | None
    ) -> Iterator[Readings]:
        """What each of them measured."""
        rows, scale = np.arange(len(inputs)), np.ones(len(self.outputs))
        yield Readings(self, tip, inputs, measured, rows, scale)

    def facts(self, parameters: Array) -> tuple[Array, Array]:
        """What is known of its own parameters besides, in standard deviations: (F,)
        off, (F, s) derivative."""
        return np.zeros(0), np.zeros((0, len(parameters)))

    def stds(self, length: float) -> Array:
        """(q,) standard deviations of the readings."""
        noise = self.usual_noise(length) if self.noise is None else self.noise
        return levels("noise of the sensor", noise, len(self.outputs))

    def to_dict(self) -> dict[str, Any]:
        """JSON with its kind."""
        return {"kind": self.kind, **plain_fields(self)}

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Self:
        """The sensor that ``to_dict`` wrote."""
        own = {field.name for field in dataclasses.fields(cls)}
        gone = {"kind", "distortion"} - own  # the latter a board's, which only 0.2 used
        return cls(**{key: content[key] for key in content if key not in gone})


@dataclasses.dataclass(frozen=True, eq=False)
class Position(Sensor):
    """x, y, z of the tip in the measuring frame; noise 0.01 % of the arm's length."""

    kind = "position"
    positions = True
    lengths = True
    outputs = ("x", "y", "z")
    misfit = 3e-4

    def usual_noise(self, length: float) -> ArrayLike:
        return 1e-4 * length

    def read(self, tip: Tip, inputs: Array, parameters: Array) -> Reading:
        count = len(tip.position)
        by_tip = np.broadcast_to(np.eye(3, 6), (count, 3, 6))
        return Reading(tip.position, by_tip, np.zeros((count, 3, 0)))


@dataclasses.dataclass(frozen=True, eq=False)
class Pose(Sensor):
    """Position, and the turn from the nominal orientation as a vector in degrees.

    The vector is in the measuring frame; ``SerialChain.rotation_vectors`` makes it
    from measured rotation matrices. Noise 0.01 % of the arm's length, 0.006 degrees.
    """

    kind = "pose"
    positions = True
    relative = True
    tool = outputs = AXES
    quantities = (Quantity("length", slice(3)), Quantity("deg", slice(3, 6)))

    def usual_noise(self, length: float) -> ArrayLike:
        return [1e-4 * length] * 3 + [float(np.degrees(1e-4))] * 3

    def read(self, tip: Tip, inputs: Array, parameters: Array) -> Reading:
        turn = tip.rotation @ np.matrix_transpose(tip.nominal())
        vector = np.asarray(Rotation.from_matrix(turn).as_rotvec())
        by_tip = np.zeros((len(vector), 6, 6))
        by_tip[:, :3, :3] = np.eye(3)
        by_tip[:, 3:, 3:] = np.degrees(rotation_vector_rate(vector))
        values = np.hstack([tip.position, np.degrees(vector)])
        return Reading(values, by_tip, np.zeros((len(vector), 6, 0)))


def rotation_vector_rate(vector: Array) -> Array:
    """(N, 3, 3) derivative of rotation vectors r (N, 3), radians, by a turn w.

    ``exp(r + dr) = exp(w) exp(r)`` to first order, dr this matrix times w.
    """
    angle = np.linalg.norm(vector, axis=-1)
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    factor = 1.0 / safe**2 - 1.0 / (2.0 * safe * np.tan(safe / 2.0))
    factor = np.where(small, 1.0 / 12.0, factor)[:, None, None]
    hat = hats(vector)
    return np.eye(3) - 0.5 * hat + factor * (hat @ hat)


def hats(vectors: Array) -> Array:
    """(..., 3, 3) with ``hats(v) @ w = v x w``."""
    matrix = np.zeros((*vectors.shape[:-1], 3, 3))
    matrix[..., [2, 0, 1], [1, 2, 0]] = vectors
    return matrix - np.matrix_transpose(matrix)


def turns(angles: Array) -> tuple[Array, Array]:
    """Rotation (3, 3) Rx Ry Rz by degrees (3,); the axes of its turns as columns."""
    whole, axes = np.eye(3), np.eye(3)
    for k, axis in enumerate("xyz"):
        axes[:, k] = whole[:, k]
        whole = whole @ Rotation.from_euler(axis, angles[k], degrees=True).as_matrix()
    return whole, axes


def label(what: str, column: Array, count: int) -> Indices:
    """(N,) which of ``count`` things each row is of, checked."""
    whole = column.astype(np.int64)
    bad = np.flatnonzero((whole != column) | (whole < 0) | (whole >= count))
    if bad.size:
        raise ValueError(
            f"column {what} of commands must be a whole number in [0, {count}), got "
            f"{column[bad[0]]:g} in row {bad[0]}"
        )
    return whole
