"""A calibration's inverse map in the languages of controllers.

C and Structured Text compute the same: a desired posture to commands in degrees and
pulses, each clamped to its limits, with a status of one bit for each axis that was
clamped. An input that is not a finite number sets the status and nothing else, so that
the caller keeps its last command. JSON, CSV and ROS parameters hold the numbers.
"""

from __future__ import annotations

import csv
import dataclasses
import hashlib
import io
import json
import pathlib
from collections.abc import Callable
from typing import Any

import numpy as np

from rig.config import AXIS_NAMES
from rig.config.axis import Scale
from rig.core.faults import Refused
from rig.journal import Record
from rig.workbench.outputs.console import recalibrate

NOT_FINITE = 8  # status
SINGLE = ("run", "created", "checksum")  # of its fields: texts


@dataclasses.dataclass(frozen=True)
class InverseMap:
    """The inverse map of one calibration, and where it is from."""

    matrix: list[list[float]]  # (3, 3) M = A^-1
    offset_deg: list[float]  # (3,) c = -A^-1 b
    min_deg: list[float]  # (3,) soft limits of the commands
    max_deg: list[float]
    pulses_per_deg: list[float]  # (3,) signed
    min_pulses: list[int]
    max_pulses: list[int]
    forward: list[list[float]]  # (3, 4) [A | b]
    half_widths: list[list[float]]  # (3, 4) 95 %, of all twelve at once
    run: str
    created: str
    device: dict[str, Any]  # fingerprint: key of rig.toml to value
    warnings: list[str]

    @property
    def numbers(self) -> list[float]:
        """The 30 numbers the map is computed from, in the order of the fields."""
        first = dataclasses.astuple(self)[:7]
        return [float(x) for field in first for x in np.ravel(field).tolist()]

    @property
    def checksum(self) -> str:
        """SHA-256 of ``numbers``, each as Python's repr of a float, one a line."""
        text = "\n".join(map(repr, self.numbers))
        return hashlib.sha256(text.encode()).hexdigest()

    @property
    def named(self) -> dict[str, Any]:
        """What JSON, CSV and ROS parameters write: every field under its name."""
        more = {"axes": list(AXIS_NAMES), "checksum": self.checksum}
        return dataclasses.asdict(self) | more

    @property
    def flat(self) -> dict[str, list[Any]]:
        """The same as lists of texts or of numbers, matrices row by row."""
        told = [f"{key} = {json.dumps(value)}" for key, value in self.device.items()]
        values = self.named | {"device": told, "warnings": self.warnings or [""]}
        return {name: np.ravel(value).tolist() for name, value in values.items()}

    @property
    def origin(self) -> list[str]:
        """Where the numbers are from, in lines of plain ASCII for a comment."""
        lines = [
            f"run {self.run}, calibrated {self.created}",
            f"SHA-256 of the numbers: {self.checksum}",
            "device fingerprint (keys of rig.toml):",
            *(f"  {key} = {json.dumps(value)}" for key, value in self.device.items()),
            *(f"WARNING: {text}" for text in self.warnings),
        ]
        return [_plain(line) for line in lines]


def load_inverse(folder: pathlib.Path, records: list[Record]) -> InverseMap:
    """The inverse map of the calibration in a run's folder, and its journal's records.

    Raises:
        Refused: it holds none, or A cannot be inverted.
    """
    import jaxcal

    path = folder / "calibration.json"
    try:
        calibration: Any = jaxcal.Calibration.load(path)
        at_zero = calibration.command_for(np.zeros(3))
        columns = [calibration.command_for(unit) - at_zero for unit in np.eye(3)]
        summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise Refused(
            f"{folder}: no calibration to export: {error}. Give the run of a "
            "`jaxcal-rig calibrate` that has ended, or its refit"
        ) from None
    config = records[0]["config"]  # of the run, also where it was refitted
    axes = {axis["name"]: axis for axis in config["axes"]}
    ordered = [axes[name] for name in AXIS_NAMES]
    notes = calibration.provenance.get("notes", {})
    warnings = recalibrate(summary, config["session"]["verify_limit_deg"])
    if summary.get("simulated"):
        warnings.append("made on a simulated rig")
    return InverseMap(
        matrix=np.column_stack(columns).tolist(),
        offset_deg=at_zero.tolist(),
        min_deg=[float(axis["min_deg"]) for axis in ordered],
        max_deg=[float(axis["max_deg"]) for axis in ordered],
        pulses_per_deg=[Scale(**axis["scale"]).pulses_per_deg for axis in ordered],
        min_pulses=[axis["min_pulses"] for axis in ordered],
        max_pulses=[axis["max_pulses"] for axis in ordered],
        forward=np.column_stack([calibration.matrix, calibration.bias]).tolist(),
        half_widths=summary["ci95"],
        run=folder.resolve().name,
        created=str(calibration.provenance.get("created", "")),
        device=notes["device"],
        warnings=warnings,
    )


