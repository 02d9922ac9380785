"""What an arm's calibration gives back: files for its controller, where its camera or
board is, as ROS reads it, and one of its chains.
"""

from __future__ import annotations

import dataclasses
import os
import warnings
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from jaxcal.arms.arguments import pose_matrix
from jaxcal.arms.files.recordings import write_servos
from jaxcal.arms.files.urdf import described, links_of
from jaxcal.arms.files.write import fixed_joint, standing_as, with_origins
from jaxcal.arms.sensors import Board
from jaxcal.arms.verdict import of_chain, place_of
from jaxcal.calibration import Calibration
from jaxcal.calibration.fit import outputs_at
from jaxcal.calibration.fit_model import fitted_again
from jaxcal.checks import Array, one_of
from jaxcal.files import AnyPath, write_over
from jaxcal.models.uncertainty import Prior

if TYPE_CHECKING:
    from jaxcal.arms.effects import Fit

_FORMS = (".yaml", ".yml", ".sh", ".urdf")
_METRES = {"m": 1.0, "mm": 1e-3, "cm": 1e-2}


def for_file(fit: ArmCalibration) -> Array:
    """(p,) for a file: without what no file holds; a warning gives the effect."""
    model, parameters = fit.model, np.array(fit.parameters)
    plain, unit = model.writable(), f" {fit.measured_unit}".rstrip()
    held = np.isin(fit.names, plain.names)
    if held.all() and not fit.estimate[len(fit.names) :].any():
        return parameters
    errors = ""
    if held.all():
        change = "it was fitted without harmonics"
        again = fitted_again(fit, plain, plain.default_prior())
        parameters = again.parameters
        off: Array = outputs_at(again, fit.commands) - outputs_at(fit, fit.commands)
        if again.noise_std is not None and fit.noise_std is not None:
            verdicts: tuple[Any, Any] = again.verdict, fit.verdict
            errors = (
                f"; cross-validated error {verdicts[0].held_out:.3g}{unit}, of the "
                f"calibration {verdicts[1].held_out:.3g}"
            )
    else:
        change = "the arm in it was moved as a whole"
        parameters = np.where(held, parameters, 0.0)
        parameters = standing_as(model, fit.arm, parameters, fit.commands)
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


class StaticTransform(NamedTuple):
    """The pose of a camera or board in a link of the arm that is used as described."""

    parent: str
    child: str
    matrix: Array  # (4, 4), in metres
    std: tuple[float, float]  # of its place in metres, and of its turn in degrees
    hidden: tuple[str, ...]  # what the views do not show, as described
    held_out: str  # error of views left out, the arm as described
    source: Any  # of the arm

    @property
    def quaternion(self) -> Array:
        """(4,) x, y, z, w."""
        return np.asarray(Rotation.from_matrix(self.matrix[:3, :3]).as_quat())

    def __str__(self) -> str:
        place = ", ".join(f"{x:.5f}" for x in self.matrix[:3, 3])
        turn = ", ".join(f"{x:.5f}" for x in self.quaternion)
        lost = ", ".join(self.hidden)
        beside = f", except {lost}, which the views do not show" if lost else ""
        return (
            f"{self.child} in {self.parent}: translation {place} m, quaternion (x, y, "
            f"z, w) {turn}; uncertainty {1000.0 * self.std[0]:.2g} mm and "
            f"{self.std[1]:.2g} deg (1 sigma){beside}; uncorrected arm: {self.held_out}"
        )


def static_transform(
    fit: Fit,
    child: str | None = None,
    parent: str | None = None,
    camera: int = 0,
) -> StaticTransform:
    """Where a camera is, on the tip or beside the arm, for the arm as described.

    It is fitted again with the arm held as its description has it, which is what a
    controller goes by: beside a corrected arm the camera is the tip of ``to_urdf``.

    Args:
        child: name of the camera's optical frame (z ahead, x to the right in the
            picture, not a driver's camera_link); by default "camera_optical_frame".
        parent: link that it is in; by default a URDF file's tip link, or the base of a
            camera that stands.
        camera: of several that see one board, its number.

    Raises:
        ValueError: the sensor is no ``Board``, or the unit of lengths is not known.
    """
    model = fit.model
    sensors = getattr(getattr(model, "sensor", None), "members", ())
    sensor = sensors[camera] if 0 <= camera < len(sensors) else None
    if not isinstance(sensor, Board):
        raise ValueError("a static transform needs an arm with sensor=Board(...)")
    unit = model.length_unit(fit.measured_unit)
    scale = _METRES[
        one_of("measured_unit, for a transform in metres,", unit, [*_METRES])
    ]
    tool = [f"tool {axis}" for axis in sensor.tool]
    owns = [model.names[model._own(i)] for i in range(len(sensors))]
    fitted = {*tool, *sum(owns, ())}
    held = tuple(name for name in model.names if name not in fitted)
    again = fitted_again(fit, model, Prior(model.default_prior().std, fixed=held))
    theta, source = again.parameters, model.source
    if sensor.moves == "camera":
        names = tool
        tip = described(source)["tool"] if source else np.eye(4)  # in the last joint
        matrix = np.linalg.inv(tip) @ model.calibrated(theta).tool
    else:
        names = list(owns[camera][:6])
        at = [model.names.index(name) for name in names]
        matrix = pose_matrix(theta[at])
        if sensor.place is not None:
            matrix[:3, :3] = matrix[:3, :3] @ sensor.place[:3, :3]
    matrix[:3, 3] *= scale
    # The arm's own errors are no noise of the views: the whole fit knows them.
    places = [place_of(one, names) for one in (again, fit)]
    std = np.max([place.std for place in places], axis=0) * [scale, 1.0]
    verdict: Any = again.verdict
    off = " and ".join(one.says(one.held_out) for one in verdict.errors)
    end = "tip" if sensor.moves == "camera" else "base"
    return StaticTransform(
        parent or (source[end] if source else end),
        child or "camera_optical_frame",
        matrix,
        (float(std[0]), float(std[1])),
        places[0].hidden,
        f"left-out views are off by {off}",
        source,
    )


