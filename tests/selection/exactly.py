"""Criteria in exact arithmetic: an oracle that shares no line with jaxcal."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from fractions import Fraction
from typing import Any

import numpy as np

Matrix = list[list[Fraction]]


def fractions(rows: Any) -> Matrix:
    return [[Fraction(float(x)) for x in row] for row in np.asarray(rows, dtype=float)]


def information(rows: Matrix, prior: Matrix | None = None) -> Matrix:
    """``rows.T @ rows``, and a precision known beforehand."""
    p = len(rows[0])
    total = [[sum(r[a] * r[b] for r in rows) for b in range(p)] for a in range(p)]
    if prior is not None:
        total = [[total[a][b] + prior[a][b] for b in range(p)] for a in range(p)]
    return total  # type: ignore[return-value]  # sums of fractions


def inverse(matrix: Matrix) -> tuple[Matrix, Fraction] | None:
    """Of a square matrix, with its determinant; None where it is singular."""
    p = len(matrix)
    rows = [[*row, *(Fraction(int(a == b)) for b in range(p))]
            for a, row in enumerate(matrix)]  # fmt: skip
    determinant = Fraction(1)
    for a in range(p):
        pivot = next((r for r in range(a, p) if rows[r][a]), None)
        if pivot is None:
            return None
        if pivot != a:
            rows[a], rows[pivot] = rows[pivot], rows[a]
            determinant = -determinant
        determinant *= rows[a][a]
        rows[a] = [x / rows[a][a] for x in rows[a]]
        for r in range(p):
            if r != a and rows[r][a]:
                rows[r] = [
                    x - rows[r][a] * y for x, y in zip(rows[r], rows[a], strict=True)
                ]
    return [row[p:] for row in rows], determinant


def worth(
    criterion: str,
    total: Matrix,
    at: Sequence[int] = (),
    region: Matrix = (),  # type: ignore[assignment]
) -> float:
    """The value of an information matrix as jaxcal reports it; nan where singular."""
    inverted = inverse(total)
    if inverted is None:
        return math.nan
    covariance, determinant = inverted
    p = len(total)
    if criterion == "D":
        return log_of(determinant)
    if criterion == "A":
        return float(sum(covariance[a][a] for a in range(p)))
    if criterion == "As":
        return float(sum(covariance[a][a] for a in at))
    if criterion == "Ds":
        part = inverse([[covariance[a][b] for b in at] for a in at])
        assert part is not None
        return log_of(1 / part[1])
    if criterion == "I":
        return float(sum(variances(covariance, region)) / len(region))
    if p != 2:
        raise NotImplementedError("E in exact arithmetic is written for two parameters")
    # The smaller root of x^2 - trace x + determinant, without cancellation.
    trace = total[0][0] + total[1][1]
    root = math.sqrt(max(float(1 - 4 * determinant / trace**2), 0.0))
    return float(2 * determinant / trace) / (1.0 + root)


def variances(covariance: Matrix, region: Matrix) -> list[Fraction]:
    """Of predictions at every row of a region."""
    return [
        sum(x * sum(c * y for c, y in zip(line, row, strict=True))  # type: ignore[misc]
            for x, line in zip(row, covariance, strict=True))
        for row in region
    ]  # fmt: skip


def log_of(number: Fraction) -> float:
    """Natural log of a positive fraction of any size."""
    return math.log(number.numerator) - math.log(number.denominator)


def every_choice(
    criterion: str, rows: Any, k: int, at: Sequence[int] = ()
) -> Iterator[tuple[tuple[int, ...], float]]:
    """All k of the rows (M, p) that are not singular, with their worth."""
    exact = fractions(rows)
    for subset in itertools.combinations(range(len(exact)), k):
        value = worth(criterion, information([exact[i] for i in subset]), at, exact)
        if not math.isnan(value):
            yield subset, value


def best_choice(criterion: str, rows: Any, k: int, at: Sequence[int] = ()) -> float:
    better = max if criterion in ("D", "Ds", "E") else min
    return better(value for _, value in every_choice(criterion, rows, k, at))
