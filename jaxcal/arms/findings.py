"""What speaks against the calibration of an arm, by name."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxcal.arms.chain import SerialChain as Chain
from jaxcal.arms.sensors import Socket, Wrench
from jaxcal.arms.sensors.sensor import Readings, facts_of
from jaxcal.calibration.fit import outputs_at, stated_prior
from jaxcal.calibration.fit_model import fitted_again
from jaxcal.calibration.reasons import Reason, in_rows
from jaxcal.calibration.verdict import outlying
from jaxcal.checks import Array
from jaxcal.models.model import Rows

if TYPE_CHECKING:
    from jaxcal.arms.effects import Fit


MORE = "measure more postures: jaxcal postures --measured chooses them"
LOOK = (
    "look at the residuals (report, --report); use the nominal machine until they are "
    "explained"
)
CLEAR_UP = "fix the problems listed above, then run identify again"
_FAR = 4.0  # standard deviations of the prior
_MOVED = 3.0  # times the scatter of a socket's contacts: it was moved
_SHUFFLES = 400
_FEW = 4  # contacts: fewer that lie apart are outliers, not a socket that was moved
_LOOSE = 7.0  # standard deviations: no scatter, a reading of something else
_SPARSE = 12  # measurements: so few have no outlier that is scatter
_APART = 3.5  # standard deviations between a distance and what contacts say of it
_ALONE = 1e-4  # of what is known of a distance: nothing but that it was given
_SHORT = 5e-4  # of the arm's length: what no parameter explains moves distances by less
_WRONG = 1e-3  # of the arm's length: a distance further off was measured wrongly
_STILL = 8  # measurements in which a joint that is used has moved
_VAGUE = 3.0  # times the nominal error: the readings leave the arm open
_TIP = 0.004  # of the arm's length: tools are built nearer to their description
_LINK = 0.02  # of the arm's length: without a distance an arm shrinks to fit contacts
_ZERO = 10.0  # degrees: no zero of a joint is set so badly
_SHOWN = 0.5  # of the prior's variance: less was removed, readings hardly show it


def parts_of(fit: Fit, used: Rows) -> list[Readings]:
    """Readings of each sensor that has some, of the rows ``used`` (K,)."""
    parts = [
        part._replace(rows=used[part.rows], title=part.kind)
        for part in fit.model.readings(fit.commands[used], None)
        if len(part.rows)
    ]
    return [parts[0]._replace(title="")] if len(parts) == 1 else parts


def unit_after(fit: Fit) -> str:
    """The unit of lengths after a number, where it is known."""
    unit = fit.model.length_unit(fit.measured_unit)
    return f" {unit}" if unit else ""


def findings_of(
    fit: Fit,
    used: Rows,
    parts: list[Readings],
    scatter: Reason | None,
    mistaken: str,
    vague: Reason | None,
    more: bool,
) -> tuple[tuple[str, ...], bool, str]:
    """What is wrong, by name, of the rows ``used`` (K,); whether nothing is that casts
    doubt on readings or description; what to do about a calibration that is not good.

    ``scatter``, ``mistaken`` (columns) and ``vague`` (the arm left open) are what was
    seen already; ``more`` measurements may help.
    """
    model = fit.model
    of_parts = [_swapped(fit, part, scatter is None) for part in parts]
    swapped = {row: other for rows in of_parts for row, other in rows.items()}
    exchanged = [line for part in parts for line in _exchanged(fit, part)]
    limit = _LOOSE if len(used) > _SPARSE else 0.0
    usual = np.asarray(model.default_noise().std)  # of the sensor, or as was said
    of_noise = scatter is not None and fit.noise_known  # all rows are far off
    outliers = [] if of_noise else [*fit.outliers]
    far = fit.distance[outliers] > limit**2
    far &= (np.abs(fit.residuals[outliers]) > limit * usual).any(axis=1)
    contradict = bool(swapped or exchanged or far.any())
    contradicting = sorted({*swapped, *outliers}) if contradict else []
    reasons = ["some readings contradict the others"] * contradict
    reasons += [scatter.fact] if scatter else []
    reasons += _wrong_rows(fit, used, parts, swapped, outliers)
    moved = {part.kind: _moved(fit, part, swapped) for part in parts}
    kind = next((kind for kind, lines in moved.items() if lines), "")
    tip, doubtful = _other_tip(fit, model)
    other_arm = [] if mistaken else _other_links(fit, parts)
    judged = [] if other_arm else parts
    apart, wrong = other_distances(fit, judged, model.length)
    still, unused = _still(model, fit.commands[used])
    reasons += [line for lines in moved.values() for line in lines]
    reasons += exchanged + _far(fit) + tip + other_arm + apart + still + _kept(fit)
    reasons += [
        f"The readings show a mass of {fit.parameters[part.own][0]:.3g} kg. If "
        "the controller subtracts a payload, this is the load less that payload: set "
        "the payload to zero, or add what is subtracted."
        for part in parts
        if isinstance(part.sensor, Wrench)
    ]
    doubtful |= wrong or unused or mistaken != ""
    doubtful |= bool(contradicting or exchanged or other_arm)
    reasons += [vague.fact] if vague else []
    residuals = scatter.remedy if scatter else LOOK
    steps = (
        (mistaken, "correct the columns, then identify again"),
        (exchanged, "look at the sockets' columns"),
        (of_noise, residuals),
        (
            contradicting,
            f"look at {in_rows(contradicting)} (counted from 0): correct, repeat or "
            "leave out",
        ),
        (
            kind and scatter,
            f"measure again with the {kind} fixed, or number it as two: before and "
            "after it moved",
        ),
        (doubtful, CLEAR_UP),
        (vague, vague.remedy if vague else ""),
        (more, MORE),
        (True, residuals),
    )
    step = next(step for holds, step in steps if holds)
    clean = not (doubtful or vague or (kind and scatter))
    # What the fit made of mistaken columns is no reason.
    return (mistaken,) if mistaken else tuple(reasons), clean, step


def left_open(
    parts: list[Readings], unit: str, anywhere: float, nominal: float
) -> Reason | None:
    """The readings leave the arm open, where they do: of contacts the size, since a
    smaller arm touches nearer sockets as well."""
    sockets = [part for part in parts if isinstance(part.sensor, Socket)]
    sized = any(part.touched().any() for part in sockets)
    if sized or not anywhere > _VAGUE * nominal:
        return None
    fact, remedy = "Too few readings", MORE
    if sockets:
        remedy = "give the distance between two sockets (distances=, --distance)"
        fact = (
            "The distance between two sockets is missing, so the arm's size is unknown"
        )
    return Reason(
        f"{fact}: away from the measured poses the tip is uncertain by {anywhere:.2g}"
        f"{unit}; uncalibrated it is off by {nominal:.2g}{unit}.",
        remedy,
    )


def _wrong_rows(
    fit: Fit,
    used: Rows,
    parts: list[Readings],
    swapped: dict[int, int],
    outliers: list[int],
) -> list[str]:
    """Rows of another socket, outliers, and contacts that were written twice."""
    commands = fit.commands
    of_row = {row: part for part in parts for row in part.rows.tolist()}
    said = [
        f"measurement {row} fits {of_row[row].kind} {other} instead"
        for row, other in sorted(swapped.items())
    ]
    loose = [row for row in outliers if row not in swapped]
    if reason := outlying(fit, loose):
        said.append(reason.fact)
    for doubled in np.flatnonzero(fit.loss_weights == 0.0):
        same = (commands[used] == commands[doubled]).all(axis=1)
        if same.any() and of_row[used[same][0]].sensor.zeros:
            said.append(f"measurement {doubled} repeats {used[same][0]}, counted once")
    return said


def _far(fit: Fit) -> list[str]:
    """Parameters that were found far from what was known of them."""
    p = len(fit.names)
    off = np.abs(fit.parameters - fit.prior_mean[:p])
    off = off * np.sqrt(fit.prior_precision[:p]) * fit.free[:p]
    return [
        f"{fit.names[i]} is {off[i]:.2g} standard deviations from its prior: is the "
        "tip, file or unit wrong?"
        for i in np.flatnonzero(off > _FAR)
    ]


def _kept(fit: Fit) -> list[str]:
    """Shifts of the tool that contacts do not show."""
    sensor = fit.model.sensor.members[0]
    if not sensor.zeros or sensor.views:
        return []
    shares = zip(fit.names, np.asarray(fit.from_data), strict=True)
    kept = [name for name, x in shares if name[:-1] == "tool " and x < _SHOWN]
    if not kept:
        return []
    return [
        f"{', '.join(kept)}: not shown by these contacts, kept at the nominal value. "
        "To find it, add contacts with the tool turned other ways."
    ]


def _other_tip(fit: Fit, model: Chain) -> tuple[list[str], bool]:
    """A tip far from where the arm's description has it, and whether that is in doubt:
    it is farther off than the prior allowed."""
    names = fit.names
    # Others' places on the tool are loose; those of a camera or board are asked for.
    if not model.sensor.members[0].zeros or "tool rx" in names:
        return [], False
    at = [names.index(f"tool {axis}") for axis in "xyz" if f"tool {axis}" in names]
    moved = fit.parameters[at] - model.nominal[at]
    variance = moved @ np.asarray(fit.covariance)[np.ix_(at, at)] @ moved
    far = float(np.linalg.norm(moved))
    if far**2 - 2.0 * np.sqrt(variance) <= _TIP * model.length * far:
        return [], False
    std = float(np.sqrt(variance)) / far
    allowed = 2.0 / np.sqrt(fit.prior_precision[at].max() + 1e-300)
    by = ", ".join(f"{shift:.3g}" for shift in moved)
    return [
        f"the tip is {far:.3g}{unit_after(fit)} from its place in the arm's "
        f"description (tool {by}), uncertainty {std:.2g}: is it another tip?"
    ], bool(far > allowed)


def other_distances(
    fit: Fit, parts: list[Readings], length: float
) -> tuple[list[str], bool]:
    """Distances that were given and that the contacts contradict; by much or not.

    Each that seems so, to first order, is freed: the readings are fitted without it.
    """
    said, most, unit = [], 0.0, unit_after(fit)
    for part in parts:
        distances = getattr(part.sensor, "distances", ())
        if not len(distances):
            continue
        off, rows = facts_of([(part.sensor, part.own)], fit.parameters)
        _, facts = fit.model.fitting.facts(fit.parameters)
        spread = rows @ _at_these_sizes(fit, facts)
        share = np.minimum((spread * rows).sum(axis=1), 1.0 - 1e-9)
        change = np.array(distances)[:, 3] * np.abs(off) / (1.0 - share)
        doubtful = np.abs(off) > _APART * np.sqrt(1.0 - share)
        doubtful &= (share < 1.0 - _ALONE) & (change > _SHORT * length)
        doubtful &= part.touched() & ~part.judged
        for k in np.flatnonzero(doubtful).tolist():
            first, second, distance, std = distances[k]
            free, free_std = _freed(fit, part, k)
            change[k] = abs(free - distance)
            sure = change[k] > _APART * np.hypot(free_std, std)
            if not sure or change[k] < _SHORT * length:
                continue
            most = max(most, change[k])
            said.append(
                f"the distance of {part.kind}s {first:.0f} and {second:.0f} was given "
                f"as {distance:g}{unit}, but the contacts and the arm's lengths give "
                f"{free:.4g} +- {free_std:.2g}: measure that distance again"
            )
    return said, most > _WRONG * length


def _freed(fit: Fit, part: Readings, row: int) -> tuple[float, float]:
    """A given distance as the readings have it without it, and its deviation."""
    model, touched = fit.model, part.touched()
    touched[row] = False
    sensor: Any = part.sensor
    distances = sensor.distances
    rest = [one for one, kept in zip(distances, touched, strict=True) if kept]
    free = model._with_member(part.member, dataclasses.replace(sensor, distances=rest))
    again = fitted_again(fit, free, stated_prior(fit))
    _, _, distance, std = distances[row]
    if again.covariance is None:  # too few readings to tell the noise without it
        return distance, np.inf
    off, rows = facts_of([(part.sensor, part.own)], again.parameters)
    variance = rows[row] @ again.covariance @ rows[row]
    return distance - std * off[row], std * float(np.sqrt(variance))


def _at_these_sizes(fit: Fit, facts: Array) -> Array:
    """(p, p) covariance of the parameters by the readings and ``facts`` (F, p) alone,
    the sizes of the arm's errors held."""
    used = np.flatnonzero(fit.loss_weights > 0.0)
    theta = fit.parameters
    slopes = np.asarray(fit.model.jacobian(fit.commands[used], theta))
    weight = np.sqrt(np.minimum(fit.loss_weights[used], 1.0))[:, None, None]
    rows = weight * slopes / np.asarray(fit.noise_std)[:, None]
    rows = np.vstack([rows.reshape(-1, len(theta)), facts])
    free = np.flatnonzero(fit.free[: len(theta)])
    information = rows[:, free].T @ rows[:, free] + np.diag(fit.prior_precision[free])
    scale = 1.0 / np.sqrt(information.diagonal() + 1e-300)
    scaled = scale[:, None] * information * scale
    inverse = np.linalg.pinv(scaled, 1e-13, hermitian=True)
    covariance = np.zeros((len(theta), len(theta)))
    covariance[np.ix_(free, free)] = scale[:, None] * inverse * scale
    return covariance


