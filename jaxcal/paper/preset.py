"""The paper's observation, learned in two ways.

``paper``: the network and the schedule of the paper's Table 2, which gives no learning
rate, clip range or entropy bonus. Adam at 1e-4, 0.2 and 0.01 are the usual ones.
``observation``: a network of products that sees the same 210 numbers, by PPO alone.
"""

from __future__ import annotations

from jaxcal.learning.config import EpisodesConfig, NetworkConfig
from jaxcal.learning.environments.task import Task
from jaxcal.learning.training.presets import TrainConfig

PAPER = TrainConfig(
    preset="paper",
    about="the paper's network (3.5 million weights) and schedule; hours on a CPU",
    network=NetworkConfig(kind="paper", width=768),
    ppo=EpisodesConfig(
        num_episodes=200_000,
        episodes_per_update=16,
        slice_rows=16,
        episodes_per_set=1,
        num_epochs=10,
        num_minibatches=1,
        learning_rate=1e-4,
        final_learning_rate=1e-4,
        entropy_start=0.01,
        entropy_end=0.01,
        normalise_per_decision=False,
        value_error_limit=100.0,  # never reached: the paper's is a plain square
        advantage_limit=1e9,
        average_decay=0.99,
    ),
)

# Updates take turns: the last decision, the one before, ... Each is learned from many
# episodes that stand in the same state, the choices after it being the likeliest.
OBSERVATION = TrainConfig(
    preset="observation",
    about="the paper's 210 numbers, a network of products, PPO alone from scratch",
    network=NetworkConfig(kind="observation", decoder_rounds=2, mirrored=True),
    ppo=EpisodesConfig(
        num_episodes=6_000_000,
        episodes_per_update=1024,
        episodes_per_set=16,
        explore_once=True,
        num_minibatches=1,
        warmup_updates=40,
        entropy_start=0.3,
        value_coefficient=0.0,
        advantage_limit=5.0,
        average_decay=0.995,
    ),
    tasks=tuple(Task(num_given=given) for given in (3, 2, 1, 0)),
)
