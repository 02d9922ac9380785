"""What a controller needs of a calibration: ``u = M y + c``, pulses and limits."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import pathlib
from typing import Any

import numpy as np

from rig.config import AXIS_NAMES
from rig.config.axis import Scale
from rig.core.faults import Refused
from rig.journal import Record
from rig.workbench.outputs.console import recalibrate


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
            "`calibrate` that has ended, or its refit"
        ) from None
    config = records[0]["config"]  # of the run, also where it was refitted
    axes = {axis["name"]: axis for axis in config["axes"]}
    ordered = [axes[name] for name in AXIS_NAMES]
    notes = calibration.provenance.get("notes", {})
    limit = config["session"]["verify_limit_deg"]
    warnings = recalibrate(summary, limit)
    if summary.get("simulated"):
        warnings.append("made on a simulated rig")
    return InverseMap(
        matrix=np.column_stack(columns).tolist(),
        offset_deg=at_zero.tolist(),
        min_deg=[axis["min_deg"] for axis in ordered],
        max_deg=[axis["max_deg"] for axis in ordered],
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
