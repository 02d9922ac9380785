"""The criteria D, A, I, G, E, Ds, As. A new criterion is one class here.

``V = C M^-1 C.T`` is the covariance of the combinations ``C theta`` that matter, M the
information (p, p). Every criterion is written as a concave phi(M) to be maximised:

========  ===========================  ======  ===========================  ==========
kind      phi                          names   reported value               efficiency
========  ===========================  ======  ===========================  ==========
``det``   -log det V                   D, Ds   log det V^-1, larger better  e^((v-b)/s)
``trace`` -trace V                     A I As  trace V, smaller better      b / v
``least`` 1 / largest eigenvalue of V  E       the same, larger better      v / b
========  ===========================  ======  ===========================  ==========

v is the value of a selection, b that of the optimum or a bound on it, s the rows of C.
C is the identity for D, A and E, picks the parameters of interest for Ds and As, and
for I ``C.T @ C`` is the mean of ``J.T @ J`` over a region: V's trace is then the mean
variance of the predictions there. G, their largest variance, is the worst of as many
traces as the region has rows; all of them are judged as scenarios are.

Sources: Pukelsheim, Optimal Design of Experiments (concavity, subsets of parameters);
Atkinson, Donev and Tobias, Optimum Experimental Designs.
"""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Iterable, Sequence
from inspect import signature
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import Array, one_of
from jaxcal.information.blocks import WhiteBlocks, triangle
from jaxcal.information.singular import power_of_two, significant

_HULL = 5  # parameters up to which qhull's facets are few


class Coordinates(NamedTuple):
    """The coordinates of one problem, in which everything measured at once says I."""

    white: WhiteBlocks
    names: tuple[str, ...]  # (p,) of the caller's parameters
    readings: int  # that all available candidates give together
    region: Array | None  # (R, q, p) blocks of the criterion's region, in the caller's
    times: int  # outputs that share these parameters' information

    @property
    def basis(self) -> Array:
        """(p, p): combinations C of the caller's parameters are ``C @ basis`` here."""
        return self.white.basis


