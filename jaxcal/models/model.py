"""``Model``: what comes out of a command, ``y = f(u; theta)``, and what follows.

A model gives its names, outputs and derivatives; everything else that ``select`` and
``identify`` ask has a default here. ``as_model`` gives the defaults to an object that
is not of this class.
"""

from __future__ import annotations

import abc
import functools
import os
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import Array, array_of, axis_names, one_or_each, require_none
from jaxcal.models.recording import Recording
from jaxcal.models.uncertainty import Noise, Prior
from jaxcal.tables import COMMANDS, header_of, of_frame

Rows = NDArray[np.intp]
Theta = ArrayLike | None  # parameters (p,); None: the nominal ones

_NOTHING_KNOWN = Prior(np.inf)


class ErrorGroups(NamedTuple):
    """Parameters whose prior has one unknown scale: ``Prior.sized()``."""

    members: NDArray[np.int64]  # (p,) the group of each parameter from 0, -1 of none
    medians: Array  # (G,) of the factor of each group, before measuring
    spreads: Array  # (G,) the factor that is one standard deviation of it


class Quantity(NamedTuple):
    """Readings of one unit, whose error is one number."""

    unit: str
    columns: slice = slice(None)  # of the readings
    points: int = 1  # whose root mean square it is, as a board's corners

    def size(self, off: Array) -> Array:
        """(...) how large differences of readings (..., q) are in this unit."""
        return np.linalg.norm(off[..., self.columns], axis=-1) / np.sqrt(self.points)


