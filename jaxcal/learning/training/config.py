"""Configuration of a training run of postures."""

from __future__ import annotations

import dataclasses
from dataclasses import field
from typing import Any

from jaxcal.learning.config import EpisodesConfig, RunConfig
from jaxcal.learning.core.postures import Postures
from jaxcal.learning.environments.task import Task
from jaxcal.learning.policies.build import build
from jaxcal.learning.policies.networks import NetworkConfig
from jaxcal.learning.settings import require, setting

__all__ = ["TrainConfig"]

_PLAIN = ("preset", "imitation")  # fields that JSON holds as is


@dataclasses.dataclass(frozen=True)
class TrainConfig(RunConfig):
    """Network, optimisation and tasks of a run that trains on postures."""

    preset: str = "compact"
    network: NetworkConfig = field(default_factory=NetworkConfig)
    ppo: EpisodesConfig = field(default_factory=EpisodesConfig)
    tasks: tuple[Task, ...] = field(default=(Task(),))  # update u: tasks[u % len]
    imitation: float = setting(
        0.0, "share of the updates, from the first on, that imitate the solvers"
    )
    about: str = ""  # one line for --help, of a preset

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self, "in [0, 1]", lambda v: 0.0 <= v <= 1.0, "imitation")

    @property
    def num_imitated(self) -> int:
        """Updates that imitate, before the others."""
        return round(self.imitation * self.ppo.num_updates)

    @property
    def learners(self) -> tuple[Postures, ...]:
        """Learners of the tasks; update u trains number u modulo theirs."""
        network = build(self.network)
        return tuple(Postures(self.ppo, task, network) for task in self.tasks)

    def as_meta(self) -> dict[str, Any]:
        """Plain JSON values; ``from_meta`` reads them back."""
        return super().as_meta() | {
            **{name: getattr(self, name) for name in _PLAIN},
            "network": dataclasses.asdict(self.network),
            "tasks": [task.as_meta() for task in self.tasks],
        }

    @staticmethod
    def from_meta(meta: dict[str, Any]) -> TrainConfig:
        """The configuration a checkpoint was trained with."""
        return TrainConfig(
            **{name: meta[name] for name in _PLAIN},
            **RunConfig.held_in(meta),
            network=NetworkConfig(**meta["network"]),
            ppo=EpisodesConfig(**meta["ppo"]),
            tasks=tuple(Task.from_meta(task) for task in meta["tasks"]),
        )
