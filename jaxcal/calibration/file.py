"""A calibration as a versioned JSON file: reading, writing, and what is refused.

Everything under ``derived`` is for other programs to read and is ignored on loading.
"""

from __future__ import annotations

import copy
import dataclasses
import json
import os
import pathlib
from collections.abc import Mapping
from typing import Any, NoReturn

import numpy as np

from jaxcal.files import write_text

__all__ = [
    "FORMAT",
    "Schema",
    "content_of",
    "fields",
    "read",
    "require_version",
    "write",
]

FORMAT = "jaxcal-calibration"
VERSION = 3

_NAMES = {"input_names": "n", "output_names": "m"}
_TEXTS = ("command_unit", "measured_unit")


@dataclasses.dataclass(frozen=True)
class Schema:
    """What a calibration keeps beside its names, units and provenance."""

    # Axes in letters: n inputs, m outputs, p parameters, others any; "" for one number.
    shapes: Mapping[str, str]
    counts: Mapping[str, int]  # whole numbers and their least value
    switches: tuple[str, ...]  # true or false
    may_be_null: tuple[str, ...]
    not_negative: tuple[str, ...]
    positive: tuple[str, ...]


def content_of(calibration: Any, schema: Schema) -> dict[str, Any]:
    """The content of the file: names, numbers and lists, as JSON has them."""
    content: dict[str, Any] = {"format": FORMAT, "version": VERSION}
    content |= {key: list(getattr(calibration, key)) for key in _NAMES}
    for key in (
        *(*_TEXTS, *schema.shapes, *schema.counts, *schema.switches, "provenance"),
    ):
        value = copy.deepcopy(getattr(calibration, key))
        content[key] = value.tolist() if isinstance(value, np.ndarray) else value
    return content


def write(path: str | os.PathLike[str], content: dict[str, Any]) -> None:
    """Write the content atomically."""
    write_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def read(path: str | os.PathLike[str]) -> Any:
    """The JSON of a file; a ValueError names the file."""

    def constant(text: str) -> NoReturn:
        raise ValueError(f"holds {text}, where only finite numbers are allowed")

    data = pathlib.Path(path).read_bytes()
    try:
        return json.loads(data.decode("utf-8"), parse_constant=constant)
    except json.JSONDecodeError as error:
        problem = f"not JSON: {error.msg} in line {error.lineno}"
    except (UnicodeDecodeError, RecursionError):
        problem = "not JSON: not text"
    except ValueError as error:
        problem = str(error)
    raise ValueError(f"{os.fspath(path)}: {problem}")


def require_version(content: Any) -> None:
    """Refuse what is no calibration, or one of another version."""
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise ValueError(f'not a calibration: "format" is not "{FORMAT}"')
    if content.get("version") != VERSION:
        raise ValueError(
            f"a calibration of version {content.get('version')!r}, this jaxcal reads "
            f"version {VERSION}: identify again from the measurements"
        )


def fields(content: Mapping[str, Any], schema: Schema) -> dict[str, Any]:
    """The arguments of a calibration from the content of its file, checked.

    Raises:
        ValueError: naming the key and what is wrong with it.
    """
    found: dict[str, Any] = {}
    keys = (*schema.shapes, *schema.counts, *_TEXTS, *_NAMES, *schema.switches)
    for key in (*keys, "provenance"):
        if key not in content:
            raise ValueError(f'key "{key}" is missing')
        found[key] = content[key]

    def require(holds: bool, key: str, rule: str) -> None:
        if not holds:
            raise ValueError(f'"{key}" must {rule}, got {found[key]!r}')

    sizes: dict[str, int] = {}
    for key, shape in schema.shapes.items():
        if found[key] is None and key in schema.may_be_null:
            continue
        array = _array(key, found[key], shape, sizes)
        require(
            key not in schema.positive or bool((array > 0.0).all()), key, "be positive"
        )
        least = 0.0 if key in schema.not_negative else -np.inf
        require(bool((array >= least).all()), key, "not be negative")
        found[key] = array if shape else float(array)
    for key, least in schema.counts.items():
        whole = type(found[key]) is int and found[key] >= least
        require(whole, key, f"be a whole number >= {least}")
    for key in _TEXTS:
        require(isinstance(found[key], str), key, "be text")
    for key, letter in _NAMES.items():
        kinds = [type(x) for x in found[key]] if isinstance(found[key], list) else None
        require(kinds == [str] * sizes[letter], key, f"hold {sizes[letter]} names")
        found[key] = tuple(found[key])
    for key in schema.switches:
        require(isinstance(found[key], bool), key, "be true or false")
    require(isinstance(found["provenance"], dict), "provenance", "be an object")
    return found


def _array(key: str, value: Any, shape: str, sizes: dict[str, int]) -> Any:
    """float64 array with an axis per letter; sizes not known yet are learned."""
    try:
        array = np.asarray(value)
    except ValueError:
        raise ValueError(f'"{key}" must be rows of equal length') from None
    if array.dtype.kind not in "if":
        raise ValueError(f'"{key}" must hold numbers')
    if array.ndim != len(shape):
        raise ValueError(f'"{key}" must have {len(shape)} axes, got {array.ndim}')
    for letter, size in zip(shape, array.shape, strict=True):
        if size < 1 or sizes.setdefault(letter, size) != size:
            want = ", ".join(str(sizes.get(name, name)) for name in shape)
            raise ValueError(f'"{key}" must have shape ({want}), got {array.shape}')
    if not np.isfinite(array).all():
        raise ValueError(f'"{key}" must be finite')
    return array.astype(np.float64)
