"""``AffineCalibration``: what ``identify`` returns for ``y = A u + b`` by itself."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from jaxcal.calibration import affine_file, affine_inverse, affine_table
from jaxcal.calibration.affine import AffineFit

__all__ = ["AffineCalibration"]


class AffineCalibration(AffineFit, version=affine_file.SCHEMA.version):
    """The identified map ``y = A u + b``.

    Data, uncertainty and prediction are those of :class:`AffineFit`; the inverse map,
    the printed table and the file are functions of their own modules.
    """

    command_for = affine_inverse.command_for
    summary = affine_table.summary
    _columns = affine_table.columns
    to_dict = affine_file.to_dict

    @classmethod
    def _fields(cls, content: Mapping[str, Any], model: object) -> dict[str, Any]:
        if model is not None:
            raise ValueError(
                "model must be left out: the file is an affine calibration"
            )
        return affine_file.fields(content)
