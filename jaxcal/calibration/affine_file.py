"""What the file of an affine calibration (version 1) holds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from jaxcal.calibration import file
from jaxcal.calibration.affine import AffineFit

__all__ = ["SCHEMA", "fields", "to_dict"]

SCHEMA = file.Schema(
    version=1,
    shapes={
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
    },
    counts={"noise_dof": 0, "dof": 0, "num_measurements": 1},
    switches=("noise_known",),
    may_be_null=("noise_std", "residual_std", "residual_std_overall"),
    not_negative=("noise_std", "residual_std", "residual_std_overall"),
    positive=("scale", "condition_number", "scaled_condition_number", "total_weight"),
)


def to_dict(self: AffineFit) -> dict[str, Any]:
    """The content of the file: names, numbers and lists, as JSON has them."""
    content = file.content_of(self, SCHEMA)
    covariance = self.covariance
    content["derived"] = {
        "parameter_names": list(self.parameter_names),
        "parameters": self.parameters.tolist(),
        "covariance": None if covariance is None else covariance.tolist(),
    }
    return content


def fields(content: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of a calibration; a noise level must be given or have freedom."""
    found = file.fields(content, SCHEMA)
    if found["noise_known"] and found["noise_std"] is None:
        raise ValueError('"noise_known" is true but "noise_std" is null')
    sources = [("residual_std", "dof"), ("residual_std_overall", "dof")]
    if not found["noise_known"]:
        sources.append(("noise_std", "noise_dof"))
    for key, freedom in sources:
        if (found[key] is None) != (found[freedom] == 0):
            raise ValueError(f'"{key}" and "{freedom}" contradict each other')
    return found
