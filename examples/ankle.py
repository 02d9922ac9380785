"""Calibrate the ankle robot on a simulated rig: four postures, A and b, four targets.

python examples/ankle.py           # the axes twenty times faster
python examples/ankle.py --full    # at their own speed
"""

from __future__ import annotations

import json
import pathlib
import sys
import tempfile
from typing import Any

import common

from jaxcal.reports import plots
from rig.__main__ import main as rig

AXES = ("pitch", "yaw", "roll")


def study(full: bool) -> dict[str, Any]:
    """The summary of a session: drives over Modbus and a phone, both simulated."""
    with tempfile.TemporaryDirectory() as folder:
        speed = "1" if full else "20"
        code = rig(["calibrate", "--simulate", "--speedup", speed, "--arm", "--zero",
                    "--out", folder])  # fmt: skip
        if code:
            raise SystemExit(code)
        (summary,) = pathlib.Path(folder).glob("*/summary.json")
        return json.loads(summary.read_text())


def rows(found: dict[str, Any]) -> common.Rows:
    """Measured less desired at the targets, degrees."""
    kinds = (("raw", "before"), ("calibrated", "after"))
    return [
        common.row({"command": kind, "target": i + 1}, AXES, errors, ".4f")
        for kind, key in kinds
        for i, errors in enumerate(found[key]["each"])
    ]


PANELS = 2


def draw(axes, rows: common.Rows) -> None:
    """Errors at the targets, raw and calibrated, each on its own scale."""
    for each, kind in zip(axes, ("raw", "calibrated"), strict=True):
        chosen = [r for r in rows if r["command"] == kind]
        errors = [[float(r[axis]) for axis in AXES] for r in chosen]
        plots.before_after(each, {kind: errors}, AXES, "°")


if __name__ == "__main__":
    common.main(sys.modules[__name__])
