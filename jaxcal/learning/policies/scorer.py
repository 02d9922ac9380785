"""A network in JAX as decoding sees it: two programs for a shape, whatever K."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.learning.core import network as networks
from jaxcal.learning.core.network import Network
from jaxcal.learning.policies import decoding as decoders
from jaxcal.learning.small_matrices import log_det_gram


@dataclasses.dataclass(frozen=True)
class NetworkScorer(decoders.Scorer):
    """A ``Network`` and its parameters; one piece, since XLA has threads of its own."""

    network: Network
    params: Any

    def encode(self, rows: NDArray[Any], usable: NDArray[np.bool_]) -> Any:
        return _encoded(self.network, self.params, rows[..., :-1], usable)

    def scores(
        self,
        memory: Any,
        chosen: NDArray[np.int64],
        free: NDArray[np.bool_],
        count: int,
        best_only: bool = False,
    ) -> NDArray[Any]:
        learned = chosen.shape[1] - count > self.network.num_unlearned
        tries = len(chosen) // len(jax.tree.leaves(memory)[0])  # in a row on each set
        choices, available = (
            array.reshape(-1, tries, array.shape[-1])
            for array in (chosen.astype(np.int32), free)
        )
        scores = scores_of(
            self.network, self.params, memory, choices, available, count, learned
        )
        return np.asarray(scores).reshape(free.shape)


@functools.partial(jax.jit, static_argnames="network")
def _encoded(
    network: Network, params: Any, candidates: jax.Array, usable: jax.Array
) -> Any:
    features = network.candidate_features(candidates, usable)
    return features, networks.encode(network, params, features)


@functools.partial(jax.jit, static_argnames=("network", "learned"))
def scores_of(
    network: Network,
    params: Any,
    memory: Any,
    chosen: jax.Array,
    free: jax.Array,
    count: jax.typing.ArrayLike,
    learned: bool,
) -> jax.Array:
    """(B, T, M) logits of the decision after ``count`` choices, T tries on each set.
    ``learned`` is False for those that the look-ahead makes."""
    features, encoded = memory

    def of_try(chosen: jax.Array, free: jax.Array) -> jax.Array:
        decision = network.decision_features(features, chosen, free, count)
        if not learned:
            return network.lookahead_logits(decision)[0]
        return networks.decode(network, params, encoded, decision)[0]

    return jax.vmap(of_try, in_axes=1, out_axes=1)(chosen, free)


def choose(
    network: Network,
    params: Any,
    candidates: ArrayLike,
    available: ArrayLike,
    required: ArrayLike | None = None,
    *,
    k: int,
    seeds: Sequence[Any] | None = None,
    decoding: str = "greedy",
    num: int = 16,
) -> NDArray[np.int64]:
    """(B, k) indices of (B, M, n) candidates; see ``decoding.choose``. ``seeds`` (B,)
    are of the sets, for ``samples``; their numbers when None."""
    points, free = np.asarray(candidates), np.asarray(available)
    rows = np.concatenate([points, np.ones_like(points[..., :1])], axis=-1)
    given = np.zeros((len(free), 0)) if required is None else required
    seeds = range(len(free)) if seeds is None else seeds
    return decoders.choose(
        NetworkScorer(network.of_choices(k), params),
        rows,
        free,
        np.asarray(given, np.int64),
        k,
        decoding=decoding,
        num=num,
        generators=[
            np.random.default_rng(seed) for seed in seeds if decoding == "samples"
        ],
    )


def log_det_of(candidates: ArrayLike, indices: ArrayLike) -> jax.Array:
    """(...,) log det(Z.T Z) of the subsets ``indices`` (..., K) of (..., M, n)."""
    points, chosen = jnp.asarray(candidates), jnp.asarray(indices)[..., None]
    return log_det_gram(jnp.take_along_axis(points, chosen, axis=-2))
