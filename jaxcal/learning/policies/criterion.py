"""The compact network for the criteria A, I and E, which differs in its geometry."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp

from jaxcal.learning.criteria import inverse_of, product, regressors, worth_of_inverse
from jaxcal.learning.policies.compact import CompactNetwork
from jaxcal.learning.policies.features import (
    CandidateFeatures,
    DecisionFeatures,
    described,
    picked_of,
    progress_of,
)
from jaxcal.learning.policies.geometry import ALL_START, STARTS
from jaxcal.learning.small_matrices import cholesky, solve_lower

__all__ = ["CriterionNetwork", "lookahead"]

_RIDGE = 1e-3  # of the mean square of a coordinate, which is one
_UNUSED = -30.0  # gain of a candidate that cannot be chosen


class CriterionNetwork(CompactNetwork):
    """Permutation-equivariant, for any M, K and n; judged by ``config.criterion``.

    Its look-ahead is that of the criterion. For A and E candidates stay in the
    coordinates they come in, because these criteria change with them: rotations alone
    leave the pick as it is. For I they are whitened, as for D. The look-ahead makes the
    last choice (``num_unlearned``), which is the best one.
    """

    @property
    def num_unlearned(self) -> int:
        """Choices at the end of an episode that are made without the network."""
        return min(self.config.lookahead, 1)

    def candidate_features(
        self, candidates: jax.Array, usable: jax.Array
    ) -> CandidateFeatures:
        """The geometry of sets; arguments as in ``Network``."""
        x, offset = regressors(self.config.criterion, candidates, usable)
        p = x.shape[-1]
        start = jnp.broadcast_to(
            jnp.eye(p, dtype=x.dtype) / _RIDGE, (*x.shape[:-2], p, p)
        )
        depth = min(self.config.lookahead, p)
        ahead = lookahead(self.config.criterion, x, start, usable, depth)
        return CandidateFeatures(
            described(x, ahead, usable, self.config.close_up), x, offset
        )

    def decision_features(
        self,
        features: CandidateFeatures,
        chosen: jax.Array,
        available: jax.Array,
        count: jax.typing.ArrayLike,
    ) -> DecisionFeatures:
        """The geometry of a decision; arguments as in ``Network``."""
        config, x = self.config, features.whitened
        which, picked = picked_of(x, chosen)
        gram = jnp.einsum(
            "...ci,...cj->...ij", picked, picked, precision=jax.lax.Precision.HIGHEST
        )
        gram = gram + _RIDGE * jnp.broadcast_to(
            jnp.eye(x.shape[-1], dtype=x.dtype), gram.shape
        )
        inverse = inverse_of(gram)
        total = chosen.shape[-1]
        depth = jnp.minimum(config.lookahead, total - jnp.asarray(count))
        ahead = lookahead(config.criterion, x, inverse, available, depth)
        y = solve_lower(cholesky(gram), x)  # in the metric of what is chosen
        vectors = described(y, ahead, available, config.close_up)
        so_far = worth_of_inverse(config.criterion, inverse)
        return DecisionFeatures(
            vectors,
            chosen=which.sum(-2) / jnp.maximum(count, 1).astype(x.dtype),
            reached=features.offset + so_far + vectors.best[..., -1],
            progress=progress_of(count, total, x, so_far.shape),
        )


def lookahead(
    criterion: str,
    x: jax.Array,
    inverse: jax.Array,
    active: jax.Array,
    depth: jax.typing.ArrayLike,
) -> list[jax.Array]:
    """How much the worth grows from each candidate and greedy choices after it.

    Greedy choices make the trace of the inverse least, of E that of its square.

    Args:
        criterion: A, I or E.
        x: (..., M, p) regressors.
        inverse: (..., p, p) of what is chosen, with a ridge.
        active: (..., M) bool, what may be chosen.
        depth: () number of choices, that candidate included; at least 1.

    Returns:
        Four arrays (..., M) as ``geometry.lookahead`` has them: over the first 1, 2, 3
        and ``depth`` choices; -30 where not active. Of more than 1,024 candidates only
        the 512 that alone grow it most are looked ahead from: of the others all but
        the first are -30.
    """
    m, p = x.shape[-2:]
    before = worth_of_inverse(criterion, inverse)[..., None]
    products = (x[..., :, None] * x[..., None, :]).reshape(*x.shape[:-1], p * p)

    def gained(inverses: jax.Array) -> jax.Array:
        return worth_of_inverse(criterion, inverses) - before

    def gains(inverses: jax.Array) -> jax.Array:
        """(..., S, M) by how much the trace falls where a candidate is chosen next."""
        squares = product(inverses, inverses)
        size = 1.0 + forms(inverses)
        square = forms(squares) / size
        if criterion != "E":
            return square
        return 2.0 * forms(product(squares, inverses)) / size - square * square

    def forms(matrices: jax.Array) -> jax.Array:
        """(..., S, M) quadratic forms x.T A x of matrices (..., S, p, p)."""
        flat = matrices.reshape(*matrices.shape[:-2], p * p)
        return jnp.einsum("...sf,...mf->...sm", flat, products)

    def further(d: jax.Array, carry: Any) -> Any:
        inverses, free, values = carry
        newest = jnp.argmax(jnp.where(free, gains(inverses), -jnp.inf), axis=-1)
        picked = jnp.take_along_axis(x, newest[..., None], axis=-2)
        some = free.any(-1)[..., None, None]
        inverses = jnp.where(some, _after(inverses, picked), inverses)
        free = free & (column != newest[..., None])
        reached = gained(inverses)
        ends = (d < 2, d < 3, jnp.array(True))
        later = [
            jnp.where(end, reached, value)
            for end, value in zip(ends, values, strict=True)
        ]
        return inverses, free, later

    every = jnp.broadcast_to(inverse[..., None, :, :], (*x.shape[:-1], p, p))
    inverses = _after(every, x)
    first = jnp.where(active, gained(inverses), _UNUSED)
    starts, begins, reached = jnp.arange(m), active, first
    if m > ALL_START:
        starts = jax.lax.top_k(first, STARTS)[1]
        begins, reached = (
            jnp.take_along_axis(values, starts, axis=-1) for values in (active, first)
        )
        inverses = jnp.take_along_axis(inverses, starts[..., None, None], axis=-3)
    shape = (*reached.shape, m)
    column = jnp.broadcast_to(jnp.arange(m), shape)
    start = jnp.broadcast_to(starts[..., None], shape)
    free = active[..., None, :] & (column != start)
    carry = (inverses, free, [reached] * 3)
    *_, values = jax.lax.fori_loop(1, depth, further, carry)
    values = [jnp.where(begins, value, _UNUSED) for value in values]
    if m > ALL_START:
        unused, some = jnp.full_like(first, _UNUSED), jnp.asarray(depth) > 1
        put = functools.partial(jnp.put_along_axis, axis=-1, inplace=False)
        values = [jnp.where(some, put(unused, starts, x), first) for x in values]
    return [first, *values]


def _after(inverses: jax.Array, rows: jax.Array) -> jax.Array:
    """(..., p, p) inverses where rows (..., p) are added to the information."""
    back = jnp.einsum("...ij,...j->...i", inverses, rows)
    size = 1.0 + (back * rows).sum(-1)
    return inverses - back[..., :, None] * back[..., None, :] / size[..., None, None]
