"""Configuration of a training of postures, those with names, and changes of one."""

from __future__ import annotations

import dataclasses
from dataclasses import field
from typing import TYPE_CHECKING, Any

from jaxcal.extras import installed
from jaxcal.learning.config import (
    SHAPES,
    EpisodesConfig,
    NetworkConfig,
    RunConfig,
    SelectionConfig,
    require,
    setting,
    settings_of,
)
from jaxcal.learning.environments.task import Task

if TYPE_CHECKING:
    from jaxcal.learning.core.postures import Postures


_GROUP = "jaxcal.presets"  # entry points: the presets of installed packages


@dataclasses.dataclass(frozen=True)
class TrainConfig(RunConfig):
    """Network, optimisation and tasks of a run that trains on postures."""

    preset: str = "compact"
    network: NetworkConfig = field(default_factory=NetworkConfig)
    ppo: EpisodesConfig = field(default_factory=EpisodesConfig)
    tasks: tuple[Task, ...] = field(default=(Task(),))  # update u: tasks[u % len]
    imitation: float = setting(
        0.0, "share of the updates, at the beginning, that imitate the solvers"
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
        from jaxcal.learning.core.network import build
        from jaxcal.learning.core.postures import Postures

        network = build(dataclasses.replace(self.network, mirrored=False))
        return tuple(Postures(self.ppo, task, network) for task in self.tasks)

    def as_meta(self) -> dict[str, Any]:
        """Plain JSON values; ``from_meta`` reads them back."""
        return super().as_meta() | {
            "preset": self.preset,
            "imitation": self.imitation,
            "network": dataclasses.asdict(self.network),
            "tasks": [task.as_meta() for task in self.tasks],
        }

    @staticmethod
    def from_meta(meta: dict[str, Any]) -> TrainConfig:
        return TrainConfig(
            **{n: meta[n] for n in ("preset", "imitation", "seed", "num_seeds")},
            network=NetworkConfig(**meta["network"]),
            ppo=EpisodesConfig(**meta["ppo"]),
            tasks=tuple(Task.from_meta(task) for task in meta["tasks"]),
        )


_COMPACT = TrainConfig(
    preset="compact",
    about="one task (4 of 50), PPO alone from scratch; 0.999 of the optimum after "
    "60,000 episodes; try this first",
    network=NetworkConfig(close_up=True),
    ppo=EpisodesConfig(num_episodes=60_000),
)

_ALL = ("uniform", *SHAPES)  # uniform twice as often as any other


def _task(k: int = 4, m: int = 50, n: int = 3, **drawn: Any) -> Task:
    """Choose k of m postures of n inputs, ``drawn`` as ``Task`` says."""
    return Task(SelectionConfig(m, k, n, n, reward_gain=k > n + 1), **drawn)


# It begins as the look-ahead rule and imitates the solvers, which improves on the rule
# most for a given time (docs/policy.md). Tasks: the paper's, other shapes of
# candidates, masks, given postures, other numbers of postures and of inputs.
_GENERAL = TrainConfig(
    preset="general",
    about="the shipped policy: twelve tasks of other sizes, shapes and masks, "
    "imitating the solvers, starting at the look-ahead rule; ten minutes",
    network=NetworkConfig(close_up=True, initial_trust=4.0, initial_actor=0.05),
    ppo=EpisodesConfig(num_episodes=300_000, entropy_start=0.002),
    imitation=1.0,
    tasks=(
        _task(),
        _task(6),
        _task(shapes=SHAPES, masked=0.4, random_starts=0.3),
        _task(5, shapes=_ALL),
        _task(),
        _task(6, masked=0.3, random_starts=0.2),
        _task(m=20, shapes=_ALL),
        _task(8, shapes=_ALL),
        _task(shapes=_ALL),
        _task(5),
        _task(3, n=2),
        _task(5, n=4),
    ),
)

_OWN = {config.preset: config for config in (_COMPACT, _GENERAL)}
PARTS: dict[str, type] = {
    "run": TrainConfig,
    "ppo": EpisodesConfig,
    "network": NetworkConfig,
    "environment": SelectionConfig,
}


def names() -> list[str]:
    return sorted({*_OWN, *installed(_GROUP)})


def load(name: str) -> TrainConfig:
    """A preset by its name."""
    if name in _OWN:
        return _OWN[name]
    if name not in names():
        raise ValueError(f"preset must be one of {', '.join(names())}, got {name!r}")
    return installed(_GROUP)[name].load()


preset = load  # as jaxcal.learning calls it


def with_values(config: TrainConfig, values: dict[str, Any]) -> TrainConfig:
    """A configuration with single fields changed, in whichever part they are; in every
    task, refused where tasks differ in it. Where more than n + 1 postures are asked
    for, the reward becomes the increase of log det S, so that an episode is paid what
    it is judged by."""
    fields = {field.name for part in PARTS.values() for field in settings_of(part)}
    for name in sorted(set(values) - fields):
        raise ValueError(f"no configuration has the field {name}")
    network, ppo, run, changed = (
        {f.name: values[f.name] for f in settings_of(PARTS[part]) if f.name in values}
        for part in ("network", "ppo", "run", "environment")
    )
    for name in changed:
        held = sorted({getattr(task.environment, name) for task in config.tasks})
        if len(held) > 1:
            raise ValueError(
                f"{name} cannot be changed in preset {config.preset}: its "
                f"{len(config.tasks)} tasks have {', '.join(map(str, held))}. Use a "
                "preset of one task, such as compact"
            )
    once = config.ppo.explore_once and "num_selected" in changed
    tasks = tuple(_changed(task, changed) for task in config.tasks[-1 if once else 0 :])
    if once:  # each decision in turn; the last task is of the first
        tasks = tuple(
            dataclasses.replace(tasks[-1], num_given=given)
            for given in reversed(range(changed["num_selected"]))
        )
    return dataclasses.replace(
        config,
        network=dataclasses.replace(config.network, **network),
        ppo=dataclasses.replace(config.ppo, **ppo),
        tasks=tasks,
        **run,
    )


def _changed(task: Task, values: dict[str, Any]) -> Task:
    env = dataclasses.replace(task.environment, **values)
    if {"num_selected", "num_inputs"} & set(values) and "reward_gain" not in values:
        gain = env.num_selected > env.num_regressors
        env = dataclasses.replace(env, reward_gain=gain)
    return dataclasses.replace(task, environment=env)
