"""Policy networks: ``compact`` (invariant, any M, K and n) and ``paper`` (Table 2).

What needs no parameters is kept apart from what does, so that training computes the
geometry of a decision once and not in every epoch:

    view          = look(candidates, usable)            of a set, no parameters
    glance        = look_at(view, chosen, available, count)   of a decision, likewise
    memory        = encode(view)                        once a set
    logits, value = decode(memory, glance)              once a decision

Arrays are batched over leading axes (``...``). ``value`` is the expected final
log det(Z.T Z), unscaled. Networks are flax modules; ``build`` makes one from a config.
"""

from __future__ import annotations

import dataclasses
from typing import Any, cast

import flax.linen as nn
import jax
import jax.numpy as jnp

from jaxcal.learning.environments.observation import context_features
from jaxcal.learning.policies import geometry

__all__ = [
    "PAPER_HEADS",
    "CompactNetwork",
    "Network",
    "NetworkConfig",
    "PaperNetwork",
    "build",
    "decode",
    "encode",
    "mask_logits",
]

View = dict[str, jax.Array]

KINDS = ("compact", "paper")

_FLOOR = -8.0  # least log-volume, relative to the best, that a feature can show
_RIDGE = 0.01  # of the mean square of a whitened coordinate, which is one
_CLOSE = (32.0, 256.0, 2048.0)  # scales at which near-equal look-aheads differ
_SHARP = 60.0  # inverse temperature of the choices that need no learning


@dataclasses.dataclass(frozen=True)
class NetworkConfig:
    """Which network, and its size."""

    kind: str = "compact"  # or "paper"
    width: int = 32  # features a candidate (compact), hidden width (paper: 768)
    encoder_rounds: int = 3  # message rounds over the whole set, once an episode
    decoder_rounds: int = 1  # message rounds over what is left, once a decision
    lookahead: int = 12  # most greedy choices ahead that a candidate's features show
    messages: bool = True  # second-moment messages sum_j v_j x_j x_j.T
    endgame: bool = True  # the last two choices by volume alone, which is optimal
    close_up: bool = False  # features that tell near-equal look-aheads apart
    initial_trust: float = 0.0  # in the look-ahead before learning; 1 begins with it
    initial_actor: float = 0.1  # scale of the learned score before learning

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(
                f"kind must be one of {', '.join(KINDS)}, got {self.kind!r}"
            )
        for name in ("width", "lookahead"):
            if getattr(self, name) < 1:
                raise ValueError(
                    f"{name} must be at least 1, got {getattr(self, name)}"
                )
        for name in ("encoder_rounds", "decoder_rounds"):
            if getattr(self, name) < 0:
                raise ValueError(
                    f"{name} must not be negative, got {getattr(self, name)}"
                )


def mask_logits(logits: jax.Array, available: jax.Array) -> jax.Array:
    """(..., M) logits, a large finite minimum where not available.

    ``-inf`` would make the entropy, and with it every gradient, NaN.
    """
    return jnp.where(available, logits, jnp.asarray(-1e9, logits.dtype))


def _second_moments(x: jax.Array) -> jax.Array:
    """(..., M, p) -> (..., M, p (p + 1) / 2) with phi(x) . phi(y) = (x . y)^2."""
    p = x.shape[-1]
    return jnp.stack(
        [
            x[..., i] * x[..., j] * (1.0 if i == j else 2.0**0.5)
            for i in range(p)
            for j in range(i, p)
        ],
        axis=-1,
    )


