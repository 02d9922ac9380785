"""The policy: a learned correction of a rule's score."""

from __future__ import annotations

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct

from jaxcal.adaptive.policy.features import NUM_FEATURES, Shortlist, shortlist_of
from jaxcal.adaptive.rules import Rule
from jaxcal.adaptive.session import Options, Session

# Initial factor of the rule's log score: an option whose score is a fifth below the
# best one's is sampled a third as often (0.8^5).
_SHARPNESS = 5.0
_STEP = 3.0  # logits per unit of the network's output, so that it learns faster


class Correction(nn.Module):
    """Logits (..., C) and a value (...) of shortlists.

    Each option is embedded, the embeddings are pooled by their maximum, and each is
    scored beside the pool. The last layer begins at zero: a policy begins as its rule.
    """

    width: int = 64

    @nn.compact
    def __call__(self, seen: Shortlist) -> tuple[jax.Array, jax.Array]:
        hidden = nn.tanh(nn.Dense(self.width)(seen.features))
        valid = seen.valid[..., None]
        pool = jnp.where(valid, hidden, -1.0).max(axis=-2)
        # A layer over both as two: the pool's product is computed once.
        beside = nn.Dense(self.width, use_bias=False)(pool)[..., None, :]
        late = nn.tanh(nn.Dense(self.width)(hidden) + beside)
        change = nn.Dense(1, kernel_init=nn.initializers.zeros)(late)[..., 0]
        beta = self.param("beta", nn.initializers.constant(_SHARPNESS), ())
        logits = beta * seen.log_score + _STEP * change
        mean = (hidden * valid).sum(axis=-2) / jnp.maximum(valid.sum(axis=-2), 1)
        value = jnp.concatenate([pool, mean], axis=-1)
        for _ in range(2):
            value = nn.tanh(nn.Dense(2 * self.width)(value))
        value = nn.Dense(1)(value)[..., 0]
        return jnp.where(seen.valid, logits, -1e9), value


@struct.dataclass
class PolicyDecider:
    """A trained network as a decider."""

    params: Any
    base: Rule
    per_group: int = struct.field(pytree_node=False, default=6)
    width: int = struct.field(pytree_node=False, default=64)

    def __call__(
        self, task: Any, belief: Any, session: Session, options: Options, key: jax.Array
    ) -> jax.Array:
        seen = shortlist_of(
            task, belief, session, options, key, self.base, self.per_group
        )
        logits, _ = Correction(self.width).apply(self.params, seen)
        return seen.index[jnp.argmax(logits)]


def initial(key: jax.Array, per_group: int, num_groups: int, width: int = 64) -> Any:
    """Parameters before training."""
    c = per_group * num_groups
    blank = Shortlist(
        index=jnp.zeros(c, jnp.int32),
        designs=jnp.zeros(c),
        features=jnp.zeros((c, NUM_FEATURES)),
        log_score=jnp.zeros(c),
        valid=jnp.ones(c, bool),
    )
    return Correction(width).init(key, blank)