class Model(abc.ABC):
    """n commands, p parameters, q outputs; everything is float64 in the caller's units.

    A model of one's own has ``names`` of the parameters, their ``nominal`` (p,),
    ``num_inputs``, ``num_outputs``, ``predict``, ``jacobian`` and ``command_jacobian``;
    the rest has defaults. ``inputs`` are n names of the commands' columns, () where
    they have none. ``parameters=None`` stands for ``nominal`` in every method.
    """

    if TYPE_CHECKING:  # attributes or properties of every model

        @property
        def names(self) -> tuple[str, ...]: ...
        @property
        def nominal(self) -> Array: ...
        @property
        def num_inputs(self) -> int: ...
        @property
        def num_outputs(self) -> int: ...

    inputs: Any = ()

    # -- f and its derivatives ---------------------------------------------------------

    @abc.abstractmethod
    def predict(self, commands: ArrayLike, parameters: Theta = None) -> Array:
        """Outputs (N, q) at commands (N, n)."""

    @abc.abstractmethod
    def jacobian(self, commands: ArrayLike, parameters: Theta = None) -> Array:
        """(N, q, p) derivative of the outputs by the parameters."""

    @abc.abstractmethod
    def command_jacobian(self, commands: ArrayLike, parameters: Theta = None) -> Array:
        """(N, q, n) derivative of the outputs by the commands."""

    def leverage_slopes(
        self, commands: Array, parameters: Array, white: Array, metric: Array
    ) -> Array | None:
        """(N, n) slopes by commands of ``trace(B metric B.T)``, ``B = white @ J``.

        J is the Jacobian (q, p) at a command, white (q, q). None: by differences.
        """
        return None

    # -- names -------------------------------------------------------------------------

    @functools.cached_property  # which an attribute may replace
    def num_parameters(self) -> int:
        """p."""
        return len(self.names)

    @property
    def title(self) -> str:
        """The model in the first line of a calibration's summary."""
        return f"of {self._kind}"

    def units_for(self, command_unit: str, measured_unit: str) -> tuple[str, ...]:
        """p units of the parameters, "" where not known."""
        return tuple(getattr(self, "units", ("",) * len(self.names)))

    def quantities(self, measured_unit: str) -> tuple[Quantity, ...]:
        """What the readings are of, each with its unit: one where all share it."""
        return (Quantity(measured_unit),)

    def accuracy_units(self, measured_unit: str) -> tuple[str, ...]:
        """Units in which ``identify`` may be asked for an accuracy; () of none."""
        return ()

    def meanings(self, inputs: Sequence[str], outputs: Sequence[str]) -> list[str]:
        """p meanings of the parameters in a summary; [] where the names tell."""
        return []

    def to_dict(self) -> dict[str, Any]:
        """JSON with a ``kind``; ``jaxcal.models.from_dict`` reads it."""
        return {"kind": type(self).__name__}

    # -- what is known before measuring ------------------------------------------------

    def default_prior(self) -> Prior:
        """Infinite standard deviations where nothing is known."""
        return _NOTHING_KNOWN

    def default_noise(self) -> Noise | None:
        """The usual noise of a reading; None where nothing is known."""
        return None

    def parameter_sizes(self) -> Array:
        """(p,) in which derivatives are compared: those below 1e-14 are rounding.

        The default prior's std, else the nominal value; NaN where neither says how
        large, or where derivatives are exact: then zero alone is no effect.
        """
        if self.linear:
            return np.full(len(self.names), np.nan)
        nominal = np.abs(self.nominal)
        precision = self.default_prior().resolve(self).precisions
        with np.errstate(divide="ignore"):
            sizes = np.where(precision > 0.0, 1.0 / np.sqrt(precision), nominal)
        return np.where(sizes > 0.0, sizes, np.nan)

    def facts(self, parameters: ArrayLike | None = None) -> tuple[Array, Array]:
        """What is known besides the prior: (F,) how far off it is and (F, p) its
        derivative, in standard deviations."""
        return np.zeros(0), np.zeros((0, len(self.names)))

    def error_groups(self) -> ErrorGroups | None:
        """The scales that ``Prior.sized()`` takes from the readings; None without."""
        return None

    def log_size(self, commands: Array, parameters: Array) -> Array | None:
        """Logarithm (N,) of what contacts' readings, near zero, grow with.

        A fit compares them (what is below four times ``default_noise``) with the
        machine's size, or a smaller machine would always fit better. None: readings are
        as large as they are.
        """
        return None

    def log_size_jacobian(self, commands: Array, parameters: Array) -> Array:
        """(N, p) derivative of ``log_size``, zero by parameters at which it is held."""
        return np.zeros((len(commands), len(self.names)))

    # -- readings that wrap, and a model that can only be run --------------------------

    @property
    def periods(self) -> Array | None:
        """(q,) of readings that wrap, as 360 degrees, inf of others; None: of none."""
        return None

    def wrapped(self, off: Array, commands: Array) -> Array:
        """(N, q) differences of readings, those that wrap within half a period."""
        return within_half(off, self.periods)

    @property
    def resolution(self) -> float:
        """Share by which derivatives are off where they are differences, else 0."""
        return 0.0

    @property
    def rounding(self) -> Array | None:
        """(q,) standard deviation of the model's own noise, as of a program that prints
        six digits; None: as exact as numbers are."""
        return None

    def unanswered(
        self, commands: Array, parameters: ArrayLike | None = None
    ) -> dict[int, str]:
        """Rows of commands (N, n) for which the model fails, and why."""
        return {}

    # -- the commands and readings of a fit or a choice --------------------------------

    @property
    def sensed(self) -> slice:
        """Columns of the commands that come with a reading: what was touched, seen."""
        return slice(0, 0)

    def anew(self, commands: Array, measured: Array) -> Model:
        """The model as ``prepared`` has it, where its sensor stood before forgotten."""
        return self

    def prepared(self, commands: Array, measured: Array | None = None) -> Model:
        """This model where the commands (and readings) show that its sensor stands.

        Raises:
            ValueError: no such machine can take the commands, or give the readings; it
                says which.
        """
        self.require_commands(commands)
        return self

    def require_commands(self, commands: Array) -> None:
        """Refuse commands (N, n) that the machine cannot take, naming one."""
        return

    def recorded(self, recording: Recording) -> tuple[Array, Array | None]:
        """Commands (N, n) of a recording, and readings (N, q) if it has them."""
        raise self._no_arm()

    def distinct(self, commands: Array, measured: Array) -> Rows:
        """(K,) the rows that count; the same contact written twice counts once."""
        return np.arange(len(commands))

    # -- linear models -----------------------------------------------------------------

    @property
    def linear(self) -> bool:
        """Whether ``f(u; theta) = J(u) theta``, and the derivatives J are exact."""
        return False

    def centred(self, centre: Array) -> Array | None:
        """(p, p) with ``f(u; theta) = f(u - centre; centred(centre) @ theta)``, or
        None."""
        return None

    @property
    def multiplicity(self) -> int:
        """m where ``blocks`` hold a regressor that all outputs share, else 0."""
        return 0

    def blocks(self, commands: ArrayLike) -> Array:
        """(..., N, 1, r) of each output by itself, with unit noise."""
        raise NotImplementedError("the outputs share no regressor")  # multiplicity 0

    def affine(self, parameters: Array) -> tuple[Array, Array] | None:
        """A (m, n) and b (m,) of a model ``y = A u + b``; None for any other."""
        return None

    # -- what no parameter explains ----------------------------------------------------

    @property
    def misfit_std(self) -> float:
        """Standard deviation of a reading by what ``with_misfit()`` does not hold."""
        return 0.0

    @property
    def fits_misfit(self) -> bool:
        """Whether without a prior the parameters of ``with_misfit()`` are fitted."""
        return False

    def with_misfit(self) -> Model:
        """This model with more parameters, which come last: what the others leave."""
        return self

    def improved(self, fit: Any) -> Any:
        """A ``jaxcal.Calibration`` by default prior and noise, or a better one."""
        return fit

    def unexplained(self, fit: Any, rows: Array) -> Array:
        """(N, q) std of predictions by what neither parameters nor noise explain."""
        return np.zeros((len(rows), self.num_outputs))

    # -- a calibrated machine ----------------------------------------------------------

    @property
    def placed(self) -> tuple[str, ...]:
        """Names of the parameters of what stands around the machine."""
        return ()

    @property
    def slips(self) -> tuple[str, ...]:
        """Names of the parameters that change alone when something slips."""
        return ()

    @property
    def relative(self) -> bool:
        """Whether readings are relative to the commands, as the turns of a pose."""
        return False

    def targets(
        self, desired: Array, start: Array | None
    ) -> Callable[[Array, Rows], Array]:
        """f(commands (R, n), rows (R,)) -> (R, q), what the machine answers there if it
        reaches those rows of ``desired`` (P, q); ``start`` (P, n) of the searches."""
        return lambda commands, rows: desired[rows]

    def verdict(self, fit: Any) -> Any:
        """Whether a ``jaxcal.Calibration`` can be trusted: a ``Verdict`` of this kind
        of model; None: by the rules for every model."""
        return None

    def of_chain(self, fit: Any, tip: str) -> dict[str, Any]:
        """The fields of a ``jaxcal.Calibration`` that are of one of several chains."""
        raise ValueError(f"the model must be Chains, got {self._kind}")

    def calibrated(self, parameters: ArrayLike) -> Model:
        """The machine whose nominal is this one's with ``parameters``."""
        raise self._no_arm()

    def writable(self) -> Model:
        """This model without the parameters that no file of ``write`` holds."""
        return self

    def standing_as(self, other: Any, parameters: Array, commands: Array) -> Array:
        """(p,) ``parameters`` with the machine moved as a whole to where ``other`` is;
        ``commands`` (N, n) show the range of what has no limits."""
        return parameters

    def write(
        self, form: str, path: Any, parameters: ArrayLike, *, force: bool = False
    ) -> str:
        """Write the machine with ``parameters`` in a form that its controller reads."""
        raise self._no_arm()

    @property
    def _kind(self) -> str:
        return type(self).__name__

    def _no_arm(self) -> ValueError:
        return ValueError(f"the model must be an arm, got {self._kind}")