def glance_at(
    y: jax.Array,
    spanned: bool,
    active: jax.Array,
    depth: int,
    tolls: jax.Array | None = None,
    entry: jax.Array | None = None,
    close_up: bool = False,
) -> View:
    """What the network reads of conditional vectors y (..., M, p).

    ``tolls`` (..., M, M), as of ``geometry.lookahead``, and ``entry`` (..., M), the
    toll of the first choice, are subtracted from the log-volumes where given.

    Returns:
        ``features`` (..., M, 13); ``moments`` (..., M, p (p + 1) / 2), scaled so that
        messages keep their size; ``active`` (..., M) bool; ``ahead`` (..., M, 4)
        log-volumes after 1, 2, 3 and ``depth`` greedy choices, relative to the best;
        and ``best`` (..., 4).
    """
    y = y * active[..., None].astype(y.dtype)
    number = jnp.maximum(active.sum(-1).astype(y.dtype), 1.0)
    square = (y * y).sum(-1)
    mean_square = jnp.maximum(square.sum(-1) / number, 1e-8)
    unit = y * jax.lax.rsqrt(mean_square)[..., None, None]
    moments = _second_moments(unit) * jax.lax.rsqrt(number)[..., None, None]
    steps = geometry.lookahead(y, spanned, active, depth, tolls)
    if entry is not None:
        steps = [jnp.where(active, step - entry, -30.0) for step in steps]
    shown = [steps[min(d, depth) - 1] for d in (1, 2, 3, depth)]
    ahead = jnp.stack(shown, axis=-1)
    best = ahead.max(-2)
    ahead = jnp.maximum(ahead - best[..., None, :], -30.0)
    level = jnp.log(jnp.maximum(square, 1e-6) / mean_square[..., None])
    short = jnp.maximum(ahead, _FLOOR)
    shown = [
        short / 2.0,
        jnp.exp(short),
        jnp.exp(4.0 * short),
        jnp.clip(level, _FLOOR, 4.0)[..., None] / 2.0,
    ]
    if close_up:
        shown.append(_close_up(short[..., 3]))
    features = jnp.concatenate(shown, axis=-1)
    return {
        "features": jnp.where(active[..., None], features, 0.0),
        "moments": moments,
        "active": active,
        "ahead": ahead,
        "best": best,
    }


def _close_up(ahead: jax.Array) -> jax.Array:
    """(..., 3) of (...,) log-volumes behind the best: 1 for the best, each sharper."""
    return jnp.stack([jnp.exp(scale * ahead) for scale in _CLOSE], axis=-1)


class _Round(nn.Module):
    """One round of messages among the active candidates, then a residual MLP.

    The message to candidate i is a linear attention with the kernel (x_i . x_j)^2:
    ``sum_j (x_i . x_j)^2 v_j``, computed through the second moments of the whole set,
    so that the cost grows with M and not with M squared.
    """

    config: NetworkConfig

    @nn.compact
    def __call__(self, h: jax.Array, glance: View) -> jax.Array:
        width = self.config.width
        active = glance["active"][..., None].astype(h.dtype)
        u = nn.LayerNorm(name="norm")(h)
        parts = [u]
        if self.config.messages:
            v = nn.Dense(width, use_bias=False, name="send")(u) * active
            moments = glance["moments"]
            total = jnp.einsum("...mf,...mw->...fw", moments, v)
            parts.append(jnp.einsum("...mf,...fw->...mw", moments, total))
            if "near" in glance:
                parts.append(jnp.einsum("...ij,...jw->...iw", glance["near"], v))
        number = jnp.maximum(active.sum(-2, keepdims=True), 1.0)
        mean = (u * active).sum(-2, keepdims=True) / number
        inner = nn.Dense(2 * width, name="mix")(jnp.concatenate(parts, axis=-1))
        pooled = nn.Dense(2 * width, use_bias=False, name="pool")(mean)
        out = nn.Dense(width, name="out")(nn.relu(inner + pooled))
        return h + out * active


