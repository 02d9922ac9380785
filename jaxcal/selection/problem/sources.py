"""Where information blocks come from: the affine model, any other one, or the caller.

A source answers, of candidates (M, n) of which some are available:

- ``names``: (p,) of the parameters; empty where the blocks are [u, 1];
- ``times``: how often log det and trace of the blocks count;
- ``root``: (r, p), of the precision known beforehand;
- ``blocks()``: (M, q, p) of the candidates, zero where not available;
- ``at(argument, values, readings)``: (N, q, p) of what was measured (``readings``) or
  of where predictions are wanted.
"""

from __future__ import annotations

import dataclasses
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import array_of, numbers
from jaxcal.information.blocks import prior_root
from jaxcal.models.identifiability import identifiability
from jaxcal.models.model import Model, derivative
from jaxcal.models.uncertainty import Noise, Prior

__all__ = ["BlockSource", "ModelSource", "SharedSource", "Source", "shares_regressor"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_OF_MODEL = " for this model"


class Source(Protocol):
    """See the top of the module; what is the same in most."""

    names: tuple[str, ...] = ()
    times: int = 1
    root: Array

    def blocks(self) -> Array: ...

    def at(self, argument: str, values: ArrayLike, readings: bool) -> Array: ...

    def require_identified(self, measured: ArrayLike | None) -> None:
        """Refuse what candidates leave unknown, by the names of a model."""
        return

    def predicted(self) -> Array | None:
        """Commands of predictions, where their blocks are not those of readings."""
        return None

    def leverage_slopes(self, commands: Array, metric: Array) -> Array | None:
        """(N, n) slopes of ``trace(B metric B.T)`` by commands, where a model has them.

        B are the blocks of readings (q, p) and ``metric`` is (p, p).
        """
        return None


def shares_regressor(model: Model, prior: Prior | None, noise: Noise | None) -> bool:
    """Is one block [u, 1] / std, counted once per output, all there is to know?"""
    if not model.multiplicity:
        return False
    if noise is not None:
        more = noise.covariance is not None or noise.command_std is not None
        if more or np.ndim(1.0 if noise.std is None else noise.std):
            return False
    if prior is None:
        return True
    resolved = prior.resolve(model)
    return bool(resolved.free.all() and not resolved.precision.any())


class SharedSource(Source):
    """A model where all outputs share one regressor, as [u, 1], / std."""

    def __init__(self, model: Model, candidates: Array, noise: Noise | None) -> None:
        self._model = model
        self._std = 1.0 if noise is None or noise.std is None else float(noise.std)  # type: ignore[arg-type]  # one number
        self.times = model.multiplicity
        self._blocks = model.blocks(candidates) / self._std
        self.root = np.zeros((0, self._blocks.shape[2]))

    def blocks(self) -> Array:
        return self._blocks

    def at(self, argument: str, values: ArrayLike, readings: bool) -> Array:
        points = array_of(argument, values, "N", self._model.num_inputs, rule=_OF_MODEL)
        return self._model.blocks(points) / self._std


class BlockSource(Source):
    """Blocks of the caller's own, and a prior precision (p, p)."""

    def __init__(
        self, blocks: Array, prior: ArrayLike | None, noise: Noise | None
    ) -> None:
        _, self._q, p = blocks.shape
        self._blocks, self._noise = blocks, noise
        self.names = tuple(f"theta{i + 1}" for i in range(p))
        self.root = np.zeros((0, p))
        if prior is None:
            return
        precision = numbers("prior", prior)
        if precision.shape != (p, p):
            raise ValueError(
                f"prior must be a precision of shape ({p}, {p}), got {precision.shape}"
            )
        self.root = prior_root(precision)

    def blocks(self) -> Array:
        return self._white(self._blocks)

    def at(self, argument: str, values: ArrayLike, readings: bool) -> Array:
        size = ("N", self._q, len(self.names))
        return self._white(array_of(argument, values, *size, rule=" as blocks have"))

    def _white(self, blocks: Array) -> Array:
        if self._noise is None:
            return blocks
        return self._noise.weigh(blocks)


class ModelSource(Source):
    """A model at the mean of its prior, without the parameters that are held."""

    def __init__(
        self,
        model: Model,
        candidates: Array,
        available: Mask,
        prior: Prior | None,
        noise: Noise | None,
        misfit: float = 0.0,
        parameters: Array | None = None,
    ) -> None:
        model = model.prepared(candidates[available])
        self._model, self._candidates, self._available = model, candidates, available
        self._noise = Noise() if noise is None else noise
        # Readings are off by what no parameter explains; a prediction is no reading.
        self._read = self._noise.beside(misfit) if misfit else self._noise
        self._prior = model.default_prior() if prior is None else prior
        resolved = self._prior.resolve(model)
        self._mean, self._free = resolved.mean, resolved.free
        if parameters is not None:  # of a scenario; what came last is not told
            self._mean = np.append(parameters, resolved.mean[len(parameters) :])
        pairs = zip(model.names, resolved.free, strict=True)
        self.names = tuple(name for name, free in pairs if free)
        self._precision = resolved.precision[np.ix_(resolved.free, resolved.free)]
        besides = model.facts(resolved.mean)[1][:, resolved.free]
        self.root = prior_root(self._precision + besides.T @ besides)

    @property
    def used(self) -> Array:
        """The available candidates."""
        return self._candidates[self._available]

    def blocks(self) -> Array:
        count, mask = len(self._candidates), self._available
        jacobian = self._jacobian(self.used)
        q = jacobian.shape[1]
        slopes = None
        if self._noise.command_std is not None:
            slopes = np.zeros((count, q, self._candidates.shape[1]))
            slopes[mask] = self._model.command_jacobian(self.used, self._mean)
        if mask.all():
            return self._read.weigh(jacobian, slopes)
        self._read.require_shape(count, q)
        read = self._read.of(mask)
        blocks = np.zeros((count, q, len(self.names)))
        blocks[mask] = read.weigh(jacobian, None if slopes is None else slopes[mask])
        return blocks

    def at(self, argument: str, values: ArrayLike, readings: bool) -> Array:
        noise = self._read if readings else self._noise
        for name, axes in (("std", 1), ("covariance", 2)):
            given = getattr(noise, name)
            if given is not None and np.ndim(given) > axes:
                raise ValueError(
                    "noise must be the same for all candidates where "
                    f"{argument} is given, got {name} of shape {np.shape(given)}"
                )
        points = array_of(argument, values, "N", self._model.num_inputs, rule=_OF_MODEL)
        slopes = None
        if noise.command_std is not None and readings:
            slopes = self._model.command_jacobian(points, self._mean)
        else:
            noise = dataclasses.replace(noise, command_std=None)
        jacobian = self._jacobian(points)
        return noise.weigh(jacobian, slopes)

    def predicted(self) -> Array | None:
        same = self._read is self._noise and self._noise.command_std is None
        return None if same else self.used

    def leverage_slopes(self, commands: Array, metric: Array) -> Array | None:
        if self._read.command_std is not None:
            return None
        p = len(self._free)
        whole = np.zeros((p, p))
        whole[np.ix_(self._free, self._free)] = metric
        white = self._read.whitening(1, self._model.num_outputs)[0]
        return self._model.leverage_slopes(commands, self._mean, white, whole)

    def require_identified(self, measured: ArrayLike | None) -> None:
        if np.diagonal(self._precision).all():
            return
        commands = self.used
        if measured is not None:
            commands = np.concatenate([commands, np.asarray(measured)])
        noise = self._noise.of(self._available)
        left = identifiability(
            self._model, commands, noise=noise, prior=self._prior
        ).directions
        if left:
            raise ValueError(
                "candidates must inform every parameter, but with what is known they "
                f"say nothing of {'; '.join(each.words for each in left)}; give a "
                "prior (jaxcal.Prior with finite std) or hold some (Prior with "
                "fixed=[name])"
            )

    def _jacobian(self, commands: Array) -> Array:
        """(N, q, p) derivative by the free parameters, checked."""
        jacobian = derivative(self._model, commands, self._mean)
        return jacobian if self._free.all() else jacobian[..., self._free]
