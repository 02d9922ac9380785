"""Information blocks of candidates, and of anything else that a question is about.

What one measurement says is a block ``B`` (q, p) in units of the noise: it adds
``B.T @ B`` to the information.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.checks import Array, array_of, numbers
from jaxcal.information.blocks import prior_root
from jaxcal.models.identifiability import identifiability
from jaxcal.models.model import Model
from jaxcal.models.predictions import derivative
from jaxcal.models.uncertainty import Noise, Prior
from jaxcal.selection.problem.candidate_set import CandidateSet

_FAR = 100.0  # spreads of the candidates, from which they are counted from their middle
_MOVES = 1e-10  # of the size, below which a command is the same everywhere
_OF_MODEL = " for this model"


class Blocks:
    """Blocks that no parameter changes: the caller's own, or [u, 1] of a model."""

    names: tuple[str, ...]  # (p,) of the parameters; empty where the blocks are [u, 1]
    root: Array  # (r, p) of the precision known beforehand
    times: int = 1  # how often log det and trace of the blocks count

    def __init__(self, offer: CandidateSet) -> None:
        self._model, self._noise, self._std = offer.model, offer.noise, 1.0
        if offer.model is None:
            assert offer.blocks is not None
            self._values, p = offer.blocks, offer.blocks.shape[2]
            self.names = tuple(f"theta{i + 1}" for i in range(p))
            self.root = _checked_root(offer.prior, p)
            self._blocks = self._of(self._values)
            return
        assert offer.candidates is not None
        self._values, self.times = offer.candidates, offer.model.fitting.multiplicity
        if offer.noise is not None and offer.noise.std is not None:
            self._std = float(offer.noise.std)
        self._blocks = self._of(self._values)
        self.names, self.root = (), np.zeros((0, self._blocks.shape[2]))

    def of_candidates(self) -> Array:
        """(M, q, p), zero where not available."""
        return self._blocks

    def at(self, argument: str, values: ArrayLike, readings: bool) -> Array:
        """(N, q, p) of commands, or blocks, that were measured, or of predictions."""
        rule = " as blocks have" if self._model is None else _OF_MODEL
        shape = ("N", *self._values.shape[1:])
        return self._of(array_of(argument, values, *shape, rule=rule))

    def predicted(self) -> Array | None:
        """Commands of predictions, where their blocks are not those of readings."""
        return None

    def require_identified(self, measured: ArrayLike | None) -> None:
        """Refuse what candidates leave unknown, by the names of parameters."""

    def _of(self, values: Array) -> Array:
        if self._model is not None:
            return self._model.blocks(values) / self._std
        return values if self._noise is None else self._noise.weigh(values)


