"""brax's PPO on both of jaxcal's environments: ``python examples/brax_ppo.py``."""

from __future__ import annotations

from brax.training.agents.ppo import train as ppo

from jaxcal.adaptive.brax_env import SequentialEnv
from jaxcal.adaptive.tasks.knee import STATE_RULE, knee
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


def task(steps: int = 100_000) -> list[float]:
    """Find a small knee; reward in nats."""
    made = knee(cells=4, sigma=0.05, seconds=(5.0, 9.0))
    return train(SequentialEnv(made, STATE_RULE, 2), made.horizon, steps)


if __name__ == "__main__":
    print("postures, before and after:", postures())
    print("task, before and after:", task())
