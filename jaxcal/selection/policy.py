"""Selection by a trained policy: one pass over the candidates, or a few.

JAX is loaded by the first call, and the network only where nobody has decided alike on
this machine before: programs are kept whole (``jaxcal.learning.runtime.programs``). Candidates
are brought to order one in float64 before the network, in float32, sees them, so pulses
and degrees give the same pick.
"""

from __future__ import annotations

import dataclasses
import functools
import pathlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.selection.exchange.exchange import exchange_from
from jaxcal.selection.problem import make_problems

if TYPE_CHECKING:
    from jaxcal.learning.runtime.programs import Program
    from jaxcal.learning.training.checkpoint import Policy

__all__ = ["DECODINGS", "load_policy", "select_batch", "to_order_one"]

DECODINGS = ("greedy", "samples", "first", "exchange")

_CELLS = 4_000_000  # pairs of candidates scored at once: bounds memory, not the result
_LARGEST_CHUNK = 512  # sets a compiled call

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class _Call:
    """What a program is compiled for."""

    size: int  # sets
    num_candidates: int
    num_inputs: int
    num_required: int
    k: int
    decoding: str  # greedy, samples or first
    num: int  # tries of the last two, else 1


class _Source:
    """A checkpoint folder, of which a process reads what it needs, once."""

    def __init__(self, folder: str | None) -> None:
        self.folder = folder
        self._programs: dict[_Call, Program] = {}

    @functools.cached_property
    def digest(self) -> str:
        """Of its files when they were first asked for."""
        from jaxcal.learning.runtime import checkpoint_folder

        return checkpoint_folder.digest(self.folder)

    @functools.cached_property
    def policy(self) -> Policy:
        """Network and weights."""
        from jaxcal.learning.runtime import cache
        from jaxcal.learning.training import checkpoint

        cache.keep_compiled_programs()
        return checkpoint.load(self.folder)

    def program(self, call: _Call) -> Program:
        """The policy, compiled for a call."""
        if call not in self._programs:
            from jaxcal.learning.runtime import programs

            name = programs.name_of(self.digest, call)
            self._programs[call] = programs.load(name) or self._compiled(call, name)
        return self._programs[call]

    def _compiled(self, call: _Call, name: str) -> Program:
        policy = self.policy
        import jax

        from jaxcal.learning.policies import decoding
        from jaxcal.learning.runtime import checkpoint_folder, programs

        if checkpoint_folder.digest(self.folder) != self.digest:
            where = checkpoint_folder.resolve(self.folder)
            raise checkpoint_folder.CheckpointError(
                f"checkpoint folder {where} has changed since this process began to "
                "use it; run again"
            )

        def decode(
            params: Any, candidates: Any, free: Any, kept: Any, *key_data: Any
        ) -> jax.Array:
            key = jax.random.key(0)  # spent by samples only
            if key_data:
                key = jax.random.wrap_key_data(key_data[0])
            chosen: jax.Array = decoding.choose(
                policy.network,
                params,
                candidates,
                free,
                kept,
                key,
                k=call.k,
                num_required=call.num_required,
                decoding=call.decoding,
                num=call.num,
            )
            return chosen

        shape = (call.size, call.num_candidates)
        arguments = [
            jax.ShapeDtypeStruct((*shape, call.num_inputs), np.float32),
            jax.ShapeDtypeStruct(shape, np.bool_),
            jax.ShapeDtypeStruct((call.size, call.num_required), np.int32),
        ]
        if call.decoding == "samples":
            key = jax.random.key_data(jax.random.key(0))
            arguments.append(jax.ShapeDtypeStruct(key.shape, key.dtype))
        facts = {"kind": policy.network.config.kind}
        return programs.make(name, decode, policy.params, tuple(arguments), facts)


@functools.lru_cache(maxsize=8)
def _source(folder: str | None) -> _Source:
    return _Source(folder)


def _source_of(checkpoint: str | pathlib.Path | None) -> _Source:
    return _source(None if checkpoint is None else str(checkpoint))


def load_policy(checkpoint: str | pathlib.Path | None = None) -> Policy:
    """The policy of a checkpoint folder, read once a process.

    Args:
        checkpoint: a checkpoint's or training run's folder; the shipped one when None.

    Raises:
        ValueError: it is missing, damaged, or made by another version.
    """
    return _source_of(checkpoint).policy


