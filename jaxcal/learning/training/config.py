"""Every number of a training run."""

from __future__ import annotations

import dataclasses
from dataclasses import field
from typing import Any

from jaxcal.learning.environments.task import Task
from jaxcal.learning.policies.networks import NetworkConfig
from jaxcal.learning.settings import require, setting

__all__ = ["PPOConfig", "TrainConfig"]


@dataclasses.dataclass(frozen=True)
class PPOConfig:
    """Every number of the optimisation."""

    num_episodes: int = setting(200_000, "training budget")
    episodes_per_update: int = setting(2048, "fresh episodes in an update")
    episodes_per_set: int = setting(
        8, "episodes on the same candidates, which share a baseline"
    )
    num_epochs: int = setting(2, "passes over the episodes of an update")
    num_minibatches: int = setting(4, "gradient steps per pass")
    learning_rate: float = setting(2e-3, "of Adam, after the warm-up")
    final_learning_rate: float = setting(3e-5, "at the end; a cosine leads there")
    warmup_updates: int = setting(5, "updates in which the learning rate rises")
    clip_range: float = setting(0.2, "most that a probability ratio counts beyond 1")
    value_coefficient: float = setting(0.5, "weight of the value's squared error")
    value_error_limit: float = setting(
        3.0, "reward units; a larger error of the value (a singular pick) is clipped"
    )
    entropy_start: float = setting(0.02, "entropy bonus at the beginning")
    entropy_end: float = setting(0.0, "entropy bonus at the end; linear between")
    discount: float = setting(1.0, "of a reward one decision later")
    gae_lambda: float = setting(1.0, "of the advantages; 1 is return less value")
    normalise_per_decision: bool = setting(
        True, "advantages: own mean and scale for each decision of an episode"
    )
    advantage_limit: float = setting(
        6.0, "standard deviations; a larger advantage (a singular pick) is clipped"
    )
    max_grad_norm: float = setting(0.5, "global norm at which gradients are clipped")
    average_decay: float = setting(
        0.99, "for each gradient step, of the averaged weights, which are what is kept"
    )
    imitation: float = setting(
        0.0, "share of the updates, the first, that imitate the solvers"
    )
    seed: int = setting(0, "of everything random")

    def __post_init__(self) -> None:
        counts = ["num_episodes", "episodes_per_update", "episodes_per_set"]
        counts += ["num_epochs", "num_minibatches"]
        require(self, "at least 1", lambda v: v >= 1, *counts)
        if self.episodes_per_update % (self.episodes_per_set * self.num_minibatches):
            raise ValueError(
                "episodes_per_update must be a multiple of episodes_per_set x "
                f"num_minibatches = {self.episodes_per_set * self.num_minibatches}, "
                f"got {self.episodes_per_update}"
            )
        positive = ("learning_rate", "clip_range", "max_grad_norm", "value_error_limit")
        require(self, "positive", lambda v: v > 0, *positive)
        shares = ("discount", "gae_lambda", "imitation")
        require(self, "in [0, 1]", lambda v: 0.0 <= v <= 1.0, *shares)
        require(self, "in [0, 1)", lambda v: 0.0 <= v < 1.0, "average_decay")
        require(self, "0 or more", lambda v: v >= 0, "seed")

    @property
    def num_updates(self) -> int:
        """Updates that cover the budget, rounded up."""
        return -(-self.num_episodes // self.episodes_per_update)

    @property
    def num_imitated(self) -> int:
        """Updates that imitate, before the others."""
        return round(self.imitation * self.num_updates)

    @property
    def steps_per_update(self) -> int:
        """Gradient steps in an update."""
        return self.num_epochs * self.num_minibatches

    @property
    def sets_per_minibatch(self) -> int:
        """Candidate sets in a minibatch: what devices share among them."""
        return self.episodes_per_update // self.episodes_per_set // self.num_minibatches


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """A whole run: what, with what, and how often to look."""

    preset: str = "compact"
    network: NetworkConfig = field(default_factory=NetworkConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    tasks: tuple[Task, ...] = field(default=(Task(),))  # update u: tasks[u % len]
    validate_every: float = 15.0  # seconds between looks at the validation set
    save_every: float = 60.0  # seconds between checkpoints
    about: str = ""  # one line for --help, of a preset

    def task_of(self, update: int) -> Task:
        """What update number ``update``, from 0, trains on."""
        return self.tasks[update % len(self.tasks)]

    def as_meta(self) -> dict[str, Any]:
        """Plain JSON values; ``from_meta`` reads them back."""
        return {
            "preset": self.preset,
            "network": dataclasses.asdict(self.network),
            "ppo": dataclasses.asdict(self.ppo),
            "tasks": [task.as_meta() for task in self.tasks],
        }

    @staticmethod
    def from_meta(meta: dict[str, Any]) -> TrainConfig:
        """The configuration a checkpoint was trained with."""
        return TrainConfig(
            preset=meta["preset"],
            network=NetworkConfig(**meta["network"]),
            ppo=PPOConfig(**meta["ppo"]),
            tasks=tuple(Task.from_meta(task) for task in meta["tasks"]),
        )