class Criterion:
    """A criterion as it is asked for, with its data; ``within`` gives that of one
    problem, which has ``root`` and what follows, in the problem's coordinates."""

    name: ClassVar[str]
    kind: ClassVar[str]  # "det", "trace" or "least"
    says: ClassVar[str]  # what a table prints before the value; V is a covariance
    per_output: ClassVar[bool] = False  # the value is one output's, not their sum
    of_region: ClassVar[bool] = False  # it is about predictions, see ``region``
    of_each: ClassVar[bool] = False  # and about each alone, whatever they say together
    by_name: ClassVar[bool] = False  # it tells the parameters apart
    of_parameters: ClassVar[bool] = False  # made of some of them: ``Ds(parameters)``
    region: ArrayLike | None = None  # commands or blocks where; the candidates if None

    root: Array  # C (s, p), of full row rank; square for "least"
    times: int = 1  # how often log det V or trace V counts: outputs of equal blocks
    offset: float = 0.0  # added to phi of "det" where C was changed by a factor
    unit: float = 1.0  # V in the caller's units is this times V, of "trace" and "least"

    @classmethod
    def of_rows(
        cls, root: Array, times: int = 1, offset: float = 0.0, unit: float = 1.0
    ) -> Self:
        criterion = cls.__new__(cls)
        criterion.root, criterion.times = root, times
        criterion.offset, criterion.unit = offset, unit
        return criterion

    @property
    def each(self) -> Criterion:
        return self

    @property
    def efficiency_name(self) -> str:
        """What a table calls the efficiency."""
        return f"{self.name}-efficiency" if len(self.name) <= 2 else "efficiency"

    def rows(self, at: Coordinates) -> Array:
        """C (s, p) in the problem's coordinates, of full row rank."""
        return at.basis

    def within(self, at: Coordinates) -> Self:
        """The criterion in the coordinates of one problem. The size of C goes into
        ``unit`` or ``offset`` by powers of two, which is exact."""
        root, times = self.rows(at), 1 if self.per_output else at.times
        if self.kind == "det":
            units = power_of_two(np.abs(root).max(axis=1, keepdims=True))
            offset = -2.0 * float(np.log(units).sum())
            return self.of_rows(root / units, times, offset=offset)
        if not root.any():
            return self.of_rows(root, times)
        size = 2.0 ** min(math.frexp(np.abs(root).max())[1], 1023)
        root = root / size
        rest = 2.0 ** math.frexp(math.sqrt((root * root).sum()))[1]
        try:
            unit = (size * rest) ** 2
        except OverflowError:  # asked for where it is used
            unit = math.inf
        return self.of_rows(root / rest, times, unit=unit)

    @property
    def form(self) -> str:
        """What kernels call it: "det", of fewer than all "subset", "trace", "least"."""
        part = self.kind == "det" and len(self.root) < self.root.shape[1]
        return "subset" if part else self.kind

    @property
    def larger_is_better(self) -> bool:
        """Whether a larger reported value is better."""
        return self.kind != "trace"

    def value(self, information: Array) -> Array:
        """phi (...,) of information matrices (..., p, p); -inf where singular."""
        half, regular = self._half(information)
        if self.kind == "least":
            phi = np.linalg.norm(half, 2, axis=(-2, -1)) ** -2.0
        elif self.kind == "trace":
            phi = -(half * half).sum(axis=(-2, -1))
        else:
            phi = -np.linalg.slogdet(half @ np.matrix_transpose(half))[1]
        return np.where(regular, phi, -np.inf)

    def slope(self, information: Array) -> Array:
        """(p, p) gradient of phi by the information (p, p)."""
        half = np.linalg.solve(information, self.root.T)  # M^-1 C.T
        covariance = self.root @ half
        if self.kind == "det":
            return np.asarray(half @ np.linalg.solve(covariance, half.T))
        if self.kind == "trace":
            return np.asarray(half @ half.T)
        values, vectors = np.linalg.eigh(covariance)
        along = half @ vectors[:, -1]
        return np.asarray(np.outer(along, along) / values[-1] ** 2)

    def reported(self, phi: Array | float) -> Array | float:
        """The value as the caller reads it."""
        if self.kind == "det":
            return self.times * (phi + self.offset)
        if self.kind == "trace":
            return -self.times * self.unit * phi
        return phi / self.unit

    def efficiency(self, value: float, bound: float) -> float:
        """Share in (0, 1] of the best possible, of reported values."""
        if self.kind == "det":
            return float(np.exp((value - bound) / (self.times * len(self.root))))
        if value == bound:  # both may be zero: predictions that nothing depends on
            return 1.0
        return float(bound / value if self.kind == "trace" else value / bound)

    def bettered(self, value: float, share: float) -> float:
        """A reported value where every variance is smaller by ``share`` of itself."""
        if self.kind == "det":
            return value + self.times * len(self.root) * float(np.log1p(share))
        return value / (1.0 + share) if self.kind == "trace" else value * (1.0 + share)

    def enough(self, efficiency: float) -> tuple[float, float]:
        """A bound on phi of at most the first times phi, plus the second, proves it."""
        if self.kind == "det":
            return 1.0, -len(self.root) * float(np.log(efficiency))
        return (efficiency if self.kind == "trace" else 1.0 / efficiency), 0.0

    def _half(self, information: Array) -> tuple[Array, NDArray[np.bool_]]:
        """H (..., s, p) with ``H @ H.T = V``, and where M is not singular."""
        size = np.sqrt(np.diagonal(information, axis1=-2, axis2=-1))
        if not size.all():
            size = np.where(size > 0.0, size, 1.0)
        row = size[..., None, :]
        values, vectors = np.linalg.eigh(information / (size[..., None] * row))
        regular = significant(values, squares=True)[..., 0]
        if not regular.all():
            values = np.where(regular[..., None], values, 1.0)
        half = (self.root / row) @ vectors / np.sqrt(values)[..., None, :]
        return half, regular


class D(Criterion):
    """Joint uncertainty of all parameters."""

    name, kind, says = "D", "det", "log det S"

    def within(self, at: Coordinates) -> Self:
        identity = _identity(len(at.white.prior))
        return self.of_rows(identity, at.times, offset=at.white.log_scale)


@functools.cache
def _identity(size: int) -> Array:
    identity = np.eye(size)
    identity.flags.writeable = False
    return identity


class A(Criterion):
    """Sum of the parameters' variances."""

    name, kind, says = "A", "trace", "trace V"


class E(Criterion):
    """The least certain combination of the parameters."""

    name, kind, says, per_output = "E", "least", "eigenvalue", True


