"""The same environment trained by brax's own PPO: ``python train.py --trainer brax``.

brax 0.14.2 calls ``jax.device_put_replicated``, which jax 0.10 removed; its main branch
is mended, its newest release is not. ``_replicated`` puts the function back while brax
trains and takes it away again. The policy is the paper's architecture, because brax's
trainer gives a network the observation and nothing else; it is masked by the
availability in that observation.
"""

from __future__ import annotations

import contextlib
import pathlib
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
from brax.training import distribution
from brax.training.agents.ppo import networks as brax_networks
from brax.training.agents.ppo import train as brax_train
from brax.training.networks import FeedForwardNetwork

from jaxcal.learning.environments.brax_env import SelectionEnv, wrap_fresh
from jaxcal.learning.environments.scenarios import mixture
from jaxcal.learning.environments.selection import SelectionConfig
from jaxcal.learning.policies import networks
from jaxcal.learning.policies.networks import NetworkConfig
from jaxcal.learning.training import checkpoint
from jaxcal.learning.training.run import TrainConfig

__all__ = ["MaskedCategorical", "train"]


class _Categorical:
    """One batch of categorical distributions over candidates."""

    def __init__(self, logits: jax.Array) -> None:
        self.logits = logits
        # brax's loss logs ``loc`` and ``scale`` of every distribution; a categorical
        # one has neither, so it is given its largest probability and its entropy.
        self.loc = jax.nn.softmax(logits).max(-1)
        self.scale = self.entropy()

    def sample(self, seed: jax.Array) -> jax.Array:
        return jax.random.categorical(seed, self.logits)

    def mode(self) -> jax.Array:
        return jnp.argmax(self.logits, axis=-1)

    def log_prob(self, x: jax.Array) -> jax.Array:
        log_probs = jax.nn.log_softmax(self.logits)
        index = x.astype(jnp.int32)[..., None]
        return jnp.take_along_axis(log_probs, index, axis=-1)[..., 0]

    def entropy(self) -> jax.Array:
        log_probs = jax.nn.log_softmax(self.logits)
        return -(jnp.exp(log_probs) * log_probs).sum(-1)


class MaskedCategorical(distribution.ParametricDistribution):
    """brax's distribution interface over logits that the network has masked."""

    def __init__(self, num_actions: int) -> None:
        super().__init__(
            param_size=num_actions,
            postprocessor=distribution.IdentityPostprocessor(),
            event_ndims=0,
            reparametrizable=False,
        )

    def create_dist(self, parameters: jax.Array) -> _Categorical:
        return _Categorical(parameters)


def _make_networks(
    env: SelectionConfig, width: int
) -> Callable[..., brax_networks.PPONetworks]:
    """The paper's network read from the observation, for the policy and the value."""
    network = networks.build(NetworkConfig(kind="paper", width=width))
    m, n = env.num_candidates, env.num_inputs

    def read(params: Any, observation: jax.Array) -> tuple[jax.Array, jax.Array]:
        lead = observation.shape[:-1]
        candidates = observation[..., : n * m].reshape(*lead, m, n)
        available = observation[..., n * m : (n + 1) * m] > 0.5
        glance = {"context": observation[..., (n + 1) * m :], "active": available}
        memory = networks.encode(network, params, network.look(candidates, available))
        return networks.decode(network, params, memory, glance)

    def init(key: jax.Array) -> Any:
        return network.init(
            key,
            jnp.zeros((1, m, n)),
            jnp.ones((1, m), bool),
            jnp.full((1, env.num_selected), -1, jnp.int32),
            jnp.ones((1, m), bool),
        )["params"]

    def factory(
        observation_size: Any, action_size: int, preprocess_observations_fn: Any = None
    ) -> brax_networks.PPONetworks:
        return brax_networks.PPONetworks(
            policy_network=FeedForwardNetwork(
                init=init, apply=lambda _, params, obs: read(params, obs)[0]
            ),
            value_network=FeedForwardNetwork(
                init=init, apply=lambda _, params, obs: read(params, obs)[1]
            ),
            parametric_action_distribution=MaskedCategorical(action_size),
        )

    return factory


@contextlib.contextmanager
def _replicated() -> Iterator[None]:
    """``jax.device_put_replicated`` for as long as brax 0.14.2 needs it."""
    if hasattr(jax, "device_put_replicated"):
        yield
        return

    def device_put_replicated(tree: Any, devices: Any) -> Any:
        return jax.tree.map(lambda leaf: jnp.stack([leaf] * len(devices)), tree)

    vars(jax)["device_put_replicated"] = device_put_replicated
    try:
        yield
    finally:
        del vars(jax)["device_put_replicated"]


def train(
    config: TrainConfig,
    folder: str | pathlib.Path,
    say: Callable[[str], None],
    num_evals: int = 10,
    watch: Callable[[int, Any], None] = lambda step, params: None,
) -> Any:
    """Train with ``brax.training.agents.ppo.train`` and save a checkpoint.

    Args:
        config: environment, budget, seed and learning rate; the network is the paper's
            architecture, 64 wide for the compact preset.
        folder: of the run.
        say: takes a line of progress.
        num_evals: how often brax reports.
        watch: called with the step and the policy's parameters at every report.

    Returns:
        The policy's parameters.
    """
    env = config.tasks[0].environment
    width = config.network.width if config.network.kind == "paper" else 64
    factory = _make_networks(env, width)
    draw = mixture(env, config.tasks[0].shapes, config.tasks[0].masked)
    begun = time.perf_counter()

    def progress(steps: int, metrics: dict[str, Any]) -> None:
        seconds = time.perf_counter() - begun
        say(
            f"{steps:10,d} decisions  {seconds:7.1f} s  "
            f"mean log det S {metrics['eval/episode_log_det']:.3f}"
        )

    say("brax is compiling (about half a minute) ...")
    with _replicated(), jax.numpy_rank_promotion("allow"):
        _, params, _ = brax_train.train(
            environment=SelectionEnv(env, draw),
            num_timesteps=config.ppo.num_episodes * env.num_selected,
            wrap_env_fn=wrap_fresh,
            num_envs=256,
            num_eval_envs=256,
            episode_length=env.num_selected,
            unroll_length=env.num_selected,
            batch_size=64,
            num_minibatches=16,
            num_updates_per_batch=4,
            learning_rate=min(config.ppo.learning_rate, 1e-3),
            entropy_cost=config.ppo.entropy_start,
            discounting=config.ppo.discount,
            gae_lambda=config.ppo.gae_lambda,
            clipping_epsilon=config.ppo.clip_range,
            max_grad_norm=config.ppo.max_grad_norm,
            normalize_observations=False,
            network_factory=factory,
            seed=config.ppo.seed,
            num_evals=num_evals,
            progress_fn=progress,
            policy_params_fn=lambda step, _, params: watch(step, params[1]),
        )
    policy = params[1]
    meta = config.as_meta() | {
        "network": {"kind": "paper", "width": width},
        "trainer": "brax",
        "seed": config.ppo.seed,
        "progress": {
            "episodes": config.ppo.num_episodes,
            "seconds": time.perf_counter() - begun,
            "device": jax.devices()[0].device_kind,
        },
    }
    root = pathlib.Path(folder) / "checkpoint"
    checkpoint.save(root, config.ppo.num_episodes, policy, meta)
    return policy
