"""The same environment trained by brax's own PPO: ``python train.py --trainer brax``.

The policy is the paper's architecture, because brax's trainer gives a network the
observation and nothing else; it is masked by the availability in that observation.
"""

from __future__ import annotations

import dataclasses
import functools
import pathlib
import time
import types
from collections.abc import Callable, Collection
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
from brax.training import distribution
from brax.training.agents.ppo import train as brax_train
from brax.training.agents.ppo.networks import PPONetworks
from brax.training.networks import FeedForwardNetwork

from jaxcal.learning.core.network import initial
from jaxcal.learning.environments.brax_env import SelectionEnv, wrap_fresh
from jaxcal.learning.environments.selection import SelectionConfig
from jaxcal.learning.policies.compact import build
from jaxcal.learning.policies.networks import NetworkConfig
from jaxcal.learning.settings import settings_of
from jaxcal.learning.training import checkpoint
from jaxcal.learning.training.config import TrainConfig

__all__ = ["adapted", "require_read", "train"]

_READ = {  # fields of PPOConfig that brax is given: brax's names
    "learning_rate": "learning_rate",
    "entropy_start": "entropy_cost",
    "discount": "discounting",
    "gae_lambda": "gae_lambda",
    "clip_range": "clipping_epsilon",
    "max_grad_norm": "max_grad_norm",
}
_FIXED = dict(
    num_envs=256, num_eval_envs=256, batch_size=64, num_minibatches=16,
    num_updates_per_batch=4, normalize_observations=False, num_evals=10,
)  # fmt: skip


def adapted(config: TrainConfig) -> TrainConfig:
    """A preset for brax: the paper's network, a learning rate of at most 1e-3."""
    width = config.network.width if config.network.kind == "paper" else 64
    rate = min(config.ppo.learning_rate, 1e-3)  # brax's updates diverge at 2e-3
    ppo = dataclasses.replace(config.ppo, learning_rate=rate)
    network = NetworkConfig(kind="paper", width=width)
    return dataclasses.replace(config, network=network, ppo=ppo)


def require_read(given: Collection[str]) -> None:
    """Refuse values of fields, by name, that brax's trainer would not read."""
    known = {*_READ, "num_episodes", "seed", "width"}
    known |= {field.name for field in settings_of(SelectionConfig)}
    if unread := sorted(set(given) - known):
        flags = ", ".join("--" + name.replace("_", "-") for name in unread)
        raise ValueError(f"--trainer brax does not read {flags}: leave it out")


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


def _networks(env: SelectionConfig, config: NetworkConfig) -> PPONetworks:
    """A network read from the observation, for the policy and the value."""
    network, m, n = build(config), env.num_candidates, env.num_inputs

    def read(part: int) -> FeedForwardNetwork:
        def apply(_: Any, params: Any, observation: jax.Array) -> Any:
            weights, method = {"params": params}, "from_observation"
            return network.apply(weights, observation, m, n, method=method)[part]

        begin = functools.partial(initial, network, m=m, n=n, k=env.num_selected)
        return FeedForwardNetwork(init=begin, apply=apply)

    identity = distribution.IdentityPostprocessor()
    actions = _MaskedCategorical(m, identity, event_ndims=0, reparametrizable=False)
    return PPONetworks(read(0), read(1), actions)


def _replicated(tree: Any, devices: list[Any]) -> Any:
    """``jax.device_put_replicated``, which brax 0.14.2 calls and jax 0.10 removed.

    google/brax issue 671: fixed on its main branch, not in its newest release.
    """
    return jax.tree.map(lambda leaf: jnp.stack([leaf] * len(devices)), tree)


def train(
    config: TrainConfig,
    folder: str | pathlib.Path,
    say: Callable[[str], None],
    **more: Any,
) -> None:
    """Train with ``brax.training.agents.ppo.train`` and save a checkpoint.

    Of network and optimisation, the checkpoint's meta holds only what brax was given.

    Args:
        config: from ``adapted``.
        folder: of the run.
        say: called with each line of progress.
        more: further arguments of brax's ``train``, such as ``num_evals``.
    """
    task, episodes = config.tasks[0], config.ppo.num_episodes
    env, length = task.environment, task.environment.num_selected
    read = {name: getattr(config.ppo, name) for name in _READ}
    given = _FIXED | {_READ[name]: value for name, value in read.items()}
    given |= {"num_timesteps": episodes * length, "seed": config.seed}
    given |= {"episode_length": length, "unroll_length": length, **more}
    begun = time.perf_counter()

    def progress(steps: int, metrics: dict[str, Any]) -> None:
        log_det, seconds = metrics["eval/episode_log_det"], time.perf_counter() - begun
        say(f"{steps:10,d} decisions  {seconds:7.1f} s  mean log det S {log_det:.3f}")

    say("brax is compiling (about half a minute) ...")
    repaired = mock.patch.object(jax, "device_put_replicated", _replicated, create=True)
    with repaired, jax.numpy_rank_promotion("allow"):
        _, params, _ = brax_train.train(
            environment=SelectionEnv(env, task.draw),
            wrap_env_fn=wrap_fresh,
            network_factory=lambda *_, **__: _networks(env, config.network),
            progress_fn=progress,
            **given,
        )
    meta = config.as_meta() | {
        "network": {"kind": config.network.kind, "width": config.network.width},
        "ppo": read | {"num_episodes": episodes},
        "trainer": "brax",
        "brax": {name: value for name, value in given.items() if not callable(value)},
        "progress": {
            "episodes": episodes,
            "seconds": time.perf_counter() - begun,
            "device": jax.devices()[0].device_kind,
        },
    }
    checkpoint.save(pathlib.Path(folder) / "checkpoint", episodes, params[1], meta)