def _plain(text: str) -> str:
    """Safe in a comment of any of the languages."""
    kept = "".join(c if c.isascii() and c.isprintable() else "?" for c in text)
    return kept.replace("*", "#").replace("\\", "/")


C_FUNCTION = """
/* Commands and pulses (each may be NULL) that bring the device to a posture.
   desired[3], command[3]: degrees, pitch yaw roll. Returns 0, or the sum of 1, 2 and 4
   where pitch, yaw and roll were clamped to their limits; JAXCAL_NOT_FINITE where a
   desired angle is not a finite number: command and pulses are then left alone. */
static inline int
jaxcal_command{s}(const {t} desired[3], {t} command[3], int32_t pulses[3])
{{
    {t} u[3];
    int status = 0;
    for (int i = 0; i < 3; ++i) {{
        if (!(desired[i] - desired[i] == 0))
            return JAXCAL_NOT_FINITE;
    }}
    for (int i = 0; i < 3; ++i) {{
        u[i] = ({t})jaxcal_offset_deg[i];
        for (int j = 0; j < 3; ++j)
            u[i] += ({t})jaxcal_matrix[i][j] * desired[j];
        if (!(u[i] >= ({t})jaxcal_min_deg[i])) {{
            u[i] = ({t})jaxcal_min_deg[i];
            status |= 1 << i;
        }} else if (!(u[i] <= ({t})jaxcal_max_deg[i])) {{
            u[i] = ({t})jaxcal_max_deg[i];
            status |= 1 << i;
        }}
    }}
    for (int i = 0; i < 3; ++i) {{
        if (command)
            command[i] = u[i];
        if (pulses) {{
            const double p = (double)u[i] * jaxcal_pulses_per_deg[i];
            const double lowest = (double)jaxcal_min_pulses[i];
            const double highest = (double)jaxcal_max_pulses[i];
            if (p < lowest || p > highest) {{
                const double past = p < lowest ? lowest - p : p - highest;
                pulses[i] = p < lowest ? jaxcal_min_pulses[i] : jaxcal_max_pulses[i];
                status |= past > 0.5 ? 1 << i : 0;
            }} else {{
                pulses[i] = (int32_t)(p < 0.0 ? p - 0.5 : p + 0.5);
            }}
        }}
    }}
    return status;
}}
"""


def c_header(inverse: InverseMap) -> str:
    """A C99 header; needs no library, allocates nothing."""
    comment = "\n".join(f"   {line}" for line in inverse.origin)
    rows = ", ".join(f"{{{_listed(row)}}}" for row in inverse.matrix)
    parts = [
        "/* Inverse map of a jaxcal calibration: command = M desired + c, in degrees.\n"
        f"{comment} */\n"
        "#ifndef JAXCAL_CALIBRATION_H\n#define JAXCAL_CALIBRATION_H\n\n"
        "#include <stdint.h>\n\n"
        f'#define JAXCAL_CHECKSUM "{inverse.checksum}"\n'
        f"#define JAXCAL_NOT_FINITE {NOT_FINITE}\n\n"
        f"static const double jaxcal_matrix[3][3] = {{{rows}}};\n"
    ]
    for name in ("offset_deg", "min_deg", "max_deg", "pulses_per_deg"):
        values = _listed(getattr(inverse, name))
        parts.append(f"static const double jaxcal_{name}[3] = {{{values}}};\n")
    for name in ("min_pulses", "max_pulses"):
        values = ", ".join(map(_c_int, getattr(inverse, name)))
        parts.append(f"static const int32_t jaxcal_{name}[3] = {{{values}}};\n")
    parts += [C_FUNCTION.format(s=s, t=t) for s, t in (("", "double"), ("f", "float"))]
    return "".join(parts) + "\n#endif\n"


