"""Turning a policy into a choice: greedy, sampled, best of the likeliest first picks.

Functions take the network, its parameters and a batch of candidate sets, and return
indices; they compile once for each shape.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp

from jaxcal.learning.core import network as networks
from jaxcal.learning.core.network import Network
from jaxcal.learning.small_matrices import log_det_gram

__all__ = ["choose", "complete", "log_det_of", "logits_at"]


def log_det_of(candidates: jax.Array, indices: jax.Array) -> jax.Array:
    """(...,) log det(Z.T Z) of the subsets ``indices`` (..., K) of (..., M, n)."""
    return log_det_gram(jnp.take_along_axis(candidates, indices[..., None], axis=-2))


def complete(
    network: Network,
    params: Any,
    features: Any,
    memory: Any,
    chosen: jax.Array,
    available: jax.Array,
    first: int,
    key: jax.Array | None,
) -> jax.Array:
    """Choose from position ``first`` to the end: sampled with a key, else greedy."""
    m = available.shape[-1]
    for position in range(first, chosen.shape[-1]):
        logits, _ = logits_at(
            network, params, features, memory, chosen, available, position
        )
        if key is None:
            action = jnp.argmax(logits, axis=-1)
        else:
            key, key_action = jax.random.split(key)
            action = jax.random.categorical(key_action, logits)
        chosen = chosen.at[:, position].set(action.astype(chosen.dtype))
        available = available & ~jax.nn.one_hot(action, m, dtype=bool)
    return chosen


def logits_at(
    network: Network,
    params: Any,
    features: Any,
    memory: Any,
    chosen: jax.Array,
    available: jax.Array,
    count: int,
) -> tuple[jax.Array, jax.Array]:
    """(B, M) logits and (B,) value of the decision after ``count`` choices.

    The look-ahead makes the last ``network.num_unlearned`` choices.
    """
    decision = network.decision_features(features, chosen, available, count)
    if chosen.shape[-1] - count <= network.num_unlearned:
        return network.lookahead_logits(decision)
    return networks.decode(network, params, memory, decision)


@functools.partial(
    jax.jit, static_argnames=("network", "k", "num_required", "decoding", "num")
)
def choose(
    network: Network,
    params: Any,
    candidates: jax.Array,
    available: jax.Array,
    required: jax.Array,
    key: jax.Array,
    *,
    k: int,
    num_required: int = 0,
    decoding: str = "greedy",
    num: int = 16,
) -> jax.Array:
    """Choose k of M candidates for every set of a batch.

    Args:
        network: from ``policies.networks.build``.
        params: its parameters.
        candidates: (B, M, n).
        available: (B, M) bool; required postures count as available to the encoder.
        required: (B, num_required) int, chosen before the policy begins.
        key: PRNG key, spent by ``samples`` only.
        k: postures to choose in all.
        decoding: ``greedy``: the likeliest at every step, one pass; ``samples``: the
            best of ``num`` sampled passes; ``first``: the best of the ``num`` likeliest
            first picks, each completed greedily.
        num: passes for ``samples`` and ``first``.

    Returns:
        (B, k) int32, required postures first.
    """
    batch, m = available.shape
    rows = jnp.arange(batch)[:, None]
    chosen = jnp.full((batch, k), -1, jnp.int32)
    chosen = chosen.at[:, :num_required].set(required.astype(jnp.int32))
    usable = available.at[rows, required].set(True)
    free = available.at[rows, required].set(False)
    features = network.candidate_features(candidates, usable)
    memory = networks.encode(network, params, features)
    completed = functools.partial(complete, network, params, features, memory)
    if decoding == "greedy" or num_required == k:
        return completed(chosen, free, num_required, None)
    if decoding == "samples":
        keys = jax.random.split(key, num)
        tries = jax.vmap(lambda key: completed(chosen, free, num_required, key))(keys)
    else:
        logits, _ = logits_at(
            network, params, features, memory, chosen, free, num_required
        )
        _, firsts = jax.lax.top_k(logits, min(num, m))
        # With fewer than ``num`` candidates available, ``firsts`` ends in masked ones:
        # replace these by the best.
        valid = jnp.take_along_axis(free, firsts, axis=-1)
        firsts = jnp.where(valid, firsts, firsts[:, :1]).astype(jnp.int32)

        def with_first(first: jax.Array) -> jax.Array:
            begun = chosen.at[:, num_required].set(first)
            rest = free & ~jax.nn.one_hot(first, m, dtype=bool)
            return completed(begun, rest, num_required + 1, None)

        tries = jax.vmap(with_first)(firsts.T)
    values = jax.vmap(lambda tried: log_det_of(candidates, tried))(tries)
    best = jnp.argmax(values, axis=0)
    return jnp.take_along_axis(tries, best[None, :, None], axis=0)[0]
