"""Configuration of a run that trains a policy of sequential measurement."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from jaxcal.adaptive import rules
from jaxcal.adaptive.policy.network import Network
from jaxcal.adaptive.policy.sessions import Sessions
from jaxcal.adaptive.rules import Scored
from jaxcal.learning.config import StreamsConfig, Sweep, runs_of
from jaxcal.learning.core.streams import Streams
from jaxcal.learning.settings import require, setting

__all__ = ["PPO", "PolicyConfig"]

_RULES: tuple[type[Scored], ...] = (rules.Priced, rules.StateRule)

PPO = StreamsConfig(
    num_epochs=4,
    num_minibatches=8,
    learning_rate=2e-3,
    final_learning_rate=6e-5,
    value_coefficient=5.0,
    entropy_start=0.01,
    entropy_end=0.0,
    gae_lambda=1.0,
    average_decay=0.998,
)
"""The defaults."""


@dataclasses.dataclass(frozen=True)
class PolicyConfig:
    """Task, base rule, network and optimisation of a run."""

    task: str  # as registered
    base: Scored  # the rule that the network corrects; its constants are floats
    options: tuple[Mapping[str, Any], ...] = ({},)  # update u trains on u modulo n
    per_group: int = setting(6, "options of a group that the network sees")
    width: int = setting(64, "of the network's layers")
    ppo: StreamsConfig = PPO
    seed: int = setting(0, "of everything random")
    num_seeds: int = setting(1, "runs side by side: seed, seed + 1, ...")
    sweep: Sweep = ()  # side by side too: every combination, for every seed
    validate_every: float = 30.0  # seconds between validations
    save_every: float = 60.0  # seconds between checkpoints

    def __post_init__(self) -> None:
        require(self, "at least 1", lambda v: v >= 1, "per_group", "width", "num_seeds")
        require(self, "0 or more", lambda v: v >= 0, "seed")
        self.ppo.require_sweep(self.sweep)
        if not isinstance(self.base, _RULES):
            known = ", ".join(rule.__name__ for rule in _RULES)
            raise ValueError(
                f"base must be one of {known}, got {type(self.base).__name__}"
            )

    @property
    def num_runs(self) -> int:
        """Runs side by side: seeds times swept values."""
        return len(runs_of(self.seed, self.num_seeds, self.sweep))

    @property
    def learners(self) -> tuple[Streams, ...]:
        """One learner: other options are other arrays of the same program."""
        return (Streams(self.ppo, Sessions(self.per_group), Network(self.width)),)

    def as_meta(self) -> dict[str, Any]:
        """Plain JSON values; ``from_meta`` reads them back."""
        constants = {
            field.name: float(getattr(self.base, field.name))
            for field in dataclasses.fields(self.base)  # type: ignore[arg-type]  # flax
        }
        return {
            "task": self.task,
            "options": [dict(options) for options in self.options],
            "network": {"width": self.width, "per_group": self.per_group},
            "base": {"rule": type(self.base).__name__, **constants},
            "ppo": dataclasses.asdict(self.ppo),
            "seed": self.seed,
            "num_seeds": self.num_seeds,
            "sweep": [[name, list(values)] for name, values in self.sweep],
        }

    @staticmethod
    def from_meta(meta: Mapping[str, Any]) -> PolicyConfig:
        """The configuration that a checkpoint was trained with."""
        constants = dict(meta["base"])
        kinds = {rule.__name__: rule for rule in _RULES}
        base = kinds[constants.pop("rule")](**constants)
        return PolicyConfig(
            task=meta["task"],
            base=base,
            options=tuple(
                {k: tuple(v) if isinstance(v, list) else v for k, v in options.items()}
                for options in meta["options"]
            ),
            ppo=StreamsConfig(**meta["ppo"]),
            seed=meta["seed"],
            num_seeds=meta["num_seeds"],
            sweep=tuple(
                (name, tuple(values)) for name, values in meta.get("sweep", ())
            ),
            **meta["network"],
        )
