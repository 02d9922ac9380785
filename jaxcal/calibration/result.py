"""``Calibration``: what ``identify`` returns and what users hold."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from jaxcal.calibration import file, inverse, table
from jaxcal.calibration.fit import AffineFit

if TYPE_CHECKING:
    from typing import Self

__all__ = ["Calibration"]


class Calibration(AffineFit):
    """The identified map from commands u (n inputs) to postures y (m outputs).

    Data, uncertainty and prediction are those of :class:`AffineFit`; the inverse map,
    the printed table and the file are functions of their own modules.
    """

    command_for = inverse.command_for
    summary = table.summary
    __repr__ = table.summary
    to_frame = table.to_frame
    to_dict = file.to_dict
    save = file.save

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Self:
        """The inverse of ``to_dict``.

        Raises:
            ValueError: it is not a calibration, of another version, or damaged; the
                message names the key.
        """
        return cls(**file.fields(content))

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Read a file that ``save`` wrote.

        Raises:
            OSError: it cannot be read.
            ValueError: as of ``from_dict``; the message names the file too.
        """
        return cls(**file.read(path))
