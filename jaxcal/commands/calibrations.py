"""``jaxcal postures``, ``identify``, ``check``, ``predict``, ``command``."""

from __future__ import annotations

import dataclasses
import logging
import os
import pathlib
from collections.abc import Sequence
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxcal.arguments import several
from jaxcal.calibration import Calibration, Source
from jaxcal.calibration import identify as identified
from jaxcal.checks import aligned
from jaxcal.commands.arms import (
    ArmOptions,
    ModelPath,
    RecordingOptions,
    in_degrees,
)
from jaxcal.commands.questions import Numbers
from jaxcal.commands.tables import (
    Output,
    write_json,
    write_rows,
)
from jaxcal.csvtable import COMMANDS, MEASURED, CsvTable, read_table
from jaxcal.extras import needs
from jaxcal.models import SerialChain
from jaxcal.models.sensors import SENSORS, Board, Landmarks
from jaxcal.selection import Design

__all__ = ["check", "command", "identify", "postures", "predict"]

Array = NDArray[np.float64]

RecordPath = Annotated[
    str, "CSV, or - (standard input); of an arm also a bag or a LeRobot dataset"
]
_DRAWS = 10  # random choices that a plan is compared with


def postures(
    model: Annotated[str, "the arm's .urdf"],
    *,
    k: Annotated[int, "postures to measure in all", "K"],
    of_arm: ArmOptions,
    near: Annotated[
        list[list[float]] | None,
        "where a socket (x,y,z), a plane (normal, offset) or an anchor (x,y,z,zero) "
        "is, roughly; for other sensors x,y,z,radius around the tip; once for each",
        several(float, "numbers"),
    ] = None,
    measured: Annotated[
        str | None,
        "table of postures that were measured already, with columns named as the "
        "joints and as the sensor's",
        "FILE",
    ] = None,
    camera: Annotated[
        list[float] | None,
        "of --sensor board: width,height,fx,fy,cx,cy in pixels, or degrees of view "
        "horizontal,vertical: the board is in the picture",
        several(float, "numbers"),
    ] = None,
    board: Annotated[
        list[float] | None,
        "width,height of the board from the corner that its pose is of",
        several(float, "numbers"),
    ] = None,
    away: Annotated[
        list[float] | None,
        "least,greatest distance of the camera from the board",
        several(float, "numbers"),
    ] = None,
    tilt: Annotated[
        float | None, "degrees that the board may be turned from the camera, default 45"
    ] = None,
    side: Annotated[
        str | None,
        "where the board's z axis points from its printed side",
        ["+z", "-z"],
    ] = None,
    floor: Annotated[float | None, "height that no joint is below"] = None,
    approach: Annotated[
        list[float] | None,
        "direction in which the tool comes, and the degrees about it: 0,0,-1,60",
        several(float, "numbers"),
    ] = None,
    clear: Annotated[
        list[list[float]] | None,
        "a plane (normal, offset) or box (least x,y,z, greatest) that links stay away "
        "from, as spheres along lines between the joints; once for each",
        several(float, "numbers"),
    ] = None,
    count: Annotated[int, "postures to choose from"] = 300,
    one_side: Annotated[
        float | None,
        "columns `from JOINT`: where to come from, so many degrees below, so that play "
        "is on one side",
    ] = None,
    seed: Annotated[int, "of the random draws of these postures"] = 0,
    picture: Annotated[
        pathlib.Path | None, "draw the arm at each posture chosen: .png, .pdf, .svg"
    ] = None,
    output: Output,
) -> None:
    """Choose the postures to measure, in an order of little travel.

    Postures are made within the joint limits, where the sensor reads, and chosen for
    the predictions of the calibrated arm. With --measured the rest of the K is chosen
    beside what was reached, which shows where sockets, planes and boards are, too.
    Collisions are looked at as far as --floor, --approach and --clear say.
    """
    reached = None if measured is None else read_table(measured)
    placed = issubclass(SENSORS[of_arm.sensor], Landmarks)
    arm = of_arm.read(model, reached, near if placed else None)
    header, done = (*arm.joint_names, *arm.sensor.inputs), None
    if reached is not None:
        done = of_arm.commands(arm, reached, reached.named(header, COMMANDS))
        arm.require_commands(done)
        arm = arm.located(done)
    more = k - (0 if done is None else len(done))
    if more < 1:
        reason = f"-k must be more than the {k - more} that were reached"
        raise ValueError(f"{reason}, got {k}")
    arm = _with_board(arm, board)
    offered = arm.postures(
        count,
        seed=seed,
        near=None if placed else near,
        camera=camera,
        distance=away,
        tilt=tilt,
        side=side,
        floor=floor,
        approach=approach,
        clear=clear or (),
    )
    design = Design(offered, model=arm, measured=done)
    chosen = design.select(more, method="exchange").indices
    logging.getLogger("jaxcal").info(_worth(design, chosen, seed))
    plan = offered[chosen]
    plan = plan[arm.in_turn(plan)]
    if picture:
        _draw(arm, plan, picture)
    header, rows = _rows_of(arm, plan, one_side, of_arm.radians)
    if not output.written(header, rows):
        cells = [[f"{i + 1}", *(f"{x:.4g}" for x in r)] for i, r in enumerate(rows)]
        print("\n".join(aligned([["", *header], *cells])))


