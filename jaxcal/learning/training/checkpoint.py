"""Checkpoints: of a run by orbax, of a finished policy as one plain file.

A run's folder ``checkpoint`` holds one numbered folder per save: ``policy`` (the
averaged weights), ``state`` (what else a resumed run needs) and ``meta`` (JSON: schema,
configuration, package versions, progress, SHA-256 of the arrays). Orbax writes a step
beside the others and renames it, so a kill during a save leaves the previous one.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import datetime
import hashlib
import json
import logging
import pathlib
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp
from flax.traverse_util import flatten_dict, unflatten_dict

from jaxcal.extras import versions
from jaxcal.learning.config import NetworkConfig
from jaxcal.learning.core.network import Network, build, initial
from jaxcal.learning.core.ppo import TrainState
from jaxcal.learning.runtime import weights
from jaxcal.learning.runtime.weights import CheckpointError, Weights

SCHEMA = "jaxcal-policy"
VERSION = 2

# orbax warns of every default it takes, on every load.
logging.getLogger("absl").setLevel(logging.ERROR)


@dataclasses.dataclass(frozen=True)
class Policy:
    """A trained policy, ready to choose."""

    network: Network
    params: Any
    meta: dict[str, Any]  # as saved

    @property
    def weights(self) -> Weights:
        return as_weights(self.params, self.meta)


def as_weights(params: Any, meta: dict[str, Any]) -> Weights:
    """A policy in plain arrays, for a file of weights."""
    arrays = flatten_dict(params, sep=".")
    plain = {name: np.asarray(array) for name, array in arrays.items()}
    return Weights(meta["network"], plain, meta)


def _alone() -> Any:
    """Options by which the calling process works without the job's others."""
    own = jax.process_index()
    return ocp.options.MultiprocessingOptions(
        primary_host=own, active_processes={own}, barrier_sync_key_prefix=str(own)
    )


def save(
    folder: str | pathlib.Path,
    step: int,
    policy: Any,
    meta: dict[str, Any],
    state: TrainState | None = None,
) -> None:
    """Add a step to a checkpoint folder, of which the newest three are kept; one that
    exists is left as it is. ``policy`` are the averaged weights, ``meta`` JSON values.
    Without ``state`` a policy cannot be resumed."""
    root = pathlib.Path(folder)
    root.mkdir(parents=True, exist_ok=True)
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    header: dict[str, Any] = {"schema": SCHEMA, "version": VERSION}
    meta = header | {"created": now, "versions": versions()} | meta
    trees = {"policy": policy} | ({} if state is None else {"state": _rest(state)})
    # Arrays of the host, so that no device is recorded.
    trees = jax.tree.map(np.asarray, trees)
    meta["sha256"] = {name: _digests(tree) for name, tree in trees.items()}
    items = {name: ocp.args.StandardSave(tree) for name, tree in trees.items()}
    options = ocp.CheckpointManagerOptions(
        max_to_keep=3,
        create=False,
        cleanup_tmp_directories=True,
        enable_async_checkpointing=False,
        multiprocessing_options=_alone(),
    )
    with _quiet_after_failure():
        try:
            with ocp.CheckpointManager(root.absolute(), options=options) as manager:
                if step in manager.all_steps():
                    return
                items["meta"] = ocp.args.JsonSave(meta)
                manager.save(step, args=ocp.args.Composite(**items))
        except Exception as error:  # orbax and tensorstore raise many kinds
            full = "No space left" in str(error)
            why = "the disk is full" if full else _first_line(error)
            raise OSError(f"{root} cannot be written: {why}") from error


def _rest(state: TrainState) -> dict[str, Any]:
    """Leaves of a state other than the averaged weights; of typed keys their data."""
    names = ("params", "opt_state", "key", "num_updates", "rollout_state", "values")

    def plain(leaf: Any) -> Any:
        return jax.random.key_data(leaf) if _is_key(leaf) else leaf

    held = {name: jax.tree.map(plain, getattr(state, name)) for name in names}
    held["playing"] = held.pop("rollout_state")  # its name in files
    return {name: tree for name, tree in held.items() if jax.tree.leaves(tree)}


def _is_key(leaf: Any) -> bool:
    return bool(jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key))


