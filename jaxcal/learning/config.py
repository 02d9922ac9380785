"""Hyperparameters: of PPO, how much an update plays, sizes of an episode, networks.

Fields have a default, a line of help and checks. Nothing here loads JAX. A network of
one's own is a ``core.network.Network``, or its name: ``module:Name`` or
``file.py:Name``; it has a ``NetworkConfig`` if it has a field ``config``. An installed
package adds a kind by an entry point in the group ``jaxcal.networks``.
"""

from __future__ import annotations

import abc
import dataclasses
import importlib
import importlib.util
import pathlib
import sys
from collections.abc import Callable
from typing import Any, ClassVar

from jaxcal.extras import installed

SHAPES = ("uniform", "gaussian", "sphere", "clustered", "grid", "cluster_uniform")
"""Shapes of a cloud of candidates, see ``environments.selection.mixture``."""

NETWORKS = "jaxcal.networks"  # entry points: kinds of network
_OWN = "jaxcal.own "  # before the path of a file, in the name of its module


def setting(default: Any, help: str) -> Any:
    """A dataclass field with a default and a line of help; commands print the line."""
    return dataclasses.field(default=default, metadata={"help": help})


def settings_of(config: Any) -> list[dataclasses.Field[Any]]:
    """The fields of a configuration, or of its class, that a command shows."""
    return [field for field in dataclasses.fields(config) if "help" in field.metadata]


def require(config: Any, rule: str, holds: Callable[[Any], bool], *names: str) -> None:
    """Refuse a configuration in which one of the named fields breaks a rule."""
    for name in names:
        value = getattr(config, name)
        if not holds(value):
            raise ValueError(f"{name} must be {rule}, got {value}")


def path_of(thing: type) -> str:
    """``module:Name`` or ``file.py:Name`` of a class, by which ``named`` finds it."""
    return f"{thing.__module__.removeprefix(_OWN)}:{thing.__qualname__}"


def of_file(path: str) -> Any:
    """The module of a Python file, which may import its neighbours; a ValueError where
    it is missing or fails."""
    name = f"{_OWN}{path}"
    if name in sys.modules:
        return sys.modules[name]
    if not pathlib.Path(path).is_file():
        raise ValueError(f"file {path} does not exist")
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None  # it is a Python file
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look up the module there
    sys.path.insert(0, folder := str(pathlib.Path(path).parent.resolve()))
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[name]
        raise ValueError(f"{path}: {type(error).__name__}: {error}") from error
    finally:
        sys.path.remove(folder)
    return module


def named(path: str) -> Any:
    """What ``module:Name`` or ``file.py:Name`` names; else a ValueError."""
    place, _, name = path.rpartition(":")
    try:
        find = of_file if place.endswith(".py") else importlib.import_module
        return getattr(find(place), name)
    except (ImportError, AttributeError) as error:
        raise ValueError(
            f"{path} must name an existing MODULE:NAME or FILE.py:NAME: {error}"
        ) from error


TRACED = (
    "learning_rate", "final_learning_rate", "clip_range", "value_coefficient",
    "value_error_limit", "entropy_start", "entropy_end", "discount", "gae_lambda",
    "advantage_limit", "max_grad_norm", "average_decay",
)  # fmt: skip
"""Fields of ``PPOConfig`` that ``make_train`` takes as arrays too: trainings that
differ in them are one program."""


