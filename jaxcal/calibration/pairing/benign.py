"""What machines do: the table as it stands, with drift, a curve, another machine."""

from __future__ import annotations

import dataclasses

import numpy as np

from jaxcal.calibration.pairing.fit import Fitted, Table, as_it_is, fits_of

BEFORE = 2.0  # times its noise, a calibration explains readings
SESSIONS = {"offset", "parameters"}  # kinds of tables that join two


def _as_before(best: Fitted) -> bool:
    """Whether columns put right leave what a calibration's noise was, which is the unit
    here: no machine changes as by a sign, a unit or a place."""
    change = best.hypothesis.change
    if change is None:
        return False
    noise = change(best.noise[None])[0] if change.of_readings else best.noise
    return bool((np.abs(noise) <= BEFORE).all())


def benign_fits(table: Table, plain: Fitted, best: Fitted) -> list[Fitted]:
    """The table as it is, with what machines do: drift, curves, another machine."""
    count = len(table.commands)
    time = np.linspace(-1.0, 1.0, count)[:, None]
    extras = [time, np.hstack([time, time**2])]
    for column in table.commands.T:  # approached from one side
        extras.append(np.sign(np.gradient(column))[:, None])
    commands = table.commands - table.commands.mean(axis=0)
    commands = commands / (commands.std(axis=0) + 1e-300)
    n = commands.shape[1]
    i, j = np.triu_indices(n)
    squares = commands[:, i] * commands[:, j]
    cubes = np.hstack([squares[:, i == j], commands**3])
    for more in (squares, cubes, np.hstack([cubes, time])):
        if more.shape[1] + n + 1 < count // 2:
            extras.append(more)
    if best.hypothesis.kind in SESSIONS:
        for column in commands.T:
            for knot in np.quantile(column, np.linspace(0.1, 0.9, 9)):
                extras.append(np.maximum(column - knot, 0.0)[:, None])
    at = dataclasses.replace(table, theta=plain.theta)
    if not table.free.any():  # a machine that changed since it was calibrated
        ones = np.ones((count, 1))
        extras = [np.hstack([ones, extra]) for extra in extras]
    fits = [plain, *fits_of(at, [as_it_is(table, extra) for extra in extras])]
    if not (table.free.any() or _as_before(best)):
        for more in (ones, np.hstack([ones, commands])):
            code = more.shape[1] * float(np.log(table.width).sum())
            fits += fits_of(at, [as_it_is(table, more, code)])
    return fits
