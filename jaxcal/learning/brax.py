"""What brax's own trainers need to train on jaxcal's environments; this loads brax.

    from brax.training.agents.ppo import train as ppo
    from jaxcal.learning.brax import brax_networks, repaired, wrap_fresh

    with repaired():
        act, params, metrics = ppo.train(
            environment=env, network_factory=brax_networks(env),
            wrap_env_fn=wrap_fresh, episode_length=4, unroll_length=4, ...
        )

``env`` is a ``SelectionEnv`` of postures, or a ``SequentialEnv`` of a task from
``jaxcal.adaptive.brax_env``. Masked options are never sampled: the network masks them
from what is observed.
"""

from __future__ import annotations

import contextlib
import types
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

import flax.linen as nn
import jax
import jax.numpy as jnp
from brax.training import distribution
from brax.training.agents.ppo.networks import PPONetworks
from brax.training.networks import FeedForwardNetwork

from jaxcal.learning.environments.brax_env import EpisodeEnv, SelectionEnv, wrap_fresh

__all__ = ["SelectionEnv", "brax_networks", "repaired", "wrap_fresh"]


class _MaskedCategorical(distribution.ParametricDistribution):
    """brax's distribution interface over logits that the network has masked."""

    def create_dist(self, parameters: jax.Array) -> Any:
        log_probs = jax.nn.log_softmax(parameters)
        entropy = -(jnp.exp(log_probs) * log_probs).sum(-1)

        def log_prob(x: jax.Array) -> jax.Array:
            one = jax.nn.one_hot(x.astype(jnp.int32), log_probs.shape[-1])
            return (one * log_probs).sum(-1)

        return types.SimpleNamespace(
            sample=lambda seed: jax.random.categorical(seed, log_probs),
            mode=lambda: jnp.argmax(log_probs, axis=-1),
            log_prob=log_prob,
            entropy=lambda: entropy,
            # brax's loss logs these two of every distribution.
            loc=jnp.exp(log_probs).max(-1),
            scale=entropy,
        )


def brax_networks(
    env: EpisodeEnv, network: nn.Module | None = None
) -> Callable[..., PPONetworks]:
    """A ``network_factory`` for ``brax.training.agents.ppo.train``.

    Args:
        env: postures or a task.
        network: (..., observation_size) -> masked logits (..., action_size) and value
            (...,); ``env.functional.network()`` when None. brax trains two copies of
            its weights, one for the policy and one for the value.
    """
    module = env.functional.network() if network is None else network
    blank = jnp.zeros((1, env.observation_size))

    def read(part: int) -> FeedForwardNetwork:
        def apply(_: Any, params: Any, observation: jax.Array) -> Any:
            answer: Any = module.apply(params, observation)
            return answer[part]

        return FeedForwardNetwork(
            init=lambda key: jax.jit(module.init)(key, blank), apply=apply
        )

    identity = distribution.IdentityPostprocessor()
    actions = _MaskedCategorical(
        env.action_size, identity, event_ndims=0, reparametrizable=False
    )
    return lambda *_, **__: PPONetworks(read(0), read(1), actions)


def _replicated(tree: Any, devices: list[Any]) -> Any:
    """``jax.device_put_replicated``, which brax 0.14.2 calls and jax 0.10 removed.

    google/brax issue 671: fixed on its main branch, not in its newest release.
    """
    return jax.tree.map(lambda leaf: jnp.stack([leaf] * len(devices)), tree)


@contextlib.contextmanager
def repaired() -> Iterator[None]:
    """Let released brax train under this JAX; all is as before afterwards."""
    put = mock.patch.object(jax, "device_put_replicated", _replicated, create=True)
    with put, jax.numpy_rank_promotion("allow"):
        yield
