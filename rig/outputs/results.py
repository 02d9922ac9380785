"""What a calibration comes to, in the files of its run."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

from jaxcal.extras import MissingExtraError
from rig.faults import EXIT_OK, EXIT_RECALIBRATE
from rig.journal.run_folder import Record, RunFolder
from rig.outputs.messages import recalibrate, summary_lines
from rig.pages import REPORT, write_report


def save_result(
    run: RunFolder, calibration: Any, summary: Record, say: Callable[[str], object]
) -> int:
    """Write what a calibration comes to, say what it holds; returns the exit code."""
    calibration.save(run.folder / "calibration.json")
    saved = ["calibration.json", "pairs.csv", "summary.json"]
    if run.config.is_arm:
        summary["urdf"] = "calibrated.urdf"
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            calibration.to_urdf(run.folder / summary["urdf"], force=True)
        for warning in caught:
            say(f"  note: {warning.message}")
        saved.insert(1, summary["urdf"])
    run.save_pairs()
    run.save_summary(summary)
    limit = run.config.session.verify_limit_deg
    for line in summary_lines(summary, limit):
        say(line)
    try:
        write_report(run.folder)
        saved.append(REPORT)
    except MissingExtraError as lack:
        say(f"  note: no report: {lack}")
    say(f"saved: {run.folder}/{', '.join(saved)}")
    return EXIT_RECALIBRATE if recalibrate(summary, limit) else EXIT_OK
