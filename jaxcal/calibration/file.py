"""A calibration as a versioned JSON file: what is in it, and what is refused.

Everything under ``derived`` is for other programs to read and is ignored on loading.
"""

from __future__ import annotations

import copy
import json
import os
import pathlib
from typing import Any, NoReturn

import numpy as np

from jaxcal.calibration.fit import AffineFit
from jaxcal.files import write_text

__all__ = ["FORMAT", "VERSION", "fields", "read", "save", "to_dict"]

FORMAT = "jaxcal-calibration"
VERSION = 1

_NAMES = {"input_names": "n", "output_names": "m"}
_TEXTS = ("command_unit", "measured_unit")
# Shapes in terms of n inputs, m outputs and any number N of rows; "" for one number.
_SHAPES = {
    "matrix": "mn",
    "bias": "m",
    "residuals": "Nm",
    "noise_std": "m",
    "residual_std": "m",
    "residual_std_overall": "",
    "condition_number": "",
    "scaled_condition_number": "",
    "centre": "n",
    "scale": "n",
    "slope_covariance": "nn",
    "total_weight": "",
}
_COUNTS = {"noise_dof": 0, "dof": 0, "num_measurements": 1}  # and their least value
_MAY_BE_NULL = ("noise_std", "residual_std", "residual_std_overall")
_POSITIVE = ("scale", "condition_number", "scaled_condition_number", "total_weight")


def to_dict(self: AffineFit) -> dict[str, Any]:
    """The content of the file: names, numbers and lists, as JSON has them."""
    content: dict[str, Any] = {"format": FORMAT, "version": VERSION}
    content |= {key: list(getattr(self, key)) for key in _NAMES}
    for key in (*_TEXTS, *_SHAPES, *_COUNTS, "noise_known", "provenance"):
        value = copy.deepcopy(getattr(self, key))
        content[key] = value.tolist() if isinstance(value, np.ndarray) else value
    covariance = self.covariance
    content["derived"] = {
        "parameter_names": list(self.parameter_names),
        "parameters": self.parameters.tolist(),
        "covariance": None if covariance is None else covariance.tolist(),
    }
    return content


def save(self: AffineFit, path: str | os.PathLike[str]) -> None:
    """Write a versioned JSON file atomically; see ``docs/calibration.md``.

    Raises:
        OSError: the folder is missing, not writable or full; the old file stays.
    """
    write_text(path, json.dumps(to_dict(self), indent=1, allow_nan=False) + "\n")


def read(path: str | os.PathLike[str]) -> dict[str, Any]:
    """``fields`` of a file; a ValueError names the file as well."""

    def constant(text: str) -> NoReturn:
        raise ValueError(f"holds {text}, where only finite numbers are allowed")

    data = pathlib.Path(path).read_bytes()
    try:
        return fields(json.loads(data.decode("utf-8"), parse_constant=constant))
    except json.JSONDecodeError as error:
        problem = f"not JSON: {error.msg} in line {error.lineno}"
    except (UnicodeDecodeError, RecursionError):
        problem = "not JSON: not text"
    except ValueError as error:
        problem = str(error)
    raise ValueError(f"{os.fspath(path)}: {problem}")


def fields(content: Any) -> dict[str, Any]:
    """The arguments of a calibration from the content of its file, checked.

    Raises:
        ValueError: naming the key and what is wrong with it.
    """
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise ValueError(f'not a calibration: "format" is not "{FORMAT}"')
    if content.get("version") != VERSION:
        raise ValueError(
            f"a calibration of version {content.get('version')!r}, this jaxcal reads "
            f"version {VERSION}"
        )
    found: dict[str, Any] = {}
    for key in (*_SHAPES, *_COUNTS, *_TEXTS, *_NAMES, "noise_known", "provenance"):
        if key not in content:
            raise ValueError(f'key "{key}" is missing')
        found[key] = content[key]

    def require(holds: bool, key: str, rule: str) -> None:
        if not holds:
            raise ValueError(f'"{key}" must {rule}, got {found[key]!r}')

    sizes: dict[str, int] = {}
    for key, shape in _SHAPES.items():
        if found[key] is None and key in _MAY_BE_NULL:
            continue
        array = _array(key, found[key], shape, sizes)
        require(key not in _POSITIVE or bool((array > 0.0).all()), key, "be positive")
        least = 0.0 if key in _MAY_BE_NULL else -np.inf
        require(bool((array >= least).all()), key, "not be negative")
        found[key] = array if shape else float(array)
    for key, least in _COUNTS.items():
        whole = type(found[key]) is int and found[key] >= least
        require(whole, key, f"be a whole number >= {least}")
    for key in _TEXTS:
        require(isinstance(found[key], str), key, "be text")
    for key, letter in _NAMES.items():
        kinds = [type(x) for x in found[key]] if isinstance(found[key], list) else None
        require(kinds == [str] * sizes[letter], key, f"hold {sizes[letter]} names")
        found[key] = tuple(found[key])
    require(isinstance(found["noise_known"], bool), "noise_known", "be true or false")
    require(isinstance(found["provenance"], dict), "provenance", "be an object")
    _require_consistent_noise(found)
    return found


def _require_consistent_noise(found: dict[str, Any]) -> None:
    """A noise level must have a source: given, or degrees of freedom."""
    if found["noise_known"] and found["noise_std"] is None:
        raise ValueError('"noise_known" is true but "noise_std" is null')
    sources = [("residual_std", "dof"), ("residual_std_overall", "dof")]
    if not found["noise_known"]:
        sources.append(("noise_std", "noise_dof"))
    for key, freedom in sources:
        if (found[key] is None) != (found[freedom] == 0):
            raise ValueError(f'"{key}" and "{freedom}" contradict each other')


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
