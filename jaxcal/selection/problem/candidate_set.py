"""``CandidateSet``: what may be measured, what is known and the rules, checked.

``jaxcal.Design`` holds one; ``assembly`` makes the problem of a question out of it.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import array_of, numbers, require_kind
from jaxcal.models.affine import Affine
from jaxcal.models.model import Model, answered, as_model
from jaxcal.models.uncertainty import Noise, Prior
from jaxcal.selection.problem.arrays import (
    check_available,
    filled,
    flatten_rounding,
    rounding_of,
    usable_numbers,
)
from jaxcal.selection.problem.scenarios import Scenarios, checked_weights, scenarios_of
from jaxcal.tables import (
    COMMANDS,
    header_of,
    inputs_of,
    names_in,
    of_frame,
    table_of_frame,
)

__all__ = ["CandidateSet", "DesignProtocol"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclasses.dataclass(eq=False, repr=False)
class CandidateSet:
    """Candidates of a model or blocks, with what is known of them and the rules."""

    model: Model | None  # None where blocks were given
    candidates: Array | None  # (M, n) in the caller's unit; finite
    blocks: Array | None  # (M, q, p), of S scenarios (M, S, q, p), where given
    available: Mask  # (M,)
    prior: Any  # a Prior, of blocks a (p, p) precision, as given
    noise: Noise | None  # as given, or the model's own
    measured: Any  # commands (N, n), or blocks (N, q, p), of scenarios (S, N, q, p)
    required: Any  # candidates that must be chosen, as given
    max_replicates: int  # how often one candidate may be chosen
    names: tuple[str, ...] | None = None  # (M,) of the candidates, the caller's own
    axes: tuple[str, ...] | None = None  # (n,) of the inputs, the caller's own
    scenarios: Scenarios | None = None  # None: the nominal alone
    parameters: Array | None = None  # (p,) of one scenario; None: the nominal's

    def __post_init__(self) -> None:
        require_kind("noise", self.noise, Noise)
        # Copies: the caller's arrays may change before the next question.
        if self.measured is not None:
            self.measured = numbers("measured", self.measured)
        if self.required is not None:
            self.required = copy.deepcopy(self.required)
        if not (self.prior is None or isinstance(self.prior, Prior)):
            self.prior = copy.deepcopy(self.prior)

    @classmethod
    def of_commands(
        cls,
        candidates: ArrayLike,
        model: Model | None = None,
        prior: Prior | None = None,
        noise: Noise | None = None,
        measured: ArrayLike | None = None,
        available: ArrayLike | None = None,
        *,
        scenarios: Any = None,
        names: Sequence[str] | None = None,
        required: ArrayLike | None = None,
        max_replicates: int = 1,
    ) -> CandidateSet:
        """Commands (M, n) of a model, see ``jaxcal.Design``."""
        if model is not None:
            model = as_model(model)
        require_kind("prior", prior, Prior)
        frame, axes = candidates, None
        if header_of("candidates", candidates):
            wanted, mask = (
                getattr(model, "inputs", ()),
                _available(candidates, available),
            )
            if wanted:
                axes = names_in("candidates", candidates, wanted, COMMANDS, ())
            else:
                axes = inputs_of("candidates", candidates)
            candidates = of_frame("candidates", candidates, axes, COMMANDS, mask)
            measured = of_frame("measured", measured, wanted or axes, COMMANDS)
            available = mask
        array = filled("candidates", candidates, "M", "n")
        labels = _names_of_rows(frame, names, len(array))
        if model is None:
            model = Affine(array.shape[1], array.shape[1])
        if model.multiplicity and array.shape[1] != model.num_inputs:
            raise ValueError(
                f"candidates must have shape (M, {model.num_inputs}) for this model, "
                f"got {array.shape}"
            )
        mask = check_available(available, array.shape[:1])
        made = cls(
            model=model,
            candidates=usable_numbers("candidates", array, mask),
            blocks=None,
            available=mask,
            prior=prior,
            noise=model.default_noise() if noise is None else noise,
            measured=measured,
            required=required,
            max_replicates=max_replicates,
            names=labels,
            axes=axes,
        )
        if scenarios is not None:
            made.scenarios = scenarios_of(scenarios, model, prior)
        assert made.candidates is not None
        if model.multiplicity:  # which answers everywhere, by the commands themselves
            spacing, rows = rounding_of(candidates), None
            if made.measured is not None and made.measured.ndim == 2:
                rows = made.measured[None, :, None]
            flatten_rounding(
                spacing, made.candidates[None, :, None], mask[None], rows, bias=True
            )
        else:
            made._leave_unanswered(model)
        made.candidates.flags.writeable = False
        return made

    def _leave_unanswered(self, model: Model) -> None:
        """Mask candidates for which the model fails; a warning names them."""
        assert self.candidates is not None
        cases = [None if self.prior is None else self.prior.resolve(model).mean]
        if self.scenarios is not None and self.scenarios.parameters is not None:
            cases += list(self.scenarios.parameters)
        masked = not self.available.any()  # by the caller, who is told with k
        for parameters in cases:
            rows = np.flatnonzero(self.available)
            if not masked and not len(rows):
                raise ValueError(
                    "model must give finite readings for some candidate in every "
                    "scenario, but fails for all"
                )
            asked = self.candidates[rows]
            kept = answered(model, asked, parameters, rows, self.names)
            self.available[rows[~kept]] = False

    @classmethod
    def of_blocks(
        cls,
        blocks: ArrayLike,
        prior: ArrayLike | None = None,
        noise: Noise | None = None,
        measured: ArrayLike | None = None,
        available: ArrayLike | None = None,
        *,
        commands: ArrayLike | None = None,
        names: Sequence[str] | None = None,
        weights: ArrayLike | None = None,
        **rules: Any,
    ) -> CandidateSet:
        """Blocks (M, q, p) or (S, M, q, p), see ``jaxcal.Design.from_blocks``."""
        if isinstance(prior, Prior):
            raise ValueError(
                "prior must be a (p, p) precision with blocks, got a Prior"
            )
        shape = ("S", "M", "q", "p") if np.ndim(blocks) == 4 else ("M", "q", "p")
        array, scenarios = filled("blocks", blocks, *shape), None
        mask = check_available(available, array.shape[-3:-2])
        if array.ndim == 4:
            scenarios = Scenarios(None, checked_weights(weights, len(array)))
            array = np.ascontiguousarray(np.moveaxis(array, 1, 0))
        elif weights is not None:
            raise ValueError("weights must come with blocks (S, M, q, p) of scenarios")
        array = usable_numbers("blocks", array, mask)
        if commands is not None:
            rule = ", one for each block"
            commands = array_of("commands", commands, len(array), "n", rule=rule)
            commands.flags.writeable = False
        made = cls(
            model=None,
            candidates=commands,
            blocks=array,
            available=mask,
            prior=prior,
            noise=noise,
            measured=measured,
            names=_names_of_rows(array, names, len(array)),
            scenarios=scenarios,
            **rules,
        )
        seen = made.measured
        if seen is not None and array.ndim == 4 and len(seen) != array.shape[1]:
            raise ValueError(
                "measured must have shape (S, N, q, p), blocks of every scenario, got "
                f"{seen.shape}"
            )
        by_set = np.moveaxis(array, 1, 0) if array.ndim == 4 else array[None]
        rows = seen[None] if seen is not None and array.ndim == 3 else seen
        if rows is not None and rows.ndim != 4:
            rows = None
        usable = np.broadcast_to(mask, by_set.shape[:2])
        flatten_rounding(rounding_of(blocks), by_set, usable, rows)
        return made

    def by_scenario(self) -> list[CandidateSet]:
        """The candidates in each scenario alone; where there are none, as they are."""
        if self.scenarios is None:
            return [self]
        alone = []
        for s in range(len(self.scenarios.weights)):
            changes: dict[str, Any] = {"scenarios": None}
            if self.scenarios.parameters is not None:
                changes["parameters"] = self.scenarios.parameters[s]
            if self.blocks is not None:
                changes["blocks"] = np.ascontiguousarray(self.blocks[:, s])
                if self.measured is not None:
                    changes["measured"] = self.measured[s]
            alone.append(dataclasses.replace(self, **changes))
        return alone


class DesignProtocol(Protocol):
    """A ``jaxcal.Design``, as the questions to it know it."""

    candidate_set: CandidateSet


def _available(frame: Any, available: Any) -> Any:
    """The column ``available`` of a frame, where it has one, else what was given."""
    column = table_of_frame("candidates", frame).available()
    if column is None or available is None:
        return available if column is None else column
    if not np.array_equal(column, np.asarray(available)):
        raise ValueError(
            "available must be that of the candidates' column, or that column be left "
            "out: they differ"
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
