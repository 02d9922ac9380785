"""collect: random postures, as the paper's Datasets 4 and 5."""

from __future__ import annotations

import numpy as np

from jaxcal.files import atomic_write
from rig.command_run import Run
from rig.core.device import Posture
from rig.core.session import visit
from rig.faults import EXIT_OK, EXIT_RECALIBRATE
from rig.identification.fit_affine import pairs
from rig.outputs.messages import numbers
from rig.procedures.calibrate import END
from rig.procedures.plan import draw


def collect(run: Run, count: int) -> int:
    """Record ``count`` random postures: the paper's Datasets 4 and 5.

    Writes pairs.csv and dataset.npz with ``candidates`` and ``measured`` of shape
    (episodes, M, n) and (episodes, M, m), M as configured; the last, unfinished
    episode is in the CSV only.
    """
    config = run.config
    targets = run.remember(
        "collection", lambda: {"pulses": draw(config, count, 2).tolist()}
    )["pulses"]
    if run.dry_run:
        for number, target in enumerate(targets):
            run.say(f"  {number:>5}   {numbers(config.to_deg(target))}   {target}")
    names = [f"collect:{number}" for number in range(len(targets))]
    if run.lacks([*names, END]):
        with run.device() as device:
            for name, target in zip(names, targets, strict=True):
                visit(device, Posture(name, tuple(target)), role="collect")
            visit(device, Posture(END, run.zero_pulses), role="reference")
            run.emit("phase", phase="saving")
    closing = run.postures().get(END)
    collected = [r for r in run.postures().values() if r["role"] == "collect"]
    commands, measured = pairs(collected)
    size = min(config.session.candidates, len(commands))
    episodes = len(commands) // max(1, size)
    run.save_pairs()
    with atomic_write(run.folder / "dataset.npz") as file:
        np.savez(
            file,
            candidates=commands[: episodes * size].reshape(episodes, size, -1),
            measured=measured[: episodes * size].reshape(episodes, size, -1),
        )
    run.say(
        f"saved: {run.folder}/pairs.csv ({len(commands)} postures), dataset.npz "
        f"({episodes} x {size})"
    )
    drift = np.abs(closing["measured_deg"]).max() if closing else 0.0
    limit = config.session.drift_limit_deg
    if drift > limit:
        run.say(
            f"RECALIBRATE: at the end the zero posture reads {drift:.3f} "
            f"{config.output_unit} (limit session.drift_limit_deg = {limit:g}). Fix "
            f"{'the sensor' if config.readings else 'the phone'}, and collect again"
        )
        return EXIT_RECALIBRATE
    return EXIT_OK
