"""The geometry a policy sees, in JAX: whitening, projection, volumes, log-determinants.

The best subset does not change under an affine map of the commands, so the policy
works on whitened regressors ``x_i`` (mean over the candidates of ``x x.T`` is the
identity; ``x_i . x_j / M`` is the hat matrix). What a choice does to the remaining
candidates is a projection: the chosen direction leaves every ``x_i``, and the squared
length of what is left is the gain. All functions broadcast over leading axes and use
no library factorisation: for matrices of 3 to 5 rows unrolled arithmetic is faster on a
batch, the same on every backend, and has a gradient.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

__all__ = [
    "cholesky",
    "cholesky_pivots",
    "log_det_gram",
    "log_det_lengths",
    "lookahead",
    "normalised_by",
    "num_starts",
    "picked",
    "plus_ridge",
    "projected",
    "row_dot",
    "row_parts",
    "row_sum",
    "solve_lower",
    "whiten",
]

_TINY = 1e-12  # below any squared length that float32 commands in [0, 1] can show
_ALL_START = 1024  # candidates up to which every one is looked ahead from
_STARTS = 512  # of more candidates, those of largest gain that are
_UNROLLED_ROWS = 16  # rows up to which sums over them are written out
_LEAST_GAIN = 1e-5  # of a whitened vector: below it float32 shows the rounding of zero


def cholesky(matrix: jax.Array) -> jax.Array:
    """Lower Cholesky factor of small symmetric positive definite matrices.

    Args:
        matrix: (..., p, p). Pivots are kept positive, so the result is finite.

    Returns:
        (..., p, p) lower triangular.
    """
    p = matrix.shape[-1]
    rows = [[matrix[..., i, j] for j in range(i + 1)] for i in range(p)]
    lower = _factored(rows)
    zero = jnp.zeros_like(matrix[..., 0, 0])
    return jnp.stack(
        [jnp.stack(row + [zero] * (p - len(row)), axis=-1) for row in lower], axis=-2
    )


def cholesky_pivots(rows: list[list[jax.Array]]) -> list[jax.Array]:
    """Diagonal of the lower factor of a matrix held as rows of its lower triangle."""
    return [row[-1] for row in _factored(rows)]


def _factored(rows: list[list[jax.Array]]) -> list[list[jax.Array]]:
    """Lower Cholesky factor, entry by entry; pivots are kept positive."""
    lower: list[list[jax.Array]] = []
    for i, row in enumerate(rows):
        done: list[jax.Array] = []
        for j, value in enumerate(row):
            above = done if i == j else lower[j]
            for k in range(j):
                value = value - done[k] * above[k]
            if i == j:
                done.append(jnp.sqrt(jnp.maximum(value, _TINY)))
            else:
                done.append(value / lower[j][j])
        lower.append(done)
    return lower


def plus_ridge(matrix: jax.Array, ridge: float) -> jax.Array:
    """(..., p, p) with ``ridge`` added to the diagonal."""
    eye = jnp.eye(matrix.shape[-1], dtype=matrix.dtype)
    return matrix + ridge * jnp.broadcast_to(eye, matrix.shape)


def solve_lower(lower: jax.Array, rows: jax.Array) -> jax.Array:
    """Rows ``r`` of the solution of ``lower @ r = row``, by forward substitution.

    Args:
        lower: (..., p, p) lower triangular.
        rows: (..., M, p) right-hand sides, one a row.

    Returns:
        (..., M, p).
    """
    out: list[jax.Array] = []
    for j in range(lower.shape[-1]):
        value = rows[..., j]
        for i, known in enumerate(out):
            value = value - lower[..., j, i][..., None] * known
        out.append(value / lower[..., j, j][..., None])
    return jnp.stack(out, axis=-1)


def whiten(candidates: jax.Array, usable: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Whitened regressors of a candidate set.

    Args:
        candidates: (..., M, n) commands.
        usable: (..., M) bool, the candidates that count (available or chosen).

    Returns:
        (..., M, n + 1) vectors x with mean ``x x.T = I`` over the usable candidates,
        zero elsewhere, and (...,) the log-determinant of ``Z_s.T Z_s`` of a subset less
        that of ``X_s.T X_s``.
    """
    weight = usable.astype(candidates.dtype)
    number = jnp.maximum(weight.sum(-1), 1.0)
    mean = (weight[..., None] * candidates).sum(-2, keepdims=True)
    centred = (candidates - mean / number[..., None, None]) * weight[..., None]
    covariance = jnp.einsum(
        "...mi,...mj->...ij", centred, centred, precision=jax.lax.Precision.HIGHEST
    )
    lower = cholesky(covariance / number[..., None, None])
    white = solve_lower(lower, centred)
    offset = 2.0 * jnp.log(jnp.diagonal(lower, axis1=-2, axis2=-1)).sum(-1)
    return jnp.concatenate([white, weight[..., None]], axis=-1), offset


