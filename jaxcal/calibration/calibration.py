"""``Calibration``: a fit with its inverse, its judges, what it prints and its file."""

from __future__ import annotations

import functools
import os
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.calibration import file
from jaxcal.calibration.check import Check, check, verification
from jaxcal.calibration.estimate import fit_model
from jaxcal.calibration.fit import Fit
from jaxcal.calibration.inverse import Carry, limits_of, reach, solve_affine
from jaxcal.calibration.summary import summary
from jaxcal.calibration.verdict import Verdict, verdict
from jaxcal.models import Affine, Model, Noise, Pose, SerialChain

__all__ = ["Calibration"]

Array = NDArray[np.float64]


class Calibration(Fit):
    """The identified map from commands u (n inputs) to outputs y (m of them).

    ``y = f(u; theta)`` with the most probable p parameters; printed, they come with
    their intervals. ``identify`` makes it; see :class:`Fit` for its fields.
    """

    def __repr__(self) -> str:
        return self.summary()

    # -- the inverse -------------------------------------------------------------------

    def command_for(
        self,
        desired: ArrayLike,
        limits: ArrayLike | None = None,
        *,
        start: ArrayLike | None = None,
        clip: bool = False,
        max_condition: float = 1e6,
    ) -> Array:
        """Commands that reach desired outputs.

        Of a square affine map its inverse, else Newton's method from several starts;
        within limits the nearest output.

        Args:
            desired: (..., m) in the measured unit; m at most n. Where m is less than n
                the command is the one that Newton's method finds near the start. Of an
                arm's pose, position and turn from the nominal orientation at ``start``,
                which then must be given, as ``model.rotation_vectors(start, R)``.
            limits: (n, 2) least and greatest command of each input, if any.
            start: (n,) or (..., n) where the search begins; the measured command whose
                output is nearest when not given.
            clip: where the limits leave no exact command, the one within them whose
                output is nearest, instead of refusing.
            max_condition: greatest condition number of the derivative by the commands,
                in units of their spread and with rows of equal size, that is accepted.

        Returns:
            (..., n) in the command unit.

        Raises:
            ValueError: a desired output is out of reach, or needs a command beyond its
                limits; an output does not respond there; m exceeds n.
        """
        n, m = self.num_inputs, self.num_outputs
        wanted = self.points("desired", desired, m)
        if m > n:
            raise ValueError(
                f"command_for needs at most as many outputs as inputs, got {m} and {n}"
            )
        begin = None
        if isinstance(self.model, Affine) and m == n:
            begin = solve_affine(self, wanted.reshape(-1, m), max_condition)
        elif start is not None:
            points = self.points("start", start, n)
            begin = np.broadcast_to(points, (*wanted.shape[:-1], n)).reshape(-1, n)
        commands = reach(
            self.whole,
            self.estimate,
            self.commands,
            wanted.reshape(-1, m),
            self.input_names,
            begin=begin,
            bounds=None if limits is None else limits_of(limits, self.input_names),
            clip=clip,
            max_condition=max_condition,
            carry=self._carry(wanted.reshape(-1, m), begin),
        )
        return commands.reshape(*wanted.shape[:-1], n)

    def _carry(self, wanted: Array, start: Array | None) -> Carry | None:
        """Of an arm's pose, whose orientations are relative to the commands."""
        arm = self.model
        if not (isinstance(arm, SerialChain) and isinstance(arm.sensor, Pose)):
            return None
        if start is None:
            raise ValueError(
                "start must be given for an arm's pose: the joints at whose nominal "
                "orientation desired is a turn, as rotation_vectors(start, R) makes it"
            )
        rotations = arm.rotations(start, wanted[:, 3:])

        def carry(commands: Array, rows: NDArray[np.intp]) -> Array:
            turns = arm.rotation_vectors(commands, rotations[rows])
            return np.hstack([wanted[rows, :3], turns])

        return carry

    # -- can it be trusted -------------------------------------------------------------

    @functools.cached_property
    def verdict(self) -> Verdict | None:
        """Of an arm: does its model explain the readings, does it help, what is wrong.

        Held-out errors with an interval beside those of the nominal arm, the scatter
        against the sensor's usual noise, and by name: outliers, contacts of another
        socket, a socket that was moved, parameters far from what was known. None for
        other models, and where the noise is unknown.
        """
        return verdict(self)

    def check(
        self,
        commands: ArrayLike,
        measured: ArrayLike,
        *,
        tolerance: float | None = None,
        placed_anew: bool = False,
    ) -> Check:
        """Does the calibration still hold, by a few new measurements.

        A chi-square test (F where the noise was estimated) of the readings against the
        predictions, with the uncertainty of both, at 5 % false alarms.

        Args:
            commands: (N, n).
            measured: (N, m) readings there.
            tolerance: how far, root mean square over the calibration's commands, the
                outputs may drift; three times the noise when not given.
            placed_anew: of an arm, what its sensor reads (sockets, planes, anchors)
                stands elsewhere than at the calibration.

        Returns:
            "holds", "does not hold", or "cannot be told": a drift of one parameter by
            more than the tolerance would be seen with less than 80 % probability.
        """
        return check(self, commands, measured, tolerance, placed_anew)

    def verification(
        self,
        candidates: ArrayLike,
        k: int,
        *,
        region: ArrayLike | None = None,
        tolerance: float | None = None,
    ) -> NDArray[np.int64]:
        """The k of the candidates that show best that the calibration is wrong.

        Args:
            candidates: (M, n) commands that could be measured.
            k: three or four see what six random ones see.
            region: (R, n) commands where it is used, which say how much a drift of a
                parameter matters; those of the calibration when not given.
            tolerance: the drift to be seen, as of :meth:`check`.

        Returns:
            (k,) indices.
        """
        return verification(self, candidates, k, region, tolerance)

    # -- an arm, written back ----------------------------------------------------------

    @property
    def arm(self) -> SerialChain:
        """The arm as calibrated, its parameters nominal, with Position()."""
        self._chain()
        return self.whole.calibrated(self.estimate)  # type: ignore[attr-defined]  # a chain

    def to_urdf(self, path: str | os.PathLike[str], *, force: bool = False) -> str:
        """See :meth:`jaxcal.models.SerialChain.to_urdf`; returns the tip link."""
        return self._chain().to_urdf(path, self.parameters, force=force)

    def to_dh(self, path: str | os.PathLike[str], *, force: bool = False) -> None:
        """See :meth:`jaxcal.models.SerialChain.to_dh`; fitted without harmonics."""
        self._chain().to_dh(path, self._of_table(), force=force)

    def to_ur_kinematics(
        self, path: str | os.PathLike[str], *, force: bool = False
    ) -> None:
        """See :meth:`jaxcal.models.SerialChain.to_ur_kinematics`."""
        self._chain().to_ur_kinematics(path, self._of_table(), force=force)

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

    # -- printed, and as a file --------------------------------------------------------

    def summary(self) -> str:
        """The parameters with their 95 % intervals, the noise and the fit, as text."""
        return summary(self, self.verdict)

    def to_dict(self) -> dict[str, Any]:
        """The content of the file: names, numbers and lists, as JSON has them."""
        return file.content_of(self)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a versioned JSON file atomically; see ``docs/calibration.md``.

        Raises:
            OSError: the folder is missing, not writable or full; the old file stays.
        """
        file.write(path, self.to_dict())

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
