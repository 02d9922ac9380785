"""What is known before measuring (Prior) and how well one measures (Noise)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import in_words, numbers, whole_number
from jaxcal.information.blocks import significant

__all__ = ["Noise", "Prior", "ResolvedPrior"]

Array = NDArray[np.float64]
Named = ArrayLike | Mapping[str, float]


class Parametric(Protocol):
    """What a prior is about: any model, by its parameters."""

    @property
    def names(self) -> tuple[str, ...]:
        """p names."""

    @property
    def nominal(self) -> Array:
        """(p,) values of the machine as it was designed."""


@dataclasses.dataclass(frozen=True)
class ResolvedPrior:
    """A prior in the order of one model's parameters."""

    mean: Array  # (p,)
    precision: Array  # (p, p) diagonal, 0 where nothing is known
    free: NDArray[np.bool_]  # (p,) False: held at the mean


@dataclasses.dataclass(frozen=True)
class Prior:
    """Independent normal knowledge of a model's parameters.

    Attributes:
        std: standard deviation in the parameters' units: one number, (p,), or a mapping
            from name to number. ``inf`` and names that are left out: nothing is known.
        mean: likewise; the model's nominal value where it is left out.
        fixed: names of parameters held at the mean, out of the identification.
        by_data: of an arm, the sizes of the errors are taken from the readings; see
            :meth:`sized`.
    """

    std: Named
    mean: Named | None = None
    fixed: Sequence[str] = ()
    by_data: bool = False

    def __post_init__(self) -> None:
        if isinstance(self.fixed, str):
            raise ValueError(
                f"fixed must be a sequence of names, got the text {self.fixed!r}"
            )
        std = np.asarray(
            list(self.std.values()) if isinstance(self.std, Mapping) else self.std
        )
        std = numbers("std of the prior", std, finite=False)
        if not (std > 0.0).all():
            raise ValueError(
                "std of the prior must be positive (inf: nothing is known; "
                f"fixed=[name] holds a parameter), got {in_words(std[~(std > 0.0)])}"
            )

    def sized(self) -> Prior:
        """This prior with the scale of its groups taken from the readings.

        Its standard deviations then say how errors compare within a group, not how
        large they are: a factor each of lengths, turns of the axes, zeros of the joints
        and their compliance follows from the readings by marginal likelihood. For an
        arm whose tolerances are not known.
        """
        return dataclasses.replace(self, by_data=True)

    def resolve(self, model: Parametric) -> ResolvedPrior:
        """The prior of ``model``'s parameters, checked against its names."""
        names = model.names
        for name in self.fixed:
            _require_name("fixed", name, names)
        std = _by_name("std of the prior", self.std, names, np.full(len(names), np.inf))
        mean = np.array(model.nominal, dtype=np.float64)
        if self.mean is not None:
            mean = _by_name("mean of the prior", self.mean, names, mean)
            if not np.isfinite(mean).all():
                raise ValueError(
                    "mean of the prior must be finite, got "
                    f"{in_words(mean[~np.isfinite(mean)])}"
                )
        free = np.array([name not in self.fixed for name in names], dtype=np.bool_)
        return ResolvedPrior(mean, np.diag(std**-2.0), free)


def _require_name(argument: str, name: str, names: tuple[str, ...]) -> None:
    if name not in names:
        raise ValueError(
            f"{argument} must name parameters of the model ({', '.join(names)}), "
            f"got {name!r}"
        )


def _by_name(
    argument: str, values: Named, names: tuple[str, ...], default: Array
) -> Array:
    """(p,) ``values`` in the order of ``names``; ``default`` where they are silent."""
    if isinstance(values, Mapping):
        result = default.copy()
        for name, value in values.items():
            _require_name(argument, name, names)
            result[names.index(name)] = value
        return result
    array = numbers(argument, values, finite=False)
    if array.shape not in ((), (len(names),)):
        raise ValueError(
            f"{argument} must be one number, ({len(names)},) or a mapping from names, "
            f"got {array.shape}"
        )
    return np.broadcast_to(array, (len(names),)).copy()