@dataclasses.dataclass(frozen=True)
class PPOConfig(abc.ABC):
    """Hyperparameters of the optimisation; subclasses add how much is played."""

    unit: ClassVar[str]  # of what is played: "episodes" or "decisions"
    num_epochs: int = setting(2, "passes over the decisions of an update")
    num_minibatches: int = setting(4, "gradient steps per pass")
    learning_rate: float = setting(2e-3, "learning rate of Adam, after the warm-up")
    final_learning_rate: float = setting(3e-5, "at the end, reached by a cosine")
    warmup_updates: int = setting(5, "updates in which the learning rate rises")
    clip_range: float = setting(0.2, "probability ratios are clipped to 1 +- this")
    value_coefficient: float = setting(0.5, "weight of the value's error")
    value_error_limit: float = setting(
        3.0, "in units of reward; larger errors of the value count linearly (Huber)"
    )
    entropy_start: float = setting(0.02, "entropy bonus at the beginning")
    entropy_end: float = setting(0.0, "entropy bonus at the end; linear between")
    discount: float = setting(1.0, "discount of a reward one decision later")
    gae_lambda: float = setting(1.0, "lambda of GAE; 1 is return minus value")
    normalise_per_decision: bool = False
    advantage_limit: float = setting(
        6.0, "in standard deviations; larger advantages (a singular pick) are clipped"
    )
    max_grad_norm: float = setting(0.5, "global norm at which gradients are clipped")
    average_decay: float = setting(
        0.99, "decay per gradient step of the averaged weights, which make the policy"
    )
    slice_rows: int = setting(
        8, "rows of a minibatch per gradient slice on a CPU, to fit the cache"
    )

    def __post_init__(self) -> None:
        counts = ("num_epochs", "num_minibatches", "slice_rows")
        require(self, "at least 1", lambda v: v >= 1, *counts)
        positive = ("learning_rate", "clip_range", "max_grad_norm", "value_error_limit")
        require(self, "positive", lambda v: v > 0, *positive)
        require(self, "in [0, 1]", lambda v: 0.0 <= v <= 1.0, "discount", "gae_lambda")
        require(self, "in [0, 1)", lambda v: 0.0 <= v < 1.0, "average_decay")
        coefficients = ("value_coefficient", "entropy_start", "entropy_end")
        limits = ("final_learning_rate", "warmup_updates", "advantage_limit")
        require(self, "0 or more", lambda v: v >= 0, *coefficients, *limits)

    def require_whole(self, budget: str, total: str, each: str) -> None:
        """Refuse a ``total`` that is not a multiple of ``each`` x num_minibatches."""
        require(self, "at least 1", lambda v: v >= 1, budget, total, each)
        whole = getattr(self, each) * self.num_minibatches
        rule = f"a multiple of {each} x num_minibatches = {whole}"
        require(self, rule, lambda v: v % whole == 0, total)

    @property
    @abc.abstractmethod
    def num_updates(self) -> int:
        """Updates that a run makes."""

    @property
    @abc.abstractmethod
    def rows_per_update(self) -> int:
        """Rows of experience that an update plays and cuts into minibatches."""

    @property
    def played_per_update(self) -> int:
        return int(getattr(self, f"{self.unit}_per_update"))

    @property
    def steps_per_update(self) -> int:
        return self.num_epochs * self.num_minibatches

    @property
    def rows_per_minibatch(self) -> int:
        return self.rows_per_update // self.num_minibatches


