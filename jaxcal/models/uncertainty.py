"""Prior knowledge (Prior) and measurement noise (Noise)."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import (
    Array,
    array_of,
    in_words,
    numbers,
    one_of,
    one_or_each,
    require_finite,
    require_none,
)
from jaxcal.information.singular import significant
from jaxcal.tables import by_name, require_unnamed

PerParameter = ArrayLike | Mapping[str, float]


@dataclasses.dataclass(frozen=True)
class ResolvedPrior:
    """A prior in the order of one model's parameters."""

    mean: Array  # (p,)
    precisions: Array  # (p,) inverse variances, 0 where nothing is known
    free: NDArray[np.bool_]  # (p,) False: held at the mean


@dataclasses.dataclass(frozen=True)
class Prior:
    """Independent normal prior of a model's parameters.

    ``std`` and ``mean`` are one number, (p,), or a mapping from name to number, as a
    row of a frame is.
    """

    std: PerParameter  # in the parameters' units; inf, or left out: nothing is known
    mean: PerParameter | None = None  # by default, or left out: the nominal values
    fixed: Sequence[str] = ()  # names of parameters held at the mean, not identified
    by_data: bool = False  # for an arm, the sizes of the errors are estimated: sized()

    def __post_init__(self) -> None:
        if isinstance(self.fixed, str) or not isinstance(self.fixed, Collection):
            raise ValueError(f"fixed must be a sequence of names, got {self.fixed!r}")
        stds: Any = self.std
        if type(stds) is not float:
            stds = by_name("std of the prior", stds)
            stds = [*stds.values()] if isinstance(stds, Mapping) else stds
        std = numbers("std of the prior", stds, finite=False)
        if not (std > 0.0).all():
            raise ValueError(
                "std of the prior must be positive (inf: nothing known; fixed=[name] "
                f"holds a parameter), got {in_words(std[~(std > 0.0)])}"
            )

    def sized(self) -> Prior:
        """This prior for an arm whose tolerances are not known: a factor each of its
        lengths, turns of the axes, zeros of the joints and compliance follows from the
        readings by marginal likelihood."""
        return dataclasses.replace(self, by_data=True)

    def resolve(self, model: Any) -> ResolvedPrior:
        """The prior of ``model``'s parameters, checked against its names."""
        names = model.names
        std = _by_name("std of the prior", self.std, names, np.inf)
        nominal = np.asarray(model.nominal, dtype=np.float64)
        mean = _by_name("mean of the prior", self.mean, names, nominal)
        require_finite("mean of the prior", mean)
        free = np.ones(len(names), dtype=np.bool_)
        for name in self.fixed:
            free[names.index(one_of("parameter in fixed", name, names))] = False
        if self.fixed and not free.any():
            raise ValueError("prior fixes all parameters; at least one must be free")
        return ResolvedPrior(mean, 1.0 / std**2, free)


def _by_name(
    argument: str, values: PerParameter | None, names: tuple[str, ...], default: Any
) -> Array:
    """(p,) ``values`` in the order of ``names``; ``default`` where they are silent."""
    if not (values is None or type(values) is float):
        values = by_name(argument, values)
    if values is None or isinstance(values, Mapping):
        result = np.empty(len(names))
        result[:] = default
        for name, value in (values or {}).items():
            one_of(f"parameter in {argument}", name, names)
            number = array_of(f"{argument} of {name}", value, finite=False)
            result[names.index(name)] = number
        return result
    return one_or_each(argument, values, len(names), " or a mapping from names")


