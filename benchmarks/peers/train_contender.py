"""One contender of the row "training", in a process of its own.

    python -m benchmarks.peers.train_contender WHO SETS.npz SECONDS BEGUN

Trains until ``SECONDS`` after ``BEGUN`` (``time.time()`` before this process started)
or until the greedy policy reaches 0.95, and prints "seconds ratio" at every look at the
fixed sets. Looks cost the same for all: they are inside the time.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from typing import Any

import numpy as np

ENOUGH = 0.95
LOOK_EVERY = 2.0  # seconds between looks


class Done(Exception):
    """Good enough, or out of time."""


class Clock:
    """Prints what is reached, and ends the run."""

    def __init__(self, begun: float, budget: float) -> None:
        self.begun, self.budget, self.looked = begun, budget, 0.0

    def due(self) -> bool:
        return time.time() - self.looked > LOOK_EVERY or self.over()

    def over(self) -> bool:
        return time.time() - self.begun > self.budget

    def say(self, ratio: float) -> bool:
        """Whether to stop."""
        self.looked = time.time()
        print(f"{self.looked - self.begun:.2f} {ratio:.5f}", flush=True)
        return ratio >= ENOUGH or self.over()


def jaxcal_compact(sets: np.ndarray, best: np.ndarray, clock: Clock) -> None:
    """``python train.py``: the compact preset, as it is."""
    ours("compact", sets, best, clock)


def jaxcal_paper(sets: np.ndarray, best: np.ndarray, clock: Clock) -> None:
    """jaxcal's PPO on the observation the peers see: brax's network, 64 wide."""
    ours("observation", sets, best, clock)


def ours(which: str, sets: np.ndarray, best: np.ndarray, clock: Clock) -> None:
    import dataclasses

    from jaxcal.learning.runtime import processes
    from jaxcal.learning.training import postures as training
    from jaxcal.learning.training import presets

    processes.keep_compiled_programs()
    config = presets.load("compact")
    if which == "observation":
        config = presets.with_values(
            config, {"kind": "paper", "width": 64, "num_episodes": 800_000}
        )
    config = dataclasses.replace(config, validate_every=LOOK_EVERY)
    reached: list[bool] = []

    def look(report: Any) -> None:
        reached.append(clock.say(report.metrics["ratio_to_exact"]))

    with tempfile.TemporaryDirectory() as folder:
        training.train(
            config,
            folder,
            validation=training.Validation(sets, best, 3),
            report=look,
            should_stop=lambda: any(reached) or clock.over(),
        )


def brax(sets: np.ndarray, best: np.ndarray, clock: Clock) -> None:
    """``python train.py --trainer brax``: brax's own PPO, the network 64 wide."""
    from jaxcal.learning.core.network import build
    from jaxcal.learning.runtime import processes
    from jaxcal.learning.training import brax_ppo, presets
    from jaxcal.learning.training import postures as training

    processes.keep_compiled_programs()
    config = presets.with_values(
        brax_ppo.adapted(presets.load("compact")), {"num_episodes": 3_000_000}
    )
    network = build(config.network)
    validation = training.Validation(sets, best, 3)

    def watch(step: int, make_policy: Any, params: Any) -> None:
        weights = params[1]["params"]["network"]
        if clock.say(validation.measure(network, weights, 4)[0]):
            raise Done

    with tempfile.TemporaryDirectory() as folder:
        options = {"num_evals": 500, "policy_params_fn": watch}
        brax_ppo.train(config, folder, lambda line: None, **options)


def sb3(sets: np.ndarray, best: np.ndarray, clock: Clock) -> None:
    """MaskablePPO, its defaults but for 16 environments and discount 1."""
    from sb3_contrib import MaskablePPO
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.vec_env import DummyVecEnv

    from benchmarks.peers.environments import SelectionGym, SelectionNumpy

    class Look(BaseCallback):
        def _on_step(self) -> bool:
            return not clock.over()

        def _on_rollout_start(self) -> None:
            if not clock.due():
                return
            env = SelectionNumpy(len(sets))
            observation = env.reset(sets.astype(np.float32))
            done = False
            while not done:
                action, _ = self.model.predict(
                    observation, deterministic=True, action_masks=env.free > 0
                )
                observation, reward, done = env.step(action)
            log_det = 10.0 * reward.astype(
                np.float64
            )  # of S: the reward's scale is 0.1
            gap = np.minimum(log_det - 3.0 * best, 0.0)
            if clock.say(float(np.exp(gap).mean())):
                raise Done

    env = DummyVecEnv([SelectionGym] * 16)
    model = MaskablePPO("MlpPolicy", env, n_steps=128, gamma=1.0, device="cpu", seed=0)
    model.learn(10**9, callback=Look())


CONTENDERS: dict[str, Callable[[np.ndarray, np.ndarray, Clock], None]] = {
    "jaxcal": jaxcal_compact,
    "jaxcal-observation": jaxcal_paper,
    "brax": brax,
    "sb3": sb3,
}


def main() -> None:
    who, file, budget, begun = sys.argv[1:]
    held = np.load(file)
    clock = Clock(float(begun), float(budget))
    try:
        CONTENDERS[who](held["sets"], held["best"], clock)
    except Done:
        pass


if __name__ == "__main__":
    main()
