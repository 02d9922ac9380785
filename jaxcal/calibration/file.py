"""A calibration as a versioned JSON file: what is in it, and what is refused.

Everything under ``derived`` is for other programs to read and is ignored on loading.
"""

from __future__ import annotations

import json
import os
import pathlib
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from jaxcal.files import write_text

if TYPE_CHECKING:
    from jaxcal.calibration.identify import Calibration

__all__ = ["FORMAT", "VERSION", "load", "save"]

FORMAT = "jaxcal-calibration"
VERSION = 1

# Shapes of the arrays, in terms of n inputs, m outputs and any number N of rows.
_ARRAYS: dict[str, tuple[str, ...]] = {
    "matrix": ("m", "n"),
    "bias": ("m",),
    "residuals": ("N", "m"),
    "centre": ("n",),
    "scale": ("n",),
    "slope_covariance": ("n", "n"),
}
_OPTIONAL_ARRAYS = {"noise_std": ("m",), "residual_std": ("m",)}
_POSITIVE = {"condition_number", "scaled_condition_number", "total_weight"}
_COUNTS = {"noise_dof": 0, "dof": 0, "num_measurements": 1}
_TEXTS = ("command_unit", "measured_unit")


def save(calibration: Calibration, path: str | os.PathLike[str]) -> None:
    """Write the file atomically."""
    content: dict[str, Any] = {"format": FORMAT, "version": VERSION}
    content |= {name: getattr(calibration, name).tolist() for name in _ARRAYS}
    for name in _OPTIONAL_ARRAYS:
        value = getattr(calibration, name)
        content[name] = None if value is None else value.tolist()
    for name in ("noise_known", "residual_std_overall", *_POSITIVE, *_COUNTS, *_TEXTS):
        content[name] = getattr(calibration, name)
    content["input_names"] = list(calibration.input_names)
    content["output_names"] = list(calibration.output_names)
    content["provenance"] = dict(calibration.provenance)
    covariance = calibration.covariance
    content["derived"] = {
        "parameter_names": list(calibration.parameter_names),
        "parameters": calibration.parameters.tolist(),
        "covariance": None if covariance is None else covariance.tolist(),
    }
    head = ["format", "version", "input_names", "output_names", *_TEXTS]
    ordered = {key: content[key] for key in [*head, *(k for k in content)]}
    write_text(path, json.dumps(ordered, indent=1, allow_nan=False) + "\n")


def load(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The fields of a ``Calibration``, checked.

    Raises:
        OSError: the file cannot be read.
        ValueError: naming the file and what is wrong in it.
    """
    where = os.fspath(path)

    def fail(problem: str) -> NoReturn:
        raise ValueError(f"{where}: {problem}") from None

    def constant(text: str) -> NoReturn:
        fail(f"holds {text}, where only finite numbers are allowed")

    data = pathlib.Path(path).read_bytes()
    try:
        content = json.loads(data.decode("utf-8"), parse_constant=constant)
    except json.JSONDecodeError as error:
        fail(f"not JSON: {error.msg} in line {error.lineno}")
    except (UnicodeDecodeError, RecursionError):
        fail("not JSON: not text")
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        fail(f'not a calibration: "format" is not "{FORMAT}"')
    if content.get("version") != VERSION:
        fail(
            f"a calibration of version {content.get('version')!r}, this jaxcal reads "
            f"version {VERSION}"
        )
    try:
        return _fields(content)
    except ValueError as error:
        fail(str(error))


def _fields(content: dict[str, Any]) -> dict[str, Any]:
    def get(key: str) -> Any:
        if key not in content:
            raise ValueError(f'key "{key}" is missing')
        return content[key]

    fields: dict[str, Any] = {}
    sizes: dict[str, int] = {}
    for key, shape in _ARRAYS.items():
        fields[key] = _array(key, get(key), shape, sizes)
    for key, shape in _OPTIONAL_ARRAYS.items():
        value = get(key)
        fields[key] = None if value is None else _array(key, value, shape, sizes)
        if value is not None and (fields[key] < 0.0).any():
            raise ValueError(f'"{key}" must not be negative')
    if (fields["scale"] <= 0.0).any():
        raise ValueError('"scale" must be positive')
    for key in _POSITIVE:
        fields[key] = _number(key, get(key))
        if fields[key] <= 0.0:
            raise ValueError(f'"{key}" must be positive, got {fields[key]}')
    for key, least in _COUNTS.items():
        value = get(key)
        if type(value) is not int or value < least:
            raise ValueError(
                f'"{key}" must be a whole number >= {least}, got {value!r}'
            )
        fields[key] = value
    overall = get("residual_std_overall")
    fields["residual_std_overall"] = (
        None if overall is None else _number("residual_std_overall", overall)
    )
    if not isinstance(get("noise_known"), bool):
        raise ValueError(
            f'"noise_known" must be true or false, got {get("noise_known")}'
        )
    fields["noise_known"] = get("noise_known")
    _consistent_noise(fields)
    for key in _TEXTS:
        if not isinstance(get(key), str):
            raise ValueError(f'"{key}" must be text, got {get(key)!r}')
        fields[key] = get(key)
    for key, size in (("input_names", sizes["n"]), ("output_names", sizes["m"])):
        names = get(key)
        if (
            not isinstance(names, list)
            or len(names) != size
            or not all(isinstance(name, str) for name in names)
        ):
            raise ValueError(f'"{key}" must hold {size} names, got {names!r}')
        fields[key] = tuple(names)
    if not isinstance(get("provenance"), dict):
        raise ValueError('"provenance" must be an object')
    fields["provenance"] = get("provenance")
    return fields


def _consistent_noise(fields: dict[str, Any]) -> None:
    """A noise level must have a source: given, or degrees of freedom."""
    if fields["noise_known"] and fields["noise_std"] is None:
        raise ValueError('"noise_known" is true but "noise_std" is null')
    if not fields["noise_known"] and (fields["noise_std"] is None) != (
        fields["noise_dof"] == 0
    ):
        raise ValueError('"noise_std" and "noise_dof" contradict each other')
    for key in ("residual_std", "residual_std_overall"):
        if (fields[key] is None) != (fields["dof"] == 0):
            raise ValueError(f'"{key}" and "dof" contradict each other')


def _number(key: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f'"{key}" must be a number, got {value!r}')
    if not np.isfinite(float(value)):
        raise ValueError(f'"{key}" must be finite, got {value}')
    return float(value)


def _array(
    key: str, value: Any, shape: tuple[str, ...], sizes: dict[str, int]
) -> NDArray[np.float64]:
    """Numbers of the shape named; sizes not known yet are learned."""
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
    array = array.astype(np.float64)
    array.setflags(write=False)
    return array
