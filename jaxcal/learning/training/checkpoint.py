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
import contextlib
import dataclasses
import datetime
import importlib.metadata
import logging
import pathlib
import platform
import sys
import tempfile
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

from jaxcal.learning.policies import networks
from jaxcal.learning.policies.build import build
from jaxcal.learning.policies.networks import Network, NetworkConfig
from jaxcal.learning.runtime import weights
from jaxcal.learning.runtime.checkpoint_folder import (
    CheckpointError,
    default_folder,
    newest_step,
    resolve,
)
from jaxcal.learning.runtime.weights import Weights

__all__ = [
    "CheckpointError",
    "Policy",
    "as_weights",
    "default_folder",
    "export",
    "fingerprint",
    "load",
    "restore",
    "save",
]

SCHEMA = "jaxcal-policy"
VERSION = 1
_PACKAGES = ("jaxcal", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "numpy")


@dataclasses.dataclass(frozen=True)
class Policy:
    """A trained policy, ready to choose."""

    network: Network
    params: Any
    meta: dict[str, Any]  # as saved
    folder: pathlib.Path
    step: int


def package_versions() -> dict[str, str]:
    """Versions of what a result depends on."""
    versions = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return versions


# orbax warns of every default it takes, on every load.
logging.getLogger("absl").setLevel(logging.ERROR)


def _alone() -> Any:
    """In a job of several processes, the one that asks works without the others."""
    own = jax.process_index()
    return ocp.options.MultiprocessingOptions(
        primary_host=own, active_processes={own}, barrier_sync_key_prefix=str(own)
    )


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


@contextlib.contextmanager
def _late_reads_ignored() -> Iterator[None]:
    """Around reads by orbax, which leaves the others to end where one has failed.

    They end in a thread of tensorstore after orbax has closed its event loop; asyncio
    then prints "Event loop is closed", which says nothing to anybody.
    """
    before = asyncio.get_event_loop_policy()
    asyncio.set_event_loop_policy(_PatientPolicy())
    try:
        yield
    finally:
        asyncio.set_event_loop_policy(before)


def _manager(folder: pathlib.Path, keep: int | None, create: bool) -> Any:
    if create:
        folder.mkdir(parents=True, exist_ok=True)
    return ocp.CheckpointManager(
        folder.absolute(),
        options=ocp.CheckpointManagerOptions(
            max_to_keep=keep,
            create=False,
            cleanup_tmp_directories=create,
            enable_async_checkpointing=False,
            read_only=not create,
            multiprocessing_options=_alone(),
        ),
    )


def _plain_keys(tree: Any) -> Any:
    """Arrays of the host, which know no device; PRNG keys as what they are made of."""
    return jax.tree.map(
        lambda leaf: np.asarray(
            jax.random.key_data(leaf)
            if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)
            else leaf
        ),
        tree,
    )