def to_order_one(candidates: Array, usable: NDArray[np.bool_], white: bool) -> Array:
    """Candidates about 0 with identity covariance, or per axis in [0, 1].

    The compact network sees only what no affine map changes: whitening in float64 first
    spares float32 the offsets and scales of encoder pulses. The paper's network was
    trained on [0, 1]: other ranges are mapped to it axis by axis.
    """
    weight = usable[..., None].astype(np.float64)
    number = weight.sum(axis=1, keepdims=True)
    if white:
        centred = (
            candidates - (candidates * weight).sum(1, keepdims=True) / number
        ) * (weight)
        spread = np.sqrt((centred**2).sum(1, keepdims=True) / number)
        centred = centred / np.where(spread > 0, spread, 1.0)
        covariance = np.matrix_transpose(centred) @ centred / number
        lower = np.linalg.cholesky(covariance + 1e-14 * np.eye(candidates.shape[-1]))
        return np.matrix_transpose(np.linalg.solve(lower, np.matrix_transpose(centred)))
    low = np.where(usable[..., None], candidates, np.inf).min(1, keepdims=True)
    high = np.where(usable[..., None], candidates, -np.inf).max(1, keepdims=True)
    if low.min() >= 0.0 and high.max() <= 1.0:
        return candidates
    return np.where(usable[..., None], (candidates - low) / (high - low), 0.0)


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
    chunk: int | None = None,
) -> NDArray[np.int64]:
    """Choose k postures for every candidate set of a batch.

    The sets are cut into chunks of one size, and every device of this process takes one
    at a time: what is chosen does not depend on how many there are. (The last two
    postures are the best pair; which of them is named first, rounding may decide.)

    Args:
        candidates: (B, M, n) commands, none of the sets in one plane.
        k: postures to choose, at least n + 1.
        available: (B, M) bool, True where a candidate may be chosen; all by default.
        required: (B, r) candidates that must be chosen; the policy goes on from them.
        decoding: "greedy": the likeliest at every step, one pass; "samples": the best
            of ``num`` sampled passes; "first": the best of the ``num`` likeliest first
            picks, each completed greedily; "exchange": greedy, then Fedorov exchange
            from there.
        num: passes of "samples" and "first".
        seed: of "samples".
        checkpoint: see ``load_policy``.
        chunk: cut after every so many sets, at least; the whole batch when None.

    Returns:
        (B, k) distinct indices, required ones first, then in the order of choice.

    Raises:
        ValueError: naming the argument, the rule and the value; or what is wrong with
            the checkpoint.
    """
    if decoding not in DECODINGS:
        raise ValueError(
            f"decoding must be one of {', '.join(DECODINGS)}, got {decoding!r}"
        )
    if num < 1:
        raise ValueError(f"num must be at least 1, got {num}")
    problems = make_problems(candidates, k, available=available, required=required)
    sets = np.stack([problem.candidates for problem in problems])
    usable = np.stack([problem.available for problem in problems])
    kept = np.stack([problem.required for problem in problems])
    batch, m, _ = sets.shape
    import jax

    from jaxcal.learning.policies.geometry import num_starts

    tries = num if decoding in ("samples", "first") else 1
    chunk = batch if chunk is None else chunk
    pairs = m * num_starts(m) * tries
    size = max(1, min(batch, chunk, _CELLS // pairs, _LARGEST_CHUNK))
    cuts = [
        slice(begin, min(begin + size, first + chunk, batch))
        for first in range(0, batch, chunk)
        for begin in range(first, min(first + chunk, batch), size)
    ]
    number = min(len(cuts), jax.local_device_count())
    how = "greedy" if decoding == "exchange" else decoding
    call = _Call(size, m, sets.shape[-1], kept.shape[1], k, how, tries)
    chooser = _chooser(_source_of(checkpoint), call, number)
    scaled = to_order_one(sets, usable, white=chooser.kind == "compact")
    inputs = np.where(usable[..., None], scaled, 0.0).astype(np.float32)
    chosen = []
    for begin in range(0, len(cuts), number):
        parts = [
            (inputs[cut], usable[cut], kept[cut].astype(np.int32), seed + cut.start)
            for cut in cuts[begin : begin + number]
        ]
        chosen += _choose(chooser.run, parts, size, number)
    indices = np.concatenate(chosen)
    if decoding == "exchange":
        found = zip(problems, indices, strict=True)
        indices = np.stack([exchange_from(problem, start) for problem, start in found])
    return indices


@dataclasses.dataclass(frozen=True)
class _Chooser:
    """The policy of a folder, for a call on each of so many devices."""

    kind: str  # of the network
    run: Callable[..., Any]  # (candidates, free, kept, a seed a device) -> indices


def _chooser(source: _Source, call: _Call, number: int) -> _Chooser:
    import jax

    if number == 1:
        program = source.program(call)

        def alone(candidates: Any, free: Any, kept: Any, seeds: list[int]) -> Any:
            if call.decoding != "samples":
                return program(candidates, free, kept)
            key_data = jax.random.key_data(jax.random.key(seeds[0]))
            return program(candidates, free, kept, key_data)

        return _Chooser(program.facts["kind"], alone)
    from jaxcal.learning.policies import decoding

    policy = source.policy

    def together(candidates: Any, free: Any, kept: Any, seeds: list[int]) -> Any:
        return decoding.choose_on_devices(
            policy.network,
            policy.params,
            candidates,
            free,
            kept,
            jax.numpy.stack([jax.random.key(seed) for seed in seeds]),
            k=call.k,
            num_required=call.num_required,
            decoding=call.decoding,
            num=call.num,
        )

    return _Chooser(policy.network.config.kind, together)


def _choose(
    run: Callable[..., Any],
    parts: list[tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.int32], int]],
    size: int,
    number: int,
) -> list[NDArray[np.int64]]:
    """One compiled call on so many devices, a part (candidates, free, kept, seed) each.

    A short part is filled up by repeating its first set, a missing one by the first.
    """
    given = [parts[min(i, len(parts) - 1)] for i in range(number)]
    fills = [np.arange(size) * (np.arange(size) < len(part[0])) for part in given]
    candidates, free, kept = (
        np.concatenate(
            [part[n][fill] for part, fill in zip(given, fills, strict=True)]  # type: ignore[index]  # the first three of a part
        )
        for n in range(3)
    )
    indices = np.asarray(run(candidates, free, kept, [part[3] for part in given]))
    rows = indices.reshape(number, size, -1).astype(np.int64)
    return [row[: len(part[0])] for row, part in zip(rows, parts, strict=False)]
