"""``CandidateSet``: what may be measured, what is known and the rules, checked."""

from __future__ import annotations

import copy
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import (
    Array,
    Mask,
    array_of,
    numbers,
    require_finite,
    require_kind,
    require_none,
    require_size,
    require_unmasked,
    whole_number,
)
from jaxcal.models.linear import Affine
from jaxcal.models.model import Model, as_model
from jaxcal.models.predictions import answered
from jaxcal.models.uncertainty import Noise, Prior, as_noise
from jaxcal.selection.problem.problem import checked_constraints
from jaxcal.tables import (
    COMMANDS,
    header_of,
    inputs_of,
    names_in,
    of_frame,
    say_order,
    table_of_frame,
)

_FILLED = ", none of them 0"
_ROUNDED = 4.0  # units in the last place that short sums of rounded numbers are off by
_NUMBERS = 2**21  # of 8 bytes; beyond 32 MiB glibc no longer follows
_SUM = 1e-6  # by which weights may miss a sum of 1


class Scenarios(NamedTuple):
    """Parameters and weights."""

    parameters: Array | None  # (S, p) of the model; None where blocks hold them
    weights: Array  # (S,) positive, of sum 1


def scenarios_of(scenarios: Any, model: Model, prior: Prior | None) -> Scenarios:
    """Scenarios of a number of draws from the prior, parameters (S, p), or
    ``(parameters, weights)``."""
    weights = None
    if isinstance(scenarios, tuple):
        if len(scenarios) != 2:
            rule = "a number, parameters (S, p), or (parameters, weights)"
            got = f"a tuple of {len(scenarios)}"
            raise ValueError(f"scenarios must be {rule}, got {got}")
        scenarios, weights = scenarios
    elif np.ndim(scenarios) == 0:
        scenarios = _drawn(whole_number("scenarios", scenarios, 1), model, prior)
    rule = f", {len(model.names)} parameters of the model a row"
    parameters = array_of("scenarios", scenarios, "S", len(model.names), rule=rule)
    if not len(parameters):
        raise ValueError("scenarios must hold at least one row of parameters, got none")
    return Scenarios(parameters, checked_weights(weights, len(parameters)))


def _drawn(count: int, model: Model, prior: Prior | None) -> Array:
    """(S, p) draws from the prior; what it says nothing of stays at its mean."""
    resolved = (model.default_prior() if prior is None else prior).resolve(model)
    precision = np.where(resolved.free, resolved.precisions, 0.0)
    drawn = precision > 0.0
    if not drawn.any():
        raise ValueError(
            "a number of scenarios needs a prior with finite std; it is missing for "
            f"{', '.join(map(str, model.names))}. Give prior=jaxcal.Prior(...), or the "
            "parameters (S, p)"
        )
    std = np.where(drawn, 1.0 / np.sqrt(np.where(drawn, precision, 1.0)), 0.0)
    normal = np.random.default_rng(0).standard_normal((count, len(std)))
    return np.asarray(resolved.mean + std * normal)


def checked_weights(weights: ArrayLike | None, count: int) -> Array:
    """(S,) positive weights of sum 1; equal ones when not given."""
    if weights is None:
        return np.full(count, 1.0 / count)
    checked = array_of("weights", weights, count, rule=", one for each scenario")
    require_none(~(checked > 0.0), checked, "weights must be positive")
    total = float(checked.sum())
    if abs(total - 1.0) > _SUM:
        raise ValueError(f"weights must sum to 1, got a sum of {total:.6g}")
    return checked / total