class _ModelBlocks(Blocks):
    """Blocks of a model by its parameters, without those that are held; ``misfit`` is
    the std of a reading by what no parameter explains, ``invariant``: commands may be
    counted from their middle."""

    def __init__(
        self, offer: CandidateSet, model: Model, misfit: float, invariant: bool
    ) -> None:
        assert offer.candidates is not None
        self._candidates, self._available = offer.candidates, offer.available
        model = self._model = model.fitting.prepared(self.used)
        self._centre = np.zeros(self._candidates.shape[1])
        if invariant and offer.prior is None and len(self.used):
            low, high = self.used.min(axis=0), self.used.max(axis=0)
            middle = 0.5 * (low + high)
            spread = high - low
            far = (np.abs(middle) > _FAR * spread) & (spread > _MOVES * np.abs(middle))
            no_slopes = offer.noise is None or offer.noise.command_std is None
            if far.any() and no_slopes and model.fitting.centred(middle) is not None:
                self._centre = np.where(far, middle, 0.0)
        self._noise = Noise() if offer.noise is None else offer.noise
        # Readings are off by what no parameter explains; a prediction is no reading.
        self._read = self._noise.beside(misfit) if misfit else self._noise
        self._prior = model.default_prior() if offer.prior is None else offer.prior
        resolved = self._prior.resolve(model)
        self._mean, self._free = resolved.mean, resolved.free
        if offer.parameters is not None:  # of a scenario, which has none of the misfit
            unsaid = resolved.mean[len(offer.parameters) :]
            self._mean = np.append(offer.parameters, unsaid)
        pairs = zip(model.names, resolved.free, strict=True)
        self.names = tuple(name for name, free in pairs if free)
        self._precision = np.diag(resolved.precisions[resolved.free])
        besides = model.fitting.facts(resolved.mean)[1][:, resolved.free]
        self.root = prior_root(self._precision + besides.T @ besides)

    @property
    def used(self) -> Array:
        """The available candidates."""
        return self._candidates[self._available]

    def of_candidates(self) -> Array:
        used, mask = self.used, self._available
        jacobian = self._jacobian(used)
        if mask.all():
            return self._weighed(jacobian, used, self._read)
        self._read.require_shape(len(mask), jacobian.shape[1])
        blocks = np.zeros((len(mask), *jacobian.shape[1:]))
        blocks[mask] = self._weighed(jacobian, used, self._read.of(mask))
        return blocks

    def at(self, argument: str, values: ArrayLike, readings: bool) -> Array:
        noise = self._read if readings else self._noise.typical(self._available)
        for name in noise.by_row:
            raise ValueError(
                f"noise must be the same for all candidates where {argument} is given, "
                f"got {name} of shape {np.shape(getattr(noise, name))}"
            )
        if not readings:
            noise = dataclasses.replace(noise, command_std=None)
        size = self._model.num_inputs
        commands = array_of(argument, values, "N", size, rule=_OF_MODEL)
        return self._weighed(self._jacobian(commands), commands, noise)

    def _jacobian(self, commands: Array) -> Array:
        """(N, q, p) derivative by the free parameters, checked."""
        jacobian = derivative(self._model, commands - self._centre, self._mean)
        return jacobian if self._free.all() else jacobian[..., self._free]

    def _weighed(self, jacobian: Array, commands: Array, noise: Noise) -> Array:
        """(N, q, p) Jacobian at commands (N, n) in units of the noise."""
        if noise.command_std is None:
            return noise.weigh(jacobian)
        slopes = self._model.command_jacobian(commands, self._mean)
        return noise.weigh(jacobian, slopes)

    def predicted(self) -> Array | None:
        noise = self._noise
        same = self._read is noise and noise.command_std is None
        return None if same and not noise.by_row else self.used

    def require_identified(self, measured: ArrayLike | None) -> None:
        if np.diagonal(self._precision).all():
            return
        commands = self.used
        if measured is not None:
            commands = np.concatenate([commands, np.asarray(measured)])
        noise = self._noise.of(self._available)
        unknown = identifiability(
            self._model, commands - self._centre, noise=noise, prior=self._prior
        ).directions
        if unknown:
            directions = "; ".join(direction.words for direction in unknown)
            raise ValueError(
                "candidates must inform every parameter, but with the prior they do "
                f"not inform {directions}; give a prior (jaxcal.Prior with finite std) "
                "or hold some (Prior with fixed=[name])"
            )


def blocks_of(
    offer: CandidateSet,
    of_parameters: bool,
    of_predictions: bool = False,
    of_volume: bool = False,
) -> Blocks:
    """Blocks of a candidate set: ``of_parameters`` by name, also where outputs share a
    regressor; ``of_predictions``, which of an arm without a prior have what no
    parameter explains; ``of_volume``, whose determinant alone counts."""
    model, prior = offer.model, offer.prior
    if model is None:
        return Blocks(offer)
    if not of_parameters and shares_regressor(model, prior, offer.noise):
        return Blocks(offer)
    if of_predictions and prior is None and model.fitting.misfit_std:
        misfit = model.fitting.misfit_std
        return _ModelBlocks(offer, model.fitting.misfit_model(), misfit, of_predictions)
    return _ModelBlocks(offer, model, 0.0, of_predictions or of_volume)


def shares_regressor(model: Model, prior: Prior | None, noise: Noise | None) -> bool:
    """Is one block [u, 1] / std, counted once per output, all there is to know?"""
    if not model.fitting.multiplicity:
        return False
    if noise is not None:
        more = noise.covariance is not None or noise.command_std is not None
        if more or np.ndim(1.0 if noise.std is None else noise.std):
            return False
    if prior is None:
        return True
    resolved = prior.resolve(model)
    return bool(resolved.free.all() and not resolved.precisions.any())


def _checked_root(precision: ArrayLike | None, p: int) -> Array:
    """(r, p) root of a prior precision (p, p) as the caller gives it."""
    if precision is None:
        return np.zeros((0, p))
    prior = numbers("prior", precision)
    if prior.shape != (p, p):
        raise ValueError(
            f"prior must be a precision of shape ({p}, {p}), got {prior.shape}"
        )
    return prior_root(prior)
