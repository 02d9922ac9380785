"""``identify``: from measurements to a calibration, with honest uncertainty."""

from __future__ import annotations

import dataclasses
import datetime
import functools
import hashlib
import json
import platform
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.calibration.calibration import Calibration
from jaxcal.calibration.fit import outputs_at, stated_prior, warn
from jaxcal.calibration.fit_model import fit_model, fitted_again, require_fitting
from jaxcal.calibration.pairing import of_unfitted
from jaxcal.checks import (
    Array,
    array_of,
    axis_names,
    by_unit,
    levels,
    require_none,
    require_size,
    table,
)
from jaxcal.files import AnyPath
from jaxcal.models.linear import Affine
from jaxcal.models.model import Model, Recording, recorded
from jaxcal.models.uncertainty import Noise, Prior, as_noise
from jaxcal.tables import (
    COMMANDS,
    MEASURED,
    columns_by_name,
    header_of,
    inputs_of,
    names_in,
    of_frame,
    outputs_of,
    say_order,
)

# The model of most calibrations, whose names are then made once.
_affine = functools.lru_cache(Affine)


def identify(
    commands: ArrayLike | Recording | AnyPath,
    measured: ArrayLike | None = None,
    *,
    model: Model | None = None,
    prior: Prior | None = None,
    noise: Noise | None = None,
    noise_std: ArrayLike | None = None,
    weights: ArrayLike | None = None,
    common_noise: bool | Sequence[Any] | None = None,
    loss: str | None = None,
    input_names: Sequence[str] | None = None,
    output_names: Sequence[str] | None = None,
    command_unit: str = "",
    measured_unit: str = "",
    notes: Mapping[str, Any] | None = None,
    accuracy: float | Mapping[str, float] | None = None,
    sessions: ArrayLike | None = None,
) -> Calibration:
    """The parameters of ``y = f(u; theta)`` that the measurements make most probable.

    The fit starts at the prior's mean; directions that no measurement determines stay
    there. The affine model without prior, student's loss or noise of another kind than
    ``noise_std`` is weighted least squares; a direction that the commands do not excite
    is an error.

    Args:
        commands: (N, n) in any unit; an array, or a frame or table, read as
            ``jaxcal.read_table`` decides; of an arm also a ``Recording`` or its path.
        measured: (N, m) readings in any unit. Not needed for contacts, recordings with
            readings, and tables with columns y_....
        model: of ``jaxcal.models``, or any object with its methods; by default affine.
        prior: of the parameters; by default ``model.default_prior()``.
        noise: of readings and commands; ``command_std`` makes the commands unknowns of
            their measurement. The level of the readings is estimated if not given.
        noise_std: () or (m,) short for ``Noise(std=...)`` of a measurement of weight 1.
        weights: (N,) a measurement of weight w has variance noise_std^2 / w (the number
            of readings averaged, say); 0 leaves it out. By default 1.
        common_noise: estimate one noise level for all outputs (they must share a unit),
            or (False) one for each, or one for each group of (m,) labels. By default
            one for each, but of an arm one for positions and one for turns unless the
            residuals contradict it (F test, 0.1 %), and one for all where
            ``command_std`` is given; of under 30 measurements whose outputs share
            parameters, as trajectories, as many as the residuals show (the summary
            says which).
        loss: "gaussian" is least squares, the default of an affine model without prior;
            "student" (4 degrees of freedom, of a measurement as a whole), otherwise the
            default, gives outliers little weight.
        input_names: n names; by default a data frame's, else u_x, u_y, u_z or u_1, ...
        output_names: m names, likewise y_x or y_1.
        command_unit, measured_unit: stored with the result.
        notes: anything JSON can hold, stored under ``provenance["notes"]``.
        accuracy: of an arm, the mean held-out error that is enough for the verdict: of
            each unit that is named, {"mm": 0.5, "deg": 0.1}; a number is of the first,
            lengths where there are some. By default, whether the noise explains the
            readings, or the nominal machine is far worse.
        sessions: (N,) a label of each row, its day or mounting. What differs between
            two or more is estimated by leaving out each, and counts in predictions.

    Returns:
        The calibration; its covariance is None where the noise is unknown: nothing was
        given and no residual degree of freedom is left. One that is not good warns
        (``jaxcal.CalibrationWarning``), once for each line of a program.

    Raises:
        ValueError: naming the argument, the rule and the value; for commands that leave
            a direction unexcited, naming that direction.
    """
    u, y, weight, inputs, outputs = _measurements(
        model, commands, measured, weights, input_names, output_names
    )
    n, m = len(inputs), len(outputs)
    noise, plain_noise = _noise(noise, noise_std, common_noise, outputs)
    units: dict[str, Any]
    units = {"command_unit": command_unit, "measured_unit": measured_unit}
    for name, unit in units.items():
        if not isinstance(unit, str):
            raise ValueError(f"{name} must be text, got {unit!r}")
    provenance = _provenance((u, y, weight), notes)
    model = require_fitting(_affine(n, m) if model is None else model, u, y)
    if accuracy is not None:
        judged = model.fitting.accuracy_units(measured_unit)
        if not judged:
            raise ValueError("accuracy needs an arm (model=)")
        provenance["accuracy"] = by_unit("accuracy", accuracy, judged)
    plain = prior is None and plain_noise and loss in (None, "gaussian")
    affine = isinstance(model, Affine)
    if loss is None and prior is None:
        if affine or model.affine(model.nominal) is not None:
            loss = "gaussian"
    try:
        fields = fit_model(
            u,
            y,
            weight,
            model=model,
            prior=prior,
            noise=noise,
            loss=loss or "student",
            common_noise=common_noise,
            excited=inputs if plain and affine else (),
        )
    except ValueError as error:
        names = getattr(model, "inputs", ()) or inputs
        mispaired = of_unfitted(model, u, y, prior, names, outputs)
        if mispaired is None:
            raise
        raise ValueError(f"{mispaired.reason}. Uncorrected: {error}") from None
    fields["provenance"] = provenance | fields["provenance"]
    kind: Any = fields["model"].fitting.result_type or Calibration
    calibration = kind(input_names=inputs, output_names=outputs, **fields, **units)
    if prior is None and plain_noise:
        calibration = model.fitting.improved(calibration)
    if sessions is not None:
        calibration = _with_sessions(calibration, sessions)
    # Of y = A u + b by as many rows as it needs the summary says that it is unchecked.
    unchecked = calibration.noise_std is None and calibration.dof < 0.5
    exact = unchecked and calibration.affine is not None
    if not exact and not calibration.verdict.good:
        warn(str(calibration.verdict), "not good", stacklevel=2)
    return calibration


