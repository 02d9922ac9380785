"""What is not determined: the one rule, and such a direction in words.

Every judgement of what is singular is made here, of columns in comparable units. The
caller's own numbers (commands, blocks) are exact to half a unit in the last place of
their size, so a direction no wider than that says nothing (``rank_rule``,
``null_directions``). What was computed from them (derivatives, factors) is exact to
about 1e-13: what is below ``SINGULAR`` of the largest singular value says nothing
(``significant``).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal import compiled
from jaxcal.checks import Array, Mask

SINGULAR = 1e-10  # share of the largest singular value
SMALL = 1e-100  # numbers below and above its inverse are divided by powers of two
SURE = 1e5  # times the tolerance: distances above it leave no doubt of the rank
_EPS = float(np.finfo(np.float64).eps)
_TINY = float(np.finfo(np.float64).tiny)
_FLAT = 64.0 * _EPS  # of the size of what a number was computed from
_OFF = 8.0  # times the share that columns are off: of r columns together
_NONE = 1e-7  # of the largest entry of a direction: its rounding where it nearly exists


def power_of_two(size: NDArray[Any]) -> Array:
    """The power of two at or below each of ``size``, 1 for 0: an exact unit."""
    exponent = np.clip(np.frexp(size)[1] - 1, -1000, 1000)
    return np.asarray(np.ldexp(1.0, np.where(size > 0.0, exponent, 0)))


def _lengths(
    columns: Array, largest: Array, count: int, computed: bool
) -> tuple[Array, Array]:
    """Lengths (S, p) of columns (S, R, p), zero where they are rounding, and the share
    (S,) of each set that is; arguments as of ``rank_rule``."""
    resolution = _EPS * max(count, 1)
    lengths = np.sqrt((columns * columns).sum(axis=1))
    with np.errstate(over="ignore"):  # of a column without a length
        beside = largest / np.maximum(lengths, _TINY)
    most = beside.max(axis=1, initial=8.0)
    if not most.max() < 1.0 / resolution:
        lengths[beside >= 1.0 / resolution] = 0.0
        beside[lengths == 0.0] = 0.0
        most = beside.max(axis=1, initial=8.0)
    rounding = resolution * most
    return lengths, np.maximum(rounding, SINGULAR) if computed else rounding


def rank_rule(
    columns: Array, largest: Array, count: int | None = None, computed: bool = False
) -> tuple[list[int], Array]:
    """(S,) ranks and natural log det (-inf below rank p) of ``columns.T @ columns``, of
    S sets of centred columns (S, R, p) and their ``largest`` entries (S, p) before
    that. Rounding errors add up over ``count`` rows, R by default; ``computed`` columns
    are rounded themselves, as a model's derivatives are."""
    num_rows, p = columns.shape[1:]
    lengths, rounding = _lengths(columns, largest, count or num_rows, computed)
    ranks = [p] * len(columns)
    unit = columns / np.maximum(lengths, _TINY)[:, None]
    if not lengths.all():  # what is rounding is no column
        unit *= (lengths > 0.0)[:, None]
    distances = np.zeros((len(columns), p))  # of each column to the span before it
    if num_rows >= p:  # their product is the volume: cheaper than singular values
        factor: Array = np.linalg.qr(unit, mode="raw")[0]
        distances = np.abs(factor.diagonal(axis1=1, axis2=2))
    value = 2.0 * np.log(np.maximum(distances * lengths, _TINY)).sum(axis=1)
    unsure = distances.min(axis=1) <= SURE * rounding
    for n in np.flatnonzero(unsure) if unsure.any() else ():
        singular_values = np.linalg.svd(unit[n], compute_uv=False)
        ranks[n] = int((singular_values > rounding[n]).sum())
        if ranks[n] < p:
            value[n] = -np.inf
    return ranks, value


