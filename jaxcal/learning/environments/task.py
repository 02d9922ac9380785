"""Task of a training: an environment and its candidates, without JAX until it plays."""

from __future__ import annotations

import dataclasses
import hashlib
from dataclasses import field
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxcal.learning.config import SelectionConfig, named, path_of, require

if TYPE_CHECKING:
    import jax

    from jaxcal.learning.environments.selection import CandidateSource, SelectionState


@dataclasses.dataclass(frozen=True)
class GivenCandidates:
    """The user's own; a checkpoint holds their digest, by which two are equal."""

    name: str = field(compare=False)  # of the file, for messages
    # (B, M, n) sets, or (1, N, n): a pool that every episode draws its M from. None
    # where only the digest is known.
    values: np.ndarray | None = field(default=None, compare=False, repr=False)
    available: np.ndarray | None = field(default=None, compare=False, repr=False)
    sha256: str = ""  # of values and available; computed where they are given

    def __post_init__(self) -> None:
        if self.values is not None:
            digest = hashlib.sha256()
            for array in (self.values, self.available):
                if array is not None:
                    digest.update(f"{array.dtype.str} {array.shape}\n".encode())
                    digest.update(np.ascontiguousarray(array).tobytes())
            object.__setattr__(self, "sha256", digest.hexdigest())
        elif not self.sha256:
            raise ValueError("give the candidates: values or sha256, got neither")

    def source(self, config: SelectionConfig) -> CandidateSource:
        if self.values is None:
            raise ValueError(
                f"this run was trained on {self.name}: pass that file with --candidates"
            )
        from jaxcal.learning.environments import selection

        return selection.given(config, self.values, self.available)


@dataclasses.dataclass(frozen=True)
class Task:
    """An environment and where its candidates come from; a subclass changes what is
    paid, and a checkpoint holds its module and name."""

    environment: SelectionConfig = field(default_factory=SelectionConfig)
    shapes: tuple[str, ...] = ("uniform",)  # of config.SHAPES
    masked: float = 0.0  # greatest share of candidates masked
    num_given: int = 0  # choices before the one that is learned, with explore_once
    random_starts: float = 0.0  # share of imitated episodes begun with random choices
    given: GivenCandidates | None = None  # instead of shapes and masked

    def __post_init__(self) -> None:
        most = self.num_decisions
        require(self, f"in [0, {most})", lambda v: 0 <= v < most, "num_given")

    @property
    def draw(self) -> CandidateSource:
        """key -> (M, n) candidates and (M,) available."""
        if self.given is not None:
            return self.given.source(self.environment)
        from jaxcal.learning.environments import selection

        return selection.mixture(self.environment, self.shapes, self.masked)

    @property
    def num_decisions(self) -> int:
        """K, choices of an episode."""
        return self.environment.num_selected

    @property
    def value_scale(self) -> float:
        """Reward per unit of the log det(Z.T Z) that a network predicts."""
        return self.environment.reward_scale * self.environment.num_outputs

    def reset(self, key: jax.Array) -> SelectionState:
        """A new episode with fresh candidates."""
        from jaxcal.learning.environments import selection

        return selection.reset(key, self.environment, self.draw)

    def step(
        self, state: SelectionState, action: jax.Array
    ) -> tuple[SelectionState, jax.Array, jax.Array]:
        """Choose one posture: the next state, () reward, () bool done."""
        from jaxcal.learning.environments import selection

        return selection.step(state, action, self.environment)

    def paid(self, state: SelectionState) -> jax.Array:
        """() reward received so far of the final value; 0 without ``reward_gain``."""
        config = self.environment
        return config.reward_scale * state.paid * float(config.reward_gain)

    def outcome(self, state: SelectionState) -> jax.Array:
        """() log det S of a finished episode."""
        return state.paid

    def as_meta(self) -> dict[str, Any]:
        """Plain JSON values; ``from_meta`` reads them back."""
        given = self.given and {"name": self.given.name, "sha256": self.given.sha256}
        meta = dataclasses.asdict(dataclasses.replace(self, given=None))
        class_path = {} if type(self) is Task else {"class": path_of(type(self))}
        return meta | {"shapes": list(self.shapes), "given": given} | class_path

    @staticmethod
    def from_meta(meta: dict[str, Any]) -> Task:
        """The task that ``as_meta`` described; of given candidates only the digest."""
        meta = dict(meta)
        path = meta.pop("class", None)
        made: type[Task] = Task if path is None else named(path)
        given = meta.get("given")
        values = {
            "environment": SelectionConfig(**meta["environment"]),
            "shapes": tuple(meta["shapes"]),
            "given": given and GivenCandidates(**given),
        }
        return made(**meta | values)
