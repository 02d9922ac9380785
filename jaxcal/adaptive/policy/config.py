"""Configuration of a run that trains a policy of sequential measurement."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from jaxcal.learning.config import RunConfig, StreamsConfig, require, setting

if TYPE_CHECKING:
    from jaxcal.adaptive.rules import Rule
    from jaxcal.learning.core.streams import Streams


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
class PolicyConfig(RunConfig):
    """Task, base rule, network and optimisation of a run."""

    task: str  # as registered
    base: Rule  # the rule that the network corrects; its constants are floats
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # of the task
    per_group: int = setting(6, "options of a group that the network sees")
    width: int = setting(64, "of the network's layers")
    ppo: StreamsConfig = PPO
    validate_every: float = dataclasses.field(default=30.0, kw_only=True)  # seconds

    def __post_init__(self) -> None:
        require(self, "at least 1", lambda v: v >= 1, "per_group", "width")
        super().__post_init__()
        if (name := type(self.base).__name__) not in (rules := _rules()):
            raise ValueError(f"base must be one of {', '.join(rules)}, got {name}")

    @property
    def learners(self) -> tuple[Streams, ...]:
        """One learner."""
        from jaxcal.adaptive.policy.network import Correction, Sessions
        from jaxcal.learning.core.streams import Streams

        return (Streams(self.ppo, Sessions(self.per_group), Correction(self.width)),)

    def as_meta(self) -> dict[str, Any]:
        """Plain JSON values; ``from_meta`` reads them back."""
        base: Any = self.base
        constants = {name: float(x) for name, x in dataclasses.asdict(base).items()}
        return super().as_meta() | {
            "task": self.task,
            "options": [dict(self.options)],
            "network": {"width": self.width, "per_group": self.per_group},
            "base": {"rule": type(base).__name__, **constants},
        }

    @staticmethod
    def from_meta(meta: Mapping[str, Any]) -> PolicyConfig:
        """The configuration that a checkpoint was trained with."""
        constants, (options,) = dict(meta["base"]), meta["options"]
        base = _rules()[constants.pop("rule")](**constants)
        return PolicyConfig(
            task=meta["task"],
            base=base,
            options={
                k: tuple(v) if isinstance(v, list) else v for k, v in options.items()
            },
            ppo=StreamsConfig(**meta["ppo"]),
            seed=meta["seed"],
            num_seeds=meta["num_seeds"],
            **meta["network"],
        )


def _rules() -> dict[str, type[Rule]]:
    from jaxcal.adaptive.rules import Priced, Shares, StateRule

    return {rule.__name__: rule for rule in (Priced, Shares, StateRule)}
