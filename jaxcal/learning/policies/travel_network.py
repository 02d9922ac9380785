"""The compact network that also sees what moving costs, for any weight of time.

Everything that has to do with time reaches it as *tolls*: travel times multiplied by
the weight, so in units of log det(Z.T Z). Speeds, accelerations and the unit of time
are in the tolls and nowhere else, and one set of parameters serves every weight, 0
included. The greedy look-ahead pays the tolls, so its last column is what the rule
without learning would go by; the network starts from that rule.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxcal.learning.policies import geometry
from jaxcal.learning.policies.networks import CompactNetwork, View, glance_at

__all__ = ["TravelNetwork"]

_MOST = 8.0  # largest toll that a feature shows


class TravelNetwork(CompactNetwork):
    """Scores the next posture by what it adds to log det(Z.T Z) less the tolls."""

    def look(
        self,
        candidates: jax.Array,
        usable: jax.Array,
        tolls: jax.Array | None = None,
        entry: jax.Array | None = None,
    ) -> View:
        """The geometry of a set; see ``CompactNetwork.look``.

        Args:
            candidates: (..., M, n) commands in any unit.
            usable: (..., M) bool, available or already chosen.
            tolls: (..., M, M) weighted time from each to each; nothing when None.
            entry: (..., M) weighted time from the start to each.
        """
        m = candidates.shape[-2]
        if tolls is None:
            tolls = jnp.zeros((*candidates.shape[:-1], m), candidates.dtype)
        if entry is None:
            entry = jnp.zeros(candidates.shape[:-1], candidates.dtype)
        x, offset = geometry.whiten(candidates, usable)
        depth = min(self.config.lookahead, x.shape[-1])
        glance = glance_at(x, False, usable, depth, tolls, entry, self.config.close_up)
        number = jnp.maximum(usable.sum(-1).astype(x.dtype), 1.0)
        near = jnp.exp(-2.0 * tolls) * usable[..., None, :]
        return glance | {
            "features": _with_tolls(glance["features"], x, usable, tolls, entry),
            "near": near / number[..., None, None],
            "x": x,
            "offset": offset,
            "tolls": tolls,
            "entry": entry,
        }

    def alike(self, view: View, k: int) -> range:
        """None: what was chosen before, and when, is in every decision."""
        return range(0)

    def look_at(  # type: ignore[override]  # no decision is alike: count is known
        self, view: View, chosen: jax.Array, available: jax.Array, count: int
    ) -> View:
        """The geometry of a decision; see ``CompactNetwork.look_at``."""
        y, spanned, so_far, scalars, which = self.after(view, chosen, count)
        tolls, entry = view["tolls"], view["entry"]
        spent = jnp.zeros_like(so_far)
        for i in range(count):
            spent = spent + (which[..., i, :] * entry).sum(-1)
            entry = jnp.einsum(
                "...i,...ij->...j",
                which[..., i, :],
                tolls,
                precision=jax.lax.Precision.HIGHEST,
            )
        depth = min(self.config.lookahead, chosen.shape[-1] - count)
        glance = glance_at(
            y, spanned, available, depth, tolls, entry, self.config.close_up
        )
        return glance | {
            "features": _with_tolls(glance["features"], y, available, tolls, entry),
            "which": which.sum(-2) / max(count, 1),
            "so_far": so_far - spent + glance["best"][..., 3],
            "scalars": scalars,
        }


def _with_tolls(
    features: jax.Array,
    y: jax.Array,
    active: jax.Array,
    tolls: jax.Array,
    entry: jax.Array,
) -> jax.Array:
    """(..., M, 13 + 6): beside the features of the volumes, those of the tolls alone.

    The gain before tolls; the toll of getting there; mean and least toll to the others
    that are active; the mean over all pairs, which is the weight in the set's own
    unit of time, plain and compressed.
    """
    weight = active.astype(y.dtype)
    number = jnp.maximum(weight.sum(-1, keepdims=True), 1.0)
    gain = jnp.log(jnp.maximum((y * y).sum(-1) * weight, 1e-6))
    gain = jnp.clip(gain - gain.max(-1, keepdims=True), -_MOST, 0.0)
    mean = jnp.einsum("...ij,...j->...i", tolls, weight) / number
    m = tolls.shape[-1]
    others = active[..., None, :] & ~jnp.eye(m, dtype=bool)[(None,) * (active.ndim - 1)]
    least = jnp.where(others, tolls, _MOST).min(-1)
    level = (mean * weight).sum(-1, keepdims=True) / number
    level = jnp.broadcast_to(level, mean.shape)
    shown = [
        gain / 2.0,
        jnp.minimum(entry, _MOST),
        jnp.minimum(mean, _MOST),
        jnp.minimum(least, _MOST),
        jnp.minimum(level, _MOST) / 2.0,
        level / (0.3 + level),
    ]
    extra = jnp.stack(shown, axis=-1)
    extra = jnp.where(active[..., None], extra, 0.0)
    return jnp.concatenate([features, extra], axis=-1)
