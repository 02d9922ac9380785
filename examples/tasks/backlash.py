"""Backlash and dead zone of a joint behind its drive.

With play of some width between drive and joint, the joint stays behind the drive by
half the width, on the side it comes from, and a move the other way first takes up the
play. A measurement is a posture and the direction in which it is reached: the axis
comes to zero against that direction, from far enough, and then goes on to the posture.
Postures within the play leave the joint where it was. Which ones these are depends on
the unknown width, and so does the information of a posture.

The output of a dead zone is 0 while the command is within half its width of a centre,
else the signed distance of the command from the zone, whatever the direction.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

from jaxcal.adaptive.grid import GridTask
from jaxcal.adaptive.tasks.registry import Entry
from jaxcal.checks import numbers, whole_number

__all__ = [
    "DEAD_ZONE",
    "ENTRY",
    "Bins",
    "backlash",
    "backlash_bins",
    "dead_zone",
    "dead_zone_bins",
    "past_zone",
    "residual",
]

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Bins:
    """``count`` equal bins from ``low`` to ``high``; the outer two are unbounded."""

    low: float
    high: float
    count: int

    def __post_init__(self) -> None:
        whole_number("bins", self.count, 2)
        if not self.low < self.high:
            raise ValueError(
                f"bins must have low under high, got {self.low:g} and {self.high:g}"
            )

    @property
    def edges(self) -> Array:
        """(count - 1,) between neighbours."""
        return np.linspace(self.low, self.high, self.count + 1)[1:-1]

    def outcome(self, reading: float) -> int:
        """The bin of a reading."""
        return int(np.searchsorted(self.edges, reading, side="right"))

    def likelihood(self, mean: ArrayLike, sigma: float, outliers: float = 0.0) -> Array:
        """(A, count, S) probability of each bin, integrated over it.

        Args:
            mean: (A, S) readings without noise.
            sigma: standard deviation of the normal noise.
            outliers: share of readings that fall into every bin with equal probability.
        """
        if not sigma > 0.0:
            raise ValueError(f"sigma must be above 0, got {sigma:g}")
        if not 0.0 <= outliers < 1.0:
            raise ValueError(f"outliers must be in [0, 1), got {outliers:g}")
        below = special.ndtr(
            (self.edges[None, :, None] - np.asarray(mean)[:, None]) / sigma
        )
        inside = np.diff(below, axis=1, prepend=0.0, append=1.0)
        return outliers / self.count + (1.0 - outliers) * inside


def residual(
    posture: ArrayLike, direction: ArrayLike, width: ArrayLike, offset: ArrayLike
) -> Array:
    """Reading less command at a posture that is reached in a direction.

    Args:
        posture: distance from zero, at least 0, in ``direction``.
        direction: 1 or -1, of the last move.
        width: of the play.
        offset: reading less command in the middle of the play.
    """
    half = np.asarray(width) / 2.0
    behind = np.maximum(half - np.asarray(posture), -half)
    return np.asarray(offset) + np.asarray(direction) * behind


def backlash_bins(max_width: float, max_offset: float, bin_width: float) -> Bins:
    """Bins of the residual reading that hold everything without noise."""
    reach = max_width / 2.0 + max_offset + bin_width
    count = int(np.ceil(2.0 * reach / bin_width))
    return Bins(-count * bin_width / 2.0, count * bin_width / 2.0, count)


def backlash(
    max_width: float = 1.0,
    max_offset: float = 0.1,
    *,
    cells: int = 50,
    offset_cells: int = 11,
    postures: ArrayLike | None = None,
    sigma: float = 0.02,
    bin_width: float = 0.04,
    outliers: float = 1e-3,
    measure_s: float = 1.0,
    speed: float = 5.0,
    measurements: int = 20,
    seconds: float | tuple[float, float] = np.inf,
) -> GridTask:
    """The task: theta = (width, offset), design = (posture, direction).

    An outcome is the bin, of ``backlash_bins``, of the reading less the signed
    posture. All angles are in one unit, such as degrees.

    Args:
        max_width: of the play; cells are equal from 0, the values their centres.
        max_offset: largest offset of the reading either way.
        cells: of the width.
        offset_cells: of the offset.
        postures: (N,) distances from zero, at least 0; 12 up to 1.5 of ``max_width``
            when not given.
        sigma: noise of a reading.
        bin_width: of the outcomes.
        outliers: share of readings that carry no information.
        measure_s: seconds of a reading.
        speed: of the axis, per second. A measurement runs up from 1.5 of ``max_width``
            on the other side.
        measurements: that end a session.
        seconds: budget of a session, or (least, most) to draw it from.
    """
    far = 1.5 * max_width
    at = (
        np.linspace(0.0, far, 12) if postures is None else numbers("postures", postures)
    )
    if at.ndim != 1 or not len(at) or (at < 0.0).any():
        raise ValueError(f"postures must be (N,), at least 0, got {at.tolist()}")
    bins = backlash_bins(max_width, max_offset, bin_width)
    widths = (np.arange(cells) + 0.5) * max_width / cells
    offsets = (np.arange(offset_cells) + 0.5) * 2.0 * max_offset / offset_cells
    theta = np.array([(w, o - max_offset) for w in widths for o in offsets])
    designs = np.array([(u, d) for d in (1.0, -1.0) for u in at])
    mean = residual(
        designs[:, :1], designs[:, 1:], theta[None, :, 0], theta[None, :, 1]
    )
    # From the present posture to ``far`` on the other side, then to the posture.
    stands = np.append(designs[:, 0] * designs[:, 1], 0.0)
    turn = -designs[:, 1] * far
    way = np.abs(stands[:, None] - turn) + far + designs[:, 0]
    return GridTask.make(
        theta,
        designs,
        bins.likelihood(mean, sigma, outliers),
        groups=np.repeat([0, 1], len(at)),
        travel=measure_s + way / speed,
        uses=1,
        num_uses=measurements,
        horizon=measurements,
        seconds=seconds,
        theta_names=["width", "offset"],
    )


def past_zone(command: ArrayLike, width: ArrayLike, centre: ArrayLike) -> Array:
    """Output of a dead zone for a command."""
    off = np.asarray(command) - np.asarray(centre)
    return np.asarray(np.sign(off) * np.maximum(np.abs(off) - np.divide(width, 2), 0.0))


def dead_zone_bins(
    max_width: float, reach: float, bin_width: float, relative: bool = False
) -> Bins:
    """Bins of the reading that hold everything without noise.

    Args:
        max_width, reach, bin_width: as of the task.
        relative: to the reading at a reference, and less the command.
    """
    highest = max_width + bin_width if relative else reach + max_width / 2.0 + bin_width
    count = int(np.ceil(2.0 * highest / bin_width))
    return Bins(-count * bin_width / 2.0, count * bin_width / 2.0, count)


def dead_zone(
    max_width: float = 1.0,
    max_offset: float = 0.25,
    *,
    cells: int = 40,
    offset_cells: int = 20,
    reach: float = 1.0,
    reference: float | None = None,
    num_postures: int = 33,
    sigma: float = 0.05,
    bin_width: float = 0.05,
    outliers: float = 1e-3,
    measurements: int = 20,
) -> GridTask:
    """The task: theta = (width, centre), design = (command,), outcome a bin.

    Args:
        max_width: of the zone; the values are the centres of equal cells from 0.
        max_offset: largest distance of the zone's centre from zero.
        cells: of the width.
        offset_cells: of the centre.
        reach: largest command either way.
        reference: a command; outcomes are then reading less command, minus the same at
            the reference, for an instrument of unknown zero. Plain readings when None.
        num_postures: commands, evenly spaced.
        sigma: noise of a reading.
        bin_width: of the outcomes, of ``dead_zone_bins``.
        outliers: share of readings that carry no information.
        measurements: that end a session.
    """
    relative = reference is not None
    bins = dead_zone_bins(max_width, reach, bin_width, relative)
    widths = (np.arange(cells) + 0.5) * max_width / cells
    centres = (np.arange(offset_cells) + 0.5) * 2.0 * max_offset / offset_cells
    theta = np.array([(w, c - max_offset) for w in widths for c in centres])
    at = np.linspace(-reach, reach, num_postures)
    mean = past_zone(at[:, None], theta[:, 0], theta[:, 1])
    if reference is not None:
        mean -= at[:, None] + past_zone(reference, theta[:, 0], theta[:, 1]) - reference
    return GridTask.make(
        theta,
        at,
        bins.likelihood(mean, sigma, outliers),
        uses=1,
        num_uses=measurements,
        horizon=measurements,
        theta_names=["width", "centre"],
    )


ENTRY = Entry(backlash, about="width of a joint's play, by posture and direction")
DEAD_ZONE = Entry(dead_zone, about="width and centre of a dead zone, by command")