class _TolerantLoop(asyncio.SelectorEventLoop):
    """An event loop that ignores results that arrive after it is closed, and does not
    print the errors of tasks: ``save`` and ``_read`` raise the first of them."""

    def call_exception_handler(self, context: Any) -> None:
        """Print nothing."""

    def call_soon_threadsafe(  # type: ignore[override]  # generic in its arguments
        self, *arguments: Any, **options: Any
    ) -> Any:
        if self.is_closed():
            return None
        return super().call_soon_threadsafe(*arguments, **options)


class _TolerantPolicy(asyncio.DefaultEventLoopPolicy):
    def new_event_loop(self) -> asyncio.AbstractEventLoop:
        return _TolerantLoop()


@contextlib.contextmanager
def _quiet_after_failure() -> Iterator[None]:
    """After one failed file orbax's others end in a thread of tensorstore when their
    event loop is closed; asyncio would print an error for each."""
    before, log = asyncio.get_event_loop_policy(), logging.getLogger("absl")
    level = log.level
    asyncio.set_event_loop_policy(_TolerantPolicy())
    log.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        asyncio.set_event_loop_policy(before)
        log.setLevel(level)


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:200]


def _digests(tree: Any) -> dict[str, str]:
    """SHA-256 of a tree's arrays, by their types: orbax converts to others."""
    arrays = [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(array.tobytes())
    types = sorted({str(array.dtype) for array in arrays})
    return {" ".join(types): digest.hexdigest()}


def _read(path: pathlib.Path, meta: dict[str, Any], like: Any, what: str) -> Any:
    """A tree of arrays that orbax saved, of the shapes and types of ``like``; those of
    an earlier jaxcal have no SHA-256 in ``meta``."""
    like = jax.tree.map(lambda leaf: np.empty(leaf.shape, leaf.dtype), like)
    try:
        with (
            _quiet_after_failure(),
            ocp.StandardCheckpointer(multiprocessing_options=_alone()) as reader,
        ):
            tree = reader.restore(path.absolute(), like)
        for leaf, wanted in zip(*map(jax.tree.leaves, (tree, like)), strict=True):
            if leaf.shape != wanted.shape:
                raise ValueError(f"shape {leaf.shape}, not {wanted.shape}")
        ((types, digest),) = _digests(tree).items()
        if meta.get("sha256", {}).get(path.name, {}).get(types, digest) != digest:
            raise ValueError("SHA-256 differs")
    except Exception as error:  # orbax and tensorstore raise many kinds
        raise _unreadable(path.parent, what, error) from error
    return jax.tree.map(jax.numpy.asarray, tree)


def _unreadable(path: pathlib.Path, what: str, error: Exception) -> CheckpointError:
    return CheckpointError(f"checkpoint {path} cannot be {what} ({_first_line(error)})")


def read_meta(
    checkpoint: str | pathlib.Path | None, schema: str = SCHEMA
) -> tuple[pathlib.Path, dict[str, Any]]:
    """A weights file or the newest step of a run (``weights.steps``) whose meta is
    whole, and that; a CheckpointError where there is none, or of another schema."""
    return _newest(checkpoint, lambda path: (path, _meta(path, schema)))


def _newest(
    checkpoint: str | pathlib.Path | None,
    read: Callable[[pathlib.Path], Any],
    aside: bool = False,
) -> Any:
    """What ``read`` returns of the newest step that it can read; newer ones are warned
    of, and with ``aside`` renamed."""
    failed: dict[pathlib.Path, CheckpointError] = {}
    for path in weights.steps(checkpoint):
        try:
            result = read(path)
            break
        except CheckpointError as error:
            failed[path] = error
    else:
        raise next(iter(failed.values()))
    for damaged, reason in failed.items():
        instead = f"{path} is read instead"
        if aside:
            named = damaged.rename(damaged.with_name(f"damaged-{damaged.name}")).name
            instead = f"it is now {named}, and the run continues from {path}"
        warnings.warn(f"{reason}; {instead}", stacklevel=3)
    return result


def _meta(path: pathlib.Path, schema: str) -> dict[str, Any]:
    if path.is_file():
        meta = weights.read(path).meta
    else:
        try:
            meta = json.loads((path / "meta" / "metadata").read_text())
        except (OSError, ValueError) as error:
            raise _unreadable(path, "read: its meta is damaged", error) from error
    held = meta.get("schema") if isinstance(meta, dict) else None
    # Of another version first: a run of a task is then not called one of postures.
    if str(held).startswith("jaxcal-") and meta.get("version") != VERSION:
        raise CheckpointError(
            f"checkpoint {path} has version {meta.get('version')!r}; this jaxcal reads "
            f"version {VERSION}"
        )
    if held != schema:
        raise CheckpointError(
            f"checkpoint {path} is not a jaxcal policy of this kind: its schema must "
            f"be {schema}, got {held}"
        )
    weights.require_trained_by_d(path, meta)
    return meta


def load(checkpoint: str | pathlib.Path | None = None) -> Policy:
    """A policy of postures, of the newest step that is whole, ``checkpoint`` as for
    ``weights.steps``; with several seeds the best by validation."""
    return _newest(checkpoint, _policy)


def _policy(path: pathlib.Path) -> Policy:
    meta = _meta(path, SCHEMA)
    try:
        network = build(NetworkConfig(**meta["network"]))
        env = meta["tasks"][0]["environment"]
        m, n, k = env["num_candidates"], env["num_inputs"], env["num_selected"]
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"checkpoint {path} names an unknown network or task: {error}"
        ) from error
    like = jax.eval_shape(lambda: initial(network, jax.random.key(0), m, n, k))
    return Policy(network, read(path, meta, like), meta)


