"""``--model``: a model from a file."""

from __future__ import annotations

import argparse
import json
import pathlib

from jaxcal.models import Model, SerialChain, from_dict

__all__ = ["add_model", "read_model"]


def add_model(parser: argparse.ArgumentParser) -> None:
    """The flag."""
    what = "model: JSON of its to_dict(), or an arm's .urdf; y = A u + b by default"
    parser.add_argument("--model", metavar="FILE", help=what)


def read_model(path: str | None) -> Model | None:
    """The model in a file; None without one.

    Raises:
        OSError: the file cannot be read.
        ValueError: naming the file and what is wrong in it.
    """
    if path is None:
        return None
    if path.lower().endswith(".urdf"):
        return SerialChain.from_urdf(path)
    try:
        read = json.loads(pathlib.Path(path).read_text(encoding="utf-8"))
    except ValueError:
        raise ValueError(
            f"{path}: a model must be a JSON file of its to_dict(), or an arm's .urdf"
        ) from None
    if isinstance(read, dict) and read.get("format") == "jaxcal-calibration":
        raise ValueError(
            f"{path}: a model is needed, this is a calibration; commands that apply "
            "one are predict and command"
        )
    try:
        return from_dict(read)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
