"""The problem of a fit, its losses, and the factors of its linear systems."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
from numpy.typing import NDArray

from jaxcal.checks import Array, Mask
from jaxcal.information.blocks import gram, triangle
from jaxcal.information.singular import significant
from jaxcal.models.model import Model

_MANY = 64  # readings of a measurement from which matrices of them are not made
_CHOLESKY = 1e-6  # least pivot, of the largest, at which it is as exact as reflections
_ONCE = 1e-3  # likewise, at which a single one is exact to 1e-8 or so
_CLEAR = 1e8  # most by which directions differ that are determined without a doubt
_LARGER = 0.05  # of its logarithm: no machine is larger than described by more
_TOUCHED = 4.0  # times the usual noise: most that is read of what is touched


class Loss:
    """Student's distribution: outliers count little, all others nearly in full.

    Iteratively reweighted least squares needs the weight of a measurement and its slope
    (Lange, Little and Taylor, 1989). A loss of one's own is a row in ``LOSSES``; at the
    fit its weight is one, so that without large residuals it is least squares.
    """

    degrees_of_freedom = 4.0

    def weight(self, square: Array, q: int) -> Array:
        """(N,) of measurements of q readings, at squared distances (N,) in noise."""
        size = self.degrees_of_freedom + q
        return np.asarray(size / (size + square))

    def slope(self, square: Array, q: int) -> Array:
        """(N,) derivative of the weight by the squared distance."""
        size = self.degrees_of_freedom + q
        return np.asarray(-size / (size + square) ** 2)


@functools.lru_cache
def constants(loss: Loss, q: int) -> tuple[float, float, float]:
    """What a loss does where the noise of q readings is normal.

    Returns:
        Mean weighted squared residual of a reading of unit noise; mean weight;
        efficiency relative to least squares.
    """
    from scipy import linalg

    # Golub and Welsch: Gauss-Laguerre nodes, whatever q is (gamma(q / 2) overflows).
    index, order = np.arange(60.0), q / 2.0 - 1.0
    beside = np.sqrt(index[1:] * (index[1:] + order))
    node, vectors = linalg.eigh_tridiagonal(2.0 * index + 1.0 + order, beside)
    share, square = vectors[0] ** 2, 2.0 * node
    weight = loss.weight(square, q)
    slope = share @ (weight + 2.0 * square * loss.slope(square, q) / q)
    efficiency = slope**2 / (share @ (weight**2 * square) / q)
    return float(share @ (weight * square) / q), float(share @ weight), efficiency


LOSSES: dict[str, Loss | None] = {"student": Loss(), "gaussian": None}


@dataclasses.dataclass(frozen=True)
class FitProblem:
    """N measurements of q outputs, P parameters of which F are free."""

    model: Model
    commands: Array  # (N, n)
    measured: Array  # (N, q)
    white: Array  # (N, q, q) whitening of the readings, at level 1; (N, q) a diagonal
    reading_std: Array  # (N, q) of a reading of weight 1, at level 1
    mean: Array  # (P,) of the prior
    precision: Array  # (P,) of the prior, 0 where nothing is known
    free: Mask  # (P,) False: held at the mean
    command_std: Array  # (N, n) 0 exact, inf unknown in every measurement
    noise_known: bool  # the level is 1; else it is estimated
    levels: NDArray[np.intp]  # (q,) from 0: outputs of the same number share one
    loss: Loss | None  # None: least squares
    first_log_size: Array | None  # (N,) of the model, at the prior's mean

    def growth(self, theta: Array) -> Array | None:
        """(N, 1) by which contacts' readings are larger than at the prior's mean, up to
        ``_LARGER``, or a tool would grow without end; None: by nothing."""
        if self.first_log_size is None:
            return None
        log = np.asarray(self.model.fitting.log_size(self.commands, theta))
        larger = np.minimum(log - self.first_log_size, _LARGER)
        return np.exp(self._zeros * larger[:, None])

    def growth_slopes(self, theta: Array) -> Array:
        """(N, F) derivative of the logarithm of ``growth``."""
        slopes = self.model.fitting.log_size_jacobian(self.commands, theta)
        log = self.model.fitting.log_size(self.commands, theta)
        if log is not None and self.first_log_size is not None:
            slopes = slopes * (log - self.first_log_size < _LARGER)[:, None]
        return self._zeros * (slopes if self.free.all() else slopes[:, self.free])

    @functools.cached_property
    def _zeros(self) -> Array:
        """(N, 1) 1 where no more was measured than contacts miss by, else 0."""
        noise = self.model.default_noise()
        most = 0.0 if noise is None else _TOUCHED * np.asarray(noise.std)
        near = np.all(np.abs(self.measured) <= most, axis=1, keepdims=True)
        return np.asarray(near, dtype=np.float64)

    @functools.cached_property
    def least_levels(self) -> Array:
        """(q,) levels that are rounding; of readings that are zero, as those of
        contacts, in usual noise."""
        if self.noise_known:
            return np.zeros(len(self.levels))
        readings = weighted(self.white, self.measured[..., None])
        largest = np.abs(readings).max(axis=(0, 2))
        if not largest.all():
            largest[largest == 0.0] = largest.max() or 1e7
        return np.asarray(1e-13 * largest)

    def blur(self, white: Array, level: Array, weights: Array) -> float:
        """By how much the noise of the model itself may change the cost."""
        noise = self.model.fitting.rounding
        if noise is None or self.white.ndim > 2:
            return 0.0
        off, share = self.white * noise / level, np.sqrt(weights)[:, None]
        beside = np.linalg.norm(share**2 * off * white / level)
        return float(4.0 * beside + 2.0 * np.linalg.norm(share * off) ** 2)


def weighted(matrices: Array, rows: Array) -> Array:
    """(N, q, F) rows times matrices (N, q, q), or their diagonals (N, q)."""
    return matrices[..., None] * rows if matrices.ndim == 2 else matrices @ rows


def apart(rows: Array) -> list[NDArray[np.intp]]:
    """Columns of rows (R, F) in groups that no row joins, as of independent outputs,
    so that a rounding of one is none of another."""
    filled = (rows != 0.0).astype(np.float64)
    joined = filled.T @ filled > 0.0
    np.fill_diagonal(joined, True)
    if joined.all():
        return [np.arange(rows.shape[1])]
    from scipy.sparse import csgraph

    count, group = csgraph.connected_components(joined)
    return [np.flatnonzero(group == k) for k in range(count)]


def singular(rows: Array) -> list[tuple[NDArray[np.intp], Array, Array]]:
    """For each group of ``apart`` columns (c,) of F or more rows (R, F): these,
    singular values, right vectors (c, c)."""
    groups = apart(rows)
    sizes = {len(columns) for columns in groups}
    if len(sizes) == 1 and len(rows) <= 128:  # all at once
        of_groups = rows.T[np.array(groups)].transpose(0, 2, 1)
        _, size, right = np.linalg.svd(of_groups, full_matrices=False)
        return list(zip(groups, size, right, strict=True))
    factors = [np.linalg.svd(triangle(rows[:, columns])) for columns in groups]
    return [(groups[i], size, right) for i, (_, size, right) in enumerate(factors)]


def directions(rows: Array, scale: Array) -> tuple[Array, Array | None]:
    """(F, r) changes of the parameters by rows (R, F), divided by ``scale`` (F,), those
    that nothing determines left out, orthogonal in what they change; and the rows by
    them, where at hand."""
    inverse, across = cholesky(rows, 0.0)
    # The least singular value is above one over the length of the inverse.
    if inverse is not None and np.vdot(inverse, inverse) * len(scale) < _CLEAR**2:
        return inverse / scale[:, None], across
    if len(rows) < len(scale):
        rows = np.concatenate([rows, np.zeros((len(scale), len(scale)))])
    blocks = []
    for columns, size, right in singular(rows):
        determined = np.flatnonzero(significant(size))
        block = np.zeros((rows.shape[1], len(determined)))
        turned = right[determined] / size[determined, None] / scale[columns]
        block[columns] = turned.T
        blocks.append(block)
    return np.hstack(blocks), None


def unseen_part(mean: Array, basis: Array) -> Array:
    """(F,) of ``mean`` (F,) across the directions ``basis`` (F, r)."""
    size = np.linalg.norm(basis, axis=1)
    size = np.where(size > 0.0, size, 1.0)
    shown = np.linalg.lstsq(basis / size[:, None], mean / size, rcond=None)[0]
    return np.asarray(mean - basis @ shown)


def degrees_of_freedom(readings: Array, residuals: Array, slopes: Array) -> Array:
    """(q,) of residuals (N, q), by roots of the hat matrix (N, q, F). A reading that
    nothing moves and that is met is none, as where sensors of one arm have different
    numbers of readings."""
    freedom = len(residuals) - np.vecdot(readings, readings).sum(axis=0)
    if (met := residuals == 0.0).any():
        freedom -= (met & (slopes == 0.0).all(axis=-1)).sum(axis=0)
    whole = np.rint(freedom)
    return np.where(np.abs(freedom - whole) < 1e-9, whole, freedom)


def deleted_residuals(readings: Array, right: Array) -> Array:
    """(N, R) residuals of each measurement from the fit without it, by roots of the hat
    matrix (N, R, F) and residuals ``right`` (N, R)."""
    count, columns = readings.shape[1:]
    back = readings.transpose(0, 2, 1)
    if count <= max(_MANY, columns):
        gap = (1.0 + 1e-9) * np.eye(count) - readings @ back
        return np.asarray(np.linalg.solve(gap, right[..., None])[..., 0])
    one = 1.0 + 1e-9  # by the F columns, of a trajectory of many readings
    inner = one * np.eye(columns) - back @ readings
    along = np.linalg.solve(inner, back @ right[..., None])
    return np.asarray((right + (readings @ along)[..., 0]) / one)


def factor(rows: Array, damping: float, once: bool = False) -> tuple[Array, Array]:
    """The inverse of R (F, F), and Q (R, F), of the damped rows (R, F); ``once``: 1e-8
    or so is enough."""
    inverse, across = cholesky(rows, damping, once)
    if inverse is not None:
        return inverse, across
    damp = np.sqrt(damping) * np.eye(rows.shape[1])
    whole, triangle = np.linalg.qr(np.concatenate([rows, damp]))
    return np.linalg.inv(triangle), whole[: len(rows)]


def cholesky(
    rows: Array, damping: float, once: bool = False
) -> tuple[Array | None, Array]:
    """The inverse of R, and Q of the damped rows (R, F); None where it is not exact.
    Cholesky twice (Yamamoto et al., 2015) is as exact as Householder's reflections
    where it succeeds, and does not wait for BLAS's threads in every column."""
    from scipy.linalg.lapack import dpotrf, dtrtri

    turned, inverse = rows, None
    for _ in range(2):
        square = gram(turned)
        if damping and inverse is None:
            square += damping * np.eye(len(square))
        elif damping and inverse is not None:
            square += damping * (inverse.T @ inverse)
        root, failed = dpotrf(square)
        size = root.diagonal().tolist()
        if failed or (size and min(size) < _CHOLESKY * max(size)):
            return None, rows
        step = dtrtri(root)[0]
        inverse = step if inverse is None else inverse @ step
        turned = rows @ inverse
        if once and min(size) > _ONCE * max(size):
            break
    return inverse, turned


def eliminated(
    rows: Array,
    right: Array,
    by_command: Array,
    root: Array,
    moved: Array,
    damping: float,
) -> tuple[Array, Array, tuple[Array, Array, Array]]:
    """Rows (N, R, F) and residuals (N, R) across k uncertain commands, and what these
    follow from: by derivatives (N, q, k), one over their std (N, k) and how far they
    have ``moved`` (N, k) in it."""
    count, k = rows.shape[1], root.shape[1]
    by_command = np.concatenate([by_command, root[..., None] * np.eye(k)], axis=1)
    length = np.sqrt((by_command**2).sum(axis=1))[:, :, None] * np.eye(k)
    by_command = np.concatenate([by_command, np.sqrt(damping) * length], axis=1)
    right = np.concatenate([right, moved, 0.0 * moved], axis=1)
    turn, upper = np.linalg.qr(by_command, mode="complete")
    turn = np.matrix_transpose(turn)
    rows = turn[..., :count] @ rows
    right = (turn @ right[..., None])[..., 0]
    return rows[:, k:], right[:, k:], (upper[:, :k], rows[:, :k], right[:, :k])