class _Adapter(Model):
    """A model of another class, with the defaults for what it has not."""

    def __init__(self, own: Any) -> None:
        self._own = own

    def __getattribute__(self, name: str) -> Any:
        if not name.startswith("_"):
            try:
                return getattr(object.__getattribute__(self, "_own"), name)
            except AttributeError:
                pass
        return object.__getattribute__(self, name)

    @property
    def _kind(self) -> str:
        return type(self._own).__name__

    # The object has them, or ``as_model`` refuses it.
    predict = jacobian = command_jacobian = None  # type: ignore[assignment]


def as_model(model: Any) -> Model:
    """``model`` itself, or with the defaults of ``Model`` if it is another object.

    Raises:
        ValueError: it is a class, or lacks a method that has no default.
    """
    if isinstance(model, Model):
        return model
    methods = ("predict", "jacobian", "command_jacobian")
    missing = [name for name in methods if not callable(getattr(model, name, None))]
    if missing or isinstance(model, type):
        got = repr(model) if isinstance(model, type) else type(model).__name__
        raise ValueError(
            "model must be of jaxcal.models, or an object with the methods of "
            f"jaxcal.models.Model, got {got}"
            + (f" without {missing[0]}" if missing else "")
            + ("; use FromFunction(f, nominal)" if callable(model) else "")
            + (f"; use Linear({model!r})" if isinstance(model, str) else "")
        )
    return _Adapter(model)


