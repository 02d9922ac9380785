"""Any function, simulator or program as a model, by finite differences."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import (
    Array,
    axis_names,
    in_words,
    levels,
    require_kind,
    table,
    whole_number,
)
from jaxcal.models.differences import STENCILS, Differences, combined, look
from jaxcal.models.model import (
    Fitting,
    FunctionModel,
    Theta,
    as_commands,
    as_parameters,
    by_name,
    checked_periods,
)
from jaxcal.models.runs import CommandLine, Runs
from jaxcal.models.uncertainty import Noise, Prior, as_noise

_PILOTS = 4  # commands at which steps are chosen
_ROUGH = 0.1  # of the largest derivative: a difference between orders that is told
_LONG = 512  # rows of a table that is remembered as a whole
_SETS = 6  # of parameters whose results are kept in memory


class FunctionFitting(Fitting):
    """How far a function can be differenced, and where it fails."""

    model: FromFunction

    @property
    def off_by(self) -> Array | None:
        return self.model.scale if self.model._stated else None

    @property
    def resolution(self) -> float:
        """Share by which derivatives are off; 0 before the first."""
        steps = self.model._steps.get("parameters")
        return 0.0 if steps is None else min(steps.error, 1.0)

    @property
    def rounding(self) -> Array | None:
        """(q,) noise of f, where it is more than that of double precision."""
        steps = self.model._steps.get("parameters")
        if steps is None or not (steps.noise > 1e-11 * steps.size).any():
            return None
        return steps.noise

    def unanswered(self, commands: Array, parameters: Theta = None) -> dict[int, str]:
        """Rows of commands (N, n) for which f fails at or near parameters, and why."""
        model = self.model
        slopes = model.jacobian(commands, as_parameters(model, parameters))
        rows = model._asked(commands)
        return {
            int(i): model._reasons.get(rows[i].tobytes(), "it fails")
            for i in np.flatnonzero(np.isnan(slopes).any(axis=(1, 2)))
        }


class FromFunction(FunctionModel):
    """``y = f(u, theta)`` of any function or program; derivatives by differences.

    Steps are chosen from the noise of f at the first derivative; ``differences`` lists
    them with the errors of derivatives. Commands for which f raises, or returns values
    that are not finite, are left out of a selection and named.

    Args:
        f: function of one command (n,) and parameters (p,) that returns the q readings,
            or a program that prints them: its arguments with ``{name}`` for values.
        nominal: (p,) parameters of the machine as it was designed.
        scale: (p,) how far off each parameter may be, of which steps are a small part;
            by default a tenth of the nominal value, which then must not be 0.
        names: of the parameters; by default t1, t2, ...
        inputs: names of the n commands, which a program needs, or n; by default that of
            the first commands.
        batch: f takes commands (N, n) and returns (N, q).
        noise, prior: the usual ones, defaults of ``select`` and ``identify``.
        periods: (q,) or one for all readings that wrap: 360 degrees, inf of others.
        processes: number that run f; f must then be importable. Or an executor of
            ``concurrent.futures``, such as a cluster's, which you close.
        quiet: no progress on standard error.
    """

    title = "of a function"
    _kind_written, _counted_by = "function", "inputs"

    def __init__(
        self,
        f: Callable[..., Any] | str | Sequence[str],
        nominal: ArrayLike,
        scale: ArrayLike | None = None,
        names: Sequence[str] | None = None,
        *,
        inputs: Sequence[str] | int | None = None,
        batch: bool = False,
        noise: Noise | None = None,
        prior: Prior | None = None,
        periods: ArrayLike | None = None,
        processes: int | Executor = 1,
        quiet: bool = False,
    ) -> None:
        super().__init__(nominal, names, periods)
        self.scale = self._scale(scale)
        self._stated = scale is not None
        self.inputs = ()  # names of the commands, where they have some
        if isinstance(inputs, int):
            self._num_inputs = whole_number("inputs", inputs, 1)
        elif inputs is not None:
            self.inputs = axis_names("inputs", inputs, "u", len(inputs))
            self._num_inputs = len(self.inputs)
        if not callable(f):
            if not self.inputs or batch:
                raise ValueError(
                    "a program needs inputs=[...], the names of its commands, and "
                    "takes one command at a time"
                )
            f = CommandLine(f, (*self.inputs, *self.names))
        noise = as_noise(noise)
        require_kind("prior", prior, Prior)
        self._noise, self._prior = noise, prior
        if not isinstance(processes, Executor):
            processes = whole_number("processes", processes, 1)
        self._runs = Runs(f, bool(batch), processes, quiet)
        self.f = f
        self._reasons: dict[bytes, str] = {}  # why f fails, by command
        self._results: dict[tuple[str, bytes], dict[bytes, Array]] = {}
        self._steps: dict[str, Differences] = {}

    # -- shapes ------------------------------------------------------------------------

    @property
    def num_outputs(self) -> int:
        """q; 0 before the first run."""
        return self._runs.num_outputs or 0

    # -- f and its derivatives ---------------------------------------------------------

    def predict(self, commands: ArrayLike, parameters: Theta = None) -> Array:
        """Outputs (N, q) at commands (N, n), NaN where f fails."""
        return self._remembered("values", commands, parameters)

    def jacobian(self, commands: ArrayLike, parameters: Theta = None) -> Array:
        """(N, q, p), NaN where f fails."""
        return self._remembered("parameters", commands, parameters)

    def command_jacobian(self, commands: ArrayLike, parameters: Theta = None) -> Array:
        """(N, q, n), NaN where f fails."""
        return self._remembered("commands", commands, parameters)

    def differences(
        self, commands: ArrayLike, parameters: ArrayLike | None = None
    ) -> Differences:
        """How derivatives by the parameters are taken; chosen at these commands, if not
        at earlier ones."""
        rows, theta = self._asked(commands), as_parameters(self, parameters)
        return self._steps_for("parameters", rows, theta)

    @property
    def fitting(self) -> FunctionFitting:
        return FunctionFitting(self)

    def parameter_sizes(self) -> Array:
        """(p,) the scale."""
        return self.scale

    def default_prior(self) -> Prior:
        """The prior as given, else infinite standard deviations."""
        return super().default_prior() if self._prior is None else self._prior

    def default_noise(self) -> Noise | None:
        """The noise as given."""
        return self._noise

    def close(self) -> None:
        """End the processes that run f, if they are not yours; they start if asked."""
        self._runs.close()

    # -- inside ------------------------------------------------------------------------

    def _scale(self, scale: ArrayLike | None) -> Array:
        if scale is not None:
            return levels("scale", scale, len(self.nominal)).copy()
        zero = np.flatnonzero(self.nominal == 0.0)
        if zero.size:
            raise ValueError(
                f"scale must be given, because {self.names[zero[0]]} is nominally 0: "
                "how far off may each parameter be?"
            )
        return np.asarray(0.1 * np.abs(self.nominal))

    def _asked(self, commands: ArrayLike) -> Array:
        if self._num_inputs is None:
            self._num_inputs = table("commands", by_name(self, commands)).shape[1]
        rows = as_commands(self, commands)
        if not len(rows):
            raise ValueError("commands must hold at least one row, got none")
        return rows

    def _remembered(
        self, what: str, commands: ArrayLike, parameters: ArrayLike | None
    ) -> Array:
        """(N, ...) values, or derivatives by parameters or commands. Kept for the last
        sets of parameters: by command, of a long table as a whole."""
        rows, theta = self._asked(commands), as_parameters(self, parameters)
        whole = len(rows) > _LONG
        key = what, theta.tobytes() + (rows.tobytes() if whole else b"")
        results = self._results.pop(key, {})
        self._results[key] = results  # the newest
        while len(self._results) > 3 * _SETS:
            del self._results[next(iter(self._results))]
        if whole:
            if not results:
                results[b""] = self._computed(what, rows, theta)
            return results[b""]
        labels = [row.tobytes() for row in rows]
        places = {label: i for i, label in enumerate(labels) if label not in results}
        if places:
            new = self._computed(what, rows[[*places.values()]], theta)
            results |= dict(zip(places, new, strict=True))
        return np.array([results[x] for x in labels])

    def _run(self, jobs: list[tuple[Array, Array]]) -> list[Array]:
        """(N, q) of each job."""
        values, reasons = self._runs(jobs)
        for (rows, _), why in zip(jobs, reasons, strict=True):
            for i, reason in why.items():
                self._reasons[rows[i].tobytes()] = reason
        if self._given_periods is not None:
            checked_periods(self._given_periods, self.num_outputs)
        return values

    def _computed(self, what: str, rows: Array, theta: Array) -> Array:
        """(N, q) values, or (N, q, p) or (N, q, n) derivatives."""
        if what == "values":
            return self._run([(rows, theta)])[0]
        steps = self._steps_for(what, rows, theta)

        def run(at: Array, directions: Iterable[tuple[int, str]]) -> list[Array]:
            """(N, q) at four places in each direction, from its side."""
            moves = [
                offset * steps.steps[j] * np.eye(len(steps.steps))[j]
                for j, side in directions
                for offset in STENCILS[side].offsets
            ]
            if what == "parameters":
                return self._run([(at, theta + move) for move in moves])
            there = np.concatenate([at + move for move in moves])  # in one call of f
            return np.split(self._run([(there, theta)])[0], len(moves))

        values = np.array(run(rows, enumerate(steps.sides)))
        sides = np.array([[*STENCILS].index(side) for side in steps.sides])
        sides = np.repeat(sides[:, None], len(rows), axis=1)
        failed = np.asarray(np.isnan(values).any(axis=(0, 2)))
        if failed.any():  # at an edge of what f takes?
            failed[failed] = ~np.isnan(self.predict(rows[failed], theta)).any(axis=1)
            for j in range(len(steps.steps)):
                its = values[4 * j : 4 * j + 4]
                for side in ("forward", "backward"):
                    lost = failed & np.isnan(its).any(axis=(0, 2))
                    if lost.any():
                        its[:, lost] = run(rows[lost], [(j, side)])
                        sides[j, lost] = [*STENCILS].index(side)
        return self._slopes(steps, rows, values, sides)

    def _slopes(
        self,
        steps: Differences,
        rows: Array,
        values: Array,
        sides: NDArray[np.intp],
    ) -> Array:
        """(N, q, p) of values (4 p, N, q), by ``sides`` (p, N), numbers of stencils."""
        slopes = np.empty((*values[0].shape, len(steps.steps)))
        rough = np.empty_like(slopes)
        for j, step in enumerate(steps.steps):
            stack = values[4 * j : 4 * j + 4]
            for side, stencil in enumerate(STENCILS.values()):
                at: Any = sides[j] == side
                if not at.any():
                    continue
                at = slice(None) if at.all() else at
                weights = np.array([stencil.fine, stencil.coarse]) / step
                fine, coarse = combined(stack[:, at], weights, self.periods)
                slopes[at, :, j], rough[at, :, j] = fine, coarse
        with np.errstate(invalid="ignore"):
            largest = np.nanmax(np.abs(slopes), axis=0, initial=0.0)  # (q, p)
            apart = np.abs(slopes - rough)
            floor = np.maximum(_ROUGH * largest, 8.0 * steps.rounding())
            jumps = np.argwhere((apart > floor).any(axis=1))
        if len(jumps):
            i, j = jumps[0]
            others = len({*jumps[:, 0]}) - 1
            warnings.warn(
                f"f is not smooth in {steps.names[j]} at the command "
                f"{in_words(rows[i])}{f' and {others} others' if others else ''}: its "
                "derivative there may be wrong (a reading that wraps around needs "
                "periods=)",
                stacklevel=4,
            )
        # A derivative that is the noise of f for all commands is none.
        return np.where(largest <= steps.rounding(), 0.0 * slopes, slopes)

    def _steps_for(self, what: str, rows: Array, theta: Array) -> Differences:
        """The steps, chosen where f does not fail."""
        if what in self._steps:
            return self._steps[what]
        # Far from each other in the table, and more of them where f fails.
        order = np.argsort((np.arange(len(rows)) * 0.6180339887) % 1.0)
        pilots: list[int] = []
        for first in range(0, len(rows), _PILOTS):
            trial = order[first : first + _PILOTS]
            outputs = self.predict(rows[trial], theta)
            pilots += trial[np.isfinite(outputs).all(axis=1)].tolist()
            if len(pilots) >= _PILOTS:
                break
        if not pilots:
            raise ValueError(
                f"f fails for all {len(rows)} commands; for {in_words(rows[0])}: "
                f"{self._reasons[rows[0].tobytes()]}"
            )
        at, n = rows[pilots[:_PILOTS]], rows.shape[1]

        def by_parameters(points: Array) -> Array:
            return np.array(self._run([(at, point) for point in points]))

        def by_commands(points: Array) -> Array:
            moved = (at + points[:, None]).reshape(-1, n)
            return self._run([(moved, theta)])[0].reshape(len(points), len(at), -1)

        if what == "parameters":
            where = by_parameters, theta, self.scale, self.names
        else:
            names = self.inputs or tuple(f"command {i + 1}" for i in range(n))
            where = by_commands, np.zeros(n), self._spread(rows), names
        self._steps[what] = steps = look(*where, self.periods)
        return steps

    @staticmethod
    def _spread(rows: Array) -> Array:
        """(n,) a tenth of what the commands spread over, else of their size, else 1."""
        spread, size = np.ptp(rows, axis=0), np.abs(rows).max(axis=0)
        whole = np.where(spread > 1e-6 * size, spread, size)
        return 0.1 * np.where(whole > 0.0, whole, 1.0)