def _with_board(arm: SerialChain, size: list[float] | None) -> SerialChain:
    """The arm whose board is of this width and height, if they are given."""
    if size is None:
        return arm
    if not isinstance(arm.sensor, Board) or len(size) != 2:
        raise ValueError("--board WIDTH,HEIGHT is of --sensor board")
    board = dataclasses.replace(arm.sensor, extent=(size[0], size[1]))
    return arm.measured_with(board)


def _draw(arm: SerialChain, plan: Array, path: pathlib.Path) -> None:
    """A picture of the arm at each posture of the plan."""
    with needs("plots", "--picture"):
        from matplotlib.figure import Figure

    from jaxcal import plots

    figure = Figure(figsize=(8, 2.2 * -(-len(plan) // 4)), layout="constrained")
    plots.postures(figure, arm, plan).savefig(path)


def _rows_of(
    arm: SerialChain, plan: Array, one_side: float | None, radians: bool
) -> tuple[tuple[str, ...], list[list[float]]]:
    """The names of the columns of a plan (N, n), and its rows.

    ``one_side``: degrees below each posture where its joints come from, which are then
    columns too.
    """
    header = (*arm.joint_names, *arm.sensor.inputs)
    turning = [i for i, unit in enumerate(arm.command_units) if unit == "deg"]
    if one_side is not None:
        start, width = arm.from_one_side(plan, one_side), plan.shape[1]
        header = (*header, *(f"from {name}" for name in arm.joint_names))
        turning += [width + i for i in turning]
        plan = np.hstack([plan, start])
    if radians:
        plan[:, turning] = np.radians(plan[:, turning])
    return header, plan.tolist()


def _worth(design: Design, chosen: NDArray[np.int_], seed: int) -> str:
    """How many random postures have the same expected error, as a sentence."""
    rng, offered, k = np.random.default_rng(seed), len(design.available), len(chosen)

    problem = design.problem(k)

    def error(indices: NDArray[np.int_]) -> float:
        blocks = problem.blocks[indices]
        gram = problem.prior + np.einsum("kqa,kqb->ab", blocks, blocks)
        return float(np.sqrt(-problem.criterion.value(gram)))

    def by_random(count: int) -> float:
        sets = [rng.permutation(offered)[:count] for _ in range(_DRAWS)]
        return float(np.median([error(rows) for rows in sets]))

    expected, random = error(chosen), by_random(k)
    same = k
    while same < offered and by_random(same) > expected:
        same = min(same + max(1, k // 4), offered)
    return (
        f"these {k}: expected error {expected / random:.2f} of that of {k} random "
        f"ones, and that of about {same}; the gain is less where the arm has errors "
        "that no parameter explains"
    )


ReportFolder = Annotated[
    str,
    "write a page, verdict.json and the calibration into this folder; the exit code is "
    "then 1 where it is not good",
    "FOLDER",
]
Earlier = Annotated[
    str | None, "an earlier calibration.json that the page compares with", "FILE"
]
CertificateSize = Annotated[
    float | None,
    "expanded uncertainty (k = 2) in the certificate of the reference instrument, in "
    "the measured unit, for the budget on the page",
    "U",
]


def identify(
    file: RecordPath,
    *,
    inputs: Annotated[str | None, "columns of commands", "A,B"] = None,
    outputs: Annotated[str | None, "columns of measurements", "C,D"] = None,
    model: ModelPath = None,
    of_arm: ArmOptions,
    recording: RecordingOptions,
    noise: Annotated[Numbers, "std of a measurement, where it is known", "S"] = None,
    play: Annotated[
        float | None, "of an arm's joints, degrees from stop to stop: servos 0.3"
    ] = None,
    weights: Annotated[str | None, "column of relative weights", "W"] = None,
    command_unit: Annotated[str, "of the commands, stored and printed", "UNIT"] = "",
    measured_unit: Annotated[str, "of the readings, stored and printed", "UNIT"] = "",
    out: Annotated[
        str,
        "save the calibration (.json), or of an arm the corrected file (.urdf)",
        "FILE",
    ] = "",
    accuracy: Annotated[
        float | None,
        "of an arm, the held-out error that is enough, in the measured unit",
    ] = None,
    overwrite: Annotated[bool, "write over an .urdf or servos file that is there"] = (
        False
    ),
    unproven: Annotated[bool, "write the .urdf of a fit that is not good"] = False,
    servos_out: Annotated[
        str, "write LeRobot's calibration, of --servos, with the zeros found", "FILE"
    ] = "",
    report: ReportFolder = "",
    against: Earlier = None,
    certificate: CertificateSize = None,
    at: Annotated[
        str | None,
        "table of commands whose predictions get a budget on the page",
        "FILE",
    ] = None,
    json: Annotated[bool, "print JSON"] = False,
) -> int:
    """Fit a model to measurements and save the calibration.

    Columns that begin with u_ are commands, those with y_ what was measured; --inputs
    and --outputs name others. Of an arm in a URDF file the commands are the columns
    named as its joints, in any order, and what its sensor asks for; a bag or a LeRobot
    dataset does in the place of the table, with the postures at which the arm rested.
    """
    as_urdf = out.lower().endswith(".urdf")
    of_urdf = (model or "").lower().endswith(".urdf")
    if servos_out and as_urdf:
        raise ValueError(
            "one of --servos-out and --out FILE.urdf must be left out: either corrects "
            "the zeros, both would twice"
        )
    if servos_out and not recording.servos:
        raise ValueError("--servos-out needs --servos, the file that it corrects")
    if as_urdf and not of_urdf:
        raise ValueError("--out FILE.urdf needs --model FILE.urdf")
    table = recording.table(file, lambda which: of_arm.of_recording(model, which))
    table = read_table(file) if table is None else table
    machine: Any = of_arm.machine(model, table)
    if of_urdf:
        readings = _arm_readings(of_arm, machine, table, inputs, outputs)
        if machine.sensor.lengths:  # files of this format are in metres
            measured_unit = measured_unit or "m"
        if as_urdf and os.path.exists(out) and not overwrite:
            raise ValueError(f"{out} is there already; --overwrite writes over it")
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
    )
    corrected = out if as_urdf else servos_out
    if corrected and not calibration.verdict.good and not unproven:
        raise ValueError(
            f"{corrected} is not written, --unproven writes it all the same:\n"
            f"{calibration.verdict}"
        )
    saved = _saved(calibration, out, servos_out, str(recording.servos), overwrite)
    good = True
    if report:
        files = [path for path in (file, model) if path and os.path.isfile(path)]
        good = _report(calibration, report, against, certificate, at, files)
    elif against or at or certificate is not None:
        raise ValueError("--against, --certificate and --at are of --report FOLDER")
    if json:
        write_json("", calibration.to_dict())
        return int(not good)
    print("\n".join([calibration.summary(), *saved]))
    if report:
        print(f"report {os.path.join(report, 'index.html')}")
    return int(not good)


def _report(
    calibration: Calibration,
    folder: str,
    against: str | None,
    certificate: float | None,
    at: str | None,
    files: list[str],
) -> bool:
    """Write the page by --against, --certificate and --at; whether it is good."""
    sources = []
    if certificate is not None:
        sources = [Source.certificate("certificate", certificate)]
    return calibration.report(
        folder,
        before=Calibration.load(against) if against else None,
        sources=sources,
        at=None if at is None else _commands_for(calibration, read_table(at))[1],
        files=files,
    )


def _noise(machine: Any, stds: list[float] | None, play: float | None) -> Any:
    """``noise`` and ``noise_std`` of ``identify``, by --noise and --play."""
    std = stds[0] if stds and len(stds) == 1 else stds
    if play is None:
        return {"noise": None, "noise_std": std}
    if not isinstance(machine, SerialChain):
        raise ValueError("--play is of an arm, --model FILE.urdf")
    noise = machine.noise_with_play(play)
    if std is not None:
        noise = dataclasses.replace(noise, std=std)
    return {"noise": noise, "noise_std": None}


def _saved(
    calibration: Calibration, out: str, servos_out: str, servos: str, overwrite: bool
) -> list[str]:
    """Write the files that were asked for; a line of each."""
    lines = []
    if out.lower().endswith(".urdf"):
        tip = calibration.to_urdf(out, force=overwrite)
        lines = [f"saved {out}, tip link {tip}"]
    elif out:
        calibration.save(out)
        lines = [f"saved {out}"]
    if servos_out:
        steps = calibration.to_lerobot(servos_out, servos, force=overwrite)
        moved = ", ".join(f"{name} {step:+d}" for name, step in steps.items())
        lines.append(f"saved {servos_out}, steps: {moved}")
    return lines


class _Readings(NamedTuple):
    """Commands (N, n) and readings (N, m), and the names of their columns."""

    commands: Array
    measured: Array
    inputs: Sequence[str]
    outputs: Sequence[str]


def _arm_readings(
    of_arm: ArmOptions,
    arm: Any,
    table: CsvTable,
    inputs: str | None,
    outputs: str | None,
) -> _Readings:
    """The columns named as the arm's joints and its sensor's; a contact has none."""
    names = of_arm.columns(arm, table, inputs, "--inputs")
    commands, columns = of_arm.commands(arm, table, names), arm.sensor.outputs
    if arm.sensor.zeros:
        return _Readings(
            commands, np.zeros((len(commands), len(columns))), names, columns
        )
    columns = table.named(columns, MEASURED, chosen=outputs, option="--outputs")
    return _Readings(commands, table.columns(columns), names, columns)


def _readings(
    of_arm: ArmOptions,
    machine: Any,
    table: CsvTable,
    inputs: str | None,
    outputs: str | None,
    weights: str | None,
) -> _Readings:
    """The columns that begin with u_ and y_, or those that were named."""
    columns = table.outputs(outputs)
    names = of_arm.columns(
        machine, table, inputs, "--inputs", (*columns, weights or "")
    )
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
        float | None,
        "drift of the outputs that matters; default three times the noise",
        "T",
    ] = None,
    placed_anew: Annotated[
        bool, "of an arm: its sockets, planes or anchors stand elsewhere now"
    ] = False,
    report: ReportFolder = "",
    json: Annotated[bool, "print JSON"] = False,
) -> int:
    """Whether a calibration still holds, by a few new readings.

    The table has the calibration's columns; of an arm a recording does. Exit code 0:
    it holds; 1: it does not, or that cannot be told from these readings; 2: bad input.
    """
    calibrated = Calibration.load(calibration)
    table = recording.table(file, lambda which: calibrated.model)
    table = read_table(file) if table is None else table
    inputs, commands = _commands_for(calibrated, table, option="")
    unit = calibrated.measured_unit
    outputs = table.named(calibrated.output_names, MEASURED, option="", unit=unit)
    if both := sorted({*inputs} & {*outputs}):
        raise ValueError(
            f"{file}: columns of commands and of readings must differ, both would be "
            f"{', '.join(both)}; begin their names with {COMMANDS} and {MEASURED}"
        )
    measured = table.columns(outputs)
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
    columns: Annotated[str | None, "columns of commands", "A,B"] = None,
    std: Annotated[bool, "add the standard error of each output"] = False,
    radians: Annotated[bool, "of an arm: joint columns are in radians"] = False,
    output: Output,
) -> None:
    """Where a calibrated machine goes for given commands."""
    calibrated = Calibration.load(calibration)
    table = read_table(file)
    _, commands = _commands_for(calibrated, table, columns)
    if radians:
        if not isinstance(calibrated.model, SerialChain):
            raise ValueError("--radians is of arms")
        commands = in_degrees(calibrated.model, commands)
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
    columns: Annotated[str | None, "columns of desired outputs", "A,B"] = None,
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
    names = table.named(calibrated.output_names, MEASURED, chosen=columns, unit=unit)
    desired = table.columns(names)
    if clip and not limits:
        raise ValueError("--clip needs --limits")
    if limits and len(limits) == 1:
        limits = limits * calibrated.num_inputs
    commands = calibrated.command_for(desired, limits=limits or None, clip=clip)
    _emit(output, calibrated.input_names, commands)


def _commands_for(
    calibration: Calibration,
    table: CsvTable,
    chosen: str | None = None,
    option: str = "--columns",
) -> tuple[tuple[str, ...], Array]:
    """The columns of the commands of a calibration in a table, and (N, n) they hold."""
    names = table.named(
        calibration.input_names,
        COMMANDS,
        chosen=chosen,
        option=option,
        unit=calibration.command_unit,
    )
    return names, table.columns(names)


def _emit(output: Output, names: Sequence[str], values: Array) -> None:
    """Rows (N, len(names)) as JSON, else as CSV."""
    rows = values.tolist()
    if not output.written(names, rows):
        write_rows("", names, rows)
