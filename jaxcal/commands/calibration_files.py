"""What ``identify`` writes: the options of its files and of its report."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from typing import Annotated, Any, ClassVar

from jaxcal.calibration import Calibration
from jaxcal.checks import Array
from jaxcal.commands.arms import in_degrees, is_recording
from jaxcal.tables import COMMANDS, Table

ReportFolder = Annotated[
    str,
    "write a page, verdict.json and the calibration into this folder; exit code 1 if "
    "the calibration is not good",
    "FOLDER",
]


@dataclasses.dataclass
class ReportOptions:
    """The page of a calibration, and what it is compared with."""

    TITLE: ClassVar[str] = "the page of a calibration"
    RARE: ClassVar[Any] = {"against"}

    report: ReportFolder = ""
    against: Annotated[
        str | None, "earlier calibration.json to compare with on the page", "FILE"
    ] = None

    def require(self) -> None:
        """Refuse options of a page without a page."""
        if self.against and not self.report:
            raise ValueError("--against needs --report FOLDER")

    def written(self, calibration: Calibration, files: Sequence[str | None]) -> bool:
        """Write the page, if it was asked for; whether nothing on it is bad."""
        if not self.report:
            return True
        return calibration.report(
            self.report,
            before=Calibration.load(self.against) if self.against else None,
            files=[path for path in files if path and os.path.isfile(path)],
        )


@dataclasses.dataclass
class SavedFiles:
    """What an identification is saved as."""

    RARE: ClassVar[Any] = {"overwrite", "unproven", "repair", "servos_out"}

    out: Annotated[
        str,
        "save the calibration (.json) or an arm's corrected file (.urdf)",
        "FILE",
    ] = ""
    overwrite: Annotated[
        bool, "overwrite an existing .urdf, servos or --repair file"
    ] = False
    unproven: Annotated[bool, "write the .urdf even if the calibration is not good"] = (
        False
    )
    repair: Annotated[
        str, "if rows are mispaired, write the corrected table", "FILE"
    ] = ""
    servos_out: Annotated[
        str, "write LeRobot's calibration file: --servos with corrected zeros", "FILE"
    ] = ""

    transform: Annotated[
        str,
        "--sensor board: write the camera's pose for the uncorrected arm, as a "
        "TransformStamped (.yaml), ROS 2's static_transform_publisher (.sh, or .py to "
        "launch it), or the .urdf with the camera's link",
        "FILE",
    ] = ""
    frames: Annotated[
        str | None,
        "with --transform: the camera's parent link and the name of its optical frame",
        "PARENT,CHILD",
    ] = None

    @property
    def as_urdf(self) -> bool:
        """The arm's own file is written, corrected."""
        return self.out.lower().endswith(".urdf")

    @property
    def corrected(self) -> str:
        """The file that a robot would go by, if one was asked for."""
        return (self.out if self.as_urdf else self.servos_out) or self.transform

    def require(self, file: str, of_urdf: bool, servos: str | None) -> None:
        """Refuse files that cannot be written, or must not be, before the fit."""
        if self.servos_out and self.as_urdf:
            raise ValueError(
                "Leave out --servos-out or --out FILE.urdf: each corrects the zeros, "
                "so both would correct them twice"
            )
        files = "--out FILE.urdf, --servos-out and --transform"
        for option in ("unproven", "overwrite"):
            of_table = self.repair and option == "overwrite"
            if getattr(self, option) and not (self.corrected or of_table):
                more = " or --repair" * (option == "overwrite")
                raise ValueError(f"--{option} needs {files}{more}")
        if self.frames is not None and not self.transform:
            raise ValueError("--frames needs --transform FILE")
        if len((self.frames or "a,b").split(",")) != 2:
            raise ValueError(f"--frames takes PARENT,CHILD, got {self.frames}")
        if self.transform and not of_urdf:
            raise ValueError("--transform needs --model FILE.urdf and --sensor board")
        if self.servos_out and not servos:
            raise ValueError("--servos-out needs --servos FILE")
        if servos and not (self.servos_out or is_recording(file)):
            raise ValueError("--servos needs a recording or --servos-out")
        if self.as_urdf and not of_urdf:
            raise ValueError("--out FILE.urdf needs --model FILE.urdf")
        for path in (self.transform, self.out if self.as_urdf else "", self.repair):
            if path and os.path.exists(path) and not self.overwrite:
                raise ValueError(f"{path} exists; pass --overwrite to replace it")

    def written(self, calibration: Calibration, servos: str | None) -> list[str]:
        """Write the files that were asked for; a line of each."""
        corrected = self.corrected
        if corrected and not calibration.verdict.good and not self.unproven:
            raise ValueError(
                f"{corrected} was not written: the calibration is not good (reasons "
                "above). --unproven writes it anyway"
            )
        lines = []
        if self.as_urdf:
            tip = calibration.to_urdf(self.out, force=self.overwrite)
            lines = [f"saved {self.out}, tip link {tip}"]
        elif self.out:
            calibration.save(self.out)
            lines = [f"saved {self.out}"]
        if self.transform:
            parent, child = (self.frames or ",").split(",")
            arm: Any = calibration.model
            count = len(arm.sensor.members)
            for camera in range(count):
                stem, ending = os.path.splitext(self.transform)
                number = f"_{camera}" if count > 1 else ""
                pose = calibration.to_transform(
                    f"{stem}{number}{ending}",
                    child=child.strip() + number * bool(child.strip()) or None,
                    parent=parent.strip() or None,
                    camera=camera,
                    force=self.overwrite,
                )
                lines.append(f"saved {stem}{number}{ending}: {pose}")
        if self.servos_out:
            steps = calibration.to_lerobot(
                self.servos_out, str(servos), force=self.overwrite
            )
            moved = ", ".join(f"{name} {step:+d}" for name, step in steps.items())
            lines.append(f"saved {self.servos_out}, steps: {moved}")
        return lines


def commands_for(
    calibration: Calibration,
    table: Table,
    chosen: str | None = None,
    option: str = "--inputs",
    *,
    radians: bool = False,
) -> tuple[tuple[str, ...], Array]:
    """The columns of the commands of a calibration in a table, and (N, n) they hold.

    ``radians``: of an arm, whose commands are then made degrees.
    """
    model: Any = calibration.model
    if radians and not is_arm(model):
        raise ValueError("--radians needs an arm")
    names = table.named(
        calibration.input_names,
        COMMANDS,
        chosen=chosen,
        option=option,
        unit=calibration.command_unit,
        others=calibration.output_names,
    )
    commands = table.columns(names, None, getattr(model, "levels", ()))
    return names, in_degrees(model, commands) if radians else commands


def is_arm(model: Any) -> bool:
    """Whether a model is an arm, of which some options are."""
    from jaxcal.arms import SerialChain

    return isinstance(model, SerialChain)