@dataclasses.dataclass(frozen=True)
class EpisodesConfig(PPOConfig):
    """How much is played, in episodes."""

    unit: ClassVar[str] = "episodes"
    num_episodes: int = setting(200_000, "training budget")
    episodes_per_update: int = setting(2048, "new episodes per update")
    episodes_per_set: int = setting(
        8, "episodes with the same candidates, which share a baseline"
    )
    explore_once: bool = setting(
        False, "learn one decision per episode; the most likely actions follow it"
    )
    normalise_per_decision: bool = setting(
        True, "advantages: separate mean and scale for each decision of an episode"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_whole("num_episodes", "episodes_per_update", "episodes_per_set")
        if self.explore_once and self.episodes_per_set < 2:
            raise ValueError(
                "episodes_per_set must be at least 2 with explore_once, got "
                f"{self.episodes_per_set}: the mean of the others is the baseline"
            )

    @property
    def num_updates(self) -> int:
        """Updates that cover the budget, rounded up."""
        return -(-self.num_episodes // self.episodes_per_update)

    @property
    def rows_per_update(self) -> int:
        return self.episodes_per_update // self.episodes_per_set


@dataclasses.dataclass(frozen=True)
class StreamsConfig(PPOConfig):
    """How much is played, in decisions, because sessions differ in length."""

    unit: ClassVar[str] = "decisions"
    num_updates: int = setting(300, "training budget")
    decisions_per_update: int = setting(4096, "decisions per update")
    stream_length: int = setting(32, "decisions of one stream per update")

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_whole("num_updates", "decisions_per_update", "stream_length")

    @property
    def rows_per_update(self) -> int:
        return self.decisions_per_update // self.stream_length


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunConfig(abc.ABC):
    """What every run has beside what it trains: seeds, how often it validates and
    saves. Subclasses have a field ``ppo``."""

    seed: int = setting(0, "seed of all random numbers")
    num_seeds: int = setting(1, "runs side by side: seed, seed + 1, ...")
    validate_every: float = 15.0  # seconds between validations
    save_every: float = 60.0  # seconds between checkpoints

    def __post_init__(self) -> None:
        require(self, "0 or more", lambda v: v >= 0, "seed")
        require(self, "at least 1", lambda v: v >= 1, "num_seeds")

    @property
    @abc.abstractmethod
    def learners(self) -> tuple[Any, ...]:
        """Learners; update u trains number u modulo theirs."""

    def as_meta(self) -> dict[str, Any]:
        """Plain JSON values; subclasses add theirs."""
        return {
            "ppo": dataclasses.asdict(self.ppo),  # type: ignore[attr-defined]
            "seed": self.seed,
            "num_seeds": self.num_seeds,
        }


@dataclasses.dataclass(frozen=True)
class SelectionConfig:
    """Sizes and reward of an episode."""

    num_candidates: int = setting(50, "postures offered per episode")
    num_selected: int = setting(4, "postures chosen; num_inputs + 1 identify the model")
    num_inputs: int = setting(3, "commanded axes")
    num_outputs: int = setting(3, "measured axes; they multiply the log-determinant")
    reward_scale: float = setting(0.1, "reward per unit of log det S (paper: 1/10)")
    reward_gain: bool = setting(
        False, "reward the increase of log det S; on if num_selected > num_inputs + 1"
    )

    def __post_init__(self) -> None:
        require(self, "at least 1", lambda v: v >= 1, "num_inputs", "num_outputs")
        least, end = self.num_regressors, self.num_candidates
        rule = f"in [{least}, {end})"
        require(self, rule, lambda v: least <= v < end, "num_selected")
        require(self, "positive", lambda v: v > 0, "reward_scale")

    @property
    def num_regressors(self) -> int:
        """p = n + 1, the fewest postures that identify the model."""
        return self.num_inputs + 1

    @property
    def observation_size(self) -> int:
        """Length of the paper's observation: 210 for 50 candidates, 3 inputs."""
        return (self.num_inputs + 1) * self.num_candidates + 2 * self.num_inputs + 4


@dataclasses.dataclass(frozen=True)
class NetworkConfig:
    """Which network, and its size."""

    kind: str = setting(
        "compact", "compact, paper, observation, MODULE:NAME or FILE.py:NAME"
    )
    width: int = setting(32, "features per candidate; for paper, hidden width")
    encoder_rounds: int = setting(3, "message rounds over the whole set, for each set")
    decoder_rounds: int = setting(
        1, "message rounds over the remaining candidates, for each decision"
    )
    lookahead: int = setting(12, "largest number of greedy choices ahead in a feature")
    close_up: bool = setting(False, "features that separate near-equal look-aheads")
    initial_trust: float = setting(
        0.0, "initial weight of the look-ahead; with 4 training starts at its rule"
    )
    initial_actor: float = setting(0.1, "scale of the learned score at the start")
    mirrored: bool = setting(
        False, "for observation: choose by the mean over a set's mirror images"
    )

    def __post_init__(self) -> None:
        kind: Any = self.kind
        if isinstance(kind, type):
            object.__setattr__(self, "kind", path_of(kind))
        installs = self.kind != "compact" and ":" not in self.kind
        if installs and self.kind not in installed(NETWORKS):
            kinds = ", ".join(["compact", *installed(NETWORKS)])
            raise ValueError(
                f"kind must be one of {kinds}, got {self.kind!r}; name your own as "
                "MODULE:NAME or FILE.py:NAME, or as an entry point in the group "
                f"{NETWORKS}"
            )
        require(self, "at least 1", lambda v: v >= 1, "width", "lookahead")
        rounds = ("encoder_rounds", "decoder_rounds")
        require(self, "0 or more", lambda v: v >= 0, *rounds)