@dataclasses.dataclass(frozen=True)
class Noise:
    """Normal noise of the readings, and of the commands, in their units."""

    # Of the readings: one number, (q,), or (N, q); 1 where none is given.
    std: ArrayLike | None = None
    covariance: ArrayLike | None = None  # instead of std: (q, q) or (N, q, q)
    # One number, (n,), or (N, n). inf: unknown in every measurement (a nuisance
    # parameter, as the pose of a camera in each view), and eliminated.
    command_std: ArrayLike | None = None

    def __post_init__(self) -> None:
        if self.std is not None and self.covariance is not None:
            raise ValueError("give std or covariance of the noise, not both")
        if self.std is not None:
            require_unnamed("std of the noise", self.std)
            std = numbers("std of the noise", self.std)
            require_none(~(std > 0.0), std, "std of the noise must be positive")
        if self.covariance is not None:
            require_unnamed("covariance of the noise", self.covariance)
            numbers("covariance of the noise", self.covariance)
        if self.command_std is None:
            return
        require_unnamed("command_std of the noise", self.command_std)
        spread = numbers("command_std", self.command_std, finite=False)
        rule = "command_std must not be negative (inf: unknown in every measurement)"
        require_none(~(spread >= 0.0), spread, rule)
        unknown = np.isinf(np.atleast_2d(spread))
        if (unknown.any(axis=0) & ~unknown.all(axis=0)).any():
            raise ValueError("command_std must be inf in a whole column, or nowhere")
        uncertain = np.isfinite(spread) & (spread > 0.0)
        if self.std is None and self.covariance is None and uncertain.any():
            raise ValueError(
                "command_std needs std or covariance of the readings too: the two are "
                "added in the readings' units"
            )

    @property
    def by_row(self) -> list[str]:
        """Names of what is given for each of the N measurements by itself."""
        axes = {"std": 2, "covariance": 3, "command_std": 2}
        return [name for name, n in axes.items() if np.ndim(getattr(self, name)) == n]

    def of(self, rows: NDArray[np.bool_]) -> Noise:
        """The noise of some of the N candidates, ``rows`` (N,) True at each of them."""
        values = {name: np.asarray(getattr(self, name))[rows] for name in self.by_row}
        return dataclasses.replace(self, **values)

    def typical(self, rows: NDArray[np.bool_]) -> Noise:
        """Noise that does not differ by row: in root mean square over ``rows`` (N,)."""
        some, means = self.of(rows), {}
        for name in self.by_row:
            power = 1 if name == "covariance" else 2
            values = getattr(some, name) ** power
            means[name] = values.mean(axis=0) ** (1.0 / power)
        return dataclasses.replace(self, **means)

    def beside(self, std: float) -> Noise:
        """This noise and, independent of it, one of ``std`` in every reading."""
        if self.covariance is None:
            known = 1.0 if self.std is None else self.std
            return dataclasses.replace(self, std=np.hypot(known, std))
        covariance = np.asarray(self.covariance)
        more = std**2 * np.eye(covariance.shape[-1])
        return dataclasses.replace(self, covariance=covariance + more)

    def whitening(
        self, count: int, num_outputs: int, command_jacobian: ArrayLike | None = None
    ) -> Array:
        """W (N, q, q) with ``W Sigma W.T = I``, a row zero where nuisance commands
        leave nothing to learn; ``command_std`` needs ``command_jacobian`` (N, q, n)."""
        shape = (count, num_outputs, num_outputs)
        if self.covariance is None and self.command_std is None:
            white = np.empty(shape)
            white[:] = np.eye(num_outputs) / self._std(*shape[:2])
            return white
        covariance = self._of_readings(count, num_outputs)
        unknown = np.zeros((count, num_outputs, 0))
        if self.command_std is not None:
            if command_jacobian is None:
                raise ValueError(
                    "command_std needs the derivative by the commands: pass a model, "
                    "or command_jacobian (N, q, n)"
                )
            derivative = array_of("command_jacobian", command_jacobian, *shape[:2], "n")
            spread = self.of_commands(count, derivative.shape[-1])[:, None]
            by_commands = derivative * np.where(np.isinf(spread), 0.0, spread)
            covariance = covariance + by_commands @ np.matrix_transpose(by_commands)
            unknown = derivative[..., np.isinf(spread).any(axis=(0, 1))]
        white = np.linalg.inv(np.linalg.cholesky(covariance))
        white = np.broadcast_to(white, shape)
        if not unknown.shape[-1]:
            return white
        basis, size, _ = np.linalg.svd(white @ unknown)
        eaten = np.zeros((count, num_outputs), dtype=np.bool_)
        eaten[:, : size.shape[-1]] = significant(size)
        return np.where(eaten[..., None], 0.0, np.matrix_transpose(basis) @ white)

    def reading_std(self, count: int, num_outputs: int) -> Array:
        """(N, q) ``std`` of the readings, 1 where it is not given."""
        return np.ones((count, num_outputs)) * self._std(count, num_outputs)[..., 0]

    def require_shape(self, count: int, num_outputs: int) -> None:
        """Refuse what is not of N measurements of q readings."""
        if self.covariance is None:
            self._std(count, num_outputs)
        else:
            self._of_readings(count, num_outputs)

    def weigh(self, rows: Array, command_jacobian: ArrayLike | None = None) -> Array:
        """(N, q, p) rows of readings ``W @ rows``, of thousands of readings too."""
        count, q = rows.shape[:2]
        if self.covariance is None and self.command_std is None:
            return np.asarray(rows * (1.0 / self._std(count, q)))
        white = self.whitening(count, q, command_jacobian)
        scale = np.diagonal(white[0]) if count else np.ones(q)
        if white.strides[0] == 0 and (white[0] == np.diag(scale)).all():
            return rows * scale[:, None]
        return white @ rows

    def _of_readings(self, count: int, q: int) -> Array:
        """(q, q) or (N, q, q) covariance."""
        if self.covariance is None:
            return np.eye(q) * np.square(self._std(count, q))
        covariance = np.asarray(self.covariance, dtype=np.float64)
        if covariance.shape not in ((q, q), (count, q, q)):
            raise ValueError(
                f"covariance of the noise must be ({q}, {q}) or ({count}, {q}, {q}), "
                f"got {covariance.shape}"
            )
        scale = np.abs(covariance).max(axis=(-1, -2), initial=0.0, keepdims=True)
        skew = np.abs(covariance - np.matrix_transpose(covariance))
        if (skew > 1e-9 * scale).any():
            raise ValueError("covariance of the noise must be symmetric")
        least = np.linalg.eigvalsh(covariance).min(initial=np.inf)
        if least <= 0.0:
            raise ValueError(
                "covariance of the noise must be positive definite, got eigenvalue "
                f"{least:.3g}"
            )
        return covariance

    def _std(self, count: int, q: int) -> Array:
        """(1, 1), (q, 1) or (N, q, 1) of the readings."""
        std = np.asarray(1.0 if self.std is None else self.std, dtype=np.float64)
        if std.shape not in ((), (q,), (count, q)):
            raise ValueError(
                f"std of the noise must be one number, ({q},) or ({count}, {q}), "
                f"got {std.shape}"
            )
        return std.reshape(1, 1) if std.ndim == 0 else std[..., None]

    def of_commands(self, count: int, n: int) -> Array:
        """(N, n) command_std, zero where it is not given."""
        given = 0.0 if self.command_std is None else self.command_std
        if np.ndim(given) == 2:
            return array_of("command_std", given, count, n, finite=False)
        return np.tile(one_or_each("command_std", given, n), (count, 1))


