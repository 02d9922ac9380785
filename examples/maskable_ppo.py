"""Postures learned by MaskablePPO of sb3-contrib, as its users write it.

    pip install sb3-contrib          # brings PyTorch
    python examples/maskable_ppo.py  # two minutes on two cores

Two of eight commands of one axis, whose line is known best from the two farthest apart.
It prints the mean reward (a tenth of log det S) of a policy before and after training,
of random choices and of the best.
"""

from __future__ import annotations

import sys
import time

import gymnasium
import numpy as np
from sb3_contrib import MaskablePPO
from stable_baselines3.common.env_util import make_vec_env

import jaxcal
import jaxcal.learning.gym  # registers the environment

SIZES = {"num_candidates": 8, "num_inputs": 1, "num_outputs": 1, "num_selected": 2}
EPISODES = 200


def env() -> gymnasium.Env:
    return gymnasium.make("jaxcal/Postures-v0", **SIZES)


def played(choose) -> tuple[float, float]:
    """Mean reward of EPISODES unseen sets, and of the best choices from them."""
    one, rewards, best = env(), [], []
    for episode in range(EPISODES):
        obs, info = one.reset(seed=10_000 + episode)
        candidates = obs[:8, None].astype(np.float64)
        best.append(0.1 * jaxcal.select(candidates, 2, "exact").log_det)
        over = False
        while not over:
            obs, reward, over, _, info = one.step(choose(obs, info["action_mask"]))
        rewards.append(reward)
    return float(np.mean(rewards)), float(np.mean(best))


def main(steps: int) -> None:
    rng = np.random.default_rng(0)
    envs = make_vec_env(env, n_envs=8, seed=0)
    model = MaskablePPO(
        "MlpPolicy", envs, n_steps=256, batch_size=512, gamma=1.0, learning_rate=1e-3,
        ent_coef=0.005, policy_kwargs={"net_arch": [128, 128]}, seed=0, device="cpu",
    )  # fmt: skip

    def by_policy(obs, mask):
        return int(model.predict(obs, action_masks=mask, deterministic=True)[0])

    random, best = played(lambda obs, mask: int(rng.choice(np.flatnonzero(mask))))
    before, _ = played(by_policy)
    start = time.perf_counter()
    model.learn(steps)
    seconds = time.perf_counter() - start
    after, _ = played(by_policy)
    print(
        f"mean reward: random {random:.3f}, before {before:.3f}, after {steps:,} steps "
        f"in {seconds:.0f} s {after:.3f}, best {best:.3f}"
    )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100_000)
