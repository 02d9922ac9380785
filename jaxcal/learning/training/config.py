"""Configuration of a training run of postures."""

from __future__ import annotations

import dataclasses
from dataclasses import field
from typing import Any

from jaxcal.learning.config import EpisodesConfig, Sweep, runs_of
from jaxcal.learning.core.postures import Postures
from jaxcal.learning.environments.task import Task
from jaxcal.learning.policies.compact import build
from jaxcal.learning.policies.networks import NetworkConfig
from jaxcal.learning.settings import require, setting

__all__ = ["TrainConfig"]

_PLAIN = ("preset", "imitation", "seed", "num_seeds")  # fields that JSON holds as is


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """Network, optimisation and tasks of a run; how often it validates and saves."""

    preset: str = "compact"
    network: NetworkConfig = field(default_factory=NetworkConfig)
    ppo: EpisodesConfig = field(default_factory=EpisodesConfig)
    tasks: tuple[Task, ...] = field(default=(Task(),))  # update u: tasks[u % len]
    imitation: float = setting(
        0.0, "share of the updates, from the first on, that imitate the solvers"
    )
    seed: int = setting(0, "of everything random")
    num_seeds: int = setting(1, "runs side by side: seed, seed + 1, ...")
    sweep: Sweep = ()  # side by side too: every combination, for every seed
    validate_every: float = 15.0  # seconds between validations
    save_every: float = 60.0  # seconds between checkpoints
    about: str = ""  # one line for --help, of a preset

    def __post_init__(self) -> None:
        require(self, "0 or more", lambda v: v >= 0, "seed")
        require(self, "at least 1", lambda v: v >= 1, "num_seeds")
        require(self, "in [0, 1]", lambda v: 0.0 <= v <= 1.0, "imitation")
        self.ppo.require_sweep(self.sweep)

    @property
    def num_runs(self) -> int:
        """Runs side by side: seeds times swept values."""
        return len(runs_of(self.seed, self.num_seeds, self.sweep))

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
        return {
            **{name: getattr(self, name) for name in _PLAIN},
            "network": dataclasses.asdict(self.network),
            "ppo": dataclasses.asdict(self.ppo),
            "sweep": [[name, list(values)] for name, values in self.sweep],
            "tasks": [task.as_meta() for task in self.tasks],
        }

    @staticmethod
    def from_meta(meta: dict[str, Any]) -> TrainConfig:
        """The configuration a checkpoint was trained with."""
        return TrainConfig(
            **{name: meta[name] for name in _PLAIN},
            network=NetworkConfig(**meta["network"]),
            ppo=EpisodesConfig(**meta["ppo"]),
            sweep=tuple(
                (name, tuple(values)) for name, values in meta.get("sweep", ())
            ),
            tasks=tuple(Task.from_meta(task) for task in meta["tasks"]),
        )
