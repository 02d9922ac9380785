"""Published suites of designs: their files, which are the user's, and own draws.

Maximum-entropy sampling: data63, data90 and data124 (.mat, ``C`` a covariance) of Chen,
Fampa and Lee, On computing with some convex relaxations, INFORMS Journal on Computing
2023. A covariance ``l (I + F F.T)``, l its least eigenvalue, is a choice of the rows of
F by D with a prior I.

The families of Hendrych, Besancon and Pokutta, Solving the optimal experiment design
problem with mixed-integer convex methods (2024): m experiments of n parameters, N
chosen, each up to a bound of its own; independent or correlated; A and D without, and
"fusion" with what is known beforehand. E in the Conic Benchmark Format: the largest t
with ``sum of x_i A_i - t I`` positive semidefinite, x whole.
"""

from __future__ import annotations

import dataclasses
import pathlib
import re

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Instance:
    """A design problem: rows (m, n), a prior, how often each row may be chosen, N."""

    name: str
    criterion: str
    rows: Array
    prior: Array | None
    most: NDArray[np.int64]
    size: int


def covariance(folder: pathlib.Path | None, n: int) -> Array:
    """``dataN.mat`` of the folder, else of a field, with noise, at n places drawn at
    random."""
    if folder is not None:
        from scipy.io import loadmat

        matrix = np.asarray(loadmat(folder / f"data{n}.mat")["C"], dtype=np.float64)
        return (matrix + matrix.T) / 2
    rng = np.random.default_rng(n)
    places = rng.uniform(size=(n, 2))
    apart = np.linalg.norm(places[:, None] - places, axis=-1)
    std = np.exp(0.3 * rng.standard_normal(n))
    return np.outer(std, std) * (np.exp(-2.0 * apart) + 0.1 * np.eye(n))


def entropy(matrix: Array, size: int) -> Instance:
    """The most informative ``size`` places of a covariance (n, n)."""
    values, vectors = np.linalg.eigh(matrix)
    rows = vectors[:, 1:] * np.sqrt((values[1:] - values[0]) / values[0])
    once = np.ones(len(rows), dtype=np.int64)
    return Instance(f"s = {size}", "D", rows, np.eye(len(rows) - 1), once, size)


def family(
    criterion: str, m: int, n: int, seed: int, *, correlated: bool, fusion: bool
) -> Instance:
    """A draw of a family of Hendrych, Besancon and Pokutta."""
    rng = np.random.default_rng(seed)
    rows = rng.random((m, n))
    if correlated:
        root = rng.random((m, n))
        mean = rng.standard_normal(n)
        rows = rng.multivariate_normal(mean, root.T @ root, size=m)
    known = rng.random((2 * n, n))
    prior = (
        known.T @ known if fusion else 1e-4 * np.eye(n) if criterion == "A" else None
    )
    size = int(rng.integers(m // 20, m // 3 + 1)) if fusion else int(1.5 * n)
    highest = m / 10 if fusion else size // 3
    most = np.floor(rng.uniform(1.0, highest, m)).astype(np.int64)
    kind = ("correlated" if correlated else "independent") + ", fusion" * fusion
    return Instance(f"{m}/{n}/{size} {kind}", criterion, rows, prior, most, size)


def smallest(m: int, n: int, size: int, seed: int) -> Instance:
    """E of m normal rows of n parameters, N chosen, each at most once."""
    rows = np.random.default_rng(seed).standard_normal((m, n))
    once = np.ones(m, dtype=np.int64)
    return Instance(f"{m}/{n}/{size}", "E", rows, None, once, size)


def cbf(path: pathlib.Path) -> Instance:
    """An instance of E in the Conic Benchmark Format; ValueError if it is none."""
    text = re.sub(r"#.*", "", path.read_text())
    parts = re.split(r"^(?!MAX|MIN)([A-Z]+)\s*$", text, flags=re.MULTILINE)
    words = {
        name: body.split() for name, body in zip(parts[1::2], parts[2::2], strict=True)
    }

    def numbers(name: str, wide: int) -> Array:
        given = words.get(name, ["0"])
        return np.array(given[1:], dtype=np.float64).reshape(-1, wide)

    def wrong(what: str) -> ValueError:
        return ValueError(f"{path}: {what}: not a choice by the least eigenvalue")

    whole = numbers("INT", 1).astype(int)[:, 0]
    size_of = np.array(words.get("PSDCON", ["0"])[1:], dtype=int)
    if len(size_of) != 1 or not len(whole):
        raise wrong("whole variables and one PSDCON are expected")
    n, m = int(size_of[0]), len(whole)
    goal = numbers("OBJACOORD", 2)
    if len(goal) != 1 or words["OBJSENSE"] != ["MAX"]:
        raise wrong("the objective is to be the largest single variable")
    matrices = {int(i): np.zeros((n, n)) for i in [*whole, goal[0, 0]]}
    for _, variable, a, b, value in numbers("HCOORD", 5):
        matrix = matrices.setdefault(int(variable), np.zeros((n, n)))
        matrix[int(a), int(b)] = matrix[int(b), int(a)] = value
    known = np.zeros((n, n))
    for _, a, b, value in numbers("DCOORD", 4):
        known[int(a), int(b)] = known[int(b), int(a)] = value
    unit = -matrices[int(goal[0, 0])] * goal[0, 1]
    if not np.allclose(unit, unit[0, 0] * np.eye(n)) or not unit[0, 0] > 0.0:
        raise wrong("the variable of the objective is to be taken off the diagonal")
    rows = np.zeros((m, n))
    for i, matrix in zip(range(m), (matrices[int(v)] for v in whole), strict=True):
        values, vectors = np.linalg.eigh(matrix / unit[0, 0])
        if values[:-1].size and np.abs(values[:-1]).max() > 1e-9 * values[-1]:
            raise wrong(f"variable {whole[i]} adds more than one reading")
        rows[i] = np.sqrt(max(values[-1], 0.0)) * vectors[:, -1]
    constants = {int(row): value for row, value in numbers("BCOORD", 2)}
    most, size = _bounds(words, numbers("ACOORD", 3), constants, whole)
    if not size:
        raise wrong("no constraint says how many are chosen")
    prior = known / unit[0, 0] if known.any() else None
    return Instance(path.stem, "E", rows, prior, most, size)


def _bounds(
    words: dict[str, list[str]],
    entries: Array,
    constants: dict[int, float],
    whole: NDArray[np.int64],
) -> tuple[NDArray[np.int64], int]:
    """How often each whole variable may be chosen, and their sum, 0 without one, by
    constraints ``a x + b`` of the cones L=, L- and L+: zero, at most and at least."""
    most, size, begun = np.full(len(whole), -1), 0, 0
    cones = words.get("CON", ["0", "0"])[2:]
    for cone, count in zip(cones[::2], cones[1::2], strict=True):
        for row in range(begun, begun + int(count)):
            here = entries[entries[:, 0].astype(int) == row]
            if not len(here):
                continue
            places = np.searchsorted(whole, here[:, 1].astype(int))
            limit, factor = -constants.get(row, 0.0) / here[0, 2], here[0, 2]
            if len(here) == len(whole):
                size = round(limit)
            elif len(here) == 1 and (cone == "L-") == (factor > 0.0) and limit:
                most[places[0]] = int(np.floor(limit + 1e-9))
        begun += int(count)
    return np.where(most < 0, size, most), size
