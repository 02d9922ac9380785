"""Scenarios of a model's parameters: what they may be, how likely each is, and criteria
over them: their mean, the worst of them, and G, as one of these.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.checks import Array, array_of, whole_number
from jaxcal.models.model import Model
from jaxcal.models.uncertainty import Prior
from jaxcal.selection.criteria import Criterion

_SUM = 1e-6  # by which weights may miss a sum of 1


class Scenarios(NamedTuple):
    """Parameters and weights."""

    parameters: Array | None  # (S, p) of the model; None where blocks hold them
    weights: Array  # (S,) positive, of sum 1


def scenarios_of(scenarios: Any, model: Model, prior: Prior | None) -> Scenarios:
    """Scenarios of a number of draws from the prior, parameters (S, p), or
    ``(parameters, weights)``."""
    weights = None
    if isinstance(scenarios, tuple):
        if len(scenarios) != 2:
            raise ValueError(
                "scenarios must be a number, parameters (S, p), or (parameters, "
                f"weights), got a tuple of {len(scenarios)}"
            )
        scenarios, weights = scenarios
    elif np.ndim(scenarios) == 0:
        scenarios = _drawn(whole_number("scenarios", scenarios, 1), model, prior)
    rule = f", {len(model.names)} parameters of the model a row"
    parameters = array_of("scenarios", scenarios, "S", len(model.names), rule=rule)
    if not len(parameters):
        raise ValueError("scenarios must hold at least one row of parameters, got none")
    return Scenarios(parameters, checked_weights(weights, len(parameters)))


def _drawn(count: int, model: Model, prior: Prior | None) -> Array:
    """(S, p) draws from the prior; what it says nothing of stays at its mean."""
    resolved = (model.default_prior() if prior is None else prior).resolve(model)
    precision = np.where(resolved.free, np.diagonal(resolved.precision), 0.0)
    drawn = precision > 0.0
    if not drawn.any():
        raise ValueError(
            "a number of scenarios needs a prior with finite std; it is missing for "
            f"{', '.join(map(str, model.names))}. Give prior=jaxcal.Prior(...), or the "
            "parameters (S, p)"
        )
    std = np.where(drawn, 1.0 / np.sqrt(np.where(drawn, precision, 1.0)), 0.0)
    normal = np.random.default_rng(0).standard_normal((count, len(std)))
    return np.asarray(resolved.mean + std * normal)


def checked_weights(weights: ArrayLike | None, count: int) -> Array:
    """(S,) positive weights of sum 1; equal ones when not given."""
    if weights is None:
        return np.full(count, 1.0 / count)
    checked = array_of("weights", weights, count, rule=", one for each scenario")
    if not (checked > 0.0).all():
        raise ValueError(
            f"weights must be positive, got {checked[~(checked > 0.0)][0]:g}"
        )
    total = float(checked.sum())
    if abs(total - 1.0) > _SUM:
        raise ValueError(f"weights must sum to 1, got a sum of {total:.6g}")
    return checked / total


class ScenarioCriterion:
    """A criterion over scenarios: ``Mean`` or ``Worst``.

    Args:
        criterion: letters of ``CRITERIA`` or an object of it; when not given the
            design's own.
    """

    word: str
    efficiency_name = "efficiency"
    least: ClassVar[bool]  # the worst scenario counts
    of_efficiency: bool = False
    each: Criterion  # of the first scenario
    kind: str  # of that

    def __init__(self, criterion: Any = None) -> None:
        if isinstance(criterion, ScenarioCriterion):
            raise ValueError(
                f"{type(self).__name__} needs a criterion of one scenario, got "
                f"{type(criterion).__name__}"
            )
        self.criterion = criterion

    def __repr__(self) -> str:
        given = "" if self.criterion is None else repr(self.criterion)
        return f"{type(self).__name__}({given})"

    def within(self, each: Criterion) -> Self:
        joined = copy.copy(self)
        joined.each, joined.kind = each, each.kind
        return joined

    @property
    def name(self) -> str:
        """The name as it is written: "Mean(D)"."""
        return f"{type(self).__name__}({self.each.name})"

    @property
    def says(self) -> str:
        return f"{self.each.says}, {self.word}"

    @property
    def larger_is_better(self) -> bool:
        return self.of_efficiency or self.each.larger_is_better

    def efficiency(self, value: float, bound: float) -> float:
        if self.of_efficiency:
            return value / bound
        return self.each.efficiency(value, bound)

    def bettered(self, value: float, share: float) -> float:
        if self.of_efficiency:
            return min(1.0, value * (1.0 + share))
        return self.each.bettered(value, share)

    def enough(self, efficiency: float) -> tuple[float, float]:
        """A bound of at most the first times the value, plus the second, proves it."""
        if self.of_efficiency and self.kind == "det":
            return 1.0, -float(np.log(efficiency))
        slope, shift = self.each.enough(efficiency)
        return slope, self.each.times * shift

    def terms(
        self, criteria: Sequence[Criterion], optima: Array | None
    ) -> tuple[Array, Array]:
        """(S,) scale and shift: ``scale phi + shift`` of a scenario is what is joined.

        It is the reported value, of a trace its negative. Of efficiencies e against
        ``optima`` (S,) it is log e (det), -1 / e (trace) or e (least): concave.
        """
        if self.kind == "det":
            scale = np.array([float(one.times) for one in criteria])
            shift = scale * [one.offset for one in criteria]
            if optima is None:
                return scale, shift
            rows = scale * len(criteria[0].root)
            return scale / rows, (shift - optima) / rows
        units = np.array([one.unit for one in criteria])
        if self.kind == "trace":
            scale = units * criteria[0].times
        else:
            scale = 1.0 / np.maximum(units, 1e-320)
        if not (np.isfinite(scale) & (scale > 0.0)).all():
            raise ValueError(
                f"criterion {self.name} in a scenario is out of range in double "
                "precision; give the commands in other units"
            )
        return (scale if optima is None else scale / optima), np.zeros(len(scale))

    def reported(self, joined: Array | float) -> Any:
        """The value as the caller reads it, of what ``terms`` make."""
        if not self.of_efficiency:
            return -joined if self.kind == "trace" else joined
        if self.kind == "det":
            return np.exp(joined)
        return -1.0 / np.asarray(joined) if self.kind == "trace" else joined


class Mean(ScenarioCriterion):
    """The weighted mean over the scenarios of a criterion."""

    word, least = "mean", False


class Worst(ScenarioCriterion):
    """The criterion in the scenario where it is worst.

    With ``efficiency`` scenarios are compared by the efficiency in each, relative to
    its own optimum, or to a bound where that is not proven.
    """

    least = True

    def __init__(self, criterion: Any = None, efficiency: bool = False) -> None:
        super().__init__(criterion)
        self.of_efficiency = bool(efficiency)

    word = "worst"

    @property
    def name(self) -> str:
        more = ", efficiency" if self.of_efficiency else ""
        return f"Worst({self.each.name}{more})"

    @property
    def says(self) -> str:
        """The criterion, in words."""
        if self.of_efficiency:
            return f"least {self.each.name}-efficiency"
        return super().says


class Largest(Worst):
    """G: the worst of the predictions, each of which stands for a scenario."""

    word, efficiency_name, name, says = "", "G-efficiency", "G", "largest variance"