@dataclasses.dataclass(frozen=True)
class Noise:
    """Normal noise of the readings, and of the commands.

    Attributes:
        std: of the readings, in their units: one number, (q,), or (N, q) for each
            candidate. 1 where neither it nor ``covariance`` is given.
        covariance: of the readings instead of std: (q, q) or (N, q, q).
        command_std: of the commands: one number or (n,), in their units. ``inf``: the
            command is unknown in every measurement (a nuisance parameter, as the pose
            of a camera in each view) and is eliminated.
    """

    std: ArrayLike | None = None
    covariance: ArrayLike | None = None
    command_std: ArrayLike | None = None

    def __post_init__(self) -> None:
        if self.std is not None and self.covariance is not None:
            raise ValueError("give std or covariance of the noise, not both")
        if self.std is not None:
            std = numbers("std of the noise", self.std)
            if not (std > 0.0).all():
                raise ValueError(
                    f"std of the noise must be positive, got {in_words(std.min())}"
                )
        if self.covariance is not None:
            numbers("covariance of the noise", self.covariance)
        if self.command_std is not None:
            spread = numbers("command_std", self.command_std, finite=False)
            if not (spread >= 0.0).all():
                raise ValueError(
                    "command_std must not be negative (inf: unknown in every "
                    f"measurement), got {in_words(spread[~(spread >= 0.0)])}"
                )
            given = self.std is not None or self.covariance is not None
            if not given and (np.isfinite(spread) & (spread > 0.0)).any():
                raise ValueError(
                    "command_std needs std or covariance of the readings beside it: "
                    "the two are added in the readings' units"
                )

    def of(self, rows: NDArray[np.bool_]) -> Noise:
        """The noise of some of the N candidates, ``rows`` (N,) True at each of them."""
        std, covariance = self.std, self.covariance
        if std is not None and np.ndim(std) == 2:
            std = np.asarray(std)[rows]
        if covariance is not None and np.ndim(covariance) == 3:
            covariance = np.asarray(covariance)[rows]
        return Noise(std, covariance, self.command_std)

    def whitening(
        self, count: int, num_outputs: int, command_jacobian: ArrayLike | None = None
    ) -> Array:
        """W (N, q, q) with ``W Sigma W.T = I``: information blocks are ``W @ J``.

        A row is zero where nuisance commands leave nothing to learn from it.

        Args:
            count: N measurements.
            num_outputs: q readings in each.
            command_jacobian: (N, q, n) of the model; needed with ``command_std``.
        """
        whole_number("count", count, 0)
        shape = (count, num_outputs, num_outputs)
        covariance = self._of_readings(*shape[:2])
        unknown = np.zeros((count, num_outputs, 0))
        if self.command_std is not None:
            derivative, spread = self._of_commands(shape[:2], command_jacobian)
            known = derivative * np.where(np.isinf(spread), 0.0, spread)
            covariance = covariance + known @ np.matrix_transpose(known)
            unknown = derivative[..., np.isinf(spread)]
        white = np.linalg.inv(np.linalg.cholesky(covariance))
        white = np.broadcast_to(white, shape)
        if not unknown.shape[-1]:
            return white
        left, size, _ = np.linalg.svd(white @ unknown)
        eaten = np.zeros((count, num_outputs), dtype=np.bool_)
        eaten[:, : size.shape[-1]] = significant(size)
        return np.where(eaten[..., None], 0.0, np.matrix_transpose(left) @ white)

    def _of_readings(self, count: int, q: int) -> Array:
        """(q, q) or (N, q, q) covariance."""
        if self.covariance is None:
            std = np.asarray(1.0 if self.std is None else self.std, dtype=np.float64)
            if std.shape not in ((), (q,), (count, q)):
                raise ValueError(
                    f"std of the noise must be one number, ({q},) or ({count}, {q}), "
                    f"got {std.shape}"
                )
            return np.eye(q) * np.square(std)[..., None]
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
        if covariance.size and np.linalg.eigvalsh(covariance).min() <= 0.0:
            raise ValueError(
                "covariance of the noise must be positive definite, got eigenvalue "
                f"{np.linalg.eigvalsh(covariance).min():.3g}"
            )
        return covariance

    def _of_commands(
        self, leading: tuple[int, int], command_jacobian: ArrayLike | None
    ) -> tuple[Array, Array]:
        """Derivative (N, q, n) and command_std (n,)."""
        if command_jacobian is None:
            raise ValueError(
                "command_std needs the derivative by the commands: give a model, or "
                "command_jacobian (N, q, n)"
            )
        derivative = numbers("command_jacobian", command_jacobian)
        if derivative.ndim != 3 or derivative.shape[:2] != leading:
            raise ValueError(
                f"command_jacobian must have shape ({leading[0]}, {leading[1]}, n), "
                f"got {derivative.shape}"
            )
        spread = np.asarray(self.command_std, dtype=np.float64)
        n = derivative.shape[-1]
        if spread.shape not in ((), (n,)):
            raise ValueError(
                f"command_std must be one number or ({n},), got {spread.shape}"
            )
        return derivative, np.broadcast_to(spread, (n,))