class CandidateSet:
    """Candidates or blocks with the rules, checked; arguments of ``Design``."""

    axes: tuple[str, ...] | None = None  # (n,) of the inputs, the caller's own
    max_replicates: Any  # how often one candidate may be chosen, or (M,)
    parameters: Array | None = None  # (p,) of one scenario; None: the nominal's

    def __init__(
        self,
        candidates: ArrayLike | None = None,
        model: Model | None = None,
        prior: Prior | ArrayLike | None = None,
        noise: Noise | ArrayLike | None = None,
        measured: ArrayLike | None = None,
        available: ArrayLike | None = None,
        required: ArrayLike | None = None,
        max_replicates: ArrayLike = 1,
        *,
        blocks: ArrayLike | None = None,
        commands: ArrayLike | None = None,
        scenarios: Any = None,
        constraints: Any = None,
        names: Sequence[str] | None = None,
    ) -> None:
        if (candidates is None) == (blocks is None):
            got = "neither" if blocks is None else "both"
            raise ValueError(f"give either candidates or blocks, got {got}")
        # Checked, the caller's arrays copied; of blocks "candidates" are the commands.
        self.candidates: Any = candidates if blocks is None else commands
        self.model: Any = model  # None where blocks are given
        self.prior: Any = prior  # a Prior, of blocks a (p, p) precision, as given
        self.noise: Any = as_noise(noise)  # as given, or the model's own
        self.measured: Any = measured  # (N, n), blocks (N, q, p) or (S, N, q, p)
        self.available: Any = available
        self.required = copy.deepcopy(required)
        self.blocks: Any = blocks  # (M, q, p), of S scenarios (M, S, q, p)
        self.scenarios: Any = scenarios  # a Scenarios; None: the nominal alone
        self.names: Any = names  # (M,) of the candidates, the caller's own
        if blocks is None:
            self._check_commands()
        else:
            self._check_blocks()
        self._check_counts(max_replicates, constraints)

    def but(self, **changes: Any) -> Self:
        """A copy with other attributes, which are taken as checked."""
        other = copy.copy(self)
        vars(other).update(changes)
        return other

    def _check_counts(self, max_replicates: ArrayLike, constraints: Any) -> None:
        """How often a candidate may be chosen, a number or (M,), and in all."""
        self.constraints = checked_constraints(constraints, len(self.available))
        caps = one_array("max_replicates", max_replicates)
        if caps.ndim == 0:
            self.max_replicates = whole_number("max_replicates", caps[()], 1)
            return
        rule = "max_replicates must be a whole number, or (M,) of them from 0"
        if caps.shape != self.available.shape or caps.dtype.kind not in "iu":
            raise ValueError(f"{rule}, got {caps.dtype} of shape {caps.shape}")
        self.max_replicates = often = caps.astype(np.int64)
        require_none(often < 0, often, rule)
        self.available = self.available & (often > 0)

    def _check_commands(self) -> None:
        """Commands (M, n) of a model, or a frame."""
        if self.model is not None:
            self.model = as_model(self.model)
        require_kind("prior", self.prior, Prior)
        given = self.candidates
        if header_of("candidates", given):
            say_order(given, self.available, ("candidates", "available"))
            mask = self.available = _available(given, self.available)
            if wanted := self.columns:
                self.axes = names_in("candidates", given, wanted, COMMANDS, ())
            else:
                self.axes = inputs_of("candidates", given)
            self.candidates = self.by_name("candidates", given, mask)
        self.measured = self.by_name("measured", self.measured)
        array = filled("candidates", self.candidates, "M", "n")
        spacing = rounding_of(self.candidates)
        self.names = _names_of_rows(given, self.names, len(array))
        if self.model is None:
            self.model = Affine(array.shape[1], array.shape[1])
        model = self.model
        if model.fitting.multiplicity and array.shape[1] != model.num_inputs:
            raise ValueError(
                f"candidates must have shape (M, {model.num_inputs}) for this model, "
                f"got {array.shape}"
            )
        self.available = check_available(self.available, array.shape[:1])
        self.candidates = usable_numbers("candidates", array, self.available)
        if self.noise is None:
            self.noise = model.default_noise()
        if self.measured is not None:
            self.measured = numbers("measured", self.measured)
        if self.scenarios is not None:
            self.scenarios = scenarios_of(self.scenarios, model, self.prior)
        if model.fitting.multiplicity:  # it answers everywhere, by commands alone
            rows: Any = self.measured
            rows = rows[:, None] if np.ndim(rows) == 2 else None
            flatten_rounding(spacing, array[:, None], self.available, rows, bias=True)
        else:
            self._leave_unanswered(model)
        self.candidates.flags.writeable = False

    @property
    def columns(self) -> tuple[str, ...]:
        """(n,) names by which commands in a frame are read; () where there are none."""
        return getattr(self.model, "inputs", ()) or self.axes or ()

    def by_name(self, argument: str, commands: Any, used: Any = None) -> Any:
        """The columns of commands in a frame, in the candidates' order; else as
        given."""
        if not self.columns:
            return commands
        words = getattr(self.model, "levels", ())
        return of_frame(argument, commands, self.columns, COMMANDS, used, words)

    def _leave_unanswered(self, model: Model) -> None:
        """Mask candidates for which the model fails; a warning names them."""
        cases = [None if self.prior is None else self.prior.resolve(model).mean]
        if self.scenarios is not None and self.scenarios.parameters is not None:
            cases += list(self.scenarios.parameters)
        masked = not self.available.any()  # by the caller, who is told with k
        for parameters in cases:
            rows = np.flatnonzero(self.available)
            if not masked and not len(rows):
                raise ValueError(
                    "the model fails for all candidates in some scenario; finite "
                    "readings are needed"
                )
            asked = self.candidates[rows]
            kept = answered(model, asked, parameters, rows, self.names)
            self.available[rows[~kept]] = False

    def _check_blocks(self) -> None:
        """Blocks (M, q, p) or (S, M, q, p), whose scenarios are (S,) weights."""
        if self.model is not None:
            raise ValueError("model needs candidates, not blocks")
        if isinstance(self.prior, Prior):
            raise ValueError(
                "prior must be a (p, p) precision with blocks, got a Prior"
            )
        joined = np.ndim(self.blocks) == 4
        shape = ("S", "M", "q", "p") if joined else ("M", "q", "p")
        array = filled("blocks", self.blocks, *shape)
        spacing = rounding_of(self.blocks)
        self.available = check_available(self.available, array.shape[-3:-2])
        if joined:
            weights = checked_weights(self.scenarios, len(array))
            self.scenarios = Scenarios(None, weights)
            array = np.ascontiguousarray(np.moveaxis(array, 1, 0))
        elif self.scenarios is not None:
            raise ValueError("weights need blocks (S, M, q, p) of scenarios")
        self.blocks = array = usable_numbers("blocks", array, self.available)
        self.prior = copy.deepcopy(self.prior)
        if self.candidates is not None:
            rule = ", one for each block"
            commands = array_of("commands", self.candidates, len(array), "n", rule=rule)
            commands.flags.writeable = False
            self.candidates = commands
        self.names = _names_of_rows(array, self.names, len(array))
        if self.measured is not None:
            self.measured = numbers("measured", self.measured)
            if joined and len(self.measured) != array.shape[1]:
                raise ValueError(
                    "measured must have shape (S, N, q, p), blocks of every scenario, "
                    f"got {self.measured.shape}"
                )
        if joined:
            for s in range(array.shape[1]):
                rows = None if self.measured is None else self.measured[s]
                flatten_rounding(spacing, array[:, s], self.available, rows)
        else:
            flatten_rounding(spacing, array, self.available, self.measured)

    def by_scenario(self) -> list[CandidateSet]:
        """The candidates in each scenario alone; where there are none, as they are."""
        if self.scenarios is None:
            return [self]
        alone: list[CandidateSet] = []
        for s in range(len(self.scenarios.weights)):
            changes: dict[str, Any] = {"scenarios": None}
            if self.scenarios.parameters is not None:
                changes["parameters"] = self.scenarios.parameters[s]
            if self.blocks is not None:
                changes["blocks"] = np.ascontiguousarray(self.blocks[:, s])
                if self.measured is not None:
                    changes["measured"] = self.measured[s]
            alone.append(self.but(**changes))
        return alone


