"""Episodes as ``brax.envs.base.Env``, and what brax's trainers need; this loads brax.

The network masks what may not be chosen, from what is observed. An episode ends, it is
never cut off, so brax's ``truncation`` stays 0.
"""

from __future__ import annotations

import contextlib
import functools
import types
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

import flax.linen as nn
import jax
import jax.numpy as jnp
from brax.envs.base import Env, State, Wrapper
from brax.envs.wrappers.training import EpisodeWrapper, VmapWrapper
from brax.training import distribution
from brax.training.agents.ppo import train as brax_train
from brax.training.agents.ppo.networks import PPONetworks
from brax.training.networks import FeedForwardNetwork

from jaxcal.learning.core.network import log_softmax
from jaxcal.learning.environments.functional import FunctionalEnv, PosturesEnv, renewed


class EpisodeEnv(Env):
    """Episodes of ``env`` as a brax environment; brax's wrappers make the batch."""

    backend = "jaxcal"

    def __init__(self, env: FunctionalEnv) -> None:
        self.functional = env

    def reset(self, rng: jax.Array) -> State:
        """A new episode; ``rng`` is a legacy uint32 key, which brax's wrappers need."""
        episode, zero = self.functional.begin(rng), jnp.zeros(())
        return State(
            pipeline_state=episode,
            obs=self.functional.observation(episode),
            reward=zero,
            done=zero,
            metrics={self.functional.metric: zero},
            info={},
        )

    def step(self, state: State, action: jax.Array) -> State:
        env = self.functional
        after, reward, done, metric = env.advance(state.pipeline_state, action)
        return state.replace(
            pipeline_state=after,
            obs=env.observation(after),
            reward=reward,
            done=done.astype(jnp.float32),
            metrics=state.metrics | {env.metric: metric},
        )

    @property
    def observation_size(self) -> int:
        return self.functional.observation_size

    @property
    def action_size(self) -> int:
        return self.functional.num_actions


class SelectionEnv(EpisodeEnv):
    """Postures; arguments as of ``PosturesEnv``."""

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(PosturesEnv(*arguments, **named))


class _FreshReset(Wrapper):
    """After ``done``, a new episode from the key that the old one carried."""

    def step(self, state: State, action: jax.Array) -> State:
        state.info["steps"] = jnp.where(state.done > 0, 0.0, state.info["steps"])
        state = self.env.step(state.replace(done=jnp.zeros_like(state.done)), action)

        def begin(key: jax.Array) -> tuple[Any, jax.Array]:
            fresh = self.unwrapped.reset(key)
            return fresh.pipeline_state, fresh.obs

        # Episodes of one length end together, so all steps but their last skip this.
        episode, obs = jax.vmap(functools.partial(renewed, begin))(
            state.done > 0, state.pipeline_state.key, (state.pipeline_state, state.obs)
        )
        return state.replace(pipeline_state=episode, obs=obs)


def wrap_fresh(
    env: Env,
    episode_length: int = 1000,
    action_repeat: int = 1,
    randomization_fn: Any = None,
) -> Wrapper:
    """The ``wrap_env_fn`` for brax's trainers: a new episode after every ``done``.
    ``randomization_fn`` must be None: there is no physical system to randomise."""
    if randomization_fn is not None:
        raise ValueError("randomization_fn must be None: there is no system to vary")
    return _FreshReset(EpisodeWrapper(VmapWrapper(env), episode_length, action_repeat))


class _MaskedCategorical(distribution.ParametricDistribution):
    def create_dist(self, parameters: jax.Array) -> Any:
        log_probs = log_softmax(parameters)
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
    """A ``network_factory`` for brax's ``ppo.train``, which trains two copies of
    ``network``: (..., observation_size) -> masked logits (..., action_size) and value
    (...,); ``env.functional.network()`` when None."""
    module = env.functional.network() if network is None else network
    blank = jnp.zeros((1, env.observation_size))

    def read(part: int) -> FeedForwardNetwork:
        def apply(_: Any, params: Any, observation: jax.Array) -> Any:
            return module.apply(params, observation)[part]

        return FeedForwardNetwork(lambda key: jax.jit(module.init)(key, blank), apply)

    identity = distribution.IdentityPostprocessor()
    actions = _MaskedCategorical(
        env.action_size, identity, event_ndims=0, reparametrizable=False
    )
    return lambda *_, **__: PPONetworks(read(0), read(1), actions)


@contextlib.contextmanager
def repaired() -> Iterator[None]:
    """Let released brax train under this JAX; all is as before afterwards. brax 0.14.2
    calls ``jax.device_put_replicated``, which jax 0.10 removed (google/brax #671)."""

    def put(tree: Any, devices: list[Any]) -> Any:
        return jax.tree.map(lambda leaf: jnp.stack([leaf] * len(devices)), tree)

    patch = mock.patch.object(jax, "device_put_replicated", put, create=True)
    with patch, jax.numpy_rank_promotion("allow"):
        yield


def train(env: EpisodeEnv, length: int, **arguments: Any) -> Any:
    """brax's PPO on episodes of ``length`` decisions: what its ``train`` returns, whose
    ``arguments`` go before those here; its own defaults would cut episodes."""
    usual: dict[str, Any] = dict(
        environment=env, wrap_env_fn=wrap_fresh, network_factory=brax_networks(env),
        episode_length=length, unroll_length=length, discounting=1.0,
        learning_rate=1e-3, num_envs=256, num_eval_envs=256, batch_size=64,
        num_minibatches=16, num_updates_per_batch=4, normalize_observations=False,
    )  # fmt: skip
    with repaired():
        return brax_train.train(**usual | arguments)
