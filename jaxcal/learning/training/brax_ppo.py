"""brax's own PPO on the environment of postures: ``python train.py --trainer brax``.

The policy is the paper's network: brax's trainer gives it the observation alone.
"""

from __future__ import annotations

import dataclasses
import pathlib
import time
from collections.abc import Callable
from typing import Any

import jax

from jaxcal.learning import brax
from jaxcal.learning.config import NetworkConfig, settings_of
from jaxcal.learning.environments.selection import SelectionConfig
from jaxcal.learning.training import checkpoint
from jaxcal.learning.training.presets import TrainConfig
from jaxcal.learning.training.run import locked

_READ = {  # fields of PPOConfig that brax is given: brax's names
    "learning_rate": "learning_rate",
    "entropy_start": "entropy_cost",
    "discount": "discounting",
    "gae_lambda": "gae_lambda",
    "clip_range": "clipping_epsilon",
    "max_grad_norm": "max_grad_norm",
}
READ = {*_READ, "num_episodes", "seed", "width"} | {
    field.name for field in settings_of(SelectionConfig)
}


def adapted(config: TrainConfig) -> TrainConfig:
    """A preset for brax: the paper's network, a learning rate of at most 1e-3, and at
    least 200,000 episodes, since the network begins from nothing."""
    width = config.network.width if config.network.kind == "paper" else 64
    rate = min(config.ppo.learning_rate, 1e-3)  # brax's updates diverge at 2e-3
    episodes = max(config.ppo.num_episodes, 200_000)
    ppo = dataclasses.replace(config.ppo, learning_rate=rate, num_episodes=episodes)
    network = NetworkConfig(kind="paper", width=width)
    return dataclasses.replace(config, network=network, ppo=ppo)


def train(
    config: TrainConfig,
    folder: str | pathlib.Path,
    say: Callable[[str], None],
    **more: Any,
) -> None:
    """Train with ``brax.training.agents.ppo.train`` and save a checkpoint, whose meta
    holds only what brax was given. ``config`` is from ``adapted``, ``say`` gets each
    line of progress, ``more`` are further arguments of brax's ``train``."""
    task, episodes = config.tasks[0], config.ppo.num_episodes
    env, length = task.environment, task.environment.num_selected
    read = {name: getattr(config.ppo, name) for name in _READ}
    given = {_READ[name]: value for name, value in read.items()} | {"num_evals": 10}
    given |= {"num_timesteps": episodes * length, "seed": config.seed, **more}
    begun = time.perf_counter()

    def progress(steps: int, metrics: dict[str, Any]) -> None:
        log_det, seconds = metrics["eval/episode_log_det"], time.perf_counter() - begun
        say(f"{steps:10,d} decisions  {seconds:7.1f} s  mean log det S {log_det:.3f}")

    with locked(pathlib.Path(folder)):
        say("brax is compiling (about half a minute) ...")
        environment = brax.SelectionEnv(env, task.draw, config.network)
        _, params, _ = brax.train(environment, length, progress_fn=progress, **given)
        meta = config.as_meta() | {
            "network": {"kind": config.network.kind, "width": config.network.width},
            "ppo": read | {"num_episodes": episodes},
            "trainer": "brax",
            "brax": {
                name: value for name, value in given.items() if not callable(value)
            },
            "progress": {
                "episodes": episodes,
                "seconds": time.perf_counter() - begun,
                "device": jax.devices()[0].device_kind,
            },
        }
        policy = params[1]["params"]["network"]  # of the policy, jaxcal's network
        checkpoint.save(pathlib.Path(folder) / "checkpoint", episodes, policy, meta)
