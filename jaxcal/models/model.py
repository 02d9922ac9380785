"""``Model``: what comes out of a command, ``y = f(u; theta)``, and what follows.

``as_model`` gives the defaults of ``Model`` to an object that is not of this class.
"""

from __future__ import annotations

import abc
import dataclasses
import functools
import os
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import (
    Array,
    array_of,
    axis_names,
    one_of,
    one_or_each,
    require_none,
)
from jaxcal.extras import installed
from jaxcal.models.uncertainty import Noise, Prior
from jaxcal.tables import COMMANDS, header_of, of_frame

Rows = NDArray[np.intp]
Theta = ArrayLike | None  # parameters (p,); None: the nominal ones

_NOTHING_KNOWN = Prior(np.inf)
_GROUP = "jaxcal.models"  # entry points by which others, as jaxcal.arms, add kinds
_KINDS = {"affine": "Affine", "linear": "Linear", "polynomial": "Polynomial"}
_UNWRITTEN = ("function", "jax")  # kinds that hold a function


@dataclasses.dataclass(frozen=True)
class Recording:
    """A recording of an arm that rested at each of several postures, as commands.

    Joints are found by name; readings are the mean over each rest of the bag's points
    or poses (geometry_msgs PointStamped, PoseStamped; of a board in the camera too),
    lengths of a wire (sensor_msgs Range, std_msgs Float64), accelerations (sensor_msgs
    Imu), wrenches (WrenchStamped), in metres, radians, newtons; contacts need none.
    """

    # rosbag2 folder or MCAP file (extra ``ros``), or the folder of a LeRobot dataset
    # (extra ``lerobot``), whose joints are in degrees.
    path: str | os.PathLike[str]
    which: Sequence[int] | None = None  # socket, plane or wire of each rest, in order
    seconds: float = 0.5  # shortest rest
    # Degrees (or units of length) in which a resting joint stays. None: 0.05, or eight
    # times what the joint's readings jitter by.
    within: float | None = None
    # LeRobot's calibration file of an arm whose dataset is in -100 to 100 of each
    # motor's range instead of degrees.
    servos: str | os.PathLike[str] | None = None
    # Of joints recorded under another name: {"Rotation": "shoulder_pan"}.
    names: Mapping[str, str] = dataclasses.field(default_factory=dict)
    topic: str = ""  # of the readings, if the bag has several of this type


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


