"""``jaxcal identify``, ``check``, ``predict``, ``command``."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from jaxcal.arguments import Numbers, Was, several
from jaxcal.calibration import Calibration
from jaxcal.calibration import identify as identified
from jaxcal.commands.arms import (
    ArmOptions,
    ModelPath,
    RecordingOptions,
    in_degrees,
    is_recording,
)
from jaxcal.commands.tables import (
    Output,
    write_json,
    write_rows,
)
from jaxcal.tables import COMMANDS, MEASURED, Table, read_table

__all__ = ["check", "command", "identify", "predict"]

Array = NDArray[np.float64]

RecordPath = Annotated[
    str, "CSV, or - (standard input); of an arm also a bag or a LeRobot dataset"
]

ReportFolder = Annotated[
    str,
    "write a page, verdict.json and the calibration into this folder; the exit code is "
    "then 1 where it is not good",
    "FOLDER",
]


@dataclasses.dataclass
class ReportOptions:
    """The page of a calibration, and what it is compared with."""

    TITLE: ClassVar[str] = "the page of a calibration"
    RARE: ClassVar[Any] = {"against", "certificate", "at"}

    report: ReportFolder = ""
    against: Annotated[
        str | None, "an earlier calibration.json that the page compares with", "FILE"
    ] = None
    certificate: Annotated[
        float | None,
        "expanded uncertainty (k = 2) in the certificate of the reference instrument, "
        "in the measured unit, for the budget on the page",
        "U",
    ] = None
    at: Annotated[
        str | None,
        "table of commands whose predictions get a budget on the page",
        "FILE",
    ] = None

    def require(self) -> None:
        """Refuse options of a page without a page."""
        if not self.report and self != ReportOptions():
            raise ValueError("--against, --certificate and --at are of --report FOLDER")

    def written(self, calibration: Calibration, files: Sequence[str | None]) -> bool:
        """Write the page, if it was asked for; whether nothing on it is bad."""
        if not self.report:
            return True
        sources = []
        if self.certificate is not None:
            from jaxcal.reports.budget import Source

            sources = [Source.certificate("certificate", self.certificate)]
        at = None
        if self.at is not None:
            at = _commands_for(calibration, read_table(self.at))[1]
        return calibration.report(
            self.report,
            before=Calibration.load(self.against) if self.against else None,
            sources=sources,
            at=at,
            files=[path for path in files if path and os.path.isfile(path)],
        )


@dataclasses.dataclass
class SavedFiles:
    """What an identification is saved as."""

    RARE: ClassVar[Any] = {"overwrite", "unproven", "repair", "servos_out"}

    out: Annotated[
        str,
        "save the calibration (.json), or of an arm the corrected file (.urdf)",
        "FILE",
    ] = ""
    overwrite: Annotated[bool, "write over an .urdf or servos file that is there"] = (
        False
    )
    unproven: Annotated[bool, "write the .urdf of a fit that is not good"] = False
    repair: Annotated[
        str, "write the rows that belong together, where they were mispaired", "FILE"
    ] = ""
    servos_out: Annotated[
        str, "write LeRobot's calibration, of --servos, with the zeros found", "FILE"
    ] = ""

    transform: Annotated[
        str,
        "of --sensor board, write where the camera is, for the arm as described: a "
        "TransformStamped (.yaml), ROS 2's static_transform_publisher (.sh, or .py to "
        "launch it), or the .urdf with its link",
        "FILE",
    ] = ""
    frames: Annotated[
        str | None,
        "with --transform: the camera's link, the name of its optical frame",
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
                "one of --servos-out and --out FILE.urdf must be left out: either "
                "corrects the zeros, both would twice"
            )
        files = "--out FILE.urdf, --servos-out and --transform"
        if self.unproven and not self.corrected:
            raise ValueError(f"--unproven is of {files}")
        if self.overwrite and not self.corrected:
            raise ValueError(f"--overwrite is of {files}")
        if self.frames is not None and not self.transform:
            raise ValueError("--frames is of --transform FILE")
        if len((self.frames or "a,b").split(",")) != 2:
            raise ValueError(f"--frames must be PARENT,CHILD, got {self.frames}")
        if self.transform and os.path.exists(self.transform) and not self.overwrite:
            raise ValueError(
                f"{self.transform} is there already; --overwrite writes over it"
            )
        if self.servos_out and not servos:
            raise ValueError("--servos-out needs --servos, the file that it corrects")
        if servos and not (self.servos_out or is_recording(file)):
            raise ValueError("--servos goes with a recording or with --servos-out")
        if self.as_urdf and not of_urdf:
            raise ValueError("--out FILE.urdf needs --model FILE.urdf")
        if self.as_urdf and os.path.exists(self.out) and not self.overwrite:
            raise ValueError(f"{self.out} is there already; --overwrite writes over it")

    def written(self, calibration: Calibration, servos: str | None) -> list[str]:
        """Write the files that were asked for; a line of each."""
        corrected = self.corrected
        if corrected and not calibration.verdict.good and not self.unproven:
            raise ValueError(
                f"{corrected} is not written: the calibration is not good, as said "
                "above; --unproven writes it all the same"
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


def _by_unit(text: str) -> float | dict[str, float]:
    """A number, or numbers of units: mm=0.5,deg=0.1."""
    if "=" not in text:
        return float(text)
    pairs = (part.rpartition("=") for part in text.split(","))
    return {unit.strip(): float(value) for unit, _, value in pairs}


def identify(
    file: RecordPath,
    *,
    inputs: Annotated[str | None, "columns of commands", "A,B"] = None,
    outputs: Annotated[str | None, "columns of measurements", "C,D"] = None,
    model: ModelPath = None,
    saved: SavedFiles,
    page: ReportOptions,
    of_arm: ArmOptions,
    recording: RecordingOptions,
    noise: Annotated[Numbers, "std of a measurement, where it is known", "S"] = None,
    play: Annotated[
        float | None, "of an arm's joints, degrees from stop to stop: servos 0.3"
    ] = None,
    weights: Annotated[str | None, "column of relative weights", "W"] = None,
    command_unit: Annotated[str, "of the commands, stored and printed", "UNIT"] = "",
    measured_unit: Annotated[str, "of the readings, stored and printed", "UNIT"] = "",
    accuracy: Annotated[
        Any,
        "of an arm, the held-out error that is enough: 0.002 in the first unit (of "
        "lengths, where there are some), or m=0.002,deg=0.1",
        _by_unit,
        "A",
    ] = None,
    session: Annotated[
        str | None, "column that labels the session (day, mounting) of each row", "S"
    ] = None,
    json: Annotated[bool, "print JSON"] = False,
) -> int:
    """Fit a model to measurements and save the calibration.

    Columns that begin with u_ are commands, those with y_ what was measured; --inputs
    and --outputs name others. Of an arm in a URDF file the commands are the columns
    named as its joints, in any order, and what its sensor asks for; a bag or a LeRobot
    dataset does in the place of the table, with the postures at which the arm rested.
    """
    of_urdf = (model or "").lower().endswith(".urdf")
    saved.require(file, of_urdf, recording.servos)
    page.require()
    if saved.repair and weights:
        raise ValueError("--repair writes no weights: leave out one of them")
    if saved.repair and os.path.realpath(saved.repair) == os.path.realpath(file):
        raise ValueError(f"--repair must be another file than {file}")
    table = recording.table(file, lambda which: of_arm.of_recording(model, which))
    table = read_table(file) if table is None else table
    machine: Any = of_arm.machine(model, table)
    if accuracy is not None and not _is_arm(machine):
        raise ValueError("--accuracy needs an arm: --model FILE.urdf")
    if of_urdf:
        readings = _arm_readings(of_arm, machine, table, inputs, outputs, weights)
        if machine.sensor.lengths:  # files of this format are in metres
            measured_unit = measured_unit or "m"
    else:
        readings = _readings(of_arm, machine, table, inputs, outputs, weights)
    calibration = identified(
        readings.commands,
        readings.measured,
        model=machine,
        **_noise(machine, noise, play),
        weights=table.columns([weights])[:, 0] if weights else None,
        input_names=readings.inputs,
        output_names=readings.outputs,
        command_unit=command_unit,
        measured_unit=measured_unit,
        accuracy=accuracy,
        sessions=table.columns([session])[:, 0] if session else None,
    )
    lines = saved.written(calibration, recording.servos)
    if saved.repair:
        lines.append(_repaired(saved.repair, file, calibration, table, readings))
    good = page.written(calibration, (file, model))
    if json:
        write_json("", calibration.to_dict())
        return int(not good)
    print("\n".join([calibration.summary(), *lines]))
    if page.report:
        print(f"report {os.path.join(page.report, 'index.html')}")
    return int(not good)


def _is_arm(model: Any) -> bool:
    """Whether a model is an arm, of which some options are."""
    from jaxcal.arms import SerialChain

    return isinstance(model, SerialChain)


def _noise(machine: Any, stds: list[float] | None, play: float | None) -> Any:
    """``noise`` and ``noise_std`` of ``identify``, by --noise and --play."""
    std = stds[0] if stds and len(stds) == 1 else stds
    if play is None:
        return {"noise": None, "noise_std": std}
    if not _is_arm(machine):
        raise ValueError("--play is of an arm, --model FILE.urdf")
    noise = machine.noise_with_play(play)
    if std is not None:
        noise = dataclasses.replace(noise, std=std)
    return {"noise": noise, "noise_std": None}


def _repaired(
    path: str,
    file: str,
    calibration: Calibration,
    table: Table,
    readings: _Readings,
) -> str:
    """Write the rows of a mispaired table that belong together; a line that says so."""
    mispairing = calibration.mispairing
    if mispairing is None:
        raise ValueError(f"{path} is not written: the rows of {file} are not mispaired")
    names, measured = [*readings.inputs], np.zeros((len(table), 0))
    if {*readings.outputs} <= {*table.names}:
        names, measured = [*names, *readings.outputs], table.columns(readings.outputs)
    columns = mispairing.repaired(table.columns(readings.inputs), measured)
    write_rows(path, names, np.hstack(columns).tolist())
    return f"saved {path}, {len(columns[0])} of {len(table)} rows; {file} is as it was"


class _Readings(NamedTuple):
    """Commands (N, n) and readings (N, m), and the names of their columns."""

    commands: Array
    measured: Array
    inputs: Sequence[str]
    outputs: Sequence[str]


def _arm_readings(
    of_arm: ArmOptions,
    arm: Any,
    table: Table,
    inputs: str | None,
    outputs: str | None,
    weights: str | None,
) -> _Readings:
    """The columns named as the arm's joints and its sensor's; a contact has none."""
    columns, contacts = arm.sensor.outputs, arm.sensor.contacts
    if not contacts:
        columns = table.named(columns, MEASURED, chosen=outputs, option="--outputs")
    elif outputs:
        raise ValueError(f"--outputs is of readings, contacts have none, got {outputs}")
    beside = (*columns, weights or "")
    names = of_arm.columns(arm, table, inputs, beside)
    commands = of_arm.commands(arm, table, names)
    measured = np.zeros((len(table), len(columns)))
    if not contacts:
        measured = table.columns(columns)
    return _Readings(commands, measured, names, columns)


def _readings(
    of_arm: ArmOptions,
    machine: Any,
    table: Table,
    inputs: str | None,
    outputs: str | None,
    weights: str | None,
) -> _Readings:
    """The columns that begin with u_ and y_, or those that were named."""
    columns = table.outputs(outputs)
    names = of_arm.columns(machine, table, inputs, (*columns, weights or ""))
    if both := sorted({*names} & {*columns}):
        raise ValueError(f"--inputs and --outputs must differ, both hold {both[0]}")
    return _Readings(table.columns(names), table.columns(columns), names, columns)


CalibrationPath = Annotated[str, "made by identify", "calibration.json"]


def check(
    calibration: CalibrationPath,
    file: RecordPath,
    *,
    recording: RecordingOptions,
    tolerance: Annotated[
        Any,
        "drift of the outputs that matters, a number or m=0.002,deg=0.1; default three "
        "times the noise",
        _by_unit,
        "T",
    ] = None,
    placed_anew: Annotated[
        bool, "of an arm: its sockets, planes, anchors or board stand elsewhere now"
    ] = False,
    radians: Annotated[bool, "of an arm: joint columns are in radians"] = False,
    report: ReportFolder = "",
    json: Annotated[bool, "print JSON"] = False,
) -> int:
    """Whether a calibration still holds, by a few new readings.

    The table has the calibration's columns, of contacts no readings; of an arm a
    recording does. Exit code 0: it holds; 1: it does not, or that cannot be told from
    these readings; 2: bad input.
    """
    calibrated = Calibration.load(calibration)
    if recording.servos and not is_recording(file):
        raise ValueError("--servos goes with a recording, not a table")
    table = recording.table(file, lambda which: calibrated.model)
    if table is not None and radians:
        raise ValueError("--radians is of tables, recordings say their unit")
    table = read_table(file) if table is None else table
    inputs, commands = _commands_for(calibrated, table, option="")
    if radians:
        commands = _in_degrees(calibrated, commands)
    if getattr(getattr(calibrated.model, "sensor", None), "contacts", False):
        measured = np.zeros((len(commands), calibrated.num_outputs))
    else:
        measured = _readings_for(calibrated, table, inputs)
    result = calibrated.check(
        commands, measured, tolerance=tolerance, placed_anew=placed_anew
    )
    if report:
        files = [path for path in (calibration, file) if os.path.isfile(path)]
        calibrated.report(
            report, check=result, readings=(commands, measured), files=files
        )
    if json:
        more = {"good": result.good, "next_step": result.next_step}
        write_json("", dataclasses.asdict(result) | more)
    else:
        print(result)
        if report:
            print(f"report {os.path.join(report, 'index.html')}")
    return int(not result.good)


def predict(
    calibration: CalibrationPath,
    file: Annotated[str, "commands: CSV, or -"],
    *,
    inputs: Annotated[str | None, "columns of commands", "A,B", Was("columns")] = None,
    std: Annotated[bool, "add the standard error of each output"] = False,
    radians: Annotated[bool, "of an arm: joint columns are in radians"] = False,
    output: Output,
) -> None:
    """Where a calibrated machine goes for given commands."""
    calibrated = Calibration.load(calibration)
    table = read_table(file)
    _, commands = _commands_for(calibrated, table, inputs)
    if radians:
        commands = _in_degrees(calibrated, commands)
    calibrated.model.require_commands(commands)
    names, values = calibrated.output_names, calibrated.predict(commands)
    if std:
        names = (*names, *(f"std_{name}" for name in names))
        values = np.concatenate([values, calibrated.predict_std(commands)], axis=1)
    _emit(output, names, values)


def command(
    calibration: CalibrationPath,
    file: Annotated[str, "desired outputs: CSV, or -"],
    *,
    outputs: Annotated[
        str | None, "columns of desired outputs", "A,B", Was("columns")
    ] = None,
    limits: Annotated[
        list[list[float]] | None,
        "lowest and highest command; once for all inputs or for each; inf for none",
        "LOW,HIGH",
        several(float, "numbers"),
    ] = None,
    clip: Annotated[bool, "move commands beyond the limits onto them"] = False,
    output: Output,
) -> None:
    """What to command to reach given outputs, the inverse map.

    A command beyond its limits is refused; --clip moves it onto the limit instead.
    """
    calibrated = Calibration.load(calibration)
    table, unit = read_table(file), calibrated.measured_unit
    names = table.named(
        calibrated.output_names,
        MEASURED,
        chosen=outputs,
        option="--outputs",
        unit=unit,
        others=calibrated.input_names,
    )
    desired = table.columns(names)
    if clip and not limits:
        raise ValueError("--clip needs --limits")
    if limits and len(limits) == 1:
        limits = limits * calibrated.num_inputs
    if limits and {len(pair) for pair in limits} != {2}:
        raise ValueError("--limits takes LOW,HIGH, once for all axes or once per axis")
    commands = calibrated.command_for(desired, limits=limits or None, clip=clip)
    _emit(output, calibrated.input_names, commands)


def _commands_for(
    calibration: Calibration,
    table: Table,
    chosen: str | None = None,
    option: str = "--inputs",
) -> tuple[tuple[str, ...], Array]:
    """The columns of the commands of a calibration in a table, and (N, n) they hold."""
    names = table.named(
        calibration.input_names,
        COMMANDS,
        chosen=chosen,
        option=option,
        unit=calibration.command_unit,
        others=calibration.output_names,
    )
    return names, table.columns(names)


def _in_degrees(calibration: Calibration, commands: Array) -> Array:
    """Commands (N, n) of an arm whose joint columns are in radians."""
    if not _is_arm(calibration.model):
        raise ValueError("--radians is of arms")
    return in_degrees(cast("Any", calibration.model), commands)


def _readings_for(
    calibration: Calibration, table: Table, inputs: Sequence[str]
) -> Array:
    """(N, m) the readings of a calibration in a table, beside columns ``inputs``."""
    outputs = table.named(
        calibration.output_names,
        MEASURED,
        option="",
        unit=calibration.measured_unit,
    )
    if both := sorted({*inputs} & {*outputs}):
        raise ValueError(
            f"{table.source}: columns of commands and of readings must differ, both "
            f"would be {', '.join(both)}; begin their names with {COMMANDS} and "
            f"{MEASURED}"
        )
    return table.columns(outputs)


def _emit(output: Output, names: Sequence[str], values: Array) -> None:
    """Rows (N, len(names)) as JSON, else as CSV."""
    rows = values.tolist()
    if not output.written(names, rows):
        write_rows("", names, rows)