def projected(x: jax.Array, chosen: jax.Array) -> jax.Array:
    """What is left of every vector once the chosen ones are projected out.

    Args:
        x: (..., M, p).
        chosen: (..., c, p) vectors chosen so far.

    Returns:
        (..., M, p); squared lengths are the Schur-complement gains.
    """
    # Component by component: XLA's CPU backend (jaxlib 0.10.2) computes the reduction
    # form wrongly where x is shared by a vmapped axis and chosen is not.
    p = x.shape[-1]
    rest = [x[..., i] for i in range(p)]
    basis: list[list[jax.Array]] = []
    for j in range(chosen.shape[-2]):
        v = [chosen[..., j, i] for i in range(p)]
        scale = _dot(v, v)
        for e in basis:
            along = _dot(v, e)
            v = [a - along * b for a, b in zip(v, e, strict=True)]
        square = _dot(v, v)
        independent = square > 1e-9 * scale
        factor = jax.lax.rsqrt(jnp.where(independent, square, 1.0))
        factor = jnp.where(independent, factor, 0.0)
        basis.append([a * factor for a in v])
    for e in basis:
        wide = [b[..., None] for b in e]
        along = _dot(rest, wide)
        rest = [a - along * b for a, b in zip(rest, wide, strict=True)]
    return jnp.stack(rest, axis=-1)


def _dot(a: list[jax.Array], b: list[jax.Array]) -> jax.Array:
    """Inner product of vectors held as lists of components."""
    total = a[0] * b[0]
    for left, right in zip(a[1:], b[1:], strict=True):
        total = total + left * right
    return total


def normalised_by(
    x: jax.Array, chosen: jax.Array, ridge: float
) -> tuple[jax.Array, jax.Array]:
    """Every vector in the metric of the chosen: ``|y_i|^2 = x_i.T G^-1 x_i``.

    Args:
        x: (..., M, p).
        chosen: (..., c, p) vectors chosen so far.
        ridge: ``G = C.T C + ridge I``; 0 needs vectors that span the space.

    Returns:
        (..., M, p) vectors y: choosing i multiplies det G by ``1 + |y_i|^2``; and
        (...,) log det G.
    """
    p = x.shape[-1]
    gram = jnp.einsum(
        "...ci,...cj->...ij", chosen, chosen, precision=jax.lax.Precision.HIGHEST
    )
    gram = jnp.broadcast_to(gram, (*x.shape[:-2], p, p))
    lower = cholesky(plus_ridge(gram, max(ridge, 1e-6)))
    log_det = 2.0 * jnp.log(jnp.diagonal(lower, axis1=-2, axis2=-1)).sum(-1)
    return solve_lower(lower, x), log_det


