"""``CandidateSet``: what may be measured, what is known and the rules, checked.

It makes the problem of a question; ``jaxcal.Design`` has the questions.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import array_of, numbers, require_kind, whole_number
from jaxcal.csvtable import COMMANDS, names_of, of_frame
from jaxcal.information.blocks import coarseness
from jaxcal.models.affine import Affine
from jaxcal.models.model import Model, answered, as_model, by_name
from jaxcal.models.uncertainty import Noise, Prior
from jaxcal.selection.criteria import Criterion, Joined, Mean, criterion_of
from jaxcal.selection.problem.assembly import (
    check_available,
    filled,
    make_problem,
    usable_numbers,
)
from jaxcal.selection.problem.losses import (
    checked_reliability,
    with_arrivals,
    with_losses,
)
from jaxcal.selection.problem.problem import Problem
from jaxcal.selection.problem.scenario_problem import joined_problem
from jaxcal.selection.problem.scenarios import Scenarios, checked_weights, scenarios_of
from jaxcal.selection.problem.sources import (
    BlockSource,
    ModelSource,
    SharedSource,
    Source,
    shares_regressor,
)

__all__ = ["CandidateSet"]

Array = NDArray[np.float64]

_MOST_LOST = 2  # measurements whose loss is counted on


class CandidateSet:
    """Candidates of a model or blocks, with what is known of them and the rules."""

    candidates: Array | None  # (M, n) in the caller's unit; finite
    model: Model | None  # None where blocks were given
    noise: Noise | None  # as given, or the model's own
    names: tuple[str, ...] | None  # (M,) of the candidates, the caller's own
    axes: tuple[str, ...] | None  # (n,) of the inputs, the caller's own
    scenarios: Scenarios | None  # None: the nominal alone

    def __init__(
        self,
        candidates: ArrayLike,
        model: Model | None = None,
        prior: Prior | None = None,
        noise: Noise | None = None,
        measured: ArrayLike | None = None,
        available: ArrayLike | None = None,
        required: ArrayLike | None = None,
        max_replicates: int = 1,
        *,
        scenarios: Any = None,
        lost: int = 0,
        reliability: ArrayLike | None = None,
        names: Sequence[str] | None = None,
    ) -> None:
        if model is not None:
            model = as_model(model)
        require_kind("prior", prior, Prior)
        candidates = by_name(model, candidates)
        if header := names_of(candidates):
            measured = of_frame("measured", measured, header, COMMANDS)
        array = filled("candidates", candidates, "M", "n")
        self.model = Affine(array.shape[1], array.shape[1]) if model is None else model
        if self.model.multiplicity and array.shape[1] != self.model.num_inputs:
            raise ValueError(
                f"candidates must have shape (M, {self.model.num_inputs}) for this "
                f"model, got {array.shape}"
            )
        self.available = check_available(available, array.shape[:1])
        self.candidates = usable_numbers("candidates", array, self.available)
        self._blocks: Array | None = None
        self._coarse = coarseness(candidates)
        noise = self.model.default_noise() if noise is None else noise
        self._set_rules(prior, noise, measured, required, max_replicates)
        self._set_losses(lost, reliability)
        self.names, self.axes = _labels(candidates, names)
        self.scenarios = None
        if scenarios is not None:
            self.scenarios = scenarios_of(scenarios, self.model, prior)
        self._leave_unanswered()
        self.candidates.flags.writeable = False

    def _leave_unanswered(self) -> None:
        """Mask candidates for which the model fails; a warning names them."""
        assert self.model is not None and self.candidates is not None
        mean = None if self.prior is None else self.prior.resolve(self.model).mean
        cases = [mean]
        if self.scenarios is not None and self.scenarios.parameters is not None:
            cases += list(self.scenarios.parameters)
        for parameters in cases:
            rows = np.flatnonzero(self.available)
            asked = self.candidates[rows]
            kept = answered(self.model, asked, parameters, rows, self.names)
            self.available[rows[~kept]] = False

    @classmethod
    def from_blocks(
        cls,
        blocks: ArrayLike,
        prior: ArrayLike | None = None,
        noise: Noise | None = None,
        measured: ArrayLike | None = None,
        available: ArrayLike | None = None,
        required: ArrayLike | None = None,
        max_replicates: int = 1,
        *,
        commands: ArrayLike | None = None,
        names: Sequence[str] | None = None,
        weights: ArrayLike | None = None,
        lost: int = 0,
        reliability: ArrayLike | None = None,
    ) -> Self:
        """The problem of information blocks, of any model.

        Args:
            blocks: (M, q, p); candidate i gives q readings, ``y = B_i theta + noise``
                with noise of unit variance, and adds ``B_i.T @ B_i`` to the
                information. Or (S, M, q, p), those of S scenarios.
            prior: (p, p) precision of what is known beforehand; nothing by default.
            noise: of the readings, where it is not of unit variance.
            measured: (N, q, p) blocks that were measured already, of scenarios
                (S, N, q, p).
            available, required, max_replicates, names, lost, reliability: as for
                candidates.
            commands: (M, n) of the candidates, for travel between them and for tables.
            weights: (S,) of the scenarios, of sum 1; equal when not given.
        """
        if isinstance(prior, Prior):
            raise ValueError(
                "prior must be a (p, p) precision with blocks, got a Prior"
            )
        shape = ("S", "M", "q", "p") if np.ndim(blocks) == 4 else ("M", "q", "p")
        array = filled("blocks", blocks, *shape)
        design = object.__new__(cls)
        design.model, design.candidates, design.scenarios = None, None, None
        design.available = check_available(available, array.shape[-3:-2])
        if array.ndim == 4:
            design.scenarios = Scenarios(None, checked_weights(weights, len(array)))
            array = np.moveaxis(array, 1, 0)
        elif weights is not None:
            raise ValueError("weights must come with blocks (S, M, q, p) of scenarios")
        design._blocks = usable_numbers("blocks", array, design.available)
        design._coarse = coarseness(blocks)
        if commands is not None:
            rule = ", one for each block"
            design.candidates = array_of(
                "commands", commands, len(array), "n", rule=rule
            )
            design.candidates.flags.writeable = False
        design._set_rules(prior, noise, measured, required, max_replicates)
        design._set_losses(lost, reliability)
        seen = design._measured
        if seen is not None and array.ndim == 4 and len(seen) != array.shape[1]:
            raise ValueError(
                "measured must have shape (S, N, q, p), blocks of every scenario, got "
                f"{seen.shape}"
            )
        design.names, design.axes = _labels(array, names)
        return design

    def __repr__(self) -> str:
        what = "blocks" if self.model is None else type(self.model).__name__
        count, left = len(self.available), int(self.available.sum())
        return f"{type(self).__name__} of {count} candidates, {left} available, {what}"

    def problem(
        self, k: int | None = None, criterion: Any = None, region: Any = None
    ) -> Problem:
        """The problem of choosing k by a criterion, checked and whitened.

        Args:
            k: candidates to choose; the fewest that identify when not given.
            criterion: letters of ``CRITERIA`` or an object of it; D for the affine
                model and blocks, else I.
            region: of I, where it is given by its letter.
        """
        joined = criterion if isinstance(criterion, Joined) else Mean(criterion)
        default = "I" if self.model and not self.model.multiplicity else "D"
        of_one = criterion_of(joined.criterion, region, default)
        if self.lost:
            return self._with_losses(k, of_one, joined)
        problem = self._joined(k, of_one, joined)
        if self.reliability is None:
            return problem
        return with_arrivals(problem, self.reliability, joined)

    def _with_losses(
        self, k: int | None, criterion: Criterion, joined: Joined
    ) -> Problem:
        """The problem where the worst ``lost`` of the chosen fail."""
        if self.reliability is not None:
            raise ValueError("lost and reliability must not be given together")
        if k is None:
            return self._with_losses(
                self._joined(None, criterion, joined).k + self.lost, criterion, joined
            )
        try:
            self._joined(whole_number("k", k, 1) - self.lost, criterion, joined)
        except ValueError as error:
            raise ValueError(f"of k = {k} with {self.lost} lost: {error}") from None
        return with_losses(self._joined(k, criterion, joined), self.lost)

    def _joined(self, k: int | None, criterion: Criterion, joined: Joined) -> Problem:
        """The problem in all scenarios."""
        if self.scenarios is None:
            return self._problem(k, criterion)
        members = []
        for s, one in enumerate(self.each()):
            try:
                members.append(one._problem(k, criterion))
            except ValueError as error:
                raise ValueError(f"in scenario {s}: {error}") from None
        nominal = None if self.model is None else self._problem(k, criterion)
        return joined_problem(members, self.scenarios.weights, joined, nominal)

    def each(self) -> list[Self]:
        """The candidates in each scenario alone; where there are none, as they are."""
        if self.scenarios is None:
            return [self]
        alone = []
        for s in range(len(self.scenarios.weights)):
            one = copy.copy(self)
            one.scenarios = None
            if self.scenarios.parameters is not None:
                one._parameters = self.scenarios.parameters[s]
            if self._blocks is not None:
                one._blocks = np.ascontiguousarray(self._blocks[:, s])
                if self._measured is not None:
                    one._measured = self._measured[s]
            alone.append(one)
        return alone

    def _problem(self, k: int | None, criterion: Criterion) -> Problem:
        """The problem of one scenario, or at the nominal."""
        source = self.source(criterion.by_name, criterion.of_region)
        raw, root = source.blocks(), source.root
        if self._measured is not None:
            seen = source.at("measured", self._measured, True)
            root = _with_measured(root, seen)
        source.require_identified(self._measured)
        where = criterion.region
        if where is None and criterion.of_region:
            where = source.predicted()
        return make_problem(
            raw, root, criterion, k, self.available, self._required,
            self.max_replicates, coarse=self._coarse, names=source.names,
            times=source.times,
            region=None if where is None else source.at("region", where, False),
            candidates=self.candidates, model=self.model,
        )  # fmt: skip

    def source(self, of_parameters: bool, of_predictions: bool = False) -> Source:
        """What makes blocks; ``of_parameters``: of all parameters by name.

        Predictions of an arm without a prior have what no parameter explains, too.
        """
        if self._blocks is not None:
            return BlockSource(self._blocks, self.prior, self.noise)
        model, candidates, prior = self.model, self.candidates, self.prior
        assert model is not None and candidates is not None
        if not of_parameters and shares_regressor(model, prior, self.noise):
            return SharedSource(model, candidates, self.noise)
        misfit = 0.0
        if of_predictions and prior is None:
            misfit = model.misfit_std
            model = model.with_misfit() if misfit else model
        return ModelSource(
            model, candidates, self.available, prior, self.noise, misfit,
            self._parameters,
        )  # fmt: skip

    def with_noise(self, noise: Noise | None) -> Self:
        """These candidates with other noise."""
        other = copy.copy(self)
        other.noise = noise
        return other

    @property
    def uncertain(self) -> bool:
        """Whether it counts on measurements that fail."""
        return self.lost > 0 or self.reliability is not None

    def _set_losses(self, lost: int, reliability: ArrayLike | None) -> None:
        self.lost, self.reliability = whole_number("lost", lost, 0), None
        if self.lost > _MOST_LOST:
            raise ValueError(f"lost must be at most {_MOST_LOST}, got {lost}")
        if reliability is not None:
            count = len(self.available)
            self.reliability = checked_reliability(reliability, count)

    def _set_rules(
        self,
        prior: Any,
        noise: Noise | None,
        measured: ArrayLike | None,
        required: ArrayLike | None,
        max_replicates: int,
    ) -> None:
        require_kind("noise", noise, Noise)
        self.prior, self.noise = prior, noise
        # Copies: the caller's arrays may change before the next question.
        self._measured = None if measured is None else numbers("measured", measured)
        self._required = copy.deepcopy(required)
        self._parameters: Array | None = None  # of one scenario; None: the nominal's
        self.max_replicates = max_replicates


def _with_measured(root: Array, blocks: Array) -> Array:
    """Root of a precision with the information of blocks (N, q, p) added."""
    rows = np.concatenate([root, blocks.reshape(-1, root.shape[1])])
    return np.linalg.qr(rows)[1] if len(rows) > root.shape[1] else rows


def _labels(
    candidates: Any, names: Sequence[str] | None
) -> tuple[tuple[str, ...] | None, tuple[str, ...] | None]:
    """Names of the candidates and of their axes, from a data frame where it is one."""
    axes = None
    if hasattr(candidates, "to_numpy") and hasattr(candidates, "columns"):
        axes = tuple(str(column) for column in candidates.columns)
        rows = tuple(str(label) for label in getattr(candidates, "index", ()))
        if names is None and rows and rows != tuple(map(str, range(len(rows)))):
            return rows, axes
    if names is None:
        return None, axes
    given, count = tuple(names), len(candidates)
    if len(given) != count or not all(isinstance(name, str) for name in given):
        raise ValueError(
            f"names must be {count} texts, one for each candidate, got {len(given)} of "
            f"{', '.join(sorted({type(name).__name__ for name in given}))}"
        )
    return given, axes
