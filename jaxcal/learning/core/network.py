"""What a network that chooses postures is, and how its parts are applied.

What needs no parameters is kept apart from what does, so that training computes it once
for a decision and not in every epoch:

    features      = candidate_features(candidates, usable)        of a set
    decision      = decision_features(features, chosen, available, count)
    memory        = encode(features)                              once for a set
    logits, value = decode(memory, decision)                      once for a decision

``value`` is the expected final log det(Z.T Z), unscaled.
"""

from __future__ import annotations

from typing import Any, Protocol, cast

import jax
import jax.numpy as jnp

__all__ = ["Network", "decode", "encode", "initial", "mask_logits"]


class Network(Protocol):
    """A flax module that scores candidates; features are trees of arrays."""

    def __hash__(self) -> int:
        """It is static to ``jit``."""

    @property
    def num_unlearned(self) -> int:
        """Choices at the end of an episode that need no parameters."""

    def candidate_features(self, candidates: jax.Array, usable: jax.Array) -> Any:
        """Of sets (..., M, n) of which (..., M) are usable: available or chosen."""

    def decision_features(
        self,
        features: Any,
        chosen: jax.Array,
        available: jax.Array,
        count: int | jax.Array,
    ) -> Any:
        """Of the decision after ``count`` choices.

        Args:
            features: from ``candidate_features``.
            chosen: (..., K) int, -1 from ``count`` on.
            available: (..., M) bool.
            count: traced only where it is in ``shares_program``.
        """

    def shares_program(self, features: Any, k: int) -> range:
        """Numbers of choices made, out of K, at which the next choice compiles to the
        same program; ``decision_features`` takes them traced."""

    def encode(self, features: Any) -> jax.Array:
        """(..., M, width) memory of a set."""

    def decode(self, memory: jax.Array, decision: Any) -> tuple[jax.Array, jax.Array]:
        """(..., M) logits, masked, and (...,) value."""

    def lookahead_logits(self, decision: Any) -> tuple[jax.Array, jax.Array]:
        """As ``decode``, of a choice that needs no parameters."""

    def init(self, *arguments: Any) -> Any:
        """flax's: fresh parameters."""

    def apply(self, *arguments: Any, **options: Any) -> Any:
        """flax's: a method with given parameters."""


def initial(network: Network, key: jax.Array, m: int, n: int, k: int) -> Any:
    """Fresh parameters for M candidates of n inputs and K choices."""
    free = jnp.ones((1, m), bool)
    nothing = jnp.full((1, k), -1, jnp.int32)
    init = jax.jit(network.init)  # op by op it would be two hundred small programs
    return init(key, jnp.zeros((1, m, n)), free, nothing, free)["params"]


def encode(network: Network, params: Any, features: Any) -> jax.Array:
    """Apply ``network.encode`` with given parameters."""
    return cast(jax.Array, network.apply({"params": params}, features, method="encode"))


def decode(
    network: Network, params: Any, memory: jax.Array, decision: Any
) -> tuple[jax.Array, jax.Array]:
    """Apply ``network.decode`` with given parameters: logits and value."""
    scored: Any = network.apply({"params": params}, memory, decision, method="decode")
    return scored


def mask_logits(logits: jax.Array, available: jax.Array) -> jax.Array:
    """(..., M) logits, a large finite minimum where not available.

    ``-inf`` would make the entropy, and with it every gradient, NaN.
    """
    return jnp.where(available, logits, jnp.asarray(-1e9, logits.dtype))