def _measurements(
    model: Model | None,
    commands: Any,
    measured: Any,
    weights: ArrayLike | None,
    input_names: Sequence[str] | None,
    output_names: Sequence[str] | None,
) -> tuple[Array, Array, Array, tuple[str, ...], tuple[str, ...]]:
    """Commands (N, n), readings (N, m), weights (N,), n and m names, checked; of a
    recording its rests."""
    commands, measured, is_recording = recorded(model, commands, measured)
    if is_recording:
        input_names = input_names or getattr(model, "inputs", ()) or None
    say_order(commands, measured)
    inputs, outputs = _columns(model, commands, measured)
    levels = getattr(model, "levels", ())
    u = of_frame("commands", commands, inputs or (), COMMANDS, levels=levels)
    u = table("commands", u)
    y = of_frame("measured", measured, outputs or (), MEASURED)
    y = table("measured", y, len(u))
    require_size("commands", u)
    require_size("measured", y)
    input_names, output_names = input_names or inputs, output_names or outputs
    inputs = axis_names("input_names", input_names, "u", u.shape[1])
    outputs = axis_names("output_names", output_names, "y", y.shape[1])
    weight = np.ones(len(u))
    if weights is not None:
        say_order(commands, weights, ("commands", "weights"))
        weight = array_of("weights", weights, len(u))
        require_none(weight < 0.0, weight, "weights must not be negative")
    return u, y, weight, inputs, outputs