def _available(frame: Any, available: Any) -> Any:
    """The column ``available`` of a frame, where it has one, else what was given."""
    column = table_of_frame("candidates", frame).available()
    if column is None or available is None:
        return available if column is None else column
    if not np.array_equal(column, np.asarray(available)):
        raise ValueError(
            "available and the candidates' column 'available' differ: leave one out"
        )
    return column


def _names_of_rows(
    candidates: Any, names: Sequence[str] | None, count: int
) -> tuple[str, ...] | None:
    """Names of the candidates, of a data frame its index or its column of words."""
    if names is None and header_of("candidates", candidates):
        index: Any = getattr(candidates, "index", ())
        rows = () if callable(index) else tuple(map(str, index))
        if rows and rows != tuple(map(str, range(len(rows)))):
            return rows
        names = table_of_frame("candidates", candidates).row_names
    if names is None:
        return None
    labels = tuple(names)
    if len(labels) != count or not all(isinstance(name, str) for name in labels):
        raise ValueError(
            f"names must be {count} texts, one for each candidate, got {len(labels)} "
            f"of {', '.join(sorted({type(name).__name__ for name in labels}))}"
        )
    return labels


def filled(name: str, values: ArrayLike, *letters: str) -> Array:
    """``values`` as float64 with an axis for each letter, none of them empty."""
    array = array_of(name, values, *letters, rule=_FILLED, finite=False)
    if 0 in array.shape:
        raise ValueError(
            f"{name} must have shape ({', '.join(letters)}){_FILLED}, got {array.shape}"
        )
    return array


