"""One function a language: an inverse map to the text of a file.

C and Structured Text compute the same: a desired posture to commands in degrees and
pulses, each clamped to its limits, with a status of one bit for each axis that was
clamped. An input that is not a finite number sets the status and nothing else, so that
the caller keeps its last command.
"""

from __future__ import annotations

import csv
import dataclasses
import io
import json
from collections.abc import Callable
from typing import Any

import numpy as np

from rig.config import AXIS_NAMES
from rig.workbench.outputs.export.inverse import InverseMap

NOT_FINITE = 8  # status

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


def structured_text(inverse: InverseMap) -> str:
    """An IEC 61131-3 function block; LREAL and DINT, no library."""
    lines = [
        "(* Inverse map of a jaxcal calibration: command = M desired + c, in degrees.",
        *(f"   {line}" for line in inverse.origin),
        "*)",
        "FUNCTION_BLOCK FB_JaxcalCommand",
        "VAR_INPUT",
        *(f"    desired_{name} : LREAL; (* degrees *)" for name in AXIS_NAMES),
        "END_VAR",
        "VAR_OUTPUT",
        *(f"    command_{name} : LREAL; (* degrees *)" for name in AXIS_NAMES),
        *(f"    pulses_{name} : DINT;" for name in AXIS_NAMES),
        *(f"    clamped_{name} : BOOL; (* at its limit *)" for name in AXIS_NAMES),
        "    not_finite : BOOL; (* an input is no number; the outputs stay *)",
        "END_VAR",
        "VAR",
        *(f"    u_{name} : LREAL;" for name in AXIS_NAMES),
        "END_VAR",
        "",
        "not_finite := NOT (",
        "    " + "\n    AND ".join(
            f"(desired_{name} - desired_{name} = 0.0)" for name in AXIS_NAMES
        ),
        ");",
        "IF NOT not_finite THEN",
    ]  # fmt: skip
    for i, name in enumerate(AXIS_NAMES):
        terms = [
            f"({_real(value)}) * desired_{other}"
            for value, other in zip(inverse.matrix[i], AXIS_NAMES, strict=True)
        ]
        low, high = f"({_real(inverse.min_deg[i])})", f"({_real(inverse.max_deg[i])})"
        pulses = f"({_real(inverse.pulses_per_deg[i])})"
        least, most = inverse.min_pulses[i], inverse.max_pulses[i]
        lines += [
            f"    u_{name} := ({_real(inverse.offset_deg[i])})",
            *(f"        + {term}" for term in terms[:-1]),
            f"        + {terms[-1]};",
            f"    clamped_{name} := (u_{name} < {low}) OR (u_{name} > {high});",
            f"    command_{name} := LIMIT({low}, u_{name}, {high});",
            f"    pulses_{name} := LIMIT(DINT#{least},",
            f"        LREAL_TO_DINT(command_{name} * {pulses}), DINT#{most});",
        ]
    return "\n".join([*lines, "END_IF;", "END_FUNCTION_BLOCK", ""])


def named(inverse: InverseMap) -> dict[str, Any]:
    """What JSON, CSV and ROS parameters write: every field under its name."""
    return {
        "axes": list(AXIS_NAMES),
        **dataclasses.asdict(inverse),
        "checksum": inverse.checksum,
    }


def ros_parameters(inverse: InverseMap) -> str:
    """A ROS 2 parameter file; matrices row by row."""
    values = named(inverse)
    for name in ("min_deg", "max_deg"):  # ROS takes no list of both kinds of number
        values[name] = [float(x) for x in values[name]]
    values["device"] = [f"{key} = {json.dumps(v)}" for key, v in inverse.device.items()]
    values["warnings"] = inverse.warnings or [""]  # ROS has no empty list of texts
    lines = [f"# {line}" for line in inverse.origin]
    lines += ["/**:", "  ros__parameters:", "    jaxcal:"]
    for name, value in values.items():
        flat = np.ravel(value).tolist() if isinstance(value, list) else value
        lines.append(f"      {name}: {_yaml(flat)}")
    return "\n".join([*lines, ""])


def _yaml(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(_yaml, value))}]"
    return _real(value) if isinstance(value, float) else json.dumps(value)


def _real(value: float) -> str:
    """1e-07 with the point that YAML and Structured Text want: 1.0e-07."""
    mantissa, e, exponent = repr(float(value)).partition("e")
    return mantissa + ".0" * ("." not in mantissa) + e + exponent


def json_text(inverse: InverseMap) -> str:
    """All fields under their names."""
    data = {"format": "jaxcal-inverse", "schema": 1} | named(inverse)
    return json.dumps(data, indent=1) + "\n"


def csv_text(inverse: InverseMap) -> str:
    """name, axis, input, value; one number a row."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["name", "axis", "input", "value"])
    values = named(inverse)
    del values["axes"]  # every row names its own
    for name, value in values.items():
        if name == "device":
            rows = [(key, "", json.dumps(each)) for key, each in value.items()]
        elif name == "warnings":
            rows = [("", "", warning) for warning in value]
        elif isinstance(value, str):
            rows = [("", "", value)]
        elif isinstance(value[0], list):
            inputs = (*AXIS_NAMES, "offset")
            rows = [
                (axis, source, repr(number))
                for axis, row in zip(AXIS_NAMES, value, strict=True)
                for source, number in zip(inputs, row, strict=False)
            ]
        else:
            pairs = zip(AXIS_NAMES, value, strict=True)
            rows = [(axis, "", repr(number)) for axis, number in pairs]
        table.writerows((name, *row) for row in rows)
    return text.getvalue()


LANGUAGES: dict[str, Callable[[InverseMap], str]] = {
    "c": c_header,
    "st": structured_text,
    "ros": ros_parameters,
    "json": json_text,
    "csv": csv_text,
}
