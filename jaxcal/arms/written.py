"""What an arm's calibration gives back: files for its controller, one of its chains."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxcal.calibration import Calibration
from jaxcal.checks import Array
from jaxcal.files import AnyPath


def of(fit: Calibration, tip: str) -> Calibration:
    """The calibration of one of several chains (``jaxcal.models.Chains``), as of an arm
    of its own, its readings in its own unit."""
    model: Any = fit.model
    if not hasattr(model, "of_chain"):
        raise ValueError(f"the model must be Chains, got {model._kind}")
    return dataclasses.replace(fit, **model.of_chain(fit, tip))


def to_urdf(fit: Calibration, path: AnyPath, *, force: bool = False) -> str:
    """Write the arm's own file, corrected; returns the tip link.

    Files cannot hold compliance (the arm is then moved as a whole to where its tip
    agrees best) and gear harmonics (the rest is fitted again); a warning says by how
    much they differ.
    """
    return str(_arm(fit).write("urdf", path, for_file(fit), force=force))


def to_dh(fit: Calibration, path: AnyPath, *, force: bool = False) -> None:
    """Write the DH table as CSV, corrected as ``to_urdf`` says."""
    _arm(fit).write("dh", path, for_file(fit), force=force)


def to_ur_kinematics(fit: Calibration, path: AnyPath, *, force: bool = False) -> None:
    """Write Universal Robots' kinematics file, corrected as ``to_urdf`` says."""
    _arm(fit).write("ur", path, for_file(fit), force=force)


def to_lerobot(
    fit: Calibration,
    path: AnyPath,
    servos: AnyPath,
    *,
    names: Mapping[str, str] | None = None,
    force: bool = False,
) -> dict[str, int]:
    """Write LeRobot's calibration file of a servo arm with corrected zeros; returns the
    steps by which the middle of each motor's range moved.

    The readings are fitted again by zeros of the joints only; a warning gives the
    error. Do not also use a corrected URDF file: it would apply the zeros twice.

    Args:
        fit: of an arm that a file of servos was read with.
        path: the file to write.
        servos: the file that the postures were read with.
        names: motors not named as the joints: {"Rotation": "shoulder_pan"}.
        force: overwrite an existing file.
    """
    plain = _arm(fit).writable()
    zeros = [name for name in plain.names if name.startswith("theta")]
    tool = [name for name in plain.names if "tool" in name]
    fitted = (*zeros, *plain.sensor.names, *tool)
    prior = plain.default_prior()
    held = tuple(name for name in plain.names if name not in fitted)
    fixed = tuple(dict.fromkeys((*prior.fixed, *held)))
    again = fit.again(plain, dataclasses.replace(prior, fixed=fixed))
    steps: dict[str, int] = plain.write_servos(
        path, again.parameters, servos, names or {}, force=force
    )
    if again.noise_std is not None:
        verdict: Any = again.verdict
        warnings.warn(
            "the file corrects the zeros of the joints only: cross-validated error "
            f"{verdict.held_out:.3g}, before calibration {verdict.nominal:.3g}",
            stacklevel=2,
        )
    return steps


def _arm(fit: Calibration) -> Any:
    """The model, which must be an arm."""
    _ = fit.arm
    return fit.model


def for_file(fit: Calibration) -> Array:
    """(p,) for a file: without what no file holds; a warning gives the effect."""
    model, parameters = _arm(fit), np.array(fit.parameters)
    plain, unit = model.writable(), f" {fit.measured_unit}".rstrip()
    held = np.isin(fit.names, plain.names)
    if held.all() and not fit.estimate[len(fit.names) :].any():
        return parameters
    errors = ""
    if held.all():
        change = "it was fitted without harmonics"
        again = fit.again(plain, plain.default_prior())
        parameters = again.parameters
        off: Array = again.outputs_at(fit.commands) - fit.outputs_at(fit.commands)
        if again.noise_std is not None and fit.noise_std is not None:
            verdicts: tuple[Any, Any] = again.verdict, fit.verdict
            errors = (
                f"; cross-validated error {verdicts[0].held_out:.3g}{unit}, of the "
                f"calibration {verdicts[1].held_out:.3g}"
            )
    else:
        change = "the arm in it was moved as a whole"
        parameters = np.where(held, parameters, 0.0)
        parameters = model.standing_as(fit.arm, parameters, fit.commands)
        file = model.calibrated(parameters)
        joints = fit.commands[:, : file.num_inputs]
        off = file.predict(joints) - fit.arm.predict(joints)
    warnings.warn(
        f"the file cannot hold compliance and gear harmonics; {change}: at the "
        "measured postures its predictions differ from the calibration's by "
        f"{np.linalg.norm(off, axis=1).mean():.3g}{unit} on average{errors}",
        stacklevel=3,
    )
    return parameters