@functools.cache
def _keep_freed_pages() -> None:
    """Let glibc's malloc keep the pages of freed arrays for the next problem: an array
    of 16 MiB, freed and never written, raises the limit beyond which it returns them.
    Saves .3 of .7 ms with blocks (2000, 3, 6)."""
    np.empty(_NUMBERS)


def usable_numbers(name: str, array: Array, mask: Mask) -> Array:
    """The array, finite where available; what is not elsewhere becomes zero in it."""
    _keep_freed_pages()
    finite = np.isfinite(array)
    if not finite.all():
        hidden = ~finite & ~mask.reshape(*mask.shape, *[1] * (array.ndim - mask.ndim))
        array[hidden] = 0.0
        require_finite(name, array)
    if name == "candidates":
        require_size(name, array, 1e305)
    return array


def rounding_of(values: ArrayLike) -> float:
    """Spacing at 1 of numbers that are coarser than double precision, else 0."""
    kind = np.asarray(values).dtype
    coarse = kind.kind == "f" and kind.itemsize < np.dtype(np.float64).itemsize
    return float(np.finfo(kind).eps) if coarse else 0.0


def flatten_rounding(
    spacing: float,
    blocks: Array,
    usable: Mask,
    measured: Array | None = None,
    *,
    bias: bool = False,
) -> None:
    """Put blocks (M, q, p), of which the ``usable`` (M,) count, that lie in a plane but
    for rounding to float32 into it, in place, and ``measured`` (N, q, p) with them. In
    double precision that rounding would pass for information, and be proven so.

    Args:
        spacing: of the caller's numbers, see ``rounding_of``; 0: nothing is done.
        bias: a column of ones stands beside them, so the plane need not pass through 0.
    """
    if not spacing or not usable.any():
        return
    counted, count = blocks[usable], int(usable.sum())
    if measured is not None and measured.shape[1:] == blocks.shape[1:]:
        counted = np.concatenate([counted, measured])
    scale = _sizes(counted, (0, 2))
    scale = scale * _sizes(counted / scale, (0, 1))
    unit = counted / scale
    middle = unit.mean(axis=0) if bias else 0.0
    rows = (unit - middle).reshape(-1, unit.shape[2])
    left, size, right = np.linalg.svd(rows, full_matrices=False)
    real = size > _ROUNDED * spacing * np.sqrt(rows.size)
    if real.all():
        return
    flat = (left * np.where(real, size, 0.0)) @ right
    flat = (flat.reshape(unit.shape) + middle) * scale
    blocks[usable] = flat[:count]
    if measured is not None and len(flat) > count:
        measured[:] = flat[count:]


def _sizes(blocks: Array, axes: tuple[int, int]) -> Array:
    """The largest of each reading or column, 1 where all are zero."""
    largest = np.abs(blocks).max(axis=axes, keepdims=True)
    return np.where(largest > 0.0, largest, 1.0)


def check_available(available: ArrayLike | None, shape: tuple[int, ...]) -> Mask:
    """(M,) or, of many sets, (B, M), as ``shape`` says."""
    if available is None:
        return np.ones(shape, dtype=np.bool_)
    mask = one_array("available", available)
    if mask.shape != shape:
        raise ValueError(f"available must have shape {shape}, got {mask.shape}")
    if mask.dtype.kind not in "biuf" or not np.isin(mask, (0, 1)).all():
        wrong = mask[~np.isin(mask, (0, 1))] if mask.dtype.kind in "iuf" else mask
        raise ValueError(
            "available must hold True or 1 for candidates that may be chosen, else "
            f"False or 0, got {wrong.flat[0]}"
        )
    return mask.astype(np.bool_)


def one_array(name: str, values: ArrayLike) -> NDArray[np.generic]:
    """A copy of ``values`` as an array of any kind."""
    require_unmasked(name, values)
    try:
        return np.array(values)
    except ValueError as error:
        raise ValueError(
            f"{name} must be one array, got {type(values).__name__} of mixed lengths"
        ) from error