def as_commands(model: Any, commands: ArrayLike) -> Array:
    """``commands`` as finite float64 (N, n); of a data frame the model's columns."""
    commands = by_name(model, commands)
    rule = " for this model"
    return array_of("commands", commands, "N", model.num_inputs, rule=rule)


def as_parameters(model: Model, parameters: ArrayLike | None) -> Array:
    """``parameters`` as finite float64 (p,); the nominal ones for None."""
    if parameters is None:
        return model.nominal
    size = model.num_parameters
    return array_of("parameters", parameters, size, rule=" for this model")


def parameter_names(names: Sequence[str] | None, count: int, letter: str = "t") -> Any:
    """``count`` different names; t1, t2, ... when not given."""
    labels = [f"{letter}{i + 1}" for i in range(count)] if names is None else names
    return axis_names("terms" if letter == "f" else "names", labels, letter, count)


def by_name(model: Any, commands: Any) -> Any:
    """The model's columns of a data frame, in its order; else as given."""
    inputs = getattr(model, "inputs", ())
    levels = getattr(model, "levels", ())
    if not inputs:
        return commands
    return of_frame("commands", commands, inputs, COMMANDS, levels=levels)


def recorded(model: Any, commands: Any, measured: Any) -> tuple[Any, Any, bool]:
    """Commands and readings as given, or those of a ``Recording`` or of its path; and
    whether they were recorded. Readings that are given count; contacts need none."""
    is_recording = isinstance(commands, Recording)
    if isinstance(commands, str | os.PathLike):
        commands, is_recording = Recording(commands), True
    if is_recording:
        if model is None:
            raise ValueError("commands are a recording: model must be an arm")
        commands, read = as_model(model).recorded(commands)
        measured = read if measured is None else measured
    elif measured is None and getattr(
        getattr(model, "sensor", None), "contacts", False
    ):
        measured = np.zeros((len(commands), model.num_outputs))
    if measured is None and header_of("commands", commands):
        measured = commands  # a table of both, y_... what was measured
    if measured is None:
        raise ValueError("measured is missing: the readings at each of the commands")
    return commands, measured, is_recording


def within_half(off: Array, periods: ArrayLike | None) -> Array:
    """(..., q) differences, those of readings that wrap within half a period (q,)."""
    if periods is None:
        return off
    wraps = np.isfinite(periods)
    whole = np.where(wraps, periods, 1.0)
    return np.asarray(np.where(wraps, off - whole * np.round(off / whole), off))


def checked_periods(periods: ArrayLike, count: int) -> Array:
    """(q,) positive numbers, one for all or one each, inf of what does not wrap."""
    given = one_or_each("periods", periods, count)
    require_none(~(given > 0.0), given, "periods must be positive (inf: does not wrap)")
    return given