def _still(model: Chain, commands: Array) -> tuple[list[str], bool]:
    """Columns that never change, and whether one may not be recorded."""
    joints = commands[:, : model.num_joints]
    if len(joints) < _STILL:
        return [], False
    still = np.flatnonzero((joints == joints[0]).all(axis=0))
    said = [
        f"{model.joint_names[i]} is {joints[0, i] + 0.0:g} in all {len(joints)} "
        "measurements: was it recorded? Its parameters come from the prior"
        for i in still
    ]
    return said, bool((joints[0, still] == 0.0).any())


def _other_links(fit: Fit, parts: list[Readings]) -> list[str]:
    """Lengths and zeros far from the arm's description, if a prior allowed that."""
    model = fit.model
    names, units = np.array(model.names), np.array(model.units)
    off = np.abs(fit.parameters - model.nominal)
    std = np.asarray(fit.standard_errors)
    sure = np.where(np.isfinite(std), off - 2.0 * std, 0.0)[: model.table.size]
    lengths = units[: model.table.size] == "length"
    far = np.flatnonzero(lengths & (sure > _LINK * model.length))
    reasons = []
    tracked = any(p.sensor.positions and not p.sensor.relative for p in parts)
    if far.size and not tracked:
        reasons.append(
            f"{', '.join(names[far])}: up to {off[far].max():.3g}"
            f"{unit_after(fit)} from the arm's description. Are the readings "
            "of another arm, in another unit, of a board of another size, or of "
            "several sockets numbered as one?"
        )
    turned = np.char.startswith(names[: model.table.size], "theta")
    return reasons + [
        f"{names[i]} is {off[i]:.3g} degrees from the arm's description: is the "
        "joint's zero or sign wrong?"
        for i in np.flatnonzero(turned & (sure > _ZERO))
    ]


