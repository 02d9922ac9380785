"""Choosing by a checkpoint: its weights read once, its kind of network looked up.

The compact network is inferred in numpy and a compiled kernel and needs no JAX; any
other kind goes through JAX, which the extra ``policy`` installs. Both read whitened or
rescaled candidates, so pulses and degrees give the same pick.
"""

from __future__ import annotations

import functools
import pathlib
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import Indices, one_of, whole_number
from jaxcal.extras import needs
from jaxcal.learning.runtime import weights
from jaxcal.selection.problem import Problem, make_problems

DECODINGS = ("greedy", "samples", "first", "exchange")

_CELLS = 4_000_000  # pairs of candidates that JAX scores at once: bounds memory alone
_LARGEST_CALL = 512  # sets


# A policy, ready to choose (B, k) for problems of one M, n, k and number of required,
# which come first, then in the order of choice: of problems, decoding, num, seed.
Chooser = Callable[[Sequence[Problem], str, int, int], Indices]


def load_policy(checkpoint: str | pathlib.Path | None = None) -> Chooser:
    """The newest policy of a weights file or a run's folder, or (None) the shipped one;
    read again only where its files have changed.

    Raises:
        ValueError: it is missing, damaged, or made by another version.
        MissingExtraError: it needs JAX, which is not installed.
    """
    path = weights.locate(checkpoint)
    state = path.stat()  # a save makes another folder, an export another file
    given = path if checkpoint is None else pathlib.Path(checkpoint)
    return _loaded(given, path, (state.st_mtime_ns, state.st_size, state.st_ino))


@functools.lru_cache(maxsize=8)
def _loaded(given: pathlib.Path, path: pathlib.Path, state: tuple[int, ...]) -> Chooser:
    """A weights file, a run or its step as ``given``, which ``path`` is at present;
    the state is what changes when it is replaced."""
    if path.is_file():
        stored = weights.read(path)
        held = stored.meta | {"network": stored.network}
        weights.require_trained_by_d(path, held)
    else:
        with needs("policy", f"checkpoint {path}, the folder of a training run,"):
            from jaxcal.learning.training import checkpoint
        stored = checkpoint.load(given).weights
    if stored.network["kind"] == "compact":
        from jaxcal.selection.policy.compact import CompactScorer

        return CompactScorer(stored.network, stored.arrays)
    with needs("policy", f"checkpoint {path}, a network other than compact,"):
        return _ThroughJax(given)


class _ThroughJax:
    """A network that reads the candidates' own coordinates, compiled for each shape."""

    def __init__(self, path: pathlib.Path) -> None:
        from jaxcal.learning.training import checkpoint

        self._path, self._policy = path, checkpoint.load(path)

    def _require_read(self, problems: Sequence[Problem]) -> None:
        """Refuse sets that the network would read as something else."""
        trained = self._policy.meta["tasks"][0]["environment"]["num_inputs"]
        inputs = problems[0].num_regressors - 1
        if inputs != trained:
            raise ValueError(
                f"checkpoint {self._path} chooses for {trained} inputs, got {inputs}"
            )
        masked = max(int((~problem.available).sum()) for problem in problems)
        if masked and self._policy.network.mask_is_chosen:
            raise ValueError(
                f"checkpoint {self._path} needs all candidates available, but {masked} "
                "are not; leave them out"
            )

    def __call__(
        self, problems: Sequence[Problem], decoding: str, num: int, seed: int
    ) -> Indices:
        from jaxcal.learning.policies import scorer

        self._require_read(problems)
        m, tries = len(problems[0].available), 1 if decoding == "greedy" else num
        # A power of two, filled up by repeating the last set: few shapes to compile.
        most = max(1, min(_LARGEST_CALL, _CELLS // (m * m * tries)))
        size = min(1 << (len(problems) - 1).bit_length(), 1 << (most.bit_length() - 1))
        chosen = []
        for begin in range(0, len(problems), size):
            part = list(problems[begin : begin + size])
            filled = part + part[-1:] * (size - len(part))
            sets = [(_in_unit_range(x), x.available, x.required) for x in filled]
            seeds = [(seed, b) for b in range(begin, begin + size)]
            indices = scorer.choose(
                self._policy.network, self._policy.params,
                *map(np.stack, zip(*sets, strict=True)),
                k=problems[0].k, seeds=seeds, decoding=decoding, num=tries,
            )  # fmt: skip
            chosen.append(indices[: len(part)])
        return np.concatenate(chosen)


def _in_unit_range(problem: Problem) -> NDArray[np.float32]:
    """(M, n) candidates on [0, 1], where such networks are trained; 0 where masked.
    Sets in [0, 1] stay as they are; others are mapped axis by axis."""
    assert problem.candidates is not None  # blocks are refused before
    usable = problem.candidates[problem.available]
    low, high = usable.min(axis=0), usable.max(axis=0)
    if low.min() >= 0.0 and high.max() <= 1.0:
        low, high = np.zeros_like(low), np.ones_like(high)
    scaled = (problem.candidates - low) / (high - low)
    return np.where(problem.available[:, None], scaled, 0.0).astype(np.float32)


def select_batch(
    candidates: ArrayLike,
    k: int,
    *,
    available: ArrayLike | None = None,
    required: ArrayLike | None = None,
    decoding: str = "greedy",
    num: int = 16,
    seed: int = 0,
    checkpoint: str | pathlib.Path | None = None,
) -> Indices:
    """(B, k) distinct postures of each candidate set, required ones first, then in the
    order of choice; what is chosen from a set does not depend on the other sets.

    Args:
        candidates: (B, M, n) commands, none of the sets in one plane.
        k: postures to choose, at least n + 1.
        available: (B, M) bool, True where a candidate may be chosen; all by default.
        required: (B, r) candidates that must be chosen; the policy goes on from them.
        decoding: "greedy": the likeliest at every step, one pass; "samples": the best
            of ``num`` sampled passes; "first": the best of the ``num`` likeliest first
            picks, each completed greedily; "exchange": greedy, then Fedorov exchange.
        num, seed: passes of "samples" and "first"; of "samples".
        checkpoint: see ``load_policy``.

    Raises:
        ValueError: also says what is wrong with the checkpoint.
    """
    problems = make_problems(candidates, k, available=available, required=required)
    return choose(problems, decoding, num, seed, checkpoint)


def choose(
    problems: Sequence[Problem],
    decoding: str,
    num: int,
    seed: int,
    checkpoint: str | pathlib.Path | None,
) -> Indices:
    """(B, k) for problems of one shape, of the affine model; see ``select_batch``."""
    one_of("decoding", decoding, DECODINGS)
    num, seed = whole_number("num", num, 1), whole_number("seed", seed, 0)
    climbs = decoding == "exchange"
    policy = load_policy(checkpoint)
    chosen = policy(problems, "greedy" if climbs else decoding, num, seed)
    if climbs:
        from jaxcal.selection.exchange.exchange import exchange_from

        chosen = np.stack(list(map(exchange_from, problems, chosen)))
    return chosen
