"""Levels of noise of trajectories, by Monte Carlo."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import jaxcal
from jaxcal.models import Model

Array = NDArray[np.float64]
TRUE = np.array([1.3, 1.6, 0.7])


class Decay(Model):
    """Trajectories of q readings that one command starts."""

    names, nominal, num_inputs = ("a", "b", "c"), np.array([1.0, 2.0, 0.5]), 1

    def __init__(self, q: int) -> None:
        self.num_outputs, self.t = q, np.linspace(0.0, 3.0, q)

    def predict(self, commands: Any, parameters: Any = None) -> Array:
        a, b, c = self.nominal if parameters is None else parameters
        u = np.asarray(commands)
        return np.asarray(a * u * np.exp(-b * self.t) + c * (1 - np.exp(-self.t * u)))

    def jacobian(self, commands: Any, parameters: Any = None) -> Array:
        a, b, _ = self.nominal if parameters is None else parameters
        u, falls = np.asarray(commands), np.exp(-b * self.t)
        rises = 1 - np.exp(-self.t * u)
        return np.stack([u * falls, -self.t * a * u * falls, rises], axis=-1)

    def command_jacobian(self, commands: Any, parameters: Any = None) -> Array:
        a, b, c = self.nominal if parameters is None else parameters
        u = np.asarray(commands)
        slope = a * np.exp(-b * self.t) + c * self.t * np.exp(-self.t * u)
        return np.asarray(slope[..., None])


def session(
    model: Decay, count: int, level: Any, rng: np.random.Generator
) -> tuple[Array, Array]:
    commands = rng.uniform(0.5, 2.0, (count, 1))
    noise = level * rng.normal(size=(count, model.num_outputs))
    return commands, model.predict(commands, TRUE) + noise


@pytest.mark.parametrize("count", [2, 5])
def test_one_white_level_is_one(count: int, rng: np.random.Generator) -> None:
    model, held, off, best = Decay(100), 0, 0.0, 0.0
    for _ in range(30):
        table = session(model, count, 0.1, rng)
        found = jaxcal.identify(*table, model=model)
        ends = found.confidence_intervals()
        held += int(((ends[:, 0] <= TRUE) & (ends[:, 1] >= TRUE)).sum())
        common = jaxcal.identify(*table, model=model, common_noise=True)
        off += float(((found.parameters - TRUE) ** 2).sum())
        best += float(((common.parameters - TRUE) ** 2).sum())
    assert held >= 77  # of 90; 71 with a level for each reading, 85.5 are expected
    assert off < 1.1 * best
    assert "one level for all 100 readings" in found.summary()


def test_a_level_that_varies_along_time_is_found(rng: np.random.Generator) -> None:
    model = Decay(120)
    level = 0.1 * (0.3 + model.t)
    found = jaxcal.identify(*session(model, 4, level, rng), model=model)
    assert "varies smoothly" in found.summary()
    np.testing.assert_allclose(found.noise_std, level, rtol=0.4)


def test_runs_of_readings_in_other_units_have_levels_of_their_own(
    rng: np.random.Generator,
) -> None:
    model = Decay(80)
    level = np.where(np.arange(80) < 30, 0.001, 0.2)
    found = jaxcal.identify(*session(model, 3, level, rng), model=model)
    assert "2 runs" in found.summary()
    np.testing.assert_allclose(found.noise_std, level, rtol=0.4)


def test_groups_that_are_declared_share_a_level(rng: np.random.Generator) -> None:
    model, groups = Decay(40), ["slow"] * 15 + ["fast"] * 25
    table = session(model, 3, 0.1, rng)
    found = jaxcal.identify(*table, model=model, common_noise=groups)
    assert found.noise_std is not None
    assert len(np.unique(found.noise_std)) == 2
    with pytest.raises(ValueError, match=r"common_noise must be .* 40 outputs"):
        jaxcal.identify(*table, model=model, common_noise=groups[1:])
