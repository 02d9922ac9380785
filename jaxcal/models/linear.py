"""Models that are linear in their parameters: affine, or features of the commands."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import Array, axis_letter, axis_names, numbers, whole_number
from jaxcal.information.regression import regressors
from jaxcal.models.model import (
    Fitting,
    Model,
    Theta,
    as_commands,
    as_parameters,
    parameter_names,
)

if TYPE_CHECKING:
    from jaxcal.models.formula import Levels


class AffineFitting(Fitting):
    """What is asked of ``y = A u + b``."""

    @property
    def multiplicity(self) -> int:
        """How often log det of the blocks counts: once per output."""
        return self.model.num_outputs

    def centred(self, centre: Array) -> Array:
        """(p, p): the outputs at the centre stand for b."""
        m, n = self.model.num_outputs, self.model.num_inputs
        to_centred = np.eye(m * (n + 1))
        for i in range(m):
            to_centred[m * n + i, i * n : (i + 1) * n] = centre
        return to_centred

    def units_for(self, command_unit: str, measured_unit: str) -> tuple[str, ...]:
        slope = measured_unit
        if command_unit:
            slope = f"{measured_unit or '1'}/{command_unit}"
        m = self.model.num_outputs
        return (slope,) * (m * self.model.num_inputs) + (measured_unit,) * m


@dataclasses.dataclass(frozen=True)
class Affine(Model):
    """n inputs, m outputs; parameters are A row by row, then b (paper, Equation 9).

    The outputs share one regressor ``[u, 1]``: with unit noise the information of a
    posture is m equal diagonal blocks, so one block [u, 1] counted m times holds it.
    """

    linear = True
    title = "y = A u + b"
    num_inputs: int  # n
    num_outputs: int  # m

    def __post_init__(self) -> None:
        whole_number("num_inputs", self.num_inputs, 1)
        whole_number("num_outputs", self.num_outputs, 1)

    @property
    def fitting(self) -> AffineFitting:
        return AffineFitting(self)

    @functools.cached_property
    def names(self) -> tuple[str, ...]:
        """``a11 a12 ... bx by bz``; ``a1,10`` where there are more than nine."""
        n, m = self.num_inputs, self.num_outputs
        comma = "," if max(m, n) > 9 else ""
        slopes = [f"a{i + 1}{comma}{j + 1}" for i in range(m) for j in range(n)]
        return (*slopes, *(f"b{axis_letter(i, m)}" for i in range(m)))

    @property
    def nominal(self) -> Array:
        """(m (n + 1),) the outputs are the inputs: A is the identity, b is zero."""
        slopes = np.eye(self.num_outputs, self.num_inputs)
        return np.concatenate([slopes.ravel(), np.zeros(self.num_outputs)])

    def predict(self, commands: ArrayLike, parameters: Theta = None) -> Array:
        """Outputs (N, m) at commands (N, n) for parameters (m (n + 1),)."""
        matrix, bias = self.affine(as_parameters(self, parameters))
        return as_commands(self, commands) @ matrix.T + bias

    def jacobian(self, commands: ArrayLike, parameters: Theta = None) -> Array:
        """(N, m, m (n + 1)) derivative of the outputs; ``parameters`` do not matter."""
        commands = as_commands(self, commands)
        (count, n), m = commands.shape, self.num_outputs
        slopes = np.zeros((count, m, m * (n + 1)))
        for i in range(m):
            slopes[:, i, i * n : (i + 1) * n] = commands
        slopes[:, :, m * n :] = np.eye(m)
        return slopes

    def command_jacobian(self, commands: ArrayLike, parameters: Theta = None) -> Array:
        """(N, m, n): the matrix A for every command."""
        matrix, _ = self.affine(as_parameters(self, parameters))
        return np.broadcast_to(
            matrix, (len(as_commands(self, commands)), *matrix.shape)
        )

    def blocks(self, commands: ArrayLike) -> Array:
        """(..., N, 1, n + 1) information blocks [u, 1] of commands (..., N, n)."""
        return regressors(commands)[..., None, :]

    def affine(self, parameters: Array) -> tuple[Array, Array]:
        """A (m, n) and b (m,)."""
        m, n = self.num_outputs, self.num_inputs
        return parameters[: m * n].reshape(m, n), parameters[m * n :]

    def meanings(self, inputs: Sequence[str], outputs: Sequence[str]) -> list[str]:
        return [
            *(f"{y} per {u}" for y in outputs for u in inputs),
            *(f"{y} at u = 0" for y in outputs),
        ]

    def to_dict(self) -> dict[str, Any]:
        return {"kind": "affine", **dataclasses.asdict(self)}


class Linear(Model):
    """``y_i = sum of theta_ij f_j(u)``: m outputs, each a sum of the same r features.

    Parameters are named by the terms, output by output: "1", "x", "x:y"; with several
    outputs "y1:1", "y1:x", ...

    Args:
        features: a formula, ``"1 + x + y + x:y + I(x**2) + sin(2*pi*x/30)"``, or a
            function of commands (N, n) that returns (N, r). In a formula
            ``C(x, levels=['a', 'b'])`` is a category. Frames and tables hold its
            words, arrays 0, 1, ... for them; levels may also be numbers.
        num_outputs: m.
        inputs: names of the n commands; with a function their number will do. By
            default x, y, z or u1, u2, ... as the formula has them.
        terms: names of the r features of a function; f1, f2, ... when not given.
    """

    linear = True
    num_inputs: int
    num_outputs: int
    inputs: tuple[str, ...]

    def __init__(
        self,
        features: str | Callable[[Array], ArrayLike],
        num_outputs: int = 1,
        *,
        inputs: Sequence[str] | int | None = None,
        terms: Sequence[str] | None = None,
    ) -> None:
        self.num_outputs = whole_number("num_outputs", num_outputs, 1)
        self.features = features
        self._analytic = isinstance(features, str)
        self._categories: dict[str, Levels] = {}
        if isinstance(features, str):
            if terms is not None:
                raise ValueError("terms must be left out: a formula has its own")
            from jaxcal.models.formula import input_names, parse

            self._factors, used, self._categories = parse(features)
            inputs = input_names(used) if inputs is None else inputs
        elif not callable(features):
            raise ValueError(
                f"features must be a formula or a function, got {features!r}"
            )
        elif inputs is None:
            raise ValueError(
                "inputs must be given with a function: names of the commands, or "
                "their number"
            )
        if not isinstance(inputs, Sequence):
            inputs = input_letters(whole_number("inputs", inputs, 1))
        self.inputs = axis_names("inputs", inputs, "u", len(inputs))
        self.num_inputs = len(self.inputs)
        if isinstance(features, str):
            if unknown := used - set(self.inputs):
                raise ValueError(
                    f"features must use the inputs {', '.join(self.inputs)}, got "
                    f"{min(unknown)!r} in {features!r}"
                )
            self.terms = tuple(self._factors)
        else:
            with np.errstate(all="ignore"):
                count = self._call(np.zeros((1, self.num_inputs))).shape[1]
            self.terms = parameter_names(terms, count, "f")
        if not self.terms:
            raise ValueError(f"features must hold at least one term, got {features!r}")

    @property
    def levels(self) -> tuple[tuple[str, ...], ...]:
        """The words that each input may be; () where it is a number."""
        return tuple(
            tuple(level for level in levels if isinstance(level, str))
            for levels in (self._categories.get(name, ()) for name in self.inputs)
        )

    @functools.cached_property
    def names(self) -> tuple[str, ...]:
        if self.num_outputs == 1:
            return self.terms
        outputs = range(1, self.num_outputs + 1)
        return tuple(f"y{i}:{term}" for i in outputs for term in self.terms)

    @property
    def nominal(self) -> Array:
        """(p,) zeros: the model is linear, so any start will do."""
        return np.zeros(self.num_parameters)

    def predict(self, commands: ArrayLike, parameters: Theta = None) -> Array:
        """Outputs (N, m) at commands (N, n), or at a data frame with their names."""
        coefficients = as_parameters(self, parameters)
        features = self._evaluate(as_commands(self, commands))
        return features @ coefficients.reshape(self.num_outputs, -1).T

    def jacobian(self, commands: ArrayLike, parameters: Theta = None) -> Array:
        """(N, m, m r): the features; ``parameters`` do not matter."""
        features = self._evaluate(as_commands(self, commands))
        whole = np.einsum("ab,nr->nabr", np.eye(self.num_outputs), features)
        return whole.reshape(-1, self.num_outputs, self.num_parameters)

    def command_jacobian(self, commands: ArrayLike, parameters: Theta = None) -> Array:
        """(N, m, n); of a function by differences, exact to about 1e-9."""
        coefficients = as_parameters(self, parameters).reshape(self.num_outputs, -1)
        slopes = self._slopes(as_commands(self, commands))
        return np.einsum("mr,nri->nmi", coefficients, slopes)

    def to_dict(self) -> dict[str, Any]:
        """A function cannot be written: its dict names the terms only."""
        return {
            "kind": "linear",
            "features": self.features if isinstance(self.features, str) else None,
            "num_outputs": self.num_outputs,
            "inputs": list(self.inputs),
            "terms": list(self.terms),
        }

    def _evaluate(self, commands: Array) -> Array:
        """(N, r), finite."""
        for name, levels in self._categories.items():
            column = commands[:, self.inputs.index(name)]
            words = isinstance(levels[0], str)
            offered = dict(enumerate(levels)) if words else dict.fromkeys(levels, "")
            for i in np.flatnonzero(~np.isin(column, [*offered]))[:1]:
                rule = ", ".join(f"{x} {word}".strip() for x, word in offered.items())
                raise ValueError(
                    f"{name} must be one of {rule}, got {column[i]:.6g} in row {i}"
                )
        with np.errstate(all="ignore"):
            features = self._features(commands)
        bad = np.argwhere(~np.isfinite(features))
        if len(bad):
            i, j = bad[0]
            at = ", ".join(
                f"{name} = {value:.6g}"
                for name, value in zip(self.inputs, commands[i], strict=True)
            )
            raise ValueError(
                f"features must be finite, {self.terms[j]!r} is {features[i, j]} at "
                f"candidate {i} ({at})"
            )
        return features

    def _features(self, commands: NDArray[Any]) -> NDArray[Any]:
        if not isinstance(self.features, str):
            return self._call(commands)
        values = dict(zip(self.inputs, commands.T, strict=True))
        ones = np.ones(len(commands), dtype=commands.dtype)
        return np.stack(
            [
                math.prod((factor(values) for factor in factors), start=ones)
                for factors in self._factors.values()
            ],
            axis=1,
        )

    def _call(self, commands: Array) -> Array:
        assert callable(self.features)
        features = numbers(
            "what features returns", self.features(commands), finite=False
        )
        right = features.ndim == 2 and len(features) == len(commands)
        terms = getattr(self, "terms", None)
        if not right or (terms and features.shape[1] != len(terms)):
            rule = f"({len(commands)}, {len(terms) if terms else 'r'})"
            raise ValueError(
                f"features must return {rule} for commands {commands.shape}, "
                f"got {features.shape}"
            )
        return features

    def _slopes(self, commands: Array) -> Array:
        """(N, r, n) derivative of the features."""
        columns = []
        for i in range(self.num_inputs):
            step = np.zeros(self.num_inputs)
            if self._analytic:  # a complex step is exact
                step[i] = 1e-30
                columns.append(self._features(commands + 1j * step).imag / 1e-30)
                continue
            step[i] = 1e-6 * (np.abs(commands[:, i]).max(initial=0.0) or 1.0)
            rise = self._evaluate(commands + step) - self._evaluate(commands - step)
            columns.append(rise / (2.0 * step[i]))
        return np.stack(columns, axis=-1)


class PolynomialFitting(Fitting):
    """What is asked of a polynomial."""

    def centred(self, centre: Array) -> Array:
        """(p, p) by the binomial theorem: ``u^a = sum of binom(a, k) c^(a-k) v^k``."""
        high, low = self.model._powers[None], self.model._powers[:, None]
        powers = range(self.model.degree + 1)
        choices = np.array([[math.comb(a, k) for k in powers] for a in powers])
        factors = choices[high, low] * centre ** np.maximum(high - low, 0)
        of_output: Array = np.prod(factors, axis=-1)  # 0 where a power is lower
        return np.asarray(np.kron(np.eye(self.model.num_outputs), of_output))


class Polynomial(Linear):
    """All monomials of total degree up to ``degree``: 1, x, y, x^2, x y, y^2, ...

    Args:
        degree: at least 1.
        num_inputs: n, called x, y, z, or u1, u2, ... from four on.
        num_outputs: m.
    """

    def __init__(self, degree: int, num_inputs: int, num_outputs: int = 1) -> None:
        self.degree = whole_number("degree", degree, 1)
        n = whole_number("num_inputs", num_inputs, 1)
        powers = [
            tuple(chosen.count(i) for i in range(n))
            for total in range(self.degree + 1)
            for chosen in itertools.combinations_with_replacement(range(n), total)
        ]
        self._powers = np.array(powers)
        names = input_letters(n)
        terms = [
            " ".join(
                name if power == 1 else f"{name}^{power}"
                for name, power in zip(names, row, strict=True)
                if power
            )
            for row in powers
        ]
        super().__init__(
            self._features, num_outputs, inputs=names, terms=["1", *terms[1:]]
        )
        self._analytic = True

    @property
    def fitting(self) -> PolynomialFitting:
        return PolynomialFitting(self)

    def affine(self, parameters: Array) -> tuple[Array, Array] | None:
        """A (m, n) and b (m,) of degree 1."""
        if self.degree > 1:
            return None
        rows = parameters.reshape(self.num_outputs, -1)
        return rows[:, 1:], rows[:, 0]

    def to_dict(self) -> dict[str, Any]:
        keys = "degree", "num_inputs", "num_outputs"
        return {"kind": "polynomial"} | {key: getattr(self, key) for key in keys}

    def _features(self, commands: NDArray[Any]) -> NDArray[Any]:
        features = np.ones((len(self._powers), len(commands)), commands.dtype)
        for term, row in zip(features, self._powers, strict=True):
            for u, power in zip(commands.T, row, strict=True):
                if power:
                    term *= u if power == 1 else u**power
        return np.ascontiguousarray(features.T)


def input_letters(count: int) -> tuple[str, ...]:
    """x, y, z; u1, u2, ... where there are more."""
    return tuple("xyz"[:count] if count <= 3 else (f"u{i + 1}" for i in range(count)))
