"""Where a checkpoint lies, and its weights in a plain file: no JAX, no orbax.

``policy.npz`` lies in a step's folder beside what orbax wrote there. It holds the
weights by flat name (``encoder_0.mix.kernel``) and ``header``: JSON with the format,
its version, the fields of the ``NetworkConfig``, the checkpoint's meta and the SHA-256
of network and weights, by which damage is found.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.files import atomic_write

__all__ = [
    "NAME",
    "CheckpointError",
    "Weights",
    "default_folder",
    "flat",
    "locate",
    "newest_step",
    "read",
    "resolve",
    "shipped",
    "write",
]

NAME = "policy.npz"
_FORMAT = "jaxcal-policy-weights"
_VERSION = 1

Arrays = dict[str, NDArray[Any]]


class CheckpointError(ValueError):
    """A checkpoint that is missing, damaged, or made by another version."""


def shipped(name: str) -> pathlib.Path:
    """A checkpoint that ships: in the installed package, or in the repository."""
    package = pathlib.Path(__file__).resolve().parents[2]
    inside = package / "checkpoints" / name
    return inside if inside.is_dir() else package.parent / "checkpoints" / name


def default_folder() -> pathlib.Path:
    """The checkpoint of postures that ships."""
    return shipped("default")


def resolve(folder: str | pathlib.Path | None) -> pathlib.Path:
    """The folder with the numbered steps: the one given, or its ``checkpoint``.

    Args:
        folder: a checkpoint folder or a training run's; the one that ships when None.

    Raises:
        CheckpointError: it does not exist.
    """
    path = default_folder() if folder is None else pathlib.Path(folder)
    if not path.is_dir():
        hint = " (train one with: python train.py)" if folder is None else ""
        raise CheckpointError(f"checkpoint folder {path} does not exist{hint}")
    return path / "checkpoint" if (path / "checkpoint").is_dir() else path


def newest_step(folder: pathlib.Path) -> pathlib.Path:
    """The folder of the newest complete step in a folder from ``resolve``."""
    steps = [p for p in folder.iterdir() if p.name.isdigit() and p.is_dir()]
    if not steps:
        raise CheckpointError(f"checkpoint folder {folder} holds no checkpoint")
    return max(steps, key=lambda step: int(step.name))


@dataclasses.dataclass(frozen=True)
class Weights:
    """A trained policy as plain arrays."""

    network: dict[str, Any]  # fields of a ``NetworkConfig``
    arrays: Arrays  # by flat name
    meta: dict[str, Any]  # of the checkpoint

    @property
    def fingerprint(self) -> str:
        """SHA-256 of network and weights, the same wherever they lie."""
        digest = hashlib.sha256(json.dumps(self.network, sort_keys=True).encode())
        for name, array in sorted(self.arrays.items()):
            digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()


def flat(tree: Mapping[str, Any], above: str = "") -> Arrays:
    """Nested dictionaries of arrays as one, names joined by dots."""
    arrays: Arrays = {}
    for name, part in tree.items():
        if isinstance(part, Mapping):
            arrays |= flat(part, f"{above}{name}.")
        else:
            arrays[above + name] = np.asarray(part)
    return arrays


def locate(checkpoint: str | pathlib.Path | None) -> pathlib.Path:
    """Where the weights file of a checkpoint is, or would be.

    Args:
        checkpoint: a checkpoint folder, a training run's or the file itself; the
            checkpoint that ships when None.

    Raises:
        CheckpointError: there is no such folder, or no step in it.
    """
    if checkpoint is not None and pathlib.Path(checkpoint).is_file():
        return pathlib.Path(checkpoint)
    return newest_step(resolve(checkpoint)) / NAME


def write(path: str | pathlib.Path, weights: Weights) -> None:
    """Write a weights file atomically."""
    header = {
        "format": _FORMAT,
        "version": _VERSION,
        "sha256": weights.fingerprint,
        "network": weights.network,
        "meta": weights.meta,
    }
    text = np.frombuffer(json.dumps(header).encode(), np.uint8)
    arrays: dict[str, Any] = {"header": text, **weights.arrays}
    with atomic_write(path) as file:
        np.savez(file, **arrays)


def read(path: str | pathlib.Path) -> Weights:
    """Read a weights file.

    Raises:
        CheckpointError: it is damaged, or no weights file of this version.
        OSError: it cannot be read.
    """
    data = pathlib.Path(path).read_bytes()
    try:
        with np.load(io.BytesIO(data)) as file:
            arrays = {name: file[name] for name in file.files}
        header = json.loads(arrays.pop("header").tobytes())
        found = header["format"], header["version"]
        weights = Weights(header["network"], arrays, header["meta"])
        stated = header["sha256"]
    except Exception as error:  # zipfile and numpy raise many kinds
        raise CheckpointError(_damaged(path, type(error).__name__)) from error
    if found != (_FORMAT, _VERSION):
        raise CheckpointError(
            f"weights file {path} must be of format {_FORMAT} {_VERSION}, got "
            f"{found[0]} {found[1]}"
        )
    if weights.fingerprint != stated:
        raise CheckpointError(_damaged(path, "SHA-256 differs"))
    return weights


def _damaged(path: str | pathlib.Path, what: str) -> str:
    return (
        f"weights file {path} is damaged ({what}): write it again with python -m "
        f"jaxcal.learning.training.checkpoint {pathlib.Path(path).parent.parent}"
    )