def read(path: pathlib.Path, meta: dict[str, Any], like: Any) -> Any:
    """The weights in a file or a step's folder, of the shapes of ``like``, one
    policy's; with several seeds the best."""
    what = "read: its weights are damaged or do not fit the network"
    seeds = meta.get("num_seeds", 1)
    if path.is_file():
        arrays = weights.read(path).arrays
        wanted = flatten_dict(like, sep=".")
        if jax.tree.map(np.shape, arrays) != jax.tree.map(lambda x: x.shape, wanted):
            raise CheckpointError(f"checkpoint {path} cannot be {what}")
        typed = {n: jax.numpy.asarray(a, wanted[n].dtype) for n, a in arrays.items()}
        params = unflatten_dict(typed, sep=".")
    elif seeds == 1:
        params = _read(path / "policy", meta, like, what)
    else:
        stacked = jax.tree.map(
            lambda leaf: jax.ShapeDtypeStruct((seeds, *leaf.shape), leaf.dtype), like
        )
        every = _read(path / "policy", meta, stacked, what)
        best = meta["progress"]["best"]
        params = jax.tree.map(lambda leaf: leaf[best], every)
    for name, array in flatten_dict(params, sep=".").items():
        if not np.isfinite(array).all():
            raise CheckpointError(
                f"checkpoint {path} has weights that are not finite, in {name}"
            )
    return params


def restore(
    folder: str | pathlib.Path, fresh: TrainState, schema: str = SCHEMA
) -> tuple[TrainState, dict[str, Any]]:
    """The training state of the newest whole step, and its meta; ``fresh`` is one of
    the same shapes. A damaged step is renamed, warned of, and the one before read."""
    return _newest(folder, lambda path: _restored(path, fresh, schema), aside=True)


def _restored(
    path: pathlib.Path, fresh: TrainState, schema: str
) -> tuple[TrainState, dict[str, Any]]:
    meta = _meta(path, schema)
    if not (path / "state").exists():
        raise CheckpointError(
            f"checkpoint {path} cannot be resumed: it has no training state"
        )
    what = "resumed: its training state is damaged or was saved by an earlier jaxcal"
    average = _read(path / "policy", meta, fresh.average, what)
    rest = _read(path / "state", meta, _rest(fresh), what)

    def typed(leaf: Any, like: Any) -> Any:
        if not _is_key(like):
            return leaf
        return jax.random.wrap_key_data(leaf, impl=jax.random.key_impl(like))

    playing = jax.tree.map(typed, rest.pop("playing"), fresh.rollout_state)
    return TrainState(average=average, rollout_state=playing, **rest), meta
