"""``Calibration``: what every calibration holds and answers, whatever its model."""

from __future__ import annotations

import abc
import copy
import dataclasses
import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.calibration import file, table
from jaxcal.checks import numbers

if TYPE_CHECKING:
    from jaxcal.models import Model

__all__ = ["Calibration"]

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Calibration(abc.ABC):
    """The identified map from commands u (n inputs) to outputs y (m of them).

    :class:`AffineCalibration` where ``y = A u + b`` was fitted by least squares alone,
    :class:`ModelCalibration` for every other model, prior or loss. Arrays are copied
    and frozen on entry.
    """

    residuals: Array  # (N, m) measured less predicted, measured unit
    noise_std: Array | None  # (m,) at weight 1, behind every uncertainty
    noise_known: bool  # True: noise_std was given; False: it comes from the residuals
    noise_dof: float  # degrees of freedom of the noise estimated, 0 where known
    num_measurements: int  # of positive weight
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    command_unit: str  # "" where not stated
    measured_unit: str
    provenance: Mapping[str, Any]  # created, packages, data_sha256, notes

    _readers: ClassVar[dict[int, type[Calibration]]] = {}  # by version of the file

    def __init_subclass__(cls, version: int | None = None) -> None:
        if version is not None:
            Calibration._readers[version] = cls

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray):
                value = np.array(value)
                value.setflags(write=False)
                object.__setattr__(self, field.name, value)
        object.__setattr__(self, "provenance", copy.deepcopy(self.provenance))

    def __getattr__(self, name: str) -> Any:
        if name in ("matrix", "bias"):
            raise AttributeError(f"{name}: only an affine model y = A u + b has one")
        raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")

    def __repr__(self) -> str:
        return self.summary()

    # -- what each kind has of its own -------------------------------------------------

    @property
    @abc.abstractmethod
    def parameters(self) -> Array:
        """(p,) the estimate."""

    @property
    @abc.abstractmethod
    def parameter_names(self) -> tuple[str, ...]:
        """p names."""

    @property
    @abc.abstractmethod
    def covariance(self) -> Array | None:
        """(p, p) of ``parameters``; None where the noise is unknown."""

    @abc.abstractmethod
    def predict(self, commands: ArrayLike) -> Array:
        """Outputs (..., m) at commands (..., n)."""

    @abc.abstractmethod
    def predict_std(
        self, commands: ArrayLike, *, new_measurement: bool = False
    ) -> Array:
        """(..., m) standard deviation of ``predict``, or of one more measurement."""

    @abc.abstractmethod
    def command_for(
        self,
        desired: ArrayLike,
        limits: ArrayLike | None = None,
        *,
        clip: bool = False,
    ) -> Array:
        """Commands (..., n) that reach outputs (..., m)."""

    @abc.abstractmethod
    def lack_of_fit(self) -> float | None:
        """p-value of residuals at least this large under the noise that was given."""

    @abc.abstractmethod
    def summary(self) -> str:
        """The calibration as a table of text."""

    @abc.abstractmethod
    def _columns(self) -> dict[str, list[Any]]:
        """The table's columns, p entries each; the first is ``parameter``."""

    @abc.abstractmethod
    def to_dict(self) -> dict[str, Any]:
        """The content of the file."""

    @classmethod
    @abc.abstractmethod
    def _fields(cls, content: Mapping[str, Any], model: Model | None) -> dict[str, Any]:
        """Arguments of the class from the content of a file of its version."""

    @abc.abstractmethod
    def _no_noise(self, what: str) -> str:
        """Why there is no ``what``: the noise is unknown."""

    # -- shared ------------------------------------------------------------------------

    @property
    def num_inputs(self) -> int:
        """n."""
        return len(self.input_names)

    @property
    def num_outputs(self) -> int:
        """m."""
        return len(self.output_names)

    @property
    def names(self) -> tuple[str, ...]:
        """p names of the parameters."""
        return self.parameter_names

    @property
    def standard_errors(self) -> Array | None:
        """(p,) standard deviation of each parameter; None as ``covariance``."""
        covariance = self.covariance
        return None if covariance is None else np.sqrt(np.diag(covariance))

    def confidence_intervals(self, confidence: float = 0.95) -> Array:
        """(p, 2) lower and upper end for each parameter, one at a time.

        Student's t where the noise was estimated, the normal where it was given.

        Args:
            confidence: probability in (0, 1).

        Raises:
            ValueError: the noise is unknown, or ``confidence`` is not in (0, 1).
        """
        self._require_noise("confidence intervals")
        half = self._quantile(confidence) * np.asarray(self.standard_errors)
        return np.stack([self.parameters - half, self.parameters + half], axis=-1)

    def predict_interval(
        self,
        commands: ArrayLike,
        confidence: float = 0.95,
        *,
        new_measurement: bool = False,
    ) -> tuple[Array, Array]:
        """Lower and upper end, (..., m) each; arguments as for ``predict_std``."""
        centre = self.predict(commands)
        half = self._quantile(confidence) * self.predict_std(
            commands, new_measurement=new_measurement
        )
        return centre - half, centre + half

    def to_frame(self) -> Any:
        """One row per parameter: value, unit, std_error, low and high (95 %), ...

        Returns:
            A ``pandas.DataFrame``; the last three only where the noise is known.

        Raises:
            ImportError: pandas is not installed.
        """
        return table.to_frame(self._columns())

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a versioned JSON file atomically; see ``docs/calibration.md``.

        Raises:
            OSError: the folder is missing, not writable or full; the old file stays.
        """
        file.write(path, self.to_dict())

    @classmethod
    def load(
        cls, path: str | os.PathLike[str], *, model: Model | None = None
    ) -> Calibration:
        """Read a file that ``save`` wrote.

        Args:
            path: the file.
            model: the model, where it holds a function, which no file can.

        Raises:
            OSError: it cannot be read.
            ValueError: as of ``from_dict``; the message names the file too.
        """
        content = file.read(path)
        try:
            return cls.from_dict(content, model=model)
        except ValueError as error:
            raise ValueError(f"{os.fspath(path)}: {error}") from None

    @classmethod
    def from_dict(cls, content: Any, *, model: Model | None = None) -> Calibration:
        """The inverse of ``to_dict``.

        Raises:
            ValueError: it is not a calibration, of another version, or damaged; the
                message names the key.
        """
        version = file.require_version(content, tuple(cls._readers))
        kind = cls._readers[version]
        return kind(**kind._fields(content, model))

    # -- inside ------------------------------------------------------------------------

    def _points(self, name: str, values: ArrayLike, width: int) -> Array:
        points = numbers(name, values)
        if points.ndim < 1 or points.shape[-1] != width:
            raise ValueError(
                f"{name} must have shape (..., {width}), got {points.shape}"
            )
        return points

    def _require_noise(self, what: str) -> Array:
        if self.noise_std is None:
            raise ValueError(self._no_noise(what))
        return self.noise_std

    def _quantile(self, confidence: float) -> float:
        """Half-width of an interval in standard errors."""
        if not 0.0 < confidence < 1.0:
            raise ValueError(f"confidence must be in (0, 1), got {confidence}")
        from scipy import special  # loads in half the time of scipy.stats

        upper = 0.5 + 0.5 * confidence
        if self.noise_known:
            return float(special.ndtri(upper))
        return float(special.stdtrit(self.noise_dof, upper))