def _listed(values: list[float]) -> str:
    return ", ".join(repr(float(value)) for value in values)


def _c_int(value: int) -> str:
    return "(-2147483647 - 1)" if value == -(2**31) else str(value)


ST_HEAD = """\
FUNCTION_BLOCK FB_JaxcalCommand
VAR_INPUT
{desired}
END_VAR
VAR_OUTPUT
{outputs}
    not_finite : BOOL; (* an input is no number; the outputs stay *)
END_VAR
VAR
{inner}
END_VAR

not_finite := NOT (
    {finite}
);
IF NOT not_finite THEN
"""
ST_AXIS = """\
    u_{n} := ({c})
        + ({m[0]}) * desired_pitch
        + ({m[1]}) * desired_yaw
        + ({m[2]}) * desired_roll;
    clamped_{n} := (u_{n} < ({low})) OR (u_{n} > ({high}));
    command_{n} := LIMIT(({low}), u_{n}, ({high}));
    pulses_{n} := LIMIT(DINT#{least},
        LREAL_TO_DINT(command_{n} * ({scale})), DINT#{most});
"""


def structured_text(inverse: InverseMap) -> str:
    """An IEC 61131-3 function block; LREAL and DINT, no library."""

    def each(line: str, between: str = "\n") -> str:
        return between.join(line.format(n=name) for name in AXIS_NAMES)

    outputs = (
        "    command_{n} : LREAL; (* degrees *)",
        "    pulses_{n} : DINT;",
        "    clamped_{n} : BOOL; (* at its limit *)",
    )
    comment = "\n".join(f"   {line}" for line in inverse.origin)
    text = (
        "(* Inverse map of a jaxcal calibration: command = M desired + c, in degrees.\n"
        f"{comment}\n*)\n"
    ) + ST_HEAD.format(
        desired=each("    desired_{n} : LREAL; (* degrees *)"),
        outputs="\n".join(map(each, outputs)),
        inner=each("    u_{n} : LREAL;"),
        finite=each("(desired_{n} - desired_{n} = 0.0)", "\n    AND "),
    )
    for i, name in enumerate(AXIS_NAMES):
        text += ST_AXIS.format(
            n=name,
            c=_real(inverse.offset_deg[i]),
            m=[_real(value) for value in inverse.matrix[i]],
            low=_real(inverse.min_deg[i]),
            high=_real(inverse.max_deg[i]),
            scale=_real(inverse.pulses_per_deg[i]),
            least=inverse.min_pulses[i],
            most=inverse.max_pulses[i],
        )
    return text + "END_IF;\nEND_FUNCTION_BLOCK\n"


def _real(value: float) -> str:
    """1e-07 with the point that YAML and Structured Text want: 1.0e-07."""
    mantissa, e, exponent = repr(float(value)).partition("e")
    return mantissa + ".0" * ("." not in mantissa) + e + exponent


def ros_parameters(inverse: InverseMap) -> str:
    """A ROS 2 parameter file."""
    lines = [f"# {line}" for line in inverse.origin]
    lines += ["/**:", "  ros__parameters:", "    jaxcal:"]
    for name, values in inverse.flat.items():
        each = [_real(v) if isinstance(v, float) else json.dumps(v) for v in values]
        text = each[0] if name in SINGLE else f"[{', '.join(each)}]"
        lines.append(f"      {name}: {text}")
    return "\n".join([*lines, ""])


def json_text(inverse: InverseMap) -> str:
    """All fields under their names."""
    data = {"format": "jaxcal-inverse", "schema": 1} | inverse.named
    return json.dumps(data, indent=1) + "\n"


def csv_text(inverse: InverseMap) -> str:
    """name, number, value; one value a row."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["name", "number", "value"])
    for name, values in inverse.flat.items():
        table.writerows((name, i, value) for i, value in enumerate(values))
    return text.getvalue()


LANGUAGES: dict[str, Callable[[InverseMap], str]] = {
    "c": c_header,
    "st": structured_text,
    "ros": ros_parameters,
    "json": json_text,
    "csv": csv_text,
}
