"""Paths of checkpoints, and a policy as one plain file; needs no JAX and no orbax.

A weights file (``.npz``) holds the weights by flat name (``encoder_0.mix.kernel``) and
``header``: JSON with format, version, network, meta and SHA-256 of network and weights.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import pathlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.files import atomic_write

_FORMAT = "jaxcal-policy-weights"
_VERSION = 2

Arrays = dict[str, NDArray[Any]]


class CheckpointError(ValueError):
    """A checkpoint that is missing, damaged, or made by another version."""


def shipped(name: str = "default") -> pathlib.Path:
    """Path of a policy that ships, in the installed package or in the repository."""
    package = pathlib.Path(__file__).resolve().parents[2]
    inside = package / "checkpoints" / f"{name}.npz"
    return inside if inside.is_file() else package.parent / "checkpoints" / inside.name


def locate(checkpoint: str | pathlib.Path | None) -> pathlib.Path:
    """Path of a weights file, or of the newest step of a run, see ``steps``."""
    return steps(checkpoint)[0]


def steps(checkpoint: str | pathlib.Path | None) -> list[pathlib.Path]:
    """Paths of a run's steps, the newest first, or of a weights file; ``checkpoint``
    may also be a run's checkpoint folder or a step in that, None what ships."""
    path = shipped() if checkpoint is None else pathlib.Path(checkpoint)
    if path.is_file() or (path / "meta" / "metadata").is_file():
        return [path]
    if not path.is_dir():
        hint = " (train one with: jaxcal train)" if checkpoint is None else ""
        raise CheckpointError(f"checkpoint {path} does not exist{hint}")
    folder = path / "checkpoint" if (path / "checkpoint").is_dir() else path
    held = [p for p in folder.iterdir() if p.name.isdigit() and p.is_dir()]
    if not held:
        raise CheckpointError(f"checkpoint folder {folder} holds no checkpoint")
    return sorted(held, key=lambda step: int(step.name), reverse=True)


@dataclasses.dataclass(frozen=True)
class Weights:
    """A trained policy as plain arrays."""

    network: dict[str, Any]  # fields of a ``NetworkConfig``
    arrays: Arrays  # by flat name
    meta: dict[str, Any]  # of the checkpoint

    @property
    def fingerprint(self) -> str:
        """SHA-256 of network and weights."""
        digest = hashlib.sha256(json.dumps(self.network, sort_keys=True).encode())
        for name, array in sorted(self.arrays.items()):
            digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()


def write(path: str | pathlib.Path, weights: Weights) -> None:
    """Write a weights file, NAME.npz, atomically; an existing one is replaced."""
    if not str(path).endswith(".npz"):
        raise ValueError(f"the exported policy must be one file NAME.npz, got {path}")
    pathlib.Path(path).parent.mkdir(parents=True, exist_ok=True)
    header = {"format": _FORMAT, "version": _VERSION, "sha256": weights.fingerprint}
    header |= {"network": weights.network, "meta": weights.meta}
    text = np.frombuffer(json.dumps(header).encode(), np.uint8)
    arrays: dict[str, Any] = {"header": text, **weights.arrays}
    with atomic_write(path) as file:
        np.savez(file, **arrays)


def read(path: str | pathlib.Path) -> Weights:
    """Read a weights file; CheckpointError where damaged or of another version."""
    data = pathlib.Path(path).read_bytes()
    try:
        with np.load(io.BytesIO(data)) as file:
            arrays = {name: file[name] for name in file.files}
        header = json.loads(arrays.pop("header").tobytes())
        version = header["format"], header["version"]
        weights = Weights(header["network"], arrays, header["meta"])
        stated = header["sha256"]
    except Exception as error:  # zipfile and numpy raise many kinds
        raise CheckpointError(_damaged(path, type(error).__name__)) from error
    if version != (_FORMAT, _VERSION):
        raise CheckpointError(
            f"weights file {path} must be of format {_FORMAT} {_VERSION}, got "
            f"{version[0]} {version[1]}"
        )
    if weights.fingerprint != stated:
        raise CheckpointError(_damaged(path, "SHA-256 differs"))
    return weights


def require_trained_by_d(path: str | pathlib.Path, meta: dict[str, Any]) -> None:
    """Refuse a policy that an earlier jaxcal trained by A, I or E; removes the field
    ``criterion`` of its network and environments, which is gone."""
    tasks = (task["environment"] for task in meta.get("tasks", ()))
    for held in (meta.get("network", {}), *tasks):
        if (criterion := held.pop("criterion", "D")) != "D":
            version = meta.get("versions", {}).get("jaxcal", "an earlier version")
            raise CheckpointError(
                f"checkpoint {path} was trained for criterion {criterion} by jaxcal "
                f"{version}; this jaxcal reads policies trained for D: train one with "
                "jaxcal train, or with a reward of your own (docs/learning.md)"
            )


def _damaged(path: str | pathlib.Path, what: str) -> str:
    return f"weights file {path} is damaged ({what}): export or copy it again"
