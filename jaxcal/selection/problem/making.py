"""Problems from candidates of a model, sets of affine candidates, or blocks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import axis_names, numbers, whole_number
from jaxcal.information.blocks import (
    coarseness,
    missing_directions,
    prior_root,
    whiten,
)
from jaxcal.information.excitation import directions_in_words, require_excited
from jaxcal.models.affine import Affine
from jaxcal.models.identifiability import identifiability
from jaxcal.models.model import Model
from jaxcal.models.uncertainty import Noise, Prior
from jaxcal.selection.problem.modelled import (
    Modelled,
    as_commands,
    shares_regressor,
)
from jaxcal.selection.problem.problem import Problem
from jaxcal.selection.problem.rules import (
    check_available,
    check_counts,
    check_k,
    check_required_rank,
    in_set,
    usable_numbers,
)
from jaxcal.selection.problem.wanted import Wanted, wanted_criterion

__all__ = ["make_block_problem", "make_problem", "make_problems"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# The C library keeps freed memory for the next array once an array as large as this was
# freed. Else every array of a problem is given back to the system and asked for again,
# which takes longer than what is computed in it. No page of this one is touched.
np.empty(2**21)


class _Rules(NamedTuple):
    """What may be chosen, over a batch of S sets."""

    k: int | None
    available: Mask  # (S, M), checked
    required: ArrayLike | None
    max_replicates: int
    single: bool = True  # one set, given without its batch axis
    coarse: float = 1.0  # how many times coarser than float64 the numbers given are


def make_problem(
    candidates: ArrayLike,
    k: int | None = None,
    *,
    model: Model | None = None,
    prior: Prior | None = None,
    noise: Noise | None = None,
    criterion: str | None = None,
    parameters: Sequence[str | int] | None = None,
    region: ArrayLike | None = None,
    measured: ArrayLike | None = None,
    available: ArrayLike | None = None,
    required: ArrayLike | None = None,
    max_replicates: int = 1,
    num_outputs: int | None = None,
) -> Problem:
    """Check candidates (M, n) of a model; arguments as for ``jaxcal.select``.

    Raises:
        ValueError: naming the argument, the rule and the value.
    """
    array = numbers("candidates", candidates, finite=False)
    if array.ndim != 2 or 0 in array.shape:
        raise ValueError(
            f"candidates must have shape (M, n), neither of them 0, got {array.shape}"
        )
    if model is None:
        m = array.shape[1] if num_outputs is None else num_outputs
        model = Affine(array.shape[1], whole_number("num_outputs", m, 1))
    elif num_outputs is not None:
        raise ValueError("num_outputs must not be given with a model, which has it")
    elif isinstance(model, Affine) and array.shape[1] != model.num_inputs:
        raise ValueError(
            f"candidates must have shape (M, {model.num_inputs}) for this model, got "
            f"{array.shape}"
        )
    mask = check_available(available, array.shape[:1], True)
    array = usable_numbers("candidates", array[None], mask, True)
    rules = _Rules(k, mask, required, max_replicates, coarse=coarseness(candidates))
    plain = parameters is None and shares_regressor(model, prior, noise)
    if plain and isinstance(model, Affine):
        wanted = wanted_criterion(criterion, None, (), "D", region)
        std = None if noise is None else noise.std
        return _affine(model, array, rules, wanted, std, region, measured)[0]
    if noise is None and hasattr(model, "default_noise"):
        noise = model.default_noise()
    modelled = Modelled(model, prior, noise)
    default = "D" if isinstance(model, Affine) else "I"
    wanted = wanted_criterion(criterion, parameters, modelled.names, default, region)
    raw = modelled.blocks(array[0], mask[0])[None]
    root, shown = prior_root(modelled.precision), array[mask]
    if measured is not None:
        root = _with_measured(root, modelled.blocks_at("measured", measured, True))
        shown = np.concatenate([shown, measured])
    if not np.diagonal(modelled.precision).all():
        known = None if noise is None else noise.of(mask[0])
        _require_identified(model, shown, known, prior)
    if region is None and modelled.noise.command_std is not None:
        region = array[mask]  # predictions are for commands that are known
    if region is not None:
        wanted = wanted._replace(region=modelled.blocks_at("region", region, False))
    return _whitened(raw, root, rules, wanted, modelled.names, array, model)[0]


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
    array = numbers("candidates", candidates, finite=False)
    if array.ndim != 3 or 0 in array.shape:
        raise ValueError(
            f"candidates must have shape (B, M, n), none of them 0, got {array.shape}"
        )
    mask = check_available(available, array.shape[:2], False)
    array = usable_numbers("candidates", array, mask, False)
    m = array.shape[2] if num_outputs is None else num_outputs
    model = Affine(array.shape[2], whole_number("num_outputs", m, 1))
    coarse = coarseness(candidates)
    rules = _Rules(k, mask, required, max_replicates, False, coarse)
    return _affine(model, array, rules, Wanted("D"))


def make_block_problem(
    blocks: ArrayLike,
    k: int | None = None,
    *,
    prior: ArrayLike | None = None,
    noise: Noise | None = None,
    criterion: str | None = None,
    parameters: Sequence[str | int] | None = None,
    region: ArrayLike | None = None,
    measured: ArrayLike | None = None,
    available: ArrayLike | None = None,
    required: ArrayLike | None = None,
    max_replicates: int = 1,
    num_outputs: int | None = None,
) -> Problem:
    """Check information blocks and whiten them.

    Args:
        blocks: (M, q, p); candidate i gives q readings, ``y = B_i theta + noise`` with
            noise of unit variance, and adds ``B_i.T @ B_i`` to the information.
        k: candidates to choose; enough that they alone identify p when not given.
        prior: (p, p) precision of what is known beforehand, zero when not given.
        noise: of the readings, where it is not of unit variance.
        criterion, parameters: as for ``jaxcal.select``; names are theta1, theta2, ...
        region: (R, q, p) blocks of the predictions that criterion I is about.
        measured: (N, q, p) blocks that were measured already.
        available, required, max_replicates: as for ``jaxcal.select``.
        num_outputs: how often log det and trace count, 1 when not given.

    Raises:
        ValueError: naming the argument, the rule and the value.
    """
    array = numbers("blocks", blocks, finite=False)
    if array.ndim != 3 or 0 in array.shape:
        raise ValueError(
            f"blocks must have shape (M, q, p) with none of them 0, got {array.shape}"
        )
    count, q, p = array.shape
    mask = check_available(available, (count,), True)
    raw = usable_numbers("blocks", array[None], mask, True)
    if noise is not None:
        raw = noise.whitening(count, q) @ raw
    root = np.zeros((0, p))
    if prior is not None:
        precision = numbers("prior", prior)
        if precision.shape != (p, p):
            raise ValueError(
                f"prior must be a precision of shape ({p}, {p}), got {precision.shape}"
            )
        root = prior_root(precision)
    if measured is not None:
        root = _with_measured(root, _as_blocks("measured", measured, noise, q, p))
    names = tuple(f"theta{i + 1}" for i in range(p))
    wanted = wanted_criterion(criterion, parameters, names, "D", region)
    if num_outputs is not None:
        wanted = wanted._replace(times=whole_number("num_outputs", num_outputs, 1))
    if region is not None:
        wanted = wanted._replace(region=_as_blocks("region", region, noise, q, p))
    rules = _Rules(k, mask, required, max_replicates, coarse=coarseness(blocks))
    return _whitened(raw, root, rules, wanted, names)[0]


def _affine(
    model: Affine,
    array: Array,
    rules: _Rules,
    wanted: Wanted,
    std: ArrayLike | None = None,
    region: ArrayLike | None = None,
    measured: ArrayLike | None = None,
) -> list[Problem]:
    """Problems of blocks [u, 1] / std for sets (S, M, n)."""

    def blocks(commands: Array) -> Array:
        made = model.blocks(commands)
        return made if std is None else made / np.asarray(std)

    root = np.zeros((0, model.num_inputs + 1))
    if measured is not None:
        root = _with_measured(
            root, blocks(as_commands("measured", measured, model.num_inputs))
        )
    if region is not None:
        wanted = wanted._replace(
            region=blocks(as_commands("region", region, model.num_inputs))
        )
    wanted = wanted._replace(times=model.multiplicity)
    return _whitened(blocks(array), root, rules, wanted, None, array, model)


def _whitened(
    raw: Array,
    root: Array,
    rules: _Rules,
    wanted: Wanted,
    names: tuple[str, ...] | None,
    candidates: Array | None = None,
    model: Model | None = None,
) -> list[Problem]:
    """The problems of blocks (S, M, q, p); ``names`` is None for blocks [u, 1]."""
    k, mask, required, max_replicates, single, coarse = rules
    readings = mask.sum(axis=1) * raw.shape[2]
    if raw.shape[2] > raw.shape[3]:  # as much information in p rows, at q^3 less cost
        raw = np.asarray(np.linalg.qr(raw, mode="r"))
    k = check_k(k, raw, mask, root, regressors=names is None)
    cap, forced = check_counts(mask, k, required, max_replicates, single)
    computed = names is not None and candidates is not None
    if computed:  # a derivative is as exact as its own numbers
        coarse = 1.0
    white = whiten(raw, mask, root, coarse=coarse, computed=computed)
    if white.singular.size:
        b = int(white.singular[0])
        if names is None and candidates is not None:
            names = (*axis_names("names", None, "u", candidates.shape[2]), "the bias")
            if not len(root):
                which = "available ones" + in_set(b, single)
                used = candidates[b][mask[b]]
                require_excited(used, names[:-1], "candidates", which, coarse)
        _refuse_blind(raw[b][mask[b]], root, names or (), coarse)
    owned = [raw, root, *white[:3], mask, forced]
    for each in owned if candidates is None else [*owned, candidates]:
        each.flags.writeable = False
    problems = [
        Problem(
            white.blocks[b], white.prior[b], k, mask[b], forced[b], cap,
            wanted.whitened(white, b, int(readings[b])), wanted.times,
            float(white.log_scale[b]), raw[b], white.basis[b], root,
            white.rounding[b], None if candidates is None else candidates[b], model,
        )
        for b in range(len(raw))
    ]  # fmt: skip
    if forced.shape[1]:
        for b, problem in enumerate(problems):
            check_required_rank(problem, in_set(b, single))
    return problems


def _require_identified(
    model: Model, commands: Array, noise: Noise | None, prior: Prior | None
) -> None:
    """Refuse commands that, with the prior, leave parameters unknown; name them."""
    prior = model.default_prior() if prior is None else prior
    left = identifiability(model, commands, noise=noise, prior=prior).directions
    if left:
        raise ValueError(
            "candidates must inform every parameter, but with what is known they say "
            f"nothing of {'; '.join(each.words for each in left)}; give a prior "
            "(jaxcal.Prior with finite std) or hold some (Prior with fixed=[name])"
        )


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


def _with_measured(root: Array, blocks: Array) -> Array:
    """Root of a precision with the information of blocks (N, q, p) added."""
    rows = np.concatenate([root, blocks.reshape(-1, root.shape[1])])
    return np.linalg.qr(rows)[1] if len(rows) > root.shape[1] else rows


def _as_blocks(
    argument: str, blocks: ArrayLike, noise: Noise | None, q: int, p: int
) -> Array:
    array = numbers(argument, blocks)
    if array.ndim != 3 or array.shape[1:] != (q, p):
        raise ValueError(
            f"{argument} must have shape (N, {q}, {p}) as blocks have, got "
            f"{array.shape}"
        )
    return array if noise is None else noise.whitening(len(array), q) @ array