def null_directions(
    columns: Array, largest: Array, computed: bool = False
) -> list[Array]:
    """Directions (p,) of which ``columns`` (R, p) say nothing by ``rank_rule``. Axes
    that no row moves come first, then a basis of the rest of the null space."""
    if len(columns):  # does the kernel leave no doubt that they are independent?
        kernel = compiled.kernel("jaxcal.information.rank_kernel")
        share = SINGULAR if computed else 0.0
        blocks, none = columns[None, :, None], np.zeros((0, len(largest)))
        if kernel.clear_log_dets(blocks, none, largest, SMALL, share, SURE)[1]:
            return []
    p, scale = columns.shape[1], power_of_two(largest)
    columns, largest = columns / scale, largest / scale
    lengths, shares = _lengths(columns[None], largest[None], len(columns), computed)
    norms, rounding = lengths[0], shares[0]
    still = norms == 0.0
    unit = columns / np.where(still, np.inf, norms)
    if len(unit) < p:
        unit = np.concatenate([unit, np.zeros((p - len(unit), p))])
    _, singular, right = np.linalg.svd(unit, full_matrices=False)
    if p and singular[-1] > rounding:
        return []
    null = [np.eye(p)[i] for i in np.flatnonzero(still)]
    free = right[singular <= rounding][:, ~still]
    if free.size:
        basis, size, _ = np.linalg.svd(free.T, full_matrices=False)
        for vector in exact_zeros(basis.T[size > 0.5]):
            direction = np.zeros(p)
            direction[~still] = vector / norms[~still] * (scale.min() / scale[~still])
            null.append(direction)
    return null


def significant(size: NDArray[Any], squares: bool = False, off: float = 0.0) -> Mask:
    """Which singular values (..., r) of columns in comparable units are no rounding;
    or (``squares``) eigenvalues of a product of these columns with themselves. ``off``
    is the share by which columns are off beyond rounding, as differences are."""
    share = 8.0 * _EPS * size.shape[-1] if squares else max(SINGULAR, _OFF * off)
    return size > share * size.max(axis=-1, initial=0.0, keepdims=True)


def flat(size: NDArray[Any], beside: Any) -> Mask:
    """Which columns of ``size`` are rounding of what they were computed ``beside``."""
    return np.asarray(size <= _FLAT * beside)


def exact_zeros(directions: Array, off: float = 0.0) -> Array:
    """Directions (..., p) in comparable units, entries that are rounding made 0."""
    size = np.abs(directions)
    least = max(_NONE, _OFF * off) * size.max(axis=-1, initial=0.0, keepdims=True)
    return np.where(size > least, directions, 0.0)


def depends(slopes: Array, directions: Array) -> Mask:
    """Which outputs of ``slopes`` (..., p) one of ``directions`` (z, p) changes."""
    moved = np.abs(slopes @ directions.T)
    return np.asarray((moved > _NONE * (np.abs(slopes) @ np.abs(directions.T))).any(-1))


def require_excited(
    commands: Array,
    names: tuple[str, ...],
    argument: str = "commands",
    which: str = "postures",
) -> None:
    """Refuse commands (N, n) that leave a direction unexcited, and name it; the message
    calls them ``argument`` ("candidates") and ``which`` ("available ones")."""
    count, n = commands.shape
    offset = commands - commands.sum(axis=0) / count if count else commands
    largest = np.abs(commands).max(axis=0, initial=0.0)
    null = null_directions(offset, largest)
    if count >= n + 1 and not null:
        return
    same = directions_in_words("the same in every row: ", null, names)
    if count < n + 1:
        raise ValueError(
            f"{argument} must hold {n + 1} or more rows to fit {n} inputs plus an "
            f"offset, got {count}" + (f"; {same}" if same else "")
        )
    place = {1: "at one point", 2: "on one line"}.get(n, "in one plane")
    raise ValueError(
        f"{argument} must vary in every direction, but the {count} {which} lie "
        f"{place}; {same}"
    )


def directions_in_words(text: str, null: list[Array], names: tuple[str, ...]) -> str:
    """``text`` with its plural at {}, then every direction; empty if there is none."""
    if not null:
        return ""
    named = "; ".join(direction_in_words(vector, names) for vector in null)
    return text.format("s" if len(null) > 1 else "") + named


def direction_in_words(vector: Array, names: tuple[str, ...]) -> str:
    """A direction in the named axes, largest component positive, unit length."""
    vector = vector / np.abs(vector).max()
    vector = vector / np.linalg.norm(vector)
    size = np.abs(vector)
    vector = vector * np.sign(vector[(size > (1.0 - 1e-9) * size.max()).argmax()])
    present = np.flatnonzero(vector)
    if present.size == 1:
        return names[present[0]]
    parts = [f"{vector[i]:+.4g} {names[i]}" for i in present]
    return "(" + " ".join(parts) + ")"
