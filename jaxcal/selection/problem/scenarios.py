"""Scenarios of a model's parameters: what they may be, and how likely each is."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.checks import Array, array_of, whole_number
from jaxcal.models.model import Model
from jaxcal.models.uncertainty import Prior

_SUM = 1e-6  # by which weights may miss a sum of 1


class Scenarios(NamedTuple):
    """Parameters and weights."""

    parameters: Array | None  # (S, p) of the model; None where blocks hold them
    weights: Array  # (S,) positive, of sum 1


def scenarios_of(scenarios: Any, model: Model, prior: Prior | None) -> Scenarios:
    """Scenarios as they are asked for.

    Args:
        scenarios: a whole number of draws from the prior, which one seed makes; (S, p)
            parameters; or ``(parameters, weights)``.
        model: whose parameters they are.
        prior: of them; the model's own when not given.
    """
    if isinstance(scenarios, tuple):
        if len(scenarios) != 2:
            raise ValueError(
                "scenarios must be a number, parameters (S, p), or (parameters, "
                f"weights), got a tuple of {len(scenarios)}"
            )
        parameters = _parameters(scenarios[0], model)
        return Scenarios(parameters, checked_weights(scenarios[1], len(parameters)))
    if np.ndim(scenarios) == 0:
        parameters = _drawn(whole_number("scenarios", scenarios, 1), model, prior)
    else:
        parameters = _parameters(scenarios, model)
    return Scenarios(parameters, checked_weights(None, len(parameters)))


def _parameters(given: ArrayLike, model: Model) -> Array:
    rule = f", {len(model.names)} parameters of the model a row"
    parameters = array_of("scenarios", given, "S", len(model.names), rule=rule)
    if not len(parameters):
        raise ValueError("scenarios must hold at least one row of parameters, got none")
    return parameters


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
