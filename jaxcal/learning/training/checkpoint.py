"""Checkpoints, by orbax: the policy, what it was trained with, and how to go on.

A checkpoint folder holds one numbered folder a save. Each has ``policy`` (the averaged
weights), ``meta`` (JSON: schema, configuration, seed, package versions, progress),
``policy.npz`` (weights and meta again, for inference without JAX) and, in a training
run, ``state`` (all an uninterrupted run would need). Orbax writes a step beside the
others and renames it, so a kill during a save leaves the previous one; ``policy.npz``
follows, and a step that lost it is still read through orbax.

    python -m jaxcal.learning.training.checkpoint FOLDER

adds ``policy.npz`` to the newest step of a folder that has none.

orbax calls this interface legacy and its successor is still experimental; it is used
here alone, so that changing it touches one file.
"""

from __future__ import annotations

import asyncio
import dataclasses
import datetime
import importlib.metadata
import json
import logging
import pathlib
import platform
import sys
import tempfile
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

from jaxcal.learning.policies import networks
from jaxcal.learning.policies.build import build
from jaxcal.learning.policies.networks import Network, NetworkConfig
from jaxcal.learning.runtime import weights
from jaxcal.learning.runtime.weights import (
    CheckpointError,
    Weights,
    newest_step,
    resolve,
)

__all__ = [
    "CheckpointError",
    "Policy",
    "export",
    "fingerprint",
    "latest",
    "load",
    "package_versions",
    "read_policy",
    "restore",
    "save",
]

SCHEMA = "jaxcal-policy"
VERSION = 1
_PACKAGES = ("jaxcal", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "numpy")

# orbax warns of every default it takes, on every load.
logging.getLogger("absl").setLevel(logging.ERROR)


@dataclasses.dataclass(frozen=True)
class Policy:
    """A trained policy, ready to choose."""

    network: Network
    params: Any
    meta: dict[str, Any]  # as saved
    folder: pathlib.Path
    step: int

    @property
    def weights(self) -> Weights:
        """As plain arrays, which ``policy.npz`` holds."""
        return _plain(self.params, self.meta)


def _plain(params: Any, meta: dict[str, Any]) -> Weights:
    network = meta["network"]
    if meta.get("schema", SCHEMA) == SCHEMA:  # with every field, also those not saved
        network = dataclasses.asdict(NetworkConfig(**network))
    return Weights(network, weights.flat(params), meta)


def package_versions() -> dict[str, str]:
    """Versions of what a result depends on."""
    versions = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return versions


def _alone() -> Any:
    """In a job of several processes, the one that asks works without the others."""
    own = jax.process_index()
    return ocp.options.MultiprocessingOptions(
        primary_host=own, active_processes={own}, barrier_sync_key_prefix=str(own)
    )


def save(
    folder: str | pathlib.Path,
    step: int,
    params: Any,
    meta: dict[str, Any],
    state: Any = None,
    keep: int = 3,
) -> None:
    """Add a step to a checkpoint folder.

    Args:
        folder: made where missing.
        step: number of the step; a step that exists is left as it is.
        params: the policy's weights.
        meta: JSON values; ``network`` is the fields of a ``NetworkConfig``, or, of
            another ``schema``, what that one says.
        state: what ``restore`` gives back, or None for a policy only.
        keep: older steps beyond these are deleted.
    """
    root = pathlib.Path(folder)
    root.mkdir(parents=True, exist_ok=True)
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    own: dict[str, Any] = {"schema": SCHEMA, "version": VERSION}
    meta = own | {"created": now, "versions": package_versions()} | meta
    arrays = {"policy": params} | ({} if state is None else {"state": state})
    # Arrays of the host, which know no device.
    items = {
        name: ocp.args.StandardSave(jax.tree.map(np.asarray, tree))
        for name, tree in arrays.items()
    }
    options = ocp.CheckpointManagerOptions(
        max_to_keep=keep,
        create=False,
        cleanup_tmp_directories=True,
        enable_async_checkpointing=False,
        multiprocessing_options=_alone(),
    )
    with ocp.CheckpointManager(root.absolute(), options=options) as manager:
        if step in manager.all_steps():
            return
        manager.save(
            step, args=ocp.args.Composite(meta=ocp.args.JsonSave(meta), **items)
        )
    weights.write(root / str(step) / weights.NAME, _plain(params, meta))


class _PatientLoop(asyncio.SelectorEventLoop):
    """An event loop that ignores results which arrive after it is closed."""

    def call_soon_threadsafe(  # type: ignore[override]  # generic in its arguments
        self, *arguments: Any, **options: Any
    ) -> Any:
        """As asyncio's, but nothing where the loop is closed."""
        if self.is_closed():
            return None
        return super().call_soon_threadsafe(*arguments, **options)


class _PatientPolicy(asyncio.DefaultEventLoopPolicy):
    def new_event_loop(self) -> asyncio.AbstractEventLoop:
        return _PatientLoop()


def _read(path: pathlib.Path, like: Any, what: str) -> Any:
    """A tree of arrays that orbax saved, of the shapes and types of ``like``.

    Raises:
        CheckpointError: it cannot be read, or has another shape.
    """
    like = jax.tree.map(lambda leaf: np.empty(leaf.shape, leaf.dtype), like)
    # Where a read fails, orbax leaves the others to end: in a thread of tensorstore,
    # after its event loop is closed. asyncio would print that.
    before = asyncio.get_event_loop_policy()
    asyncio.set_event_loop_policy(_PatientPolicy())
    try:
        with ocp.StandardCheckpointer(multiprocessing_options=_alone()) as reader:
            found = reader.restore(path.absolute(), like)
        for leaf, wanted in zip(*map(jax.tree.leaves, (found, like)), strict=True):
            if leaf.shape != wanted.shape:
                raise ValueError(f"shape {leaf.shape}, not {wanted.shape}")
    except Exception as error:  # orbax and tensorstore raise many kinds
        raise _unreadable(path.parent, what, error) from error
    finally:
        asyncio.set_event_loop_policy(before)
    return jax.tree.map(jax.numpy.asarray, found)


