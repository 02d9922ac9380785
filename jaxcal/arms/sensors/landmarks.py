"""What stands around the arm and is touched or reached: sockets, planes, anchors."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.arms.sensors.sensor import BASE, Located, Reading, Sensor, Tip, hats, label
from jaxcal.checks import Array, Indices, array_of, numbers, whole_number
from jaxcal.models.model import Quantity, Rows


@dataclasses.dataclass(frozen=True, eq=False)
class Landmarks(Sensor):
    """A sensor with things that stand around the arm: sockets, planes, anchors.

    Attributes:
        count: how many there are. From two on the commands have one more column,
            named as the sensor, which says of each row which one it is, from 0.
        places: (count, width) where they stand, roughly; found from the first readings
            when not given.
    """

    count: int = 1
    places: Array | None = None

    stands = True
    axes: ClassVar[tuple[str, ...]]  # w names of the parameters of one of them
    axis_units: ClassVar[tuple[str, ...]]
    width: ClassVar[int]  # numbers that say where one stands

    def __post_init__(self) -> None:
        whole_number("count", self.count, 1)
        if self.places is not None:
            places = array_of("places", self.places, self.count, self.width)
            object.__setattr__(self, "places", places)

    @property
    def num_places(self) -> int:
        return self.count

    @property
    def inputs(self) -> tuple[str, ...]:
        return (self.kind,) if self.count > 1 else ()

    @property
    def names(self) -> tuple[str, ...]:
        numbers = range(self.count) if self.count > 1 else [""]
        return tuple(f"{self.kind}{i} {axis}" for i in numbers for axis in self.axes)

    @property
    def units(self) -> tuple[str, ...]:
        return self.axis_units * self.count

    @property
    def nominal(self) -> Array:
        if self.places is None:
            return np.zeros(self.count * len(self.axes))
        return self.places.ravel()

    def unseen(self, arm: Any) -> tuple[str, ...]:
        return BASE

    def located(self, tip: Tip, inputs: Array, measured: Array | None) -> Located:
        """Each where the nominal postures (and lengths) of its rows have it."""
        if self.places is not None or (measured is None and not self.zeros):
            return self, None
        which = self.of_rows(inputs)
        rows = [np.flatnonzero(which == i) for i in range(self.count)]
        places = [self.place(i, at, tip, measured) for i, at in enumerate(rows)]
        return dataclasses.replace(self, places=np.array(places)), None

    def place(self, i: int, rows: Rows, tip: Tip, measured: Array | None) -> Array:
        """(width,) where number ``i`` stands, of its rows (K,)."""
        raise NotImplementedError  # abstract: each kind of landmark has its own

    def of_rows(self, inputs: Array) -> Indices:
        if self.count == 1:
            return np.zeros(len(inputs), dtype=np.int64)
        return label(self.kind, inputs[:, 0], self.count)

    def spread(self, which: Indices, by_one: Array) -> Array:
        """(N, q, s) derivative by all parameters, of (N, q, w) by those of a row's."""
        count, q, w = by_one.shape
        full = np.zeros((count, q, self.count, w))
        full[np.arange(count), :, which] = by_one
        return full.reshape(count, q, self.count * w)


@dataclasses.dataclass(frozen=True, eq=False)
class Socket(Landmarks):
    """Three zeros a contact: the ball's centre less that of its socket.

    Contacts do not show where the arm stands, so ``base`` is held; without a known
    distance they do not show its scale, which is the prior's: a fit compares misses
    with the size of the arm (``Fitting.log_size``). ``places`` are the centres (S, 3);
    noise, the play of the ball, 0.02 % of the arm's length.

    Attributes:
        distances: rows (first, second, distance, std) of two sockets.
    """

    distances: Sequence[Sequence[float]] = ()

    kind = "socket"
    lengths = True
    outputs = ("off x", "off y", "off z")
    zeros = True
    local = True
    compliant = True
    axes = ("x", "y", "z")
    axis_units = ("length",) * 3
    width = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        rows = numbers("distances", self.distances or np.zeros((0, 4)))
        if rows.ndim != 2 or rows.shape[1] != 4 or not (rows[:, 2:] > 0.0).all():
            raise ValueError(
                "distances must be rows (first socket, second, distance, std), the "
                f"last two positive, got {self.distances!r}"
            )
        one, two = pairs = rows[:, :2].T
        exists = (pairs == pairs.round()) & (pairs >= 0.0) & (pairs < self.count)
        if not exists.all() or (one == two).any():
            raise ValueError(
                f"distances must name two of {self.count} sockets, counted from 0 (in "
                f"a recording --which numbers them), got {self.distances!r}"
            )
        object.__setattr__(self, "distances", tuple(map(tuple, rows.tolist())))

    def usual_noise(self, length: float) -> ArrayLike:
        return 2e-4 * length

    def read(self, tip: Tip, inputs: Array, parameters: Array) -> Reading:
        which = self.of_rows(inputs)
        count = len(which)
        by_tip = np.broadcast_to(np.eye(3, 6), (count, 3, 6))
        by_one = np.broadcast_to(-np.eye(3), (count, 3, 3))
        values = tip.position - parameters.reshape(-1, 3)[which]
        return Reading(values, by_tip, self.spread(which, by_one))

    def place(self, i: int, rows: Rows, tip: Tip, measured: Array | None) -> Array:
        """The middle of its nominal contacts, or of all."""
        points = tip.position[rows] if rows.size else tip.position
        return np.asarray(points.mean(axis=0))

    def lacking(self, inputs: Array) -> tuple[int, ...]:
        named = {int(i) for pair in self.distances for i in pair[:2]}
        return tuple(sorted(named.difference(self.of_rows(inputs).tolist())))

    def facts(self, parameters: Array) -> tuple[Array, Array]:
        places = parameters.reshape(-1, 3)
        table = np.array(self.distances).reshape(-1, 4)
        (i, j), (distance, std) = table[:, :2].T.astype(np.intp), table[:, 2:].T
        apart = places[j] - places[i]
        far = np.linalg.norm(apart, axis=1)
        apart[far == 0.0] = np.eye(3)[0]
        rows, pair = np.zeros((len(far), self.count, 3)), np.arange(len(far))
        rows[pair, j] = apart / np.where(far > 0.0, far, 1.0)[:, None] / std[:, None]
        rows[pair, i] = -rows[pair, j]
        return (distance - far) / std, rows.reshape(len(far), parameters.size)


