"""Runs of postures for many weights of time at once, in one compiled call."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp

from jaxcal.learning.policies import decoding, networks
from jaxcal.learning.policies.networks import Network

__all__ = ["runs"]


@functools.partial(jax.jit, static_argnames=("network", "k", "num"))
def runs(
    network: Network,
    params: Any,
    candidates: jax.Array,
    available: jax.Array,
    required: jax.Array,
    tolls: jax.Array,
    entry: jax.Array,
    *,
    k: int,
    num: int = 1,
) -> jax.Array:
    """K postures in the order to visit, for each of a batch of tolls.

    Args:
        network: a ``TravelNetwork``.
        params: its parameters; None for the look-ahead alone, without learning.
        candidates: (B, M, n).
        available: (B, M) bool.
        required: (B, r) int, visited first.
        tolls: (B, M, M) weighted times, units of log det(Z.T Z).
        entry: (B, M) weighted times from the start.
        k: postures in all.
        num: likeliest first picks, each completed greedily.

    Returns:
        (num, B, k) int32.
    """
    batch, m = available.shape
    given = required.shape[-1]
    rows = jnp.arange(batch)[:, None]
    chosen = jnp.full((batch, k), -1, jnp.int32)
    chosen = chosen.at[:, :given].set(required.astype(jnp.int32))
    usable = available.at[rows, required].set(True)
    free = available.at[rows, required].set(False)
    view = network.look(candidates, usable, tolls, entry)  # type: ignore[call-arg]
    memory = None if params is None else networks.encode(network, params, view)
    finish = functools.partial(decoding.complete, network, params, view, memory)
    if num == 1 or given == k:
        return finish(chosen, free, given, None)[None]
    logits, _ = decoding.logits_at(network, params, view, memory, chosen, free, given)
    _, firsts = jax.lax.top_k(logits, min(num, m))
    # A list longer than what is free ends in what may not be chosen: repeat the best.
    valid = jnp.take_along_axis(free, firsts, axis=-1)
    firsts = jnp.where(valid, firsts, firsts[:, :1]).astype(jnp.int32)

    def with_first(first: jax.Array) -> jax.Array:
        begun = chosen.at[:, given].set(first)
        rest = free & ~jax.nn.one_hot(first, m, dtype=bool)
        return finish(begun, rest, given + 1, None)

    return jax.vmap(with_first)(firsts.T)
