"""What a policy network is, and how one is found by its kind.

What needs no parameters is kept apart from what does, so that training computes it once
for a decision and not in every epoch:

    features      = candidate_features(candidates, usable)        of a set
    decision      = decision_features(features, chosen, available, count)
    memory        = encode(features)                              once for a set
    logits, value = decode(memory, decision)                      once for a decision

``value`` is the expected final log det(Z.T Z), unscaled. Networks are flax modules that
are made from a ``NetworkConfig``. ``compact`` stands in this package; an installed
package adds a kind by an entry point, as jaxcal's own pyproject.toml adds ``paper``:

    [project.entry-points."jaxcal.networks"]
    paper = "jaxcal.paper.network:PaperNetwork"
"""

from __future__ import annotations

import dataclasses
from typing import Any, Protocol, cast

import jax
import jax.numpy as jnp

from jaxcal.learning.settings import installed, require, setting

__all__ = [
    "Network",
    "NetworkConfig",
    "decode",
    "encode",
    "initial",
    "mask_logits",
]

GROUP = "jaxcal.networks"


@dataclasses.dataclass(frozen=True)
class NetworkConfig:
    """Which network, and its size."""

    kind: str = setting("compact", "compact, paper, or what an installed package adds")
    width: int = setting(32, "features of a candidate; hidden width of paper")
    encoder_rounds: int = setting(3, "message rounds over the whole set, for each set")
    decoder_rounds: int = setting(
        1, "message rounds over what is left, for each decision"
    )
    lookahead: int = setting(12, "most greedy choices ahead that a feature shows")
    close_up: bool = setting(False, "features that tell near-equal look-aheads apart")
    initial_trust: float = setting(
        0.0, "weight of the look-ahead before learning; 4 begins as the rule"
    )
    initial_actor: float = setting(0.1, "scale of the learned score before learning")

    def __post_init__(self) -> None:
        if self.kind != "compact" and self.kind not in installed(GROUP):
            known = ", ".join(["compact", *installed(GROUP)])
            raise ValueError(
                f"kind must be one of {known}, got "
                f"{self.kind!r}; a package adds a kind by an entry point in the group "
                f"{GROUP}, when it is installed"
            )
        require(self, "at least 1", lambda v: v >= 1, "width", "lookahead")
        rounds = ("encoder_rounds", "decoder_rounds")
        require(self, "0 or more", lambda v: v >= 0, *rounds)


class Network(Protocol):
    """A flax module that scores candidates; features are trees of arrays."""

    config: NetworkConfig

    def __hash__(self) -> int:
        """It is static to ``jit``."""

    @property
    def num_unlearned(self) -> int:
        """Choices at the end of an episode that ``finish`` makes without parameters."""

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
        """Counts of choices made, out of K, whose next choice is the same program."""

    def encode(self, features: Any) -> jax.Array:
        """(..., M, width) memory of a set."""

    def decode(self, memory: jax.Array, decision: Any) -> tuple[jax.Array, jax.Array]:
        """(..., M) logits, masked, and (...,) value."""

    def finish(self, decision: Any) -> tuple[jax.Array, jax.Array]:
        """As ``decode``, of a choice that needs no network."""

    def init(self, *arguments: Any) -> Any:
        """flax's: fresh parameters."""

    def apply(self, *arguments: Any, **options: Any) -> Any:
        """flax's: a method with given parameters."""


def initial(network: Network, key: jax.Array, m: int, n: int, k: int) -> Any:
    """Fresh parameters for M candidates of n inputs and K choices."""
    free = jnp.ones((1, m), bool)
    nothing = jnp.full((1, k), -1, jnp.int32)
    return network.init(key, jnp.zeros((1, m, n)), free, nothing, free)["params"]


def encode(network: Network, params: Any, features: Any) -> jax.Array:
    """Apply ``network.encode`` with given parameters."""
    return cast(jax.Array, network.apply({"params": params}, features, method="encode"))


def decode(
    network: Network, params: Any, memory: jax.Array, decision: Any, axes: int = 0
) -> tuple[jax.Array, jax.Array]:
    """Apply ``network.decode`` with given parameters: logits and value.

    ``axes`` axes of decisions of the same set follow the first one, of the sets.
    """

    def scored(decision: Any) -> Any:
        return network.apply({"params": params}, memory, decision, method="decode")

    for _ in range(axes):
        scored = jax.vmap(scored, in_axes=1, out_axes=1)
    return cast(tuple[jax.Array, jax.Array], scored(decision))


def mask_logits(logits: jax.Array, available: jax.Array) -> jax.Array:
    """(..., M) logits, a large finite minimum where not available.

    ``-inf`` would make the entropy, and with it every gradient, NaN.
    """
    return jnp.where(available, logits, jnp.asarray(-1e9, logits.dtype))
