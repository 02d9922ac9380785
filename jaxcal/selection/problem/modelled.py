"""Information blocks of a model: its derivative, whitened by the noise."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import numbers
from jaxcal.models.affine import Affine
from jaxcal.models.model import Model
from jaxcal.models.uncertainty import Noise, Prior

__all__ = ["Modelled", "as_commands", "shares_regressor"]

Array = NDArray[np.float64]


def as_commands(argument: str, commands: ArrayLike, n: int) -> Array:
    """``commands`` as finite float64 (N, n), or an error that names the argument."""
    array = numbers(argument, commands)
    if array.ndim != 2 or array.shape[1] != n:
        raise ValueError(
            f"{argument} must have shape (N, {n}) for this model, got {array.shape}"
        )
    return array


def shares_regressor(model: Model, prior: Prior | None, noise: Noise | None) -> bool:
    """Is one block [u, 1] / std, counted once per output, all there is to know?"""
    if not isinstance(model, Affine):
        return False
    if isinstance(noise, Noise):
        more = noise.covariance is not None or noise.command_std is not None
        if more or np.ndim(1.0 if noise.std is None else noise.std):
            return False
    if not isinstance(prior, Prior):
        return prior is None and (noise is None or isinstance(noise, Noise))
    known = prior.resolve(model)
    return bool(known.free.all() and not known.precision.any())


class Modelled:
    """A model at the mean of its prior, without the parameters that are held."""

    def __init__(self, model: Model, prior: Prior | None, noise: Noise | None) -> None:
        for name, value, kind in (("prior", prior, Prior), ("noise", noise, Noise)):
            if value is not None and not isinstance(value, kind):
                raise ValueError(
                    f"{name} must be a jaxcal.{kind.__name__} where candidates are "
                    f"given, got {type(value).__name__}"
                )
        self.model = model
        self.noise = Noise() if noise is None else noise
        known = (model.default_prior() if prior is None else prior).resolve(model)
        if not known.free.any():
            raise ValueError("prior must leave a parameter free, but it fixes them all")
        self._mean, self._free = known.mean, known.free
        pairs = zip(model.names, known.free, strict=True)
        self.names = tuple(name for name, free in pairs if free)
        self.precision = known.precision[np.ix_(known.free, known.free)]

    def blocks(self, candidates: Array, available: NDArray[np.bool_]) -> Array:
        """(M, q, p) of candidates (M, n), zero where not available."""
        count, used = len(candidates), candidates[available]
        jacobian = self._jacobian("candidates", used)
        q = jacobian.shape[1]
        slopes = None
        if self.noise.command_std is not None:
            slopes = np.zeros((count, q, candidates.shape[1]))
            slopes[available] = self.model.command_jacobian(used, self._mean)
        white = self.noise.whitening(count, q, slopes)
        if available.all():
            return _weighted(white, jacobian)
        blocks = np.zeros((count, q, len(self.names)))
        blocks[available] = white[available] @ jacobian
        return blocks

    def blocks_at(self, argument: str, commands: ArrayLike, readings: bool) -> Array:
        """(N, q, p) of other commands; with the noise of the commands if ``readings``.

        Raises:
            ValueError: the noise differs between the candidates.
        """
        noise = self.noise
        for name, axes in (("std", 1), ("covariance", 2)):
            given = getattr(noise, name)
            if given is not None and np.ndim(given) > axes:
                raise ValueError(
                    "noise must be the same for all candidates where "
                    f"{argument} is given, got {name} of shape {np.shape(given)}"
                )
        points = as_commands(argument, commands, self.model.num_inputs)
        slopes = None
        if noise.command_std is not None and readings:
            slopes = self.model.command_jacobian(points, self._mean)
        else:
            noise = dataclasses.replace(noise, command_std=None)
        jacobian = self._jacobian(argument, points)
        white = noise.whitening(len(points), jacobian.shape[1], slopes)
        return _weighted(white, jacobian)

    def _jacobian(self, argument: str, commands: Array) -> Array:
        """(N, q, p) derivative by the free parameters, checked."""
        model = self.model
        jacobian = numbers(
            "model.jacobian", model.jacobian(commands, self._mean), finite=False
        )
        shape = (len(commands), model.num_outputs, len(model.names))
        if jacobian.shape != shape:
            raise ValueError(
                f"model.jacobian must return shape {shape}, got {jacobian.shape}"
            )
        finite = np.isfinite(jacobian)
        if not finite.all():
            i, output, at = np.argwhere(~finite)[0]
            raise ValueError(
                f"model.jacobian must be finite, got {jacobian[i, output, at]} for "
                f"parameter {model.names[at]}, output {output + 1}, at {argument} "
                f"{commands[i].tolist()}"
            )
        return jacobian if self._free.all() else jacobian[..., self._free]


def _weighted(white: Array, jacobian: Array) -> Array:
    """``white @ jacobian`` (N, q, p), by columns where white is one diagonal matrix."""
    scale = np.diagonal(white[0]) if len(white) else np.ones(white.shape[1])
    if white.strides[0] == 0 and (white[0] == np.diag(scale)).all():
        return jacobian * scale[:, None]
    return white @ jacobian