class CompactNetwork(nn.Module):
    """Permutation-equivariant, affine-invariant, for any M, K and n.

    It sees the candidates only through inner products of whitened regressors, so no
    affine map of the commands and no order of the candidates can change the pick. With
    one choice left the largest gain is optimal, and with two the largest pair volume:
    those two are taken as they are (``endgame``), the network chooses before them.
    """

    config: NetworkConfig

    def setup(self) -> None:
        config = self.config
        self.embed = nn.Dense(config.width)
        self.encoder = [_Round(config) for _ in range(config.encoder_rounds)]
        self.join = nn.Dense(config.width)
        self.decoder = [_Round(config) for _ in range(config.decoder_rounds)]
        self.final_norm = nn.LayerNorm()
        self.actor = nn.Dense(
            1,
            use_bias=False,
            kernel_init=nn.initializers.orthogonal(config.initial_actor),
        )
        trust = nn.initializers.constant(config.initial_trust)
        self.trust = self.param("trust", trust, ())
        self.critic_hidden = nn.Dense(config.width)
        self.critic = nn.Dense(1, kernel_init=nn.initializers.orthogonal(0.1))

    @property
    def num_unlearned(self) -> int:
        """Choices at the end of an episode that are made without the network."""
        return min(self.config.lookahead, 2) if self.config.endgame else 0

    def look(self, candidates: jax.Array, usable: jax.Array) -> View:
        """The geometry of a set.

        Args:
            candidates: (..., M, n) commands in any unit.
            usable: (..., M) bool, available or already chosen.
        """
        x, offset = geometry.whiten(candidates, usable)
        depth = min(self.config.lookahead, x.shape[-1])
        close_up = self.config.close_up
        glance = glance_at(x, False, usable, depth, close_up=close_up)
        return glance | {"x": x, "offset": offset}

    def alike(self, view: View, k: int) -> range:
        """Numbers of choices made, out of K, after which the next is the same program:
        the chosen span the space, and the look ahead is not cut short by the end."""
        p = view["x"].shape[-1]
        ahead = max(self.config.lookahead, self.num_unlearned + 1)
        return range(p, k - ahead + 1) if k > p else range(0)

    def look_at(
        self,
        view: View,
        chosen: jax.Array,
        available: jax.Array,
        count: int | jax.Array,
    ) -> View:
        """The geometry of a decision.

        Args:
            view: from ``look``.
            chosen: (..., K) int, of which the first ``count`` are chosen, the rest -1.
            available: (..., M) bool.
            count: choices made, the same for the whole batch; traced only if one of
                ``alike``.
        """
        y, spanned, so_far, scalars, which = self.after(view, chosen, count)
        depth = self.config.lookahead
        if isinstance(count, int):
            depth = min(depth, chosen.shape[-1] - count)
        glance = glance_at(y, spanned, available, depth, close_up=self.config.close_up)
        return glance | {
            "which": which.sum(-2) / jnp.maximum(count, 1),
            "so_far": so_far + glance["best"][..., 3],
            "scalars": scalars,
        }

    def after(
        self, view: View, chosen: jax.Array, count: int | jax.Array
    ) -> tuple[jax.Array, bool, jax.Array, jax.Array, jax.Array]:
        """What is left of a set after ``count`` choices.

        Returns:
            (..., M, p) conditional vectors, and whether they are those of
            ``normalised_by``; (...,) log det(Z.T Z) so far; (..., 7) scalars of the
            progress; (..., c, M) one-hot choices, c = ``count`` or, where that is
            traced, K with zeros after it.
        """
        x = view["x"]
        p, total = x.shape[-1], chosen.shape[-1]
        left = total - count
        known = isinstance(count, int)
        shown = chosen[..., :count] if isinstance(count, int) else chosen
        which = jax.nn.one_hot(shown, x.shape[-2], dtype=x.dtype)
        picked = jnp.einsum(
            "...km,...mp->...kp", which, x, precision=jax.lax.Precision.HIGHEST
        )
        if total == p:
            # Every choice is a new direction: exact projections.
            y, spanned = geometry.projected(x, picked), False
            so_far = geometry.log_det_lengths(picked)
        else:
            # The metric of the chosen; until they span the space, with a ridge small
            # beside what a posture contributes.
            ridge = _RIDGE if known and count < p else 0.0
            y, so_far = geometry.normalised_by(x, picked, ridge)
            spanned = True
        scalars = [
            jnp.asarray(scalar, x.dtype)
            for scalar in (
                left == 1,
                left == 2,
                left == 3,
                1.0 / left,
                count / p,
                jnp.minimum(left / p, 3.0),
                total > p,
            )
        ]
        progress = jnp.broadcast_to(jnp.stack(scalars), (*so_far.shape, len(scalars)))
        return y, spanned, view["offset"] + so_far, progress, which

    def encode(self, view: View) -> jax.Array:
        """Embed a set: (..., M, width)."""
        features, active = view["features"], view["active"]
        size = jnp.log(jnp.maximum(active.sum(-1).astype(features.dtype), 1.0) / 50.0)
        dimension = jnp.full_like(size, view["x"].shape[-1] / 4.0 - 1.0)
        scalars = jnp.stack([size / 3.0, dimension], axis=-1)[..., None, :]
        scalars = jnp.broadcast_to(scalars, (*features.shape[:-1], 2))
        h = self.embed(jnp.concatenate([features, scalars], axis=-1))
        h = h * active[..., None]
        for layer in self.encoder:
            h = layer(h, view)
        return h

    def decode(self, memory: jax.Array, glance: View) -> tuple[jax.Array, jax.Array]:
        """Score the next choice.

        Returns:
            (..., M) masked logits and (...,) value, in units of log det(Z.T Z).
        """
        h, features, active = memory, glance["features"], glance["active"]
        lead = features.shape[:-1]
        mean = jnp.einsum("...m,...mw->...w", glance["which"], h)
        state = jnp.concatenate([mean, glance["scalars"]], axis=-1)[..., None, :]
        state = jnp.broadcast_to(state, (*lead, state.shape[-1]))
        h = jnp.broadcast_to(h, (*lead, h.shape[-1]))
        g = self.join(jnp.concatenate([h, features, state], axis=-1))
        g = g * active[..., None]
        for layer in self.decoder:
            g = layer(g, glance)
        g = self.final_norm(g)
        # How far to believe the greedy look ahead is learned.
        rule = 20.0 * glance["ahead"][..., 3]
        if self.config.close_up:
            rule = rule + _close_up(glance["ahead"][..., 3]).sum(-1)
        logits = self.actor(g)[..., 0] + self.trust * rule
        logits = mask_logits(logits, active)
        weight = active[..., None].astype(g.dtype)
        number = jnp.maximum(weight.sum(-2), 1.0)
        pooled = jnp.concatenate(
            [(g * weight).sum(-2) / number, (g - 1e3 * (1.0 - weight)).max(-2)], axis=-1
        )
        value = self.critic(nn.relu(self.critic_hidden(pooled)))[..., 0]
        return logits, glance["so_far"] + value

    def finish(self, glance: View) -> tuple[jax.Array, jax.Array]:
        """Logits and value of a choice that needs no network (``num_unlearned``)."""
        logits = mask_logits(_SHARP * glance["ahead"][..., 3], glance["active"])
        return logits, glance["so_far"]

    def __call__(
        self,
        candidates: jax.Array,
        usable: jax.Array,
        chosen: jax.Array,
        available: jax.Array,
    ) -> tuple[jax.Array, jax.Array]:
        view = self.look(candidates, usable)
        return self.decode(self.encode(view), self.look_at(view, chosen, available, 0))


