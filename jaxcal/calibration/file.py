"""A calibration as a versioned JSON file: reading, writing, and what is refused.

Everything under ``derived`` is for other programs to read and is ignored on loading.
"""

from __future__ import annotations

import contextlib
import copy
import json
import os
import pathlib
import typing
from collections.abc import Mapping
from typing import Any, NoReturn

import numpy as np

from jaxcal.calibration.fit import Fit
from jaxcal.calibration.fit_problem import LOSSES
from jaxcal.files import AnyPath, write_text
from jaxcal.models.model import Model, as_model, from_dict

FORMAT = "jaxcal-calibration"
VERSION = 3

_NUMBERS = {
    name: hint
    for name, hint in typing.get_type_hints(Fit, include_extras=True).items()
    if typing.get_origin(hint) is typing.Annotated
}
_NAMES = {"input_names": "n", "output_names": "m"}
_KINDS = {
    "command_unit": (str, "text"),
    "measured_unit": (str, "text"),
    "loss": (str, "text"),
    "provenance": (dict, "an object"),
}


def to_dict(fit: Fit) -> dict[str, Any]:
    """The content of the file: names, numbers and lists, as JSON has them."""
    content: dict[str, Any] = {"format": FORMAT, "version": VERSION}
    for key in (*_NAMES, *_NUMBERS, *_KINDS):
        value = copy.deepcopy(getattr(fit, key))
        array = isinstance(value, np.ndarray | tuple)
        content[key] = np.asarray(value).tolist() if array else value
    content["model"] = fit.model.to_dict()
    covariance = fit.covariance
    content["derived"] = {
        "parameter_names": list(fit.names),
        "parameters": fit.parameters.tolist(),
        "covariance": None if covariance is None else covariance.tolist(),
    }
    if fit.affine is not None:
        content["derived"]["matrix"] = fit.matrix.tolist()
        content["derived"]["bias"] = fit.bias.tolist()
    return content


def save(fit: Fit, path: AnyPath) -> None:
    """Write a versioned JSON file atomically; after an OSError the old one stays."""
    write_text(path, json.dumps(to_dict(fit), indent=1, allow_nan=False) + "\n")


def read(path: AnyPath) -> Any:
    """The JSON of a file; a ValueError names the file."""

    def constant(text: str) -> NoReturn:
        raise ValueError(f"holds {text}, where only finite numbers are allowed")

    data = pathlib.Path(path).read_bytes()
    try:
        return json.loads(data.decode("utf-8-sig"), parse_constant=constant)
    except (ValueError, RecursionError) as error:
        raise ValueError(
            f"{os.fspath(path)}: not JSON: {error}; `jaxcal identify ... --out FILE` "
            "writes a calibration"
        ) from None


def fields(content: Any, model: Model | None = None) -> dict[str, Any]:
    """The arguments of a calibration from what ``to_dict`` made, checked; ``model``
    where the file cannot hold it."""
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise ValueError(f'not a calibration: "format" is not "{FORMAT}"')
    version = content.get("version")
    if version != VERSION:
        newer = isinstance(version, int) and version > VERSION
        raise ValueError(
            f"calibration file version {version!r}, this jaxcal reads version "
            f"{VERSION}: {'update jaxcal, or ' * newer}identify again from the "
            "measurements"
        )
    values = _checked_values(content)
    names = content["derived"].get("parameter_names")
    model = from_dict(content["model"]) if model is None else as_model(model)
    if list(model.names) != names:
        raise ValueError(
            f"model must have the parameters of the file, {names}, got {model.names}"
        )
    size = len(values["estimate"])
    if size not in (len(names), len(model.fitting.misfit_model().names)):
        raise ValueError(f'"estimate" must have shape ({len(names)},)')
    if (values["noise_std"] is None) != (values["joint_covariance"] is None):
        raise ValueError('"noise_std" and "joint_covariance" contradict each other')
    return values | {"model": model}


def _checked_values(content: Mapping[str, Any]) -> dict[str, Any]:
    """Numbers, names and kinds of the file, of the shapes and types that they have."""
    values: dict[str, Any] = {}
    for key in (*_NUMBERS, *_NAMES, *_KINDS):
        if key not in content:
            raise ValueError(f'key "{key}" is missing')
        values[key] = content[key]

    def require(holds: bool, key: str, rule: str) -> None:
        if not holds:
            raise ValueError(f'"{key}" must {rule}, got {content.get(key)!r}')

    sizes: dict[str, int] = {}
    for key, hint in _NUMBERS.items():
        shape, least = (*hint.__metadata__, -np.inf)[:2]
        if values[key] is None and type(None) in typing.get_args(hint.__origin__):
            continue
        array = _array(key, values[key], shape, sizes)
        require(bool((array >= least).all()), key, f"be at least {least:g}")
        values[key] = array if shape else float(array)
    for key, letter in _NAMES.items():
        names, count = values[key], sizes[letter]
        kinds = [type(name) for name in names] if isinstance(names, list) else None
        require(kinds == [str] * count, key, f"hold {count} names")
        values[key] = tuple(names)
    for key, (kind, what) in _KINDS.items():
        require(isinstance(values[key], kind), key, f"be {what}")
    require(values["loss"] in LOSSES, "loss", f"be {' or '.join(LOSSES)}")
    for key in ("model", "derived"):
        require(isinstance(content.get(key), dict), key, "be an object")
    return values


def _array(key: str, value: Any, shape: str, sizes: dict[str, int]) -> Any:
    """float64 array with an axis per letter; sizes not known yet are learned."""
    with contextlib.suppress(ValueError):  # of rows of different lengths
        array = np.asarray(value)
        if array.dtype.kind in "if" and array.ndim == len(shape):
            pairs = zip(shape, array.shape, strict=True)
            fits = all(size and sizes.setdefault(x, size) == size for x, size in pairs)
            if fits and np.isfinite(array).all():
                return array.astype(np.float64)
    wanted = ", ".join(str(sizes.get(letter, letter)) for letter in shape)
    raise ValueError(f'"{key}" must hold finite numbers of shape ({wanted})')