class I(Criterion):  # noqa: E742 - the criterion's own name in the literature
    """Mean variance of the predictions over a region, in units of the noise.

    Noise that differs by row is averaged in root mean square.

    Args:
        region: (R, n) commands, or (R, q, p) blocks, at which predictions are wanted;
            the available candidates when not given.
    """

    name, kind, says, per_output = "I", "trace", "mean variance", True
    of_region = True

    def __init__(self, region: ArrayLike | None = None) -> None:
        self.region = region

    def rows(self, at: Coordinates) -> Array:
        p = len(at.white.prior)
        if at.region is None and not at.white.prior.any():
            return _identity(p) / np.sqrt(at.readings)
        if at.region is None:
            rows, count = at.white.blocks.reshape(-1, p), at.readings
        else:
            rows = at.white.of(at.region).reshape(-1, p)
            count = len(rows)
        # No squares: what a prior alone knows may be small here.
        size, right = np.linalg.svd(triangle(rows))[1:]
        keep = size > 0.0 if at.region is None else significant(size)
        right = right[: len(size)]
        return np.asarray(size[keep, None] * right[keep] / np.sqrt(count))


class G(I):
    """Largest variance of a prediction over a ``region`` as of ``I``."""

    name, says, of_each = "G", "largest variance", True

    def rows(self, at: Coordinates) -> Array:
        """(R, p) the predictions that may be the least certain."""
        rows = at.white.blocks if at.region is None else at.white.of(at.region)
        rows = rows.reshape(-1, len(at.white.prior))
        rows = np.unique(rows, axis=0)
        rows = rows[rows.any(axis=1)]
        if not 2 <= rows.shape[1] <= _HULL or len(rows) <= 4 * rows.shape[1]:
            return rows
        from scipy.spatial import ConvexHull, QhullError

        try:  # a variance is convex in its row, and even
            vertices = ConvexHull(np.concatenate([rows, -rows])).vertices
        except QhullError:
            return rows
        return rows[np.unique(vertices % len(rows))]


class _SubsetCriterion(Criterion):
    """A criterion of the parameters of interest."""

    by_name = of_parameters = True

    def __init__(self, parameters: Sequence[str | int]) -> None:
        self.parameters = parameters

    def rows(self, at: Coordinates) -> Array:
        return at.basis[positions(self.parameters, at.names)]


class Ds(_SubsetCriterion):
    """Joint uncertainty of the parameters of interest; the others are nuisance.

    Args:
        parameters: their names or indices, at least one.
    """

    name, kind, says = "Ds", "det", "log det V^-1"


class As(_SubsetCriterion):
    """Sum of the variances of the ``parameters`` of interest, as of ``Ds``."""

    name, kind, says = "As", "trace", "trace V"


CRITERIA: dict[str, type[Criterion]] = {
    each.name: each for each in (D, A, I, G, E, Ds, As)
}


def offered() -> list[str]:
    """Names in ``CRITERIA`` that a command line can ask for."""
    return [
        name
        for name, kind in CRITERIA.items()
        if kind.of_parameters or kind.of_region or not signature(kind).parameters
    ]


def criterion_of(criterion: Any, region: Any, default: str) -> Criterion:
    """The criterion asked for by its letters (``default`` if None), or as an object."""
    if isinstance(criterion, Criterion):
        asked = criterion
    else:
        name = default if criterion is None else getattr(criterion, "name", criterion)
        one_of("criterion", name, tuple(CRITERIA))
        try:
            asked = CRITERIA[name]()
        except TypeError:
            raise ValueError(
                f"criterion {name} needs its parameters: "
                f"jaxcal.{CRITERIA[name].__name__}([...])"
            ) from None
    if region is None:
        return asked
    if not asked.of_region or asked.region is not None:
        raise ValueError(
            f"region works once, with criterion I or G only, got criterion {asked.name}"
        )
    return type(asked)(region)  # type: ignore[call-arg]  # I and G


def positions(
    parameters: str | Sequence[str | int], names: tuple[str, ...]
) -> list[int]:
    """Indices of ``parameters``, given by name or index, each once."""
    if not isinstance(parameters, Iterable):
        raise ValueError(f"parameters must be names or indices, got {parameters!r}")
    parameters = [parameters] if isinstance(parameters, str) else list(parameters)
    places: list[Any] = [names.index(x) if x in names else x for x in parameters]
    for at, asked in zip(places, parameters, strict=True):
        whole = isinstance(at, int | np.integer) and not isinstance(at, bool)
        if not whole or not 0 <= int(at) < len(names):
            raise ValueError(
                "parameters must be indices or names of free parameters "
                f"({', '.join(names)}), got {asked!r}"
            )
    if len(set(places)) < len(places) or not places:
        raise ValueError(f"parameters must be names, each once, got {parameters!r}")
    return [int(at) for at in places]


