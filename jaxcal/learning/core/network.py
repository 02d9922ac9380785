"""Interface of a network that chooses postures.

Features, which need no parameters, are computed once for a decision and not in every
epoch. ``value`` is the expected final log det(Z.T Z), unscaled. M candidates of n
inputs, K choices; leading axes ``...``.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from jaxcal.extras import installed
from jaxcal.learning.config import NETWORKS, NetworkConfig, named

Scores = tuple[jax.Array, jax.Array]
"""(..., M) masked logits and (...,) value."""

_OWN = "a Network of one's own defines this"
_LAST = "a Network with num_unlearned > 0 defines this"
_COMPACT = "jaxcal.learning.policies.compact:CompactNetwork"
_LEAST = -1e9  # logit of what is not available


class Network(nn.Module):
    """Scores candidates; features are trees of arrays."""

    @property
    def num_unlearned(self) -> int:
        """Choices at the end of an episode that the look-ahead makes."""
        return 0

    @property
    def mask_is_chosen(self) -> bool:
        """Whether it takes a candidate that is not available for a chosen one."""
        return False

    def of_choices(self, num_selected: int) -> Network:
        """The network for K choices, where it asks for their number."""
        return self

    def candidate_features(self, candidates: jax.Array, usable: jax.Array) -> Any:
        """Features of sets (..., M, n); (..., M) bool usable: available or chosen."""
        raise NotImplementedError(_OWN)  # abstract

    def decision_features(
        self,
        features: Any,
        chosen: jax.Array,
        available: jax.Array,
        count: jax.typing.ArrayLike,
    ) -> Any:
        """Features of the decision after ``count`` choices, of those of the set, of
        ``chosen`` (..., K) int, -1 from ``count`` on, and ``available`` (..., M) bool,
        at first as ``usable``. ``count`` is the number 0, or traced, so that decisions
        share a program."""
        raise NotImplementedError(_OWN)  # abstract

    def encode(self, features: Any) -> Any:
        """(..., M, width) memory of a set, or a tree of arrays."""
        raise NotImplementedError(_OWN)  # abstract

    def decode(self, memory: Any, decision: Any) -> Scores:
        """(..., M) logits, masked, and (...,) value."""
        raise NotImplementedError(_OWN)  # abstract

    def lookahead_logits(self, decision: Any) -> Scores:
        """Logits as of ``decode``, for one of the last ``num_unlearned`` choices."""
        raise NotImplementedError(_LAST)  # abstract where num_unlearned is 0

    def __call__(
        self, candidates: jax.Array, available: jax.Array, chosen: jax.Array
    ) -> Scores:
        """Logits and value of the first decision; flax initialises with this call."""
        features = self.candidate_features(candidates, available)
        decision = self.decision_features(features, chosen, available, 0)
        return self.decode(self.encode(features), decision)


def build(config: NetworkConfig) -> Network:
    """The network that a configuration names: ``compact``, one's own, a package's."""
    path = _COMPACT if config.kind == "compact" else config.kind
    kind: Any = named(path) if ":" in path else installed(NETWORKS)[path].load()
    if not (isinstance(kind, type) and issubclass(kind, Network)):
        raise ValueError(f"kind must be a Network, got {config.kind}")
    fields = [field.name for field in dataclasses.fields(kind)]
    arguments: dict[str, Any] = {"config": config} if "config" in fields else {}
    return kind(**arguments)


def initial(network: Network, key: jax.Array, m: int, n: int, k: int) -> Any:
    """Fresh parameters for M candidates of n inputs and K choices; a network that lacks
    a method, or whose logits and value have other shapes, is refused."""
    kind = type(network)
    for name in ("candidate_features", "decision_features", "encode", "decode"):
        if getattr(kind, name, None) is getattr(Network, name):
            raise ValueError(f"a Network must define {name}; {kind.__name__} does not")
    answer, params = _initial(network, key, m, n, k)
    shapes = [leaf.shape for leaf in jax.tree.leaves(answer)]
    if shapes != [(1, m), (1,)]:
        raise ValueError(
            f"decode of {kind.__name__} must return logits (..., {m}), value (...,): "
            f"for one set (1, {m}) and (1,), got {', '.join(map(str, shapes))}"
        )
    return params


# Eager, it would compile two hundred small programs.
@functools.partial(jax.jit, static_argnums=(0, 2, 3, 4))
def _initial(network: Network, key: jax.Array, m: int, n: int, k: int) -> Any:
    blank = jnp.zeros((1, m, n)), jnp.ones((1, m), bool), jnp.full((1, k), -1)
    answer, variables = network.init_with_output(key, *blank)
    return answer, variables.get("params", {})


def encode(network: Network, params: Any, features: Any) -> Any:
    return network.apply({"params": params}, features, method="encode")


def decode(network: Network, params: Any, memory: Any, decision: Any) -> Any:
    return network.apply({"params": params}, memory, decision, method="decode")


def mask_logits(logits: jax.Array, available: jax.Array) -> jax.Array:
    """(..., M) logits, a large finite minimum where not available: ``-inf`` would make
    the entropy, and with it every gradient, NaN."""
    return jnp.where(available, logits, jnp.asarray(_LEAST, logits.dtype))


def log_softmax(logits: jax.Array) -> jax.Array:
    """(..., M) log-probabilities, all finite: of logits masked by ``-inf`` too."""
    return jax.nn.log_softmax(jnp.maximum(logits, _LEAST))
