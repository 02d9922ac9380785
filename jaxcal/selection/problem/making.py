"""Problems from information blocks that were checked, one set or many at once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import axis_names, whole_number
from jaxcal.information.blocks import coarseness, missing_directions, whiten
from jaxcal.information.excitation import directions_in_words, require_excited
from jaxcal.models.affine import Affine
from jaxcal.models.model import Model
from jaxcal.selection.criteria import CRITERIA, Coordinates, Wanted
from jaxcal.selection.problem.problem import Problem
from jaxcal.selection.problem.rules import (
    check_available,
    check_counts,
    check_k,
    check_required_rank,
    filled,
    in_set,
    usable_numbers,
)

__all__ = ["Rules", "make_problems", "whitened_problems"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# The C library keeps freed memory for the next array once an array as large as this was
# freed. Else every array of a problem is given back to the system and asked for again,
# which takes longer than what is computed in it. No page of this one is touched.
np.empty(2**21)


class Rules(NamedTuple):
    """What may be chosen, over a batch of S sets."""

    k: int | None
    available: Mask  # (S, M), checked
    required: ArrayLike | None
    max_replicates: int
    coarse: float = 1.0  # how many times coarser than float64 the numbers given are


def make_problems(
    candidates: ArrayLike,
    k: int | None = None,
    *,
    available: ArrayLike | None = None,
    required: ArrayLike | None = None,
    max_replicates: int = 1,
    num_outputs: int | None = None,
) -> list[Problem]:
    """Check a batch of candidate sets of the affine model, for criterion D.

    Args:
        candidates: (B, M, n) float, any unit; NaN where masked does no harm.
        k: postures to choose in each set, at least n + 1, which is the default.
        available: (B, M) bool, True where a candidate may be chosen.
        required: (B, r) indices that must be chosen.
        max_replicates: how often one candidate may be chosen.
        num_outputs: m; as many as inputs when not given.

    Raises:
        ValueError: naming the argument, the rule and the value.
    """
    array = filled("candidates", candidates, "B", "M", "n")
    mask = check_available(available, array.shape[:2])
    array = usable_numbers("candidates", array, mask)
    m = array.shape[2] if num_outputs is None else num_outputs
    model = Affine(array.shape[2], whole_number("num_outputs", m, 1))
    root = np.zeros((0, model.num_inputs + 1))
    rules = Rules(k, mask, required, max_replicates, coarseness(candidates))
    return whitened_problems(
        model.blocks(array), root, rules, CRITERIA["D"](), times=m, candidates=array,
        model=model,
    )  # fmt: skip


def whitened_problems(
    raw: Array,
    root: Array,
    rules: Rules,
    wanted: Wanted,
    *,
    names: tuple[str, ...] = (),
    times: int = 1,
    region: Array | None = None,
    candidates: Array | None = None,
    model: Model | None = None,
) -> list[Problem]:
    """The problems of blocks (S, M, q, p) that were checked; whitened here.

    Args:
        raw: in the caller's numbers, zero where not available.
        root: (r, p) of the precision known beforehand.
        rules: what may be chosen.
        wanted: the criterion.
        names: (p,) of the parameters; empty where the blocks are [u, 1].
        times: how often log det and trace count.
        region: (R, q, p) blocks that the criterion is about, if it is of a region.
        candidates: (S, M, n), where there are any.
        model: what made blocks of them.
    """
    k, mask, required, max_replicates, coarse = rules
    readings = mask.sum(axis=1) * raw.shape[2]
    if raw.shape[2] > raw.shape[3]:  # as much information in p rows, at q^3 less cost
        raw = np.asarray(np.linalg.qr(raw, mode="r"))
    k = check_k(k, raw, mask, root, regressors=not names)
    cap, forced = check_counts(mask, k, required, max_replicates)
    computed = bool(names) and model is not None
    if computed:  # a derivative is as exact as its own numbers
        coarse = 1.0
    white = whiten(raw, mask, root, coarse=coarse, computed=computed)
    if white.singular.size:
        b = int(white.singular[0])
        if not names and candidates is not None:
            names = (*axis_names("names", None, "u", candidates.shape[2]), "the bias")
            if not len(root):
                which = "available ones" + in_set(b, len(raw))
                used = candidates[b][mask[b]]
                require_excited(used, names[:-1], "candidates", which, coarse)
        _refuse_blind(raw[b][mask[b]], root, names, coarse)
    owned = [raw, root, *white[:3], *white[5:], mask, forced]
    for each in owned if candidates is None else [*owned, candidates]:
        each.flags.writeable = False
    problems = []
    for b in range(len(raw)):
        at = Coordinates(
            white.basis[b], names, white.prior[b], int(readings[b]), region, times,
            float(white.log_scale[b]),
        )  # fmt: skip
        problems.append(
            Problem(
                white.blocks[b], white.prior[b], k, mask[b], forced[b], cap,
                wanted.criterion(at), times, at.log_scale, raw[b], white.basis[b], root,
                white.triangle[b], white.size[b],
                None if candidates is None else candidates[b], model,
            )
        )  # fmt: skip
    if forced.shape[1]:
        for b, problem in enumerate(problems):
            check_required_rank(problem, in_set(b, len(raw)))
    return problems


def _refuse_blind(
    blocks: Array, root: Array, names: tuple[str, ...], coarse: float
) -> None:
    """Raise for the directions that neither blocks (N, q, p) nor ``root`` inform."""
    null = missing_directions(blocks, root, coarse)
    raise ValueError(
        "blocks must inform every parameter, but the available ones"
        + (" and what is known" if len(root) else "")
        + directions_in_words(" say nothing of the direction{} ", null, names)
        + "; give prior, a precision of what is known of them"
    )
