"""Where a camera or board is, as ROS reads it: a static transform or a URDF joint."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from jaxcal.arms.arguments import pose_matrix
from jaxcal.arms.files.urdf import described, links_of
from jaxcal.arms.files.write import fixed_joint, with_origins
from jaxcal.arms.sensors import Board
from jaxcal.arms.verdict import place_of
from jaxcal.checks import Array, one_of
from jaxcal.files import AnyPath, write_over
from jaxcal.models.uncertainty import Prior

if TYPE_CHECKING:
    from jaxcal.arms.effects import Fit as Calibration


_FORMS = (".yaml", ".yml", ".sh", ".urdf")
_METRES = {"m": 1.0, "mm": 1e-3, "cm": 1e-2}


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
    calibration: Calibration,
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
    model = calibration.model
    sensors = getattr(getattr(model, "sensor", None), "members", ())
    sensor = sensors[camera] if 0 <= camera < len(sensors) else None
    if not isinstance(sensor, Board):
        raise ValueError("a static transform needs an arm with sensor=Board(...)")
    unit = model.length_unit(calibration.measured_unit)
    scale = _METRES[
        one_of("measured_unit, for a transform in metres,", unit, [*_METRES])
    ]
    tool = [f"tool {axis}" for axis in sensor.tool]
    owns = [model.names[model.own(i)] for i in range(len(sensors))]
    fitted = {*tool, *(name for own in owns for name in own)}
    held = tuple(name for name in model.names if name not in fitted)
    again = calibration.again(model, Prior(model.default_prior().std, fixed=held))
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
    places = [place_of(fit, names) for fit in (again, calibration)]
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
    calibration: Calibration,
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

    Raises:
        ValueError: as of ``static_transform``; .urdf of an arm of no file.
        FileExistsError: there is a file and ``force`` is not given.
    """
    form = os.path.splitext(os.fspath(path))[1].lower()
    one_of("ending of the file", form, _FORMS)
    pose = static_transform(calibration, child, parent, camera)
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
    keys = ("x", "y", "z", "qx", "qy", "qz", "qw")
    values = {key: repr(float(x)) for key, x in zip(keys, numbers, strict=True)}
    if form in (".yaml", ".yml"):
        shift = ", ".join(f"{key}: {values[key]}" for key in keys[:3])
        turn = ", ".join(f"{key[1]}: {values[key]}" for key in keys[3:])
        return (
            f"# {pose}\nheader: {{frame_id: {pose.parent}}}\n"
            f"child_frame_id: {pose.child}\n"
            f"transform:\n  translation: {{{shift}}}\n  rotation: {{{turn}}}\n"
        )
    words = [word for key in keys for word in (f"--{key}", values[key])]
    words += ["--frame-id", pose.parent, "--child-frame-id", pose.child]
    call = " ".join(words)
    return f"# {pose}\nros2 run tf2_ros static_transform_publisher {call}\n"
