"""Where a checkpoint lies, without reading it."""

from __future__ import annotations

import pathlib

__all__ = ["CheckpointError", "default_folder", "newest_step", "resolve"]


class CheckpointError(ValueError):
    """A checkpoint that is missing, damaged, or made by another version."""


def default_folder(name: str = "default") -> pathlib.Path:
    """A checkpoint that ships: inside the installed package, or in the repository.

    Args:
        name: "default", the only one.
    """
    package = pathlib.Path(__file__).resolve().parents[2]
    inside = package / "checkpoints" / name
    return inside if inside.is_dir() else package.parent / "checkpoints" / name


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
    """The folder of the newest complete step.

    Args:
        folder: from ``resolve``.

    Raises:
        CheckpointError: there is no step.
    """
    steps = [p for p in folder.iterdir() if p.name.isdigit() and p.is_dir()]
    if not steps:
        raise CheckpointError(f"checkpoint folder {folder} holds no checkpoint")
    return max(steps, key=lambda step: int(step.name))
