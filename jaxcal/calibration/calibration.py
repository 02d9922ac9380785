"""``Calibration``: a fit with its inverse, its judges, what it prints and its file."""

from __future__ import annotations

import functools
import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.calibration import file
from jaxcal.calibration.check import check, verification
from jaxcal.calibration.estimate import fit_model
from jaxcal.calibration.file import save, to_dict
from jaxcal.calibration.fit import Fit
from jaxcal.calibration.inverse import command_for
from jaxcal.calibration.summary import summary
from jaxcal.calibration.verdict import verdict
from jaxcal.models import Model, Noise, SerialChain

__all__ = ["Calibration"]

Array = NDArray[np.float64]


class Calibration(Fit):
    """The identified map from commands u (n inputs) to outputs y (m of them).

    ``y = f(u; theta)`` with the most probable p parameters; printed, they come with
    their intervals. ``identify`` makes it; see :class:`Fit` for its fields.
    """

    def __repr__(self) -> str:
        return self.summary()

    command_for = command_for
    verdict = functools.cached_property(verdict)
    check = check
    verification = verification
    to_dict = to_dict
    save = save

    def summary(self) -> str:
        """The parameters with their 95 % intervals, the noise and the fit, as text."""
        return summary(self, self.verdict)

    # -- an arm, written back ----------------------------------------------------------

    @property
    def arm(self) -> SerialChain:
        """The arm as calibrated, its parameters nominal, with Position()."""
        self._chain()
        return self.whole.calibrated(self.estimate)  # type: ignore[attr-defined]  # a chain

    def to_urdf(self, path: str | os.PathLike[str], *, force: bool = False) -> str:
        """The arm's own file, corrected; see :meth:`jaxcal.models.SerialChain.write`.

        Returns the tip link.
        """
        return self._chain().write("urdf", path, self.parameters, force=force)

    def to_dh(self, path: str | os.PathLike[str], *, force: bool = False) -> None:
        """The DH table as CSV, fitted without harmonics."""
        self._chain().write("dh", path, self._of_table(), force=force)

    def to_ur_kinematics(
        self, path: str | os.PathLike[str], *, force: bool = False
    ) -> None:
        """Universal Robots' kinematics file, likewise."""
        self._chain().write("ur", path, self._of_table(), force=force)

    def _of_table(self) -> Array:
        """(p,) for a file, which holds no harmonics: fitted without them."""
        if self.whole is self.model:
            return self.parameters
        found = fit_model(
            self.commands,
            self.residuals + self.predict(self.commands),
            (self.loss_weights > 0.0).astype(np.float64),
            model=self.model,
            prior=self.model.default_prior(),
            noise=Noise(std=self.noise_std) if self.noise_known else None,
            loss=self.loss,
            common_noise=None,
        )
        return np.asarray(found["estimate"])

    def _chain(self) -> SerialChain:
        if not isinstance(self.model, SerialChain):
            raise ValueError(
                f"the model must be an arm, got {type(self.model).__name__}"
            )
        return self.model

    # -- from a file -------------------------------------------------------------------

    @classmethod
    def load(
        cls, path: str | os.PathLike[str], *, model: Model | None = None
    ) -> Calibration:
        """Read a file that ``save`` wrote.

        Args:
            path: the file.
            model: the model, where it holds a function, which no file can.

        Raises:
            OSError: it cannot be read.
            ValueError: as of ``from_dict``; the message names the file too.
        """
        content = file.read(path)
        try:
            return cls.from_dict(content, model=model)
        except ValueError as error:
            raise ValueError(f"{os.fspath(path)}: {error}") from None

    @classmethod
    def from_dict(cls, content: Any, *, model: Model | None = None) -> Calibration:
        """The inverse of ``to_dict``.

        Raises:
            ValueError: it is not a calibration, of another version, or damaged; the
                message names the key.
        """
        return cls(**file.fields(content, model))