class Fitting:
    """What a fit, a choice or a check asks of a model besides f: ``model.fitting``.

    These are the answers of most models; arms have their own. A model of one's own that
    answers otherwise has a property ``fitting`` of a class that derives from this.
    """

    off_by: Any = None  # (p,) from nominal, that parameters may be, as stated
    resolution: Any = 0.0  # share by which derivatives by differences err
    rounding: Any = None  # (q,) std of its own noise, as of printed digits
    relative: Any = False  # readings are relative to the commands, as turns
    sensed: Any = slice(0, 0)  # columns of commands that a reading brings
    placed: Any = ()  # parameters of what stands around it
    slips: Any = ()  # parameters that change when something slips
    multiplicity: Any = 0  # m where all outputs share one regressor
    misfit_std: Any = 0.0  # of a reading, what ``misfit_model`` leaves
    fits_misfit: Any = False  # ``misfit_model`` is fitted without a prior
    result_type: Any = None  # the subclass of ``jaxcal.Calibration`` that it gives

    def __init__(self, model: Any) -> None:
        self.model = model

    def units_for(self, command_unit: str, measured_unit: str) -> tuple[str, ...]:
        """p units of the parameters, "" where not known."""
        return tuple(getattr(self.model, "units", ("",) * len(self.model.names)))

    def centred(self, centre: Array) -> Array | None:
        """(p, p) with ``f(u; theta) = f(u - centre; centred(centre) @ theta)``, or
        None."""
        return None

    def misfit_model(self) -> Model:
        """The model with more parameters, which come last: what the others leave."""
        model: Model = self.model
        return model

    def accuracy_units(self, measured_unit: str) -> tuple[str, ...]:
        """Units in which ``identify`` may be asked for an accuracy; () of none."""
        return ()

    def facts(self, parameters: Theta = None) -> tuple[Array, Array]:
        """What is known besides the prior: (F,) how far off it is and (F, p) its
        derivative, in standard deviations."""
        return np.zeros(0), np.zeros((0, len(self.model.names)))

    def error_groups(self) -> ErrorGroups | None:
        """The scales that ``Prior.sized()`` takes from the readings; None without."""
        return None

    def log_size(self, commands: Array, parameters: Array) -> Array | None:
        """Logarithm (N,) of what contacts' readings, near zero, grow with. A fit
        compares them (below four times ``default_noise``) with the machine's size, or a
        smaller one would always fit better. None: readings are as large as they are."""
        return None

    def log_size_jacobian(self, commands: Array, parameters: Array) -> Array:
        """(N, p) derivative of ``log_size``, zero by parameters at which it is held."""
        return np.zeros((len(commands), len(self.model.names)))

    def wrapped(self, off: Array, commands: Array) -> Array:
        """(N, q) differences of readings, those that wrap within half a period."""
        return within_half(off, self.model.periods)

    def unanswered(self, commands: Array, parameters: Theta = None) -> dict[int, str]:
        """Rows of commands (N, n) for which the model fails, and why."""
        return {}

    def apart(self, commands: Array, measured: Array) -> tuple[Array, Array] | None:
        """How far rows are from one another, whatever the parameters: (N, N) by the
        commands and (N, N) by the readings. None where the parameters say that too."""
        return None

    def anew(self, commands: Array, measured: Array) -> Any:
        """The model as ``prepared`` has it, where its sensor stood before forgotten."""
        return self.model

    def prepared(self, commands: Array, measured: Array | None = None) -> Any:
        """The model where the commands (and readings) show that its sensor stands; a
        ValueError where no such machine takes the commands, or gives the readings."""
        self.require_commands(commands)
        return self.model

    def require_commands(self, commands: Array) -> None:
        """Refuse commands (N, n) that the machine cannot take, naming one."""
        return

    def distinct(self, commands: Array, measured: Array) -> Rows:
        """(K,) the rows that count; the same contact written twice counts once."""
        return np.arange(len(commands))

    def improved(self, fit: Any) -> Any:
        """A ``jaxcal.Calibration`` by default prior and noise, or a better one."""
        return fit

    def unexplained(self, fit: Any, rows: Array) -> Array:
        """(N, q) std of predictions by what neither parameters nor noise explain."""
        return np.zeros((len(rows), self.model.num_outputs))

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


def _warn_of_hooks(kind: type) -> None:
    """Say what a class defines that is asked of ``model.fitting``, and not of it."""
    for name, value in vars(kind).items():
        if name in vars(Fitting) and callable(value) and name[0] != "_":
            warnings.warn(
                f"{kind.__name__}.{name} is not used: define it in a class derived "
                "from jaxcal.models.model.Fitting, which the property fitting returns",
                stacklevel=3,
            )


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
    linear: ClassVar[Any] = False  # ``f(u; theta) = J(u) theta``, J exact
    periods: ClassVar[Any] = None  # (q,) of readings that wrap, as 360; inf: does not

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        _warn_of_hooks(cls)

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

    @functools.cached_property  # which an attribute may replace
    def num_parameters(self) -> int:
        """p."""
        return len(self.names)

    @property
    def title(self) -> str:
        """The model in the first line of a calibration's summary."""
        return f"of {self._kind}"

    def quantities(self, measured_unit: str) -> tuple[Quantity, ...]:
        """What the readings are of, each with its unit: one where all share it."""
        return (Quantity(measured_unit),)

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
        """(p,) in which derivatives are compared, those below 1e-14 are rounding: the
        default prior's std, else the nominal value; NaN where neither says how large,
        or where derivatives are exact: then zero alone is no effect."""
        if self.linear:
            return np.full(len(self.names), np.nan)
        nominal = np.abs(self.nominal)
        precision = self.default_prior().resolve(self).precisions
        with np.errstate(divide="ignore"):
            sizes = np.where(precision > 0.0, 1.0 / np.sqrt(precision), nominal)
        return np.where(sizes > 0.0, sizes, np.nan)

    # -- what is asked of it -----------------------------------------------------------

    @property
    def fitting(self) -> Fitting:
        """What a fit asks of it besides f. A model of one's own that answers otherwise
        returns an object of a class derived from ``jaxcal.models.model.Fitting``."""
        return Fitting(self)

    def blocks(self, commands: ArrayLike) -> Array:
        """(..., N, 1, r) of each output by itself, with unit noise."""
        raise NotImplementedError("the outputs share no regressor")  # multiplicity 0

    def affine(self, parameters: Array) -> tuple[Array, Array] | None:
        """A (m, n) and b (m,) of a model ``y = A u + b``; None for any other."""
        return None

    @property
    def _kind(self) -> str:
        return type(self).__name__