def to_transform(
    fit: Fit,
    path: AnyPath,
    *,
    child: str | None = None,
    parent: str | None = None,
    camera: int = 0,
    force: bool = False,
) -> StaticTransform:
    """Write ``static_transform`` as what reads it.

    Args:
        path: .yaml, a geometry_msgs/TransformStamped; .sh, a call of ROS 2's
            static_transform_publisher; .urdf, the arm's own file with the frame as a
            link and its fixed joint.
        child, parent, camera: as of ``static_transform``.
        force: write over a file that is there.
    """
    form = os.path.splitext(os.fspath(path))[1].lower()
    one_of("ending of the file", form, _FORMS)
    pose = static_transform(fit, child, parent, camera)
    write_over(path, _text(form, pose), force)
    return pose


def _text(form: str, pose: StaticTransform) -> str:
    if form == ".urdf":
        if pose.source is None:
            raise ValueError(
                "the arm must come from a URDF file: SerialChain.from_urdf"
            )
        text, frame = pose.source["text"], fixed_joint(*pose[:3])
        one_of("parent", pose.parent, links_of(text))
        if pose.child in links_of(text):
            raise ValueError(
                f"the file already has a link {pose.child}: name another child"
            )
        return with_origins(text, {}, frame)
    numbers = [*pose.matrix[:3, 3].tolist(), *pose.quaternion.tolist()]
    values = [repr(float(x)) for x in numbers]
    if form in (".yaml", ".yml"):
        named = [f"{key}: {x}" for key, x in zip("xyzxyzw", values, strict=True)]
        shift, turn = ", ".join(named[:3]), ", ".join(named[3:])
        return (
            f"# {pose}\nheader: {{frame_id: {pose.parent}}}\n"
            f"child_frame_id: {pose.child}\n"
            f"transform:\n  translation: {{{shift}}}\n  rotation: {{{turn}}}\n"
        )
    keys = ("x", "y", "z", "qx", "qy", "qz", "qw", "frame-id", "child-frame-id")
    both = zip(keys, [*values, pose.parent, pose.child], strict=True)
    call = " ".join(f"--{key} {word}" for key, word in both)
    return f"# {pose}\nros2 run tf2_ros static_transform_publisher {call}\n"


class ArmCalibration(Calibration):
    """The calibration of an arm or of several chains, with what only these have."""

    model: Any

    static_transform = static_transform
    to_transform = to_transform

    @property
    def arm(self) -> Any:
        """The arm as calibrated, its parameters nominal, with Position()."""
        return self.whole.calibrated(self.estimate)  # type: ignore[attr-defined]

    def of(self, tip: str) -> Calibration:
        """The calibration of one of several chains (``jaxcal.models.Chains``), as of an
        arm of its own, its readings in its own unit."""
        if not hasattr(self.model, "chains"):
            raise ValueError(f"the model must be Chains, got {self.model._kind}")
        return dataclasses.replace(self, **of_chain(self.model, self, tip))

    def to_urdf(self, path: AnyPath, *, force: bool = False) -> str:
        """Write the arm's own file, corrected; returns the tip link.

        Files cannot hold compliance (the arm is then moved as a whole to where its tip
        agrees best) and gear harmonics (the rest is fitted again); a warning says by
        how much they differ.
        """
        return str(self.model.write("urdf", path, for_file(self), force=force))

    def to_dh(self, path: AnyPath, *, force: bool = False) -> None:
        """Write the DH table as CSV, corrected as ``to_urdf`` says."""
        self.model.write("dh", path, for_file(self), force=force)

    def to_ur_kinematics(self, path: AnyPath, *, force: bool = False) -> None:
        """Write Universal Robots' kinematics file, corrected as ``to_urdf`` says."""
        self.model.write("ur", path, for_file(self), force=force)

    def to_lerobot(
        self,
        path: AnyPath,
        servos: AnyPath,
        *,
        names: Mapping[str, str] | None = None,
        force: bool = False,
    ) -> dict[str, int]:
        """Write LeRobot's calibration file of a servo arm with corrected zeros; returns
        the steps by which the middle of each motor's range moved.

        The readings are fitted again by zeros of the joints only; a warning gives the
        error. Do not also use a corrected URDF file: it would apply the zeros twice.

        Args:
            servos: the file that the postures were read with.
            names: motors not named as the joints: {"Rotation": "shoulder_pan"}.
        """
        plain = self.model.writable()
        prior, own = plain.default_prior(), plain.sensor.names
        held = (
            name
            for name in plain.names
            if not (name.startswith("theta") or "tool" in name or name in own)
        )
        fixed = tuple(dict.fromkeys((*prior.fixed, *held)))
        again = fitted_again(self, plain, dataclasses.replace(prior, fixed=fixed))
        steps = write_servos(
            plain, path, again.parameters, servos, names or {}, force=force
        )
        if again.noise_std is not None:
            verdict: Any = again.verdict
            warnings.warn(
                "the file corrects the zeros of the joints only: cross-validated error "
                f"{verdict.held_out:.3g}, before calibration {verdict.nominal:.3g}",
                stacklevel=2,
            )
        return steps
