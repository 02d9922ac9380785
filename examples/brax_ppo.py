"""brax's PPO on both of jaxcal's environments: ``python examples/brax_ppo.py``."""

from __future__ import annotations

import numpy as np
from brax.training.agents.ppo import train as ppo

from jaxcal.adaptive import GridTask
from jaxcal.adaptive.brax_env import SequentialEnv
from jaxcal.learning.brax import SelectionEnv, brax_networks, repaired, wrap_fresh
from jaxcal.learning.environments.selection import SelectionConfig


def train(env, length: int, steps: int = 200_000, **more):
    """Metrics of evaluations before and after: ``eval/episode_reward``."""
    seen: list[float] = []

    def progress(steps: int, found: dict) -> None:
        seen.append(float(found["eval/episode_reward"]))

    with repaired():
        ppo.train(
            environment=env, network_factory=brax_networks(env), wrap_env_fn=wrap_fresh,
            num_timesteps=steps, episode_length=length, unroll_length=length,
            num_envs=256, batch_size=64, num_minibatches=16, num_updates_per_batch=4,
            discounting=1.0, learning_rate=1e-3, num_evals=2, num_eval_envs=256,
            progress_fn=progress, **more,
        )  # fmt: skip
    return seen


def postures(steps: int = 200_000) -> list[float]:
    """Choose 4 of 50 postures; reward log det S / 10."""
    return train(SelectionEnv(SelectionConfig()), 4, steps)


def ladder(rungs: int = 24) -> GridTask:
    """Which rung of a ladder is the highest that holds? A test takes half a second, the
    way along the ladder 4 s, a rung that breaks 2 s more, and one or two may break."""
    strength, load = np.arange(rungs) + 0.5, np.arange(1, rungs)
    way = np.abs(np.append(load, 1)[:, None] - load) / rungs
    breaks = 0.02 + 0.96 * (load[:, None] > strength)  # one reading in fifty is wrong
    return GridTask.make(
        strength, load / rungs, np.stack([1.0 - breaks, breaks], axis=1),
        travel=0.5 + 4.0 * way, extra=[0.0, 2.0], uses=[0, 1], num_uses=(1, 2),
        seconds=(4.0, 12.0), horizon=16,
    )  # fmt: skip


def task(steps: int = 100_000) -> list[float]:
    """Sessions on a ladder of one's own; reward in nats."""
    made = ladder()
    return train(SequentialEnv(made), made.horizon, steps)


if __name__ == "__main__":
    print("postures, before and after:", postures())
    print("task, before and after:", task())