def _plain_policy(folder: pathlib.Path) -> Any:
    """Weights as arrays of the host, whatever devices they were saved from."""
    with ocp.StandardCheckpointer(multiprocessing_options=_alone()) as reader:
        saved = reader.metadata(folder.absolute()).item_metadata
        like = jax.tree.map(lambda leaf: np.empty(leaf.shape, leaf.dtype), saved.tree)
        return reader.restore(folder.absolute(), like)


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
        meta: JSON values; ``network`` is the fields of a ``NetworkConfig``.
        state: what ``restore`` gives back, or None for a policy only.
        keep: older steps beyond these are deleted.
    """
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    own: dict[str, Any] = {"schema": SCHEMA, "version": VERSION}
    meta = own | {"created": now, "versions": package_versions()} | meta
    items = {
        "policy": ocp.args.StandardSave(_plain_keys(params)),
        "meta": ocp.args.JsonSave(meta),
    }
    if state is not None:
        items["state"] = ocp.args.StandardSave(_plain_keys(state))
    with _manager(pathlib.Path(folder), keep, create=True) as manager:
        if step in manager.all_steps():
            return
        manager.save(step, args=ocp.args.Composite(**items))
    plain = _weights(NetworkConfig(**meta["network"]), params, meta)
    weights.write(pathlib.Path(folder) / str(step) / weights.NAME, plain)


def _weights(config: NetworkConfig, params: Any, meta: dict[str, Any]) -> Weights:
    return Weights(dataclasses.asdict(config), weights.flat(params), meta)


def _unreadable(path: pathlib.Path, what: str, error: Exception) -> CheckpointError:
    line = (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
    return CheckpointError(f"checkpoint {path} cannot be {what} ({line})")


def _latest(folder: pathlib.Path) -> tuple[pathlib.Path, int, dict[str, Any]]:
    """The newest complete step of a folder and its meta, checked."""
    step = int(newest_step(folder).name)
    try:
        with _manager(folder, None, create=False) as manager:
            meta = manager.restore(
                step, args=ocp.args.Composite(meta=ocp.args.JsonRestore())
            )["meta"]
    except Exception as error:  # orbax and tensorstore raise many kinds
        what = "read: its meta is damaged"
        raise _unreadable(folder / str(step), what, error) from error
    if not isinstance(meta, dict) or meta.get("schema") != SCHEMA:
        raise CheckpointError(
            f"checkpoint {folder / str(step)} is not a jaxcal policy: its schema is "
            f"{meta.get('schema')!r}, not {SCHEMA!r}"
        )
    if meta.get("version") != VERSION:
        raise CheckpointError(
            f"checkpoint {folder / str(step)} has version {meta.get('version')!r}; "
            f"this jaxcal reads version {VERSION}"
        )
    return folder / str(step), step, meta


def load(folder: str | pathlib.Path | None = None) -> Policy:
    """The newest policy in a folder.

    Args:
        folder: a checkpoint folder or a training run's; the one that ships when None.

    Raises:
        CheckpointError: there is none, it is damaged, or another version made it.
    """
    root = resolve(folder)
    path, step, meta = _latest(root)
    try:
        config = NetworkConfig(**meta["network"])
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"checkpoint {path} names no network this jaxcal knows: {error}"
        ) from error
    try:
        with _late_reads_ignored():
            params = jax.tree.map(jax.numpy.asarray, _plain_policy(path / "policy"))
    except Exception as error:  # orbax and tensorstore raise many kinds
        raise _unreadable(path, "read: its weights are damaged", error) from error
    network = build(config)
    _check_weights(path, params, network, meta)
    return Policy(network, params, meta, root, step)


def as_weights(policy: Policy) -> Weights:
    """A policy as plain arrays, which ``policy.npz`` holds."""
    return _weights(policy.network.config, policy.params, policy.meta)


def fingerprint(folder: str | pathlib.Path | None = None) -> str:
    """SHA-256 of a policy's network and weights, the same wherever it lies.

    Raises:
        CheckpointError: see ``load``.
    """
    return as_weights(load(folder)).fingerprint


def _check_weights(
    path: pathlib.Path, params: Any, network: Network, meta: dict[str, Any]
) -> None:
    """Refuse weights that the network cannot use."""
    try:
        env = meta["tasks"][0]["environment"]
        m, n, k = env["num_candidates"], env["num_inputs"], env["num_selected"]
    except (KeyError, IndexError, TypeError) as error:
        raise CheckpointError(
            f"checkpoint {path} does not say what it was trained on: no {error}"
        ) from error
    expected = jax.eval_shape(
        lambda: networks.initial(network, jax.random.key(0), m, n, k)
    )
    wanted = {
        jax.tree_util.keystr(name, simple=True, separator="."): leaf.shape
        for name, leaf in jax.tree_util.tree_leaves_with_path(expected)
    }
    arrays = weights.flat(params)
    held = {name: array.shape for name, array in arrays.items()}
    if wanted != held:
        name = sorted(set(wanted.items()) ^ set(held.items()))[0][0]
        raise CheckpointError(
            f"checkpoint {path} does not fit its network: {name} has shape "
            f"{held.get(name)}, the network wants {wanted.get(name)}"
        )
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise CheckpointError(
                f"checkpoint {path} holds weights that are not finite, in {name}"
            )


def export(run: str | pathlib.Path, folder: str | pathlib.Path) -> None:
    """Write a run's policy alone, without its training state, to another folder.

    Args:
        run: a training run's folder.
        folder: becomes a checkpoint folder with one step; one that is there is replaced
            after the new one is complete.
    """
    policy = load(run)
    target = pathlib.Path(folder)
    target.parent.mkdir(parents=True, exist_ok=True)
    own = {"schema", "version", "created", "versions"}
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


def restore(folder: str | pathlib.Path, fresh: Any) -> tuple[Any, dict[str, Any]]:
    """The training state of the newest step, and its meta.

    Args:
        folder: as for ``load``.
        fresh: a state of the same structure, for shapes and types.

    Raises:
        CheckpointError: none, damaged, or one without a training state.
    """
    root = resolve(folder)
    path, step, meta = _latest(root)
    if not (path / "state").exists():
        raise CheckpointError(
            f"checkpoint {path} holds a policy but no training state to resume from"
        )
    try:
        with _late_reads_ignored(), _manager(root, None, create=False) as manager:
            plain = manager.restore(
                step,
                args=ocp.args.Composite(
                    state=ocp.args.StandardRestore(_plain_keys(fresh))
                ),
            )["state"]
    except Exception as error:  # orbax and tensorstore raise many kinds
        what = "resumed: its training state is damaged or of another configuration"
        raise _unreadable(path, what, error) from error
    state = jax.tree.map(
        lambda new, old: (
            jax.random.wrap_key_data(jax.numpy.asarray(old))
            if jax.dtypes.issubdtype(new.dtype, jax.dtypes.prng_key)
            else jax.numpy.asarray(old)
        ),
        fresh,
        plain,
    )
    return state, meta


def main(argv: list[str]) -> int:
    """Add the weights file to the newest step of a checkpoint or run folder."""
    if len(argv) != 1 or argv[0].startswith("-"):
        print((__doc__ or "").partition("\n\n    ")[2].strip())
        return 2
    try:
        policy = load(argv[0])
        path = policy.folder / str(policy.step) / weights.NAME
        weights.write(path, as_weights(policy))
    except (CheckpointError, OSError) as error:
        print(f"checkpoint: {error}", file=sys.stderr)
        return 2
    print(f"wrote {path}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
