"""Full polynomials of the commands."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.checks import whole_number
from jaxcal.models.linear import Linear, input_letters

__all__ = ["Polynomial"]

Array = NDArray[np.float64]


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
            self._monomials, num_outputs, inputs=names, terms=["1", *terms[1:]]
        )

    def to_dict(self) -> dict[str, Any]:
        return {
            "kind": "polynomial",
            "degree": self.degree,
            "num_inputs": self.num_inputs,
            "num_outputs": self.num_outputs,
        }

    def _monomials(self, commands: Array) -> Array:
        return np.prod(commands[:, None, :] ** self._powers, axis=-1)

    def _slopes(self, commands: Array) -> Array:
        columns = []
        for i in range(self.num_inputs):
            lower = self._powers - np.eye(self.num_inputs, dtype=int)[i]
            rest = np.prod(commands[:, None, :] ** np.maximum(lower, 0), axis=-1)
            columns.append(self._powers[:, i] * rest)
        return np.stack(columns, axis=-1)