@dataclasses.dataclass(frozen=True, eq=False)
class Plane(Landmarks):
    """One zero a touch: the tip's height above its plane.

    A constant, such as the radius of the probe, belongs to the plane. Where the arm
    stands is not shown, so ``base`` is held. ``places`` are rows (normal x, y, z,
    distance from the origin along it). Noise 0.01 % of the arm's length.
    """

    kind = "plane"
    lengths = True
    mounting = 0.004
    outputs = ("height",)
    zeros = True
    axes = ("tilt1", "tilt2", "offset")
    axis_units = ("deg", "deg", "length")
    needed = 3
    width = 4

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.places is not None:
            size = np.linalg.norm(self.places[:, :3], axis=1, keepdims=True)
            if not (size > 0.0).all():
                raise ValueError("planes must have normals other than zero")
            places = np.hstack([self.places[:, :3] / size, self.places[:, 3:]])
            object.__setattr__(self, "places", places)

    @property
    def nominal(self) -> Array:
        return (self._rows()[:, 3:] * [0.0, 0.0, 1.0]).ravel()

    def _rows(self) -> Array:
        if self.places is None:
            return np.tile([0.0, 0.0, 1.0, 0.0], (self.count, 1))
        return self.places

    def usual_noise(self, length: float) -> ArrayLike:
        return 1e-4 * length

    def read(self, tip: Tip, inputs: Array, parameters: Array) -> Reading:
        unit, by_tilt = self._normals(inputs, parameters)
        points = tip.position
        offset = parameters.reshape(-1, 3)[self.of_rows(inputs), 2]
        by_tip = np.hstack([unit, np.zeros_like(unit)])[:, None]
        by_tilts = (points[:, None] @ by_tilt)[:, 0]
        by_one = np.column_stack([by_tilts, -np.ones(len(points))])[:, None]
        values = ((unit * points).sum(axis=1) - offset)[:, None]
        return Reading(values, by_tip, self.spread(self.of_rows(inputs), by_one))

    def _normals(self, inputs: Array, parameters: Array) -> tuple[Array, Array]:
        """(N, 3) unit normals of the rows' planes, (N, 3, 2) by both tilts."""
        which = self.of_rows(inputs)
        normals = self._rows()[which, :3]
        first = np.cross(normals, np.eye(3)[np.abs(normals).argmin(axis=-1)])
        first /= np.linalg.norm(first, axis=-1, keepdims=True)
        across = np.radians(np.stack([first, np.cross(normals, first)], axis=-1))
        long = normals + (across @ parameters.reshape(-1, 3)[which, :2, None])[..., 0]
        size = np.linalg.norm(long, axis=1, keepdims=True)
        unit = long / size
        along = unit[:, None] @ across
        return unit, (across - unit[..., None] * along) / size[..., None]

    def place(self, i: int, rows: Rows, tip: Tip, measured: Array | None) -> Array:
        """Through its nominal points of touch."""
        points = tip.position[rows]
        if len(points) < self.needed:
            return self._rows()[i]
        middle = points.mean(axis=0)
        normal = np.linalg.svd(points - middle)[2][-1]
        normal = normal * (np.sign(normal[np.abs(normal).argmax()]) or 1.0)
        return np.append(normal, normal @ middle)