def lookahead(
    y: jax.Array,
    spanned: bool,
    active: jax.Array,
    depth: int,
    tolls: jax.Array | None = None,
) -> list[jax.Array]:
    """How far each candidate leads when the choices after it are greedy.

    Args:
        y: (..., M, p) conditional vectors (``projected`` or ``normalised_by``), zero
            where not active.
        spanned: True where choosing i multiplies the determinant by ``1 + |y_i|^2``,
            False where by ``|y_i|^2``.
        active: (..., M) bool.
        depth: choices to look at, that candidate included; at least 1.
        tolls: (..., M, M) what choosing j right after i costs, in logarithms; greedy
            is then by the gain less the toll, and the values are less the tolls.

    Returns:
        ``depth`` arrays (..., M): the log of the factor by which the determinant grows
        over the first 1, 2, ... choices; -30 where not active. The first is the gain.
        The second is the gain of the best pair, exactly; later ones are what greedy
        choices reach. Cost: ``depth - 1`` products of (S, p) with (p, M), where
        S = ``num_starts(M)``. Of more than 1,024 candidates only the 512 of largest
        gain are looked ahead from; the others have -30 after the first choice.
    """
    m = y.shape[-2]
    base = 1.0 if spanned else 0.0
    square = (y * y).sum(-1)
    first = jnp.log(jnp.maximum(base + square, _LEAST_GAIN))
    values = [jnp.where(active, first, -30.0)]
    if depth == 1:
        return values
    # For every start i (axis -2): the gains of all j (axis -1) after its choices.
    number = num_starts(m)
    shape = (*square.shape[:-1], number, m)
    if number < m:
        starts = jax.lax.top_k(values[0], number)[1]
        itself = jax.nn.one_hot(starts, m, dtype=bool)
        picked = jnp.take_along_axis(y, starts[..., None], axis=-2)
        start_active = jnp.take_along_axis(active, starts, axis=-1)
        reached = jnp.take_along_axis(values[0], starts, axis=-1)
    else:
        itself = jnp.broadcast_to(jnp.eye(m, dtype=bool), shape)
        picked, start_active, reached = y, active, values[0]
    # ``picked`` (..., S, p): the newest choice of each start, as it was when chosen.
    gains = jnp.broadcast_to(square[..., None, :], shape)
    rest = jnp.broadcast_to(active[..., None, :], shape) & ~itself
    along: list[tuple[jax.Array, jax.Array]] = []  # directions, and how far they shrink
    every = leave = None  # leave: tolls from the newest choice of each start
    if tolls is not None:
        every = leave = jnp.broadcast_to(tolls, (*square.shape, m))
        if number < m:
            leave = jnp.take_along_axis(every, starts[..., None], axis=-2)
    for _ in range(1, depth):
        size = jnp.maximum((picked * picked).sum(-1), _LEAST_GAIN)
        unit = picked * jax.lax.rsqrt(size)[..., None]
        # A spanning choice removes its direction; later ones shorten it.
        keep = jax.lax.rsqrt(1.0 + size) if spanned else jnp.zeros_like(size)
        along.append((unit, 1.0 - keep))
        # The direction in y's own coordinates, through the earlier ones, newest first.
        back = unit
        for before, shrink in reversed(along[:-1]):
            back = back - ((back * before).sum(-1) * shrink)[..., None] * before
        inner = jnp.einsum(
            "...ip,...jp->...ij", back, y, precision=jax.lax.Precision.HIGHEST
        )
        gains = gains - inner * inner * (1.0 - keep * keep)[..., None]
        if every is None or leave is None:
            ranked = jnp.where(rest, gains, -1.0)
            best = jnp.argmax(ranked, axis=-1)
            gain = jnp.maximum(ranked.max(-1), 0.0)
            step = jnp.log(jnp.maximum(base + gain, _LEAST_GAIN))
        else:
            grown = jnp.log(jnp.maximum(base + gains, _LEAST_GAIN))
            ranked = jnp.where(rest, grown - leave, -1e9)
            best = jnp.argmax(ranked, axis=-1)
            step = jnp.maximum(ranked.max(-1), -30.0)
            leave = jnp.take_along_axis(every, best[..., None], axis=-2)
        which = jax.nn.one_hot(best, m, dtype=bool)
        rest = rest & ~which
        reached = jnp.where(start_active, reached + step, -30.0)
        if number < m:
            nothing = jnp.full_like(values[0], -30.0)
            values.append(
                jnp.put_along_axis(nothing, starts, reached, axis=-1, inplace=False)
            )
        else:
            values.append(reached)
        picked = jnp.einsum(
            "...ij,...jp->...ip",
            which.astype(y.dtype),
            y,
            precision=jax.lax.Precision.HIGHEST,
        )
        for before, shrink in along:
            overlap = (picked * before).sum(-1) * shrink
            picked = picked - overlap[..., None] * before
    return values