class FunctionModel(Model):
    """A model of a caller's function, whose numbers n and q the first commands show."""

    names: tuple[str, ...]
    nominal: Array
    _kind_written: ClassVar[str]  # in files
    _counted_by: ClassVar[str]  # the argument that gives n

    def __init__(
        self,
        nominal: ArrayLike,
        names: Sequence[str] | None,
        periods: ArrayLike | None,
    ) -> None:
        self.nominal = array_of("nominal", nominal, "p")
        if not len(self.nominal):
            raise ValueError("nominal must hold at least one parameter, got none")
        self.names = parameter_names(names, len(self.nominal))
        self._num_inputs: int | None = None
        self._given_periods = periods

    @property
    def num_inputs(self) -> int:
        """n."""
        if self._num_inputs is None:
            made = f"{type(self).__name__}(f, nominal, {self._counted_by}=...)"
            raise ValueError(
                f"give {self._counted_by}: {made}. Before the first commands this "
                "model does not know num_inputs"
            )
        return self._num_inputs

    @property
    def periods(self) -> Array | None:
        """(q,) of readings that wrap; None before the first commands."""
        if self._given_periods is None or self._num_inputs is None:
            return None
        if not self.num_outputs:
            return None
        return checked_periods(self._given_periods, self.num_outputs)

    def to_dict(self) -> dict[str, Any]:
        """The function itself cannot be written."""
        names, nominal = list(self.names), self.nominal.tolist()
        return {"kind": self._kind_written, "names": names, "nominal": nominal}


class _Adapter(Model):
    """A model of another class, with the defaults for what it has not."""

    def __init__(self, own: Any) -> None:
        self._own = own
        _warn_of_hooks(type(own))

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
    """``model`` itself, or with the defaults of ``Model`` if it is another object; a
    ValueError where it is a class, or lacks a method that has no default."""
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
    if type(commands) is not np.ndarray or commands.dtype.names:
        commands = by_name(model, commands)
    rule = " for this model"
    return array_of("commands", commands, "N", model.num_inputs, rule=rule)


def as_parameters(model: Any, parameters: ArrayLike | None) -> Array:
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
        if not hasattr(model, "recorded"):
            raise ValueError(f"the model must be an arm, got {as_model(model)._kind}")
        commands, read = model.recorded(commands)
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


def from_dict(data: Mapping[str, Any]) -> Model:
    """The model that ``to_dict`` wrote; a ValueError for an unknown kind, a key that is
    missing, unknown or of another type, and a model that a function made."""
    if not isinstance(data, Mapping):
        raise ValueError(f"a model must be a JSON object with a kind, got {data!r}")
    fields = dict(data)
    kind = fields.pop("kind", None)
    kinds = (*_KINDS, *_UNWRITTEN)
    others = {} if kind in kinds else installed(_GROUP)
    kind = one_of("kind of the model", kind, (*kinds, *others))
    if kind in _UNWRITTEN or fields.get("features", "") is None:
        raise ValueError(
            "the model contains a function, which cannot be saved: pass the model, "
            "model=..."
        )
    if kind == "linear":  # a formula names its own
        fields.pop("terms", None)
    room = sys.modules["jaxcal.models"]  # which loads a model's module when asked
    make = others[kind].load() if kind in others else getattr(room, _KINDS[kind])
    try:
        return cast("Model", make(**fields))
    except TypeError as error:
        raise ValueError(
            f"a model of kind {kind} must hold values as to_dict writes them: {error}"
        ) from error