def _unreadable(path: pathlib.Path, what: str, error: Exception) -> CheckpointError:
    line = (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
    return CheckpointError(f"checkpoint {path} cannot be {what} ({line})")


def latest(
    folder: str | pathlib.Path | None, schema: str = SCHEMA
) -> tuple[pathlib.Path, dict[str, Any]]:
    """The newest complete step of a folder and its meta, checked.

    Args:
        folder: a checkpoint folder or a training run's; the one that ships when None.
        schema: what it must hold.

    Raises:
        CheckpointError: there is none, it is damaged, or holds something else.
    """
    path = newest_step(resolve(folder))
    try:
        meta = json.loads((path / "meta" / "metadata").read_text())
    except (OSError, ValueError) as error:
        raise _unreadable(path, "read: its meta is damaged", error) from error
    if not isinstance(meta, dict) or meta.get("schema") != schema:
        held = meta.get("schema") if isinstance(meta, dict) else None
        raise CheckpointError(
            f"checkpoint {path} is not a jaxcal policy of this kind: its schema must "
            f"be {schema}, got {held}"
        )
    if meta.get("version") != VERSION:
        raise CheckpointError(
            f"checkpoint {path} has version {meta.get('version')!r}; this jaxcal reads "
            f"version {VERSION}"
        )
    return path, meta


def load(folder: str | pathlib.Path | None = None) -> Policy:
    """The newest policy in a folder.

    Args:
        folder: a checkpoint folder or a training run's; the one that ships when None.

    Raises:
        CheckpointError: there is none, it is damaged, or another version made it.
    """
    path, meta = latest(folder)
    try:
        network = build(NetworkConfig(**meta["network"]))
        env = meta["tasks"][0]["environment"]
        m, n, k = env["num_candidates"], env["num_inputs"], env["num_selected"]
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"checkpoint {path} names no network or task this jaxcal knows: {error}"
        ) from error
    like = jax.eval_shape(lambda: networks.initial(network, jax.random.key(0), m, n, k))
    params = read_policy(path, like)
    return Policy(network, params, meta, path.parent, int(path.name))


def read_policy(path: pathlib.Path, like: Any) -> Any:
    """The weights in a step's folder, of the shapes of ``like``.

    Raises:
        CheckpointError: they are damaged, of other shapes or not finite.
    """
    what = "read: its weights are damaged or do not fit its network"
    params = _read(path / "policy", like, what)
    for name, array in weights.flat(params).items():
        if not np.isfinite(array).all():
            raise CheckpointError(
                f"checkpoint {path} holds weights that are not finite, in {name}"
            )
    return params


def fingerprint(folder: str | pathlib.Path | None = None) -> str:
    """SHA-256 of a policy's network and weights, the same wherever it lies.

    Raises:
        CheckpointError: see ``load``.
    """
    return load(folder).weights.fingerprint


def export(
    run: str | pathlib.Path,
    folder: str | pathlib.Path,
    load: Callable[[str | pathlib.Path], Any] = load,
) -> None:
    """Write a run's policy alone, without its training state, to another folder.

    Args:
        run: a training run's folder.
        folder: becomes a checkpoint folder with one step; one that is there is replaced
            after the new one is complete.
        load: reads the run's policy, with ``params``, ``meta`` and ``step``.
    """
    policy = load(run)
    target = pathlib.Path(folder)
    target.parent.mkdir(parents=True, exist_ok=True)
    own = {"version", "created", "versions"}
    meta = {name: value for name, value in policy.meta.items() if name not in own}
    meta["trained_with"] = policy.meta["versions"]
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=".export-") as fresh:
        new, old = pathlib.Path(fresh) / "new", pathlib.Path(fresh) / "old"
        save(new, policy.step, policy.params, meta)
        for marker in new.rglob("commit_success.txt"):
            # orbax looks only whether the file is there, and writes this machine's
            # folders into it.
            marker.write_text("committed\n")
        if target.exists():
            target.rename(old)
        new.rename(target)


def restore(
    folder: str | pathlib.Path, fresh: Any, schema: str = SCHEMA
) -> tuple[Any, dict[str, Any]]:
    """The training state of the newest step, and its meta.

    Args:
        folder: as for ``load``.
        fresh: a state of the same structure, for shapes and types.
        schema: of the run.

    Raises:
        CheckpointError: none, damaged, or one without a training state.
    """
    path, meta = latest(folder, schema)
    if not (path / "state").exists():
        raise CheckpointError(
            f"checkpoint {path} holds a policy but no training state to resume from"
        )
    what = "resumed: its training state is damaged or of another configuration"
    return _read(path / "state", fresh, what), meta


def main(argv: list[str]) -> int:
    """Add the weights file to the newest step of a checkpoint or run folder."""
    if len(argv) != 1 or argv[0].startswith("-"):
        print((__doc__ or "").partition("\n\n    ")[2].strip())
        return 2
    try:
        policy = load(argv[0])
        path = policy.folder / str(policy.step) / weights.NAME
        weights.write(path, policy.weights)
    except (CheckpointError, OSError) as error:
        print(f"checkpoint: {error}", file=sys.stderr)
        return 2
    print(f"wrote {path}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