class _Keys(nn.Module):
    """A linear map of candidates that is never applied to them.

    A score ``q . (K.T p + b)`` is ``(K q) . p`` and a number that is the same for every
    candidate, which no softmax sees; a weighted mean of keys is the key of the weighted
    mean. So the map is applied to a few queries and not to every candidate.
    """

    width: int

    def setup(self) -> None:
        shape = (self.width, self.width)
        self.kernel = self.param("kernel", nn.initializers.lecun_normal(), shape)
        self.bias = self.param("bias", nn.initializers.zeros, (self.width,))

    def __call__(self, poses: jax.Array) -> jax.Array:
        """Keys (..., width) of encoded poses (..., width)."""
        keys = poses @ self.kernel
        return keys + jnp.broadcast_to(self.bias, keys.shape)

    def scores(self, query: jax.Array, poses: jax.Array) -> jax.Array:
        """(..., M) inner products with the keys, less what all of them share."""
        return jnp.einsum("...w,...mw->...m", query @ self.kernel.T, poses)


class PaperNetwork(nn.Module):
    """The paper's attention policy: hidden 768, 3.5 M parameters, 71 % shared.

    Candidates are encoded one by one, a context encoder reads the ten numbers of the
    state that are not candidates, attention relates the two, and an actor and a critic
    stand on that shared encoder. Any M runs; it is not invariant to affine maps.
    """

    config: NetworkConfig

    num_unlearned = 0

    def setup(self) -> None:
        width = self.config.width
        self.pose_1, self.pose_2 = nn.Dense(width), nn.Dense(width)
        self.pose_norm = nn.LayerNorm()
        self.key = _Keys(width)
        self.context_1, self.context_2 = nn.Dense(width), nn.Dense(width)
        self.context_norm = nn.LayerNorm()
        self.query = nn.Dense(width)
        self.squeeze = nn.Dense(max(width * 3 // 32, 1))
        self.expand = nn.Dense(width)
        self.actor = nn.Dense(width)
        self.critic_1 = nn.Dense(max(width * 2 // 3, 1))
        self.critic_2 = nn.Dense(1, kernel_init=nn.initializers.orthogonal(0.1))

    def look(self, candidates: jax.Array, usable: jax.Array) -> View:
        """The candidates as they are."""
        return {"candidates": candidates}

    def alike(self, view: View, k: int) -> range:
        """None: every choice is written out, they are few."""
        return range(0)

    def look_at(
        self,
        view: View,
        chosen: jax.Array,
        available: jax.Array,
        count: int | jax.Array,
    ) -> View:
        """The ten context numbers and the availability of the 210."""
        context = context_features(view["candidates"], chosen)
        return {"context": context, "active": available}

    def encode(self, view: View) -> jax.Array:
        """The candidates (..., M, width), encoded one by one."""
        poses = nn.relu(self.pose_1(2.0 * view["candidates"] - 1.0))
        return self.pose_norm(nn.relu(self.pose_2(poses)))

    def decode(self, memory: jax.Array, glance: View) -> tuple[jax.Array, jax.Array]:
        """Score the next choice; see ``CompactNetwork.decode``."""
        poses = memory
        context = nn.relu(self.context_1(glance["context"]))
        context = self.context_norm(nn.relu(self.context_2(context)))
        scale = self.config.width**-0.5
        scores = self.key.scores(self.query(context), poses) * scale
        weights = nn.softmax(mask_logits(scores, glance["active"]))
        glimpse = self.key(jnp.einsum("...m,...mw->...w", weights, poses))
        shared = context + self.expand(nn.relu(self.squeeze(context + glimpse)))
        logits = self.key.scores(self.actor(shared), poses) * scale
        value = self.critic_2(nn.relu(self.critic_1(shared)))[..., 0]
        return mask_logits(logits, glance["active"]), value

    def __call__(
        self,
        candidates: jax.Array,
        usable: jax.Array,
        chosen: jax.Array,
        available: jax.Array,
    ) -> tuple[jax.Array, jax.Array]:
        view = self.look(candidates, usable)
        return self.decode(self.encode(view), self.look_at(view, chosen, available, 0))


PAPER_HEADS = ("actor", "critic_1", "critic_2")  # everything else is shared

Network = CompactNetwork | PaperNetwork


def encode(network: Network, params: Any, view: View) -> jax.Array:
    """Apply ``network.encode`` with given parameters."""
    return cast(jax.Array, network.apply({"params": params}, view, method="encode"))


def decode(
    network: Network, params: Any, memory: jax.Array, glance: View
) -> tuple[jax.Array, jax.Array]:
    """Apply ``network.decode`` with given parameters: logits and value."""
    out = network.apply({"params": params}, memory, glance, method="decode")
    return cast(tuple[jax.Array, jax.Array], out)


def build(config: NetworkConfig) -> Network:
    """The network a config names, as a flax module."""
    return CompactNetwork(config) if config.kind == "compact" else PaperNetwork(config)