def _exchanged(fit: Fit, part: Readings) -> list[str]:
    """Sockets that were found where others were said to be."""
    sensor = part.sensor
    if not isinstance(sensor, Socket) or sensor.places is None:
        return []
    places = fit.parameters[part.own]
    apart = np.linalg.norm(places.reshape(-1, 1, 3) - sensor.places, axis=-1)
    nearest = apart.argmin(axis=1)
    if len(np.unique(nearest)) < len(nearest):  # one was moved, or the arm is far off
        return []
    return [
        f"{part.kind} {i} was found at the stated place of socket {j}: are their rows "
        "exchanged?"
        for i, j in enumerate(nearest)
        if i != j and apart[i, j] < 0.5 * apart[i, i]
    ]


def _moved(fit: Fit, part: Readings, swapped: dict[int, int]) -> list[str]:
    """Sockets and planes whose first and last contacts lie apart."""
    reasons, unit, rng = [], unit_after(fit), np.random.default_rng(0)
    width = len(part.scale)
    for i, of_one in enumerate(part.groups()):
        rows = of_one[~np.isin(of_one, list(swapped))]
        residuals = fit.residuals[rows, :width] * part.scale
        if len(rows) < 2 * _FEW:
            continue
        gain, at, apart, within = _split(residuals)
        if apart < _MOVED * within:
            continue
        shuffled = [_split(rng.permutation(residuals))[0] for _ in range(_SHUFFLES)]
        if gain > np.quantile(shuffled, 0.99):
            first, last = rows[:at], rows[at:]
            reasons.append(
                f"{part.kind} {i} seems to have moved by {apart:.3g}{unit} "
                f"between measurements {first[-1]} and {last[0]}"
            )
    return reasons