class ScenarioCriterion:
    """A criterion over scenarios, of letters or an object, else the design's own."""

    word: str
    efficiency_name = "efficiency"
    least: ClassVar[bool]  # the worst scenario counts
    of_efficiency: bool = False
    each: Criterion  # of the first scenario
    kind: str  # of that

    def __init__(self, criterion: Any = None) -> None:
        if isinstance(criterion, ScenarioCriterion):
            raise ValueError(
                f"{type(self).__name__} needs a criterion of one scenario, got "
                f"{type(criterion).__name__}"
            )
        self.criterion = criterion

    def __repr__(self) -> str:
        given = "" if self.criterion is None else repr(self.criterion)
        return f"{type(self).__name__}({given})"

    def within(self, each: Criterion) -> Self:
        joined = copy.copy(self)
        joined.each, joined.kind = each, each.kind
        return joined

    @property
    def name(self) -> str:
        """The name as it is written: "Mean(D)"."""
        more = ", efficiency" if self.of_efficiency else ""
        return f"{type(self).__name__}({self.each.name}{more})"

    @property
    def says(self) -> str:
        """The criterion, in words."""
        if self.of_efficiency:
            return f"least {self.each.name}-efficiency"
        return f"{self.each.says}, {self.word}"

    @property
    def larger_is_better(self) -> bool:
        return self.of_efficiency or self.each.larger_is_better

    def efficiency(self, value: float, bound: float) -> float:
        if self.of_efficiency:
            return value / bound
        return self.each.efficiency(value, bound)

    def bettered(self, value: float, share: float) -> float:
        if self.of_efficiency:
            return min(1.0, value * (1.0 + share))
        return self.each.bettered(value, share)

    def enough(self, efficiency: float) -> tuple[float, float]:
        """A bound of at most the first times the value, plus the second, proves it."""
        if self.of_efficiency and self.kind == "det":
            return 1.0, -float(np.log(efficiency))
        slope, shift = self.each.enough(efficiency)
        return slope, self.each.times * shift

    def terms(
        self, criteria: Sequence[Criterion], optima: Array | None
    ) -> tuple[Array, Array]:
        """(S,) scale and shift: ``scale phi + shift`` of a scenario is what is joined.

        It is the reported value, of a trace its negative. Of efficiencies e against
        ``optima`` (S,) it is log e (det), -1 / e (trace) or e (least): concave.
        """
        if self.kind == "det":
            scale = np.array([float(one.times) for one in criteria])
            shift = scale * [one.offset for one in criteria]
            if optima is None:
                return scale, shift
            rows = scale * len(criteria[0].root)
            return scale / rows, (shift - optima) / rows
        units = np.array([one.unit for one in criteria])
        if self.kind == "trace":
            scale = units * criteria[0].times
        else:
            scale = 1.0 / np.maximum(units, 1e-320)
        if not (np.isfinite(scale) & (scale > 0.0)).all():
            raise ValueError(
                f"criterion {self.name} in a scenario is out of range in double "
                "precision; give the commands in other units"
            )
        return (scale if optima is None else scale / optima), np.zeros(len(scale))

    def reported(self, joined: Array | float) -> Any:
        """The value as the caller reads it, of what ``terms`` make."""
        if not self.of_efficiency:
            return -joined if self.kind == "trace" else joined
        if self.kind == "det":
            return np.exp(joined)
        return -1.0 / np.asarray(joined) if self.kind == "trace" else joined


class Mean(ScenarioCriterion):
    """The weighted mean over the scenarios of a criterion."""

    word, least = "mean", False


class Worst(ScenarioCriterion):
    """The criterion in the scenario where it is worst.

    With ``efficiency`` scenarios are compared by the efficiency in each, relative to
    its own optimum, or to a bound where that is not proven.
    """

    word, least = "worst", True

    def __init__(self, criterion: Any = None, efficiency: bool = False) -> None:
        super().__init__(criterion)
        self.of_efficiency = bool(efficiency)


class Largest(Worst):
    """G: the worst of the predictions, each of which stands for a scenario."""

    word, efficiency_name, name, says = "", "G-efficiency", "G", "largest variance"