def num_starts(num_candidates: int) -> int:
    """Candidates that ``lookahead`` looks ahead from: all of up to 1,024, else 512.

    A member of the best set has a large gain of its own, so a set is found from one of
    its members as long as that one is a start; memory and time then grow with M and not
    with its square.
    """
    return num_candidates if num_candidates <= _ALL_START else _STARTS


def picked(candidates: jax.Array, chosen: jax.Array) -> jax.Array:
    """(..., K, n) postures that were chosen; the first one where nothing is yet.

    Args:
        candidates: (..., M, n).
        chosen: (..., K) int, -1 where nothing is chosen.
    """
    # Everybody gathers alike, so that a program that needs them twice gathers once.
    index = jnp.maximum(chosen, 0)[..., None]
    return jnp.take_along_axis(candidates, index, axis=-2, mode="clip")


def log_det_lengths(chosen: jax.Array) -> jax.Array:
    """Log of the squared volume that up to p chosen vectors span.

    Args:
        chosen: (..., c, p), c <= p.

    Returns:
        (...,) 0 where nothing is chosen.
    """
    total = jnp.zeros(chosen.shape[:-2], chosen.dtype)
    basis: list[list[jax.Array]] = []
    for j in range(chosen.shape[-2]):
        v = [chosen[..., j, i] for i in range(chosen.shape[-1])]
        for e in basis:
            along = _dot(v, e)
            v = [a - along * b for a, b in zip(v, e, strict=True)]
        square = jnp.maximum(_dot(v, v), 1e-9)
        total = total + jnp.log(square)
        basis.append([a * jax.lax.rsqrt(square) for a in v])
    return total


def log_det_gram(
    postures: jax.Array, present: jax.Array | None = None, floor: float = 1e-18
) -> jax.Array:
    """Log-determinant of ``Z.T @ Z`` by Gram-Schmidt about the centroid.

    Args:
        postures: (..., K, n) commands, K > n.
        present: (..., K) bool, the rows that count; all of them by default. At least
            one must.
        floor: least squared column length, relative to its share before projection;
            it keeps the value finite where the postures lie in one plane.

    Returns:
        (...,) natural log.
    """
    if present is None:
        present = jnp.ones(postures.shape[:-1], bool)
    weight = row_parts(present.astype(postures.dtype))
    number = row_sum(weight)
    value = jnp.log(number)
    basis: list[list[jax.Array]] = []
    for j in range(postures.shape[-1]):
        column = row_parts(postures[..., j])
        kept = [x * w for x, w in zip(column, weight, strict=True)]
        mean = row_sum(kept) / number
        v = [(x - mean) * w for x, w in zip(column, weight, strict=True)]
        for e in basis:
            along = row_dot(v, e)
            v = [x - along * y for x, y in zip(v, e, strict=True)]
        square = row_dot(v, v)
        factor = jax.lax.rsqrt(jnp.maximum(square, floor))
        basis.append([x * factor for x in v])
        value = value + jnp.log(jnp.maximum(square, floor))
    return value[..., 0]


def row_parts(column: jax.Array) -> list[jax.Array]:
    """A column (..., K) as K arrays (..., 1) where K is small, else as it is.

    A compiled loop runs over the last axis that is long: one over the batch is several
    times faster than one over four rows, and long columns would be long programs.
    """
    k = column.shape[-1]
    size = 1 if k <= _UNROLLED_ROWS else k
    return [column[..., i : i + size] for i in range(0, k, size)]


def row_sum(parts: list[jax.Array]) -> jax.Array:
    """(..., 1) sum of a column held as ``row_parts``."""
    total = parts[0]
    for part in parts[1:]:
        total = total + part
    return total if total.shape[-1] == 1 else total.sum(-1, keepdims=True)


def row_dot(a: list[jax.Array], b: list[jax.Array]) -> jax.Array:
    """(..., 1) inner product of two columns held as ``row_parts``."""
    return row_sum([x * y for x, y in zip(a, b, strict=True)])