def _split(values: Array) -> tuple[float, int, float, float]:
    """Best split of (n, q) in two: what the squares lose, where, step, scatter."""
    n = len(values)
    sums = np.cumsum(values, axis=0)
    at = np.arange(_FEW, n - _FEW + 1)
    first = sums[at - 1] / at[:, None]
    last = (sums[-1] - sums[at - 1]) / (n - at)[:, None]
    apart = np.linalg.norm(first - last, axis=1)
    gain = apart**2 * at * (n - at) / n
    best = int(gain.argmax())
    total = float(((values - values.mean(axis=0)) ** 2).sum())
    within = np.sqrt(max(total - gain[best], 0.0) / (n - 2))
    return float(gain[best]), int(at[best]), float(apart[best]), float(within)


def _swapped(fit: Fit, part: Readings, explains: bool) -> dict[int, int]:
    """Outliers that fit another socket or plane, as if their column were wrong."""
    model, sensor = fit.model, part.sensor
    if not (sensor.zeros and sensor.num_places > 1):
        return {}
    noise = np.asarray(fit.noise_std)
    at = part.rows[np.isin(part.rows, list(fit.outliers))]
    swaps: dict[int, int] = {}
    if at.size:
        trial = np.repeat(fit.commands[None, at], sensor.num_places, axis=0)
        column = model.num_joints + model.sensor.inputs.index(sensor.inputs[0])
        stated = trial[..., column].copy()
        trial[..., column] = np.arange(sensor.num_places)[:, None]
        off = np.abs(outputs_at(fit, trial) / noise).max(axis=-1)
        for other, row in np.argwhere((off < 4.0) & (stated != trial[..., column])):
            swaps[int(at[row])] = int(other)
    if isinstance(sensor, Socket) and not explains:
        # So many that none is an outlier: by the arm as described, where that can tell.
        points = part.tip.position
        labels, which = np.unique(sensor.of_rows(part.columns), return_inverse=True)
        middles = [np.median(points[which == i], axis=0) for i in range(len(labels))]
        apart = np.linalg.norm(points[:, None] - middles, axis=-1)
        as_stated, nearest = apart[np.arange(len(which)), which], apart.min(axis=1)
        if np.median(as_stated) < 0.5 * np.median(apart.max(axis=1)):
            wrong = np.flatnonzero(nearest < 0.8 * as_stated)
            fits = labels[apart[wrong].argmin(axis=1)]
            swaps |= dict(zip(part.rows[wrong].tolist(), fits.tolist(), strict=True))
    return swaps