@dataclasses.dataclass(frozen=True, eq=False)
class Flush(Plane):
    """Three zeros: a flat face at the tip lies flush on its plane.

    Height of the tip above the plane, and how far the face's normal, the tip's z axis
    of either sign, leans from the plane's, in degrees. A turn about it, ``tool rz``, is
    not shown and held, as ``base`` is. Noise 0.01 % of the arm's length, 0.1 degrees.
    """

    kind = "flush"
    lengths = False
    tool = ("x", "y", "z", "rx", "ry")
    outputs = ("height", "lean x", "lean y")  # type: ignore[assignment]  # of three
    quantities = (Quantity("length", slice(1)), Quantity("deg", slice(1, 3)))

    def usual_noise(self, length: float) -> ArrayLike:
        return [1e-4 * length, 0.1, 0.1]

    def read(self, tip: Tip, inputs: Array, parameters: Array) -> Reading:
        height = super().read(tip, inputs, parameters)
        unit, by_tilt = self._normals(inputs, parameters)
        back = np.degrees(np.matrix_transpose(tip.rotation)[:, :2])  # (N, 2, 3)
        by_tip = np.zeros((len(unit), 2, 6))
        by_tip[..., 3:] = back @ hats(unit)
        by_one = np.zeros((len(unit), 2, 3))
        by_one[..., :2] = back @ by_tilt
        by_own = self.spread(self.of_rows(inputs), by_one)
        return Reading(
            np.hstack([height.values, (back @ unit[..., None])[..., 0]]),
            np.concatenate([height.by_tip, by_tip], axis=1),
            np.concatenate([height.by_own, by_own], axis=1),
        )


@dataclasses.dataclass(frozen=True, eq=False)
class Distance(Landmarks):
    """One length: the tip's distance from its anchor, less the zero of the wire.

    Where the arm stands is not shown, so ``base`` is held. ``places`` are rows (x, y,
    z, zero); the zero is known to 1 % of the arm's length. Noise 0.05 % of it.
    """

    kind = "distance"
    lengths = True
    outputs = ("length",)
    axes = ("x", "y", "z", "zero")
    axis_units = ("length",) * 4
    needed = 4
    width = 4

    def prior_std(self, length: float) -> Array:
        return np.tile([np.inf, np.inf, np.inf, 0.01 * length], self.count)

    def usual_noise(self, length: float) -> ArrayLike:
        return 5e-4 * length

    def read(self, tip: Tip, inputs: Array, parameters: Array) -> Reading:
        which = self.of_rows(inputs)
        places = parameters.reshape(-1, 4)[which]
        apart = tip.position - places[:, :3]
        far = np.linalg.norm(apart, axis=1, keepdims=True)
        unit = apart / np.where(far > 0.0, far, 1.0)
        by_tip = np.hstack([unit, np.zeros_like(unit)])[:, None]
        by_one = np.hstack([-unit, -np.ones_like(far)])[:, None]
        return Reading(far - places[:, 3:], by_tip, self.spread(which, by_one))

    def place(self, i: int, rows: Rows, tip: Tip, measured: Array | None) -> Array:
        """The anchor nearest to nominal points and lengths, from linear starts.

        One is linear in the anchor and its square; of one that is far the lengths are.
        The zero too, where lengths fit three times as well with another one (twice from
        30 lengths on), and to 2 % of the arm.
        """
        from scipy import optimize

        points, far = tip.position[rows], np.asarray(measured)[rows, 0]
        if len(points) < self.needed:
            raise ValueError(
                f"places are missing: anchor {i} has {len(points)} lengths, four are "
                "needed to find it"
            )
        middle = points.mean(axis=0)
        points = points - middle
        table = np.column_stack([points, np.full(len(points), 0.5), far])
        square = ((points**2).sum(axis=1) - far**2) / 2.0
        both = np.column_stack([square, -far])
        near, along = np.linalg.lstsq(table[:, :4], both, rcond=1e-6)[0][:3].T
        size = float(np.linalg.norm(along)) or 1.0
        loose = np.linalg.lstsq(table, square, rcond=1e-6)[0][[0, 1, 2, 4]]

        def apart(at: Array) -> Array:
            gaps = np.linalg.norm(points - at[:3], axis=1) - far - at[3:].sum()
            return np.asarray(gaps, dtype=float)

        def fit(*starts: Array) -> Array:
            fits = [optimize.least_squares(apart, one, method="lm") for one in starts]
            return np.asarray(min(fits, key=lambda one: one.cost).x)

        starts = near, along / size * far.mean()
        best = fit(*starts)
        loose = fit(loose, *(np.append(one, 0.0) for one in (*starts, best)))
        off, other = (np.median(np.abs(apart(at))) for at in (best, loose))
        better = min(off / (2.0 if len(points) > 29 else 3.0), 0.02 * tip.length)
        if other < better and len(points) > 10:
            best, off = loose, other
        if off > 0.2 * tip.length:
            raise ValueError(
                f"lengths to anchor {i} do not fit by {off:.3g}: measured must be in "
                f"the unit of the arm, whose length is {tip.length:.3g}, and commands "
                "in degrees"
            )
        return np.append(best[:3] + middle, best[3:].sum())
