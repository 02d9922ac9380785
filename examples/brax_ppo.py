"""brax's PPO on both of jaxcal's environments: ``python examples/brax_ppo.py``."""

from __future__ import annotations

import numpy as np

from jaxcal.adaptive import GridTask
from jaxcal.adaptive.brax_env import SequentialEnv
from jaxcal.learning.brax import SelectionEnv, train
from jaxcal.learning.environments.selection import SelectionConfig


def rewards(env, length: int, steps: int) -> list[float]:
    """Mean rewards of episodes, before and after a training."""
    reached: list[float] = []

    def progress(steps: int, found: dict) -> None:
        reached.append(float(found["eval/episode_reward"]))

    train(env, length, num_timesteps=steps, num_evals=2, progress_fn=progress)
    return reached


def postures(steps: int = 200_000) -> list[float]:
    """Choose 4 of 50 postures; reward log det S / 10."""
    return rewards(SelectionEnv(SelectionConfig()), 4, steps)


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
    return rewards(SequentialEnv(made), made.horizon, steps)


if __name__ == "__main__":
    print("postures, before and after:", postures())
    print("task, before and after:", task())