def _columns(model: Any, commands: Any, measured: Any) -> tuple[Any, Any]:
    """Names of the columns of commands and of readings; None of what has no names."""
    wanted = getattr(getattr(model, "sensor", None), "outputs", ())
    together, outputs = measured is commands, None
    readings = header_of("measured", measured)
    if any(columns_by_name(wanted, readings, MEASURED)):
        outputs = names_in("measured", measured, wanted, MEASURED)
    elif readings:
        outputs = outputs_of("measured", measured, together)
    beside = (outputs or ()) if together else ()
    if inputs := getattr(model, "inputs", ()):
        return names_in("commands", commands, inputs, COMMANDS, beside), outputs
    return inputs_of("commands", commands, beside), outputs


def _noise(
    noise: Noise | None,
    noise_std: ArrayLike | None,
    common_noise: bool | Sequence[Any] | None,
    outputs: tuple[str, ...],
) -> tuple[Noise, bool]:
    """The noise as given, and whether that is at most a level of each output."""
    if noise_std is not None:
        noise_std = of_frame("noise_std", noise_std, outputs, MEASURED)
    if noise is not None and not isinstance(noise, Noise):
        noise = as_noise(of_frame("noise", noise, outputs, MEASURED))
    if not (common_noise is None or isinstance(common_noise, bool)):
        labels = () if isinstance(common_noise, str) else np.atleast_1d(common_noise)
        if np.shape(labels) != (len(outputs),):
            raise ValueError(
                f"common_noise must be True, False or a label for each of the "
                f"{len(outputs)} outputs, got {common_noise!r}"
            )
    if noise is not None and noise_std is not None:
        raise ValueError("give noise_std or noise, not both")
    noise = noise or Noise()
    # At most a level of each output, known or not, in every reading.
    plain = noise.covariance is None and noise.command_std is None
    plain = plain and (noise.std is None or np.ndim(noise.std) < 2)
    level = noise_std if noise.std is None else noise.std
    if plain and level is not None:
        noise = Noise(std=levels("noise_std", level, len(outputs)))
    estimated = noise.std is None and noise.covariance is None
    if common_noise is not None and not estimated:
        raise ValueError(
            "give noise (the noise itself) or common_noise (how to estimate it), not "
            "both"
        )
    return noise, plain


def _provenance(
    data: tuple[Array, ...], notes: Mapping[str, Any] | None
) -> dict[str, Any]:
    try:
        noted = json.loads(json.dumps(dict(notes), allow_nan=False)) if notes else {}
    except (TypeError, ValueError) as error:
        raise ValueError(f"notes must be valid JSON: {error}") from None
    parts = [(str(x.shape).encode(), x.astype("<f8", copy=False)) for x in data]
    content = b"".join(shape + array.tobytes() for shape, array in parts)
    return {
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "packages": {
            "jaxcal": sys.modules["jaxcal"].__version__,  # an import would be a circle
            "numpy": np.__version__,
            "python": platform.python_version(),
        },
        "data_sha256": hashlib.sha256(content).hexdigest(),
        "notes": noted,
    }


def _with_sessions(fit: Calibration, labels: ArrayLike) -> Calibration:
    """The calibration with (m,) standard deviations of readings of another session, of
    ``labels`` (N,), beyond what is expected when the others predict it."""
    names, which = np.unique(np.asarray(labels), return_inverse=True)
    if np.shape(labels) != (len(fit.commands),) or len(names) < 2:
        raise ValueError(
            f"sessions must be two or more labels, of {len(fit.commands)} rows,"
            f" got shape {np.shape(labels)} and {len(names)} labels"
        )
    excess = []
    for label in range(len(names)):
        try:
            trial = fitted_again(fit, fit.model, stated_prior(fit), which != label)
        except ValueError:
            continue
        rows = (which == label) & (fit.loss_weights > 0.0)
        if trial.noise_std is not None and rows.any():
            commands = fit.commands[rows]
            off = fit.measured[rows] - outputs_at(trial, commands)
            off = fit.model.fitting.wrapped(off, commands)
            std = trial.predict_std(commands, new_measurement=True)
            excess.append(off**2 - std**2)
    if not excess:
        raise ValueError("sessions: each fit without one session must be possible")
    variance = np.vstack(excess).mean(axis=0).clip(0.0)
    about = {"count": len(names), "std": np.sqrt(variance).tolist()}
    provenance = {**fit.provenance, "sessions": about}
    return dataclasses.replace(fit, provenance=provenance)