def as_noise(noise: Any) -> Noise | None:
    """A ``Noise`` as it is, its standard deviation made one; None of None."""
    if noise is None or isinstance(noise, Noise):
        return noise
    if np.asarray(noise).dtype.kind not in "iuf":
        raise ValueError(
            "noise must be a jaxcal.Noise or its standard deviation, got "
            f"{type(noise).__name__}"
        )
    return Noise(noise)


def reading_noise(
    model: Any, noise: Noise, weights: Array, q: int
) -> tuple[Array, Array, NDArray[np.intp]]:
    """Whitening (N, q, q) of readings at these weights, or its diagonal (N, q) where
    they are independent; their std (N, q) at weight 1; and (q,) which outputs share a
    level, from 0."""
    count, levels = len(weights), np.arange(q)
    if noise.covariance is None:
        std = noise.reading_std(count, q)
        white = 1.0 / std
    else:
        white = Noise(covariance=noise.covariance).whitening(count, q)
        std = np.sqrt((np.linalg.inv(white) ** 2).sum(axis=2))
    usual = model.default_noise()
    if usual is not None and noise.std is None and noise.covariance is None:
        usual_std = np.broadcast_to(np.asarray(usual.std), (q,))
        white = white / usual_std
        std = std * usual_std
        levels = np.unique(usual_std, return_inverse=True)[1]  # positions and turns
    root = np.sqrt(weights)[:, None]
    return white * (root if white.ndim == 2 else root[..., None]), std, levels


def command_noise(noise: Noise, commands: Array, q: int) -> Array:
    """(N, n) command_std, zero where it is not given."""
    spread = noise.of_commands(*commands.shape)
    unknown = int(np.isinf(spread[0]).sum())
    if unknown and unknown >= q:
        raise ValueError(
            f"command_std must leave fewer unknown commands than the {q} readings of a "
            f"measurement, got {unknown}"
        )
    return spread


def with_play(model: Any, noise: Noise, commands: Array, spread: Array) -> Noise:
    """The noise of an arm's readings, that of its joints in it, to first order: with
    unknowns of their own the arm's errors could not be sized from the readings."""
    if not np.isfinite(spread).all():
        raise ValueError("command_std of an arm must be finite")
    slopes = model.command_jacobian(commands) * spread[:, None]
    plain = Noise(std=noise.std, covariance=noise.covariance)
    root = np.linalg.inv(plain.whitening(len(commands), model.num_outputs))
    covariance = root @ np.matrix_transpose(root)
    return Noise(covariance=covariance + slopes @ np.matrix_transpose(slopes))
