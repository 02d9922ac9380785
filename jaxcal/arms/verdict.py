"""Can a calibration be trusted: does its model explain the readings, does it help?

Held-out errors are those of leaving out one measurement at a time, to first order:
with predicted covariance S and noise R the residual r becomes ``R (R - S)^-1 r``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxcal.arms.effects import SCATTER, in_words, play_in_words, scatter
from jaxcal.arms.mistaken import mistaken_columns
from jaxcal.arms.sensors import (
    Pose,
    Sensor,
    Socket,
    Wrench,
)
from jaxcal.arms.sensors.sensor import hats
from jaxcal.information.singular import depends, significant
from jaxcal.models import verdict as models
from jaxcal.models.reasons import (
    Reason,
    computed,
    in_rows,
    never_measured,
    outlying,
    wrong_noise,
)
from jaxcal.models.verdict import left_out

if TYPE_CHECKING:
    from jaxcal.arms.chain import SerialChain as Chain
    from jaxcal.calibration import Calibration

    class ArmFit(Calibration):
        """A calibration of an arm, or of several."""

        model: Chain

        def again(self, *given: Any) -> ArmFit: ...

        @property
        def verdict(self) -> ArmVerdict: ...

    Fit = ArmFit


Array = NDArray[np.float64]

_LOOK = (
    "look at the residuals (report, --report); keep the nominal machine until they are "
    "explained"
)
_MORE = "measure more postures: jaxcal postures --measured chooses them"
CLEAR_UP = "fix the problems listed above, then run identify again"

_FAR = 4.0  # standard deviations of the prior
_MOVED = 3.0  # times the scatter of a socket's contacts: it was moved
_SHUFFLES = 400
_FEW = 4  # contacts: fewer that lie apart are outliers, not a socket that was moved
_LOOSE = 7.0  # standard deviations: no scatter, a reading of something else
_SPARSE = 12  # measurements: so few have no outlier that is scatter
_LITTLE = 1.0 / 3.0  # of the nominal error: so little left is worth having anyway
_APART = 3.5  # standard deviations between a distance and what contacts say of it
_ALONE = 1e-4  # of what is known of a distance: nothing but that it was given
_SHORT = 5e-4  # of the arm's length: what no parameter explains moves distances by less
_WRONG = 1e-3  # of the arm's length: a distance further off was measured wrongly
_STILL = 8  # measurements in which a joint that is used has moved
_VAGUE = 3.0  # times the nominal error: the readings leave the arm open
_TIP = 0.004  # of the arm's length: tools are built nearer to their description
_LINK = 0.02  # of the arm's length: without a distance an arm shrinks to fit contacts
_ZERO = 10.0  # degrees: no zero of a joint is set so badly
_LOUD = 10.0  # times the usual noise
_PLACED = 0.01  # of the arm's length: a camera known to that is found
_SHOWN = 0.5  # of the prior's variance: less was removed, readings hardly show it
_UNSHOWN = 0.5  # of the usual variance: so much is left, readings hardly show it
_NO_WORSE = 2.0  # times the nominal error: an accurate arm that few readings bend
_PLAIN = 0.01  # of the arm's length: columns as they should be are nearer than that
_DRAWN = 200  # postures anywhere within the limits


@dataclasses.dataclass(frozen=True)
class HeldOut:
    """Mean errors of a measurement in one unit, of readings left out of the fit."""

    of: str  # kind of the sensor, where there are several
    unit: str  # "length": that of the arm, which is not known
    held_out: float
    interval: tuple[float, float]  # 95 % of that mean
    nominal: float  # of the nominal machine

    def says(self, value: float) -> str:
        """A number of it in words."""
        return f"{value:.3g} {'' if self.unit == 'length' else self.unit}".strip()


@dataclasses.dataclass(frozen=True, kw_only=True)
class ArmVerdict(models.Verdict):
    """What the readings say of an arm's calibration.

    Good: held-out errors are below the accuracy asked for. Where none was, it is better
    than the nominal machine, and the noise explains the scatter or what is left is a
    third of the nominal error; of an accurate arm with a camera or a board, the place
    of that is known. In each case no reading contradicts the others or the arm's
    description, and contacts do not leave its size open.
    """

    # None where there are too few measurements to tell.
    explains: bool | None = None  # the scatter of the readings is what the noise can be
    helps: bool | None = None  # held-out errors are below those of the nominal machine
    clean: bool | None = None  # no reading contradicts the others or the description
    errors: tuple[HeldOut, ...] = ()  # of each sensor and unit
    anywhere: float = np.nan  # standard deviation within the limits; NaN if not known
    accuracy: Mapping[str, float] | None = None  # that was asked for, by unit
    sessions: str = ""  # what is known of how they differ
    place: Place | None = None  # of a camera or board on the tip
    length_unit: str = ""

    @property
    def held_out(self) -> float:
        """Mean held-out error of a measurement, in the first unit."""
        return self.errors[0].held_out if self.errors else np.nan

    @property
    def interval(self) -> tuple[float, float]:
        """95 % of ``held_out``."""
        return self.errors[0].interval if self.errors else (np.nan, np.nan)

    @property
    def nominal(self) -> float:
        """Mean error of the nominal machine, in the first unit."""
        return self.errors[0].nominal if self.errors else np.nan

    def lines(self) -> tuple[str, ...]:
        """The errors, and what speaks against the calibration."""
        if self.explains is None:
            return self.reasons
        length = f" {self.length_unit}" if self.length_unit else ""
        lines = [
            f"Cross-validated error{f' of {one.of}' if one.of else ''} "
            f"{one.says(one.held_out)} (95 %: {one.interval[0]:.3g} to "
            f"{one.interval[1]:.3g}); before calibration {one.says(one.nominal)}."
            for one in self.errors
        ]
        if np.isfinite(self.anywhere):
            lines.append(
                f"Tip uncertainty over the workspace: {self.anywhere:.3g}{length} (1 "
                "sigma, base frame excluded)."
            )
        if self.place is not None:
            lines.append(
                "Place of the camera or board on the tip: known to "
                f"{self.place.says(length)} (1 sigma)."
            )
        lines += [self.sessions] if self.sessions else []
        for one in _missed(self.errors, self.accuracy):
            asked = one.says((self.accuracy or {})[one.unit])
            lines.append(f"Not the accuracy you asked for, {asked}.")
        if not self.explains:
            lines.append("This model does not explain these readings by its noise.")
        if self.place is not None and not self.helps:
            lines.append("The arm itself was as accurate before.")
        elif self.helps is None:
            lines.append("It may not be better than the nominal machine.")
        elif not self.helps:
            lines.append("It is no better than the nominal machine.")
        return (*lines, *self.reasons)


def _missed(
    errors: Sequence[HeldOut], accuracy: Mapping[str, float] | None
) -> list[HeldOut]:
    """Errors that are not below the accuracy asked for."""
    asked = accuracy or {}
    return [one for one in errors if one.interval[1] > asked.get(one.unit, np.inf)]


def verdict(calibration: Fit) -> ArmVerdict:
    """Does its model explain the readings, does it help, what is wrong.

    Held-out errors with an interval beside those of the nominal arm, the scatter
    against the sensor's usual noise, and by name: outliers, contacts of another socket,
    a socket that was moved, a distance that contacts contradict, joints reversed or
    exchanged, parameters far from what was known.
    """
    model, unit = calibration.model, calibration.measured_unit
    if calibration.noise_std is None:
        return ArmVerdict(
            good=False,
            reasons=(calibration.no_noise("intervals and no verdict"),),
            next_step="measure more postures, or state noise_std, --noise (this "
            f"sensor's usual one: {_usual_noise(calibration)})",
            unit=unit,
        )
    reason = None
    if not model.sensor.zeros:
        reason = never_measured(calibration) or computed(calibration)
    if reason is not None:
        return ArmVerdict(
            good=False, reasons=(reason.fact,), next_step=reason.remedy, unit=unit
        )
    used = np.flatnonzero(calibration.loss_weights > 0.0)
    commands, usual = calibration.commands[used], np.asarray(model.default_noise().std)
    measured = calibration.measured[used]
    parts = _parts(calibration, used)
    held_out, off = _errors(calibration, used, measured, parts)
    errors = [
        one
        for part in parts
        for one in _in_units(calibration, part, parts, held_out, off)
    ]
    helps = _helps(held_out[used] / usual, off[used] / usual)
    scatter = _scattered(calibration, usual, parts)
    explains = scatter is None
    mistaken = ""
    if not explains and errors[0].nominal > _PLAIN * model.length:
        mistaken = mistaken_columns(model, commands, measured)
    findings = _findings(calibration, used, parts, scatter, mistaken)
    at, anywhere = _anywhere(calibration, model, parts)
    nominal = next(one.nominal for one in errors if one.of == _title(parts[at], parts))
    findings = _left_open(findings, parts, _in(calibration), anywhere, nominal)
    clean = not (findings.doubtful or (findings.moved and not explains))
    place = None
    if all(part.sensor.views for part in parts):
        place = place_of(calibration, [f"tool {axis}" for axis in Pose.tool])
    reach = model.length or float(np.ptp(parts[0].points, axis=0).max())
    reasons = findings.reasons
    if place is not None and place.hidden:
        reasons += (
            f"{', '.join(place.hidden)}: not shown by these views, kept as described. "
            "Views with the tip turned about another axis would show it, or measure it "
            "and give tool=",
        )
    if not explains and not calibration.noise_known:
        unit_of_first = "" if errors[0].unit == "length" else f" {errors[0].unit}"
        reasons += tuple(in_words(calibration, unit_of_first))
        reasons += tuple(play_in_words(calibration, unit_of_first))
    accuracy = calibration.provenance.get("accuracy")
    if isinstance(accuracy, float):  # of a file of 0.2
        accuracy = {errors[0].unit: accuracy}
    if accuracy is not None:
        good = clean and not _missed(errors, accuracy)
    elif place is not None and place.std[0] < _PLACED * reach and explains:
        good = clean and helps.ratio < _NO_WORSE
    else:
        good = bool(clean and helps.helps and (explains or helps.most < _LITTLE))
    more = accuracy is not None or helps.helps is None
    return ArmVerdict(
        good=good,
        reasons=reasons,
        next_step=models.USE
        if good
        else _next_step(findings, scatter, calibration.noise_known, more),
        unit=unit,
        explains=explains,
        helps=helps.helps,
        clean=clean,
        errors=tuple(errors),
        anywhere=anywhere,
        accuracy=accuracy,
        place=place,
        sessions=_sessions(calibration, errors[0]),
        length_unit=model.length_unit(unit),
    )


class Place(NamedTuple):
    """How well the readings determine a place that was unknown before."""

    std: tuple[float, float]  # of what they show, in length and degrees
    hidden: tuple[str, ...]  # parameters that they do not show

    def says(self, unit: str) -> str:
        """Both in words; of what is not shown nothing."""
        sizes = [f"{self.std[0]:.2g}{unit or ' in length'}", f"{self.std[1]:.2g} deg"]
        turns = [name for name in self.hidden if name[-2] == "r"]
        lost = [len(self.hidden) - len(turns) == 3, len(turns) == 3]
        shown = [size for size, none in zip(sizes, lost, strict=True) if not none]
        return " and ".join(shown) or "nothing"


def place_of(calibration: Fit, names: Sequence[str]) -> Place:
    """How well six shifts and turns are known.

    Hidden are those in directions of which the readings leave half of what is usual of
    a tool: along a SCARA's axes, and all shifts of a gantry, whose tool never turns.
    """
    model = calibration.model
    at = np.array([model.names.index(name) for name in names])
    size = np.repeat([0.1 * (model.length or 1.0), 1.7], 3)
    scaled = np.asarray(calibration.covariance)[np.ix_(at, at)] / np.outer(size, size)
    lost = np.flatnonzero(calibration.undetermined[at])
    scaled[lost, lost] += 1.0
    square, axes = np.linalg.eigh(scaled)
    vague = square > _UNSHOWN
    shown = size[:, None] * axes[:, ~vague] * np.sqrt(square[~vague].clip(0.0))
    hidden = (axes[:, vague] ** 2).sum(axis=1) > _UNSHOWN
    std = np.sqrt((shown**2).sum(axis=1).reshape(2, 3).sum(axis=1))
    named = tuple(np.array(names)[hidden].tolist())
    return Place((float(std[0]), float(std[1])), named)


class Part(NamedTuple):
    """What one sensor of an arm read: of ``Several`` each, else the only one.

    Or of arms that share it.
    """

    member: int  # number of it
    sensor: Sensor
    kind: str  # of it, for a message
    rows: NDArray[np.intp]  # (K,) measurements that are used
    columns: Array  # (K, e) of their commands
    points: Array  # (K, 3) where the arm as described has it
    own: slice | NDArray[np.intp]  # of the parameters
    scale: Array  # (q,) its unit in that of the calibration's readings
    judged: NDArray[np.bool_] | None = None  # (D,) distances, of one of the arms alone

    def groups(self) -> list[NDArray[np.intp]]:
        """Rows of each socket, plane or anchor, in the order of measuring."""
        which = self.sensor.of_rows(self.columns)
        return [self.rows[which == i] for i in range(self.sensor.num_places)]

    def touched(self) -> NDArray[np.bool_]:
        """(D,) distances both of whose sockets have contacts of this arm."""
        pairs = np.array(getattr(self.sensor, "distances", ())).reshape(-1, 4)[:, :2]
        labels = self.sensor.of_rows(self.columns)
        return np.asarray(np.isin(pairs, labels).all(axis=1))


def _sessions(calibration: Fit, first: HeldOut) -> str:
    """How sessions differ, in a sentence."""
    of_sessions = calibration.provenance.get("sessions")
    if of_sessions is None:
        return (
            "On another day, or mounted again, it may be off by more: unknown from one "
            "session (sessions=, --session)."
        )
    quantity = calibration.model.quantities(calibration.measured_unit)[0]
    size = first.says(float(quantity.size(calibration.session_std)))
    return f"Another session differs by {size} (1 sigma), which predictions count."


def _parts(calibration: Fit, used: NDArray[np.intp]) -> list[Part]:
    """Readings of each sensor that has some."""
    model, commands = calibration.model, calibration.commands[used]
    tip, inputs = model.nominal_tip(commands), commands[:, model.num_joints :]
    kinds = [one.kind for one in model.sensor.members]
    parts = []
    for i, read in enumerate(model.sensor.of_members(tip, inputs, None)):
        twice = kinds.count(read.sensor.kind) > 1
        kind = f"sensor {i}'s {read.sensor.kind}" if twice else read.sensor.kind
        if len(read.rows):
            parts.append(
                Part(
                    i,
                    read.sensor,
                    kind,
                    used[read.rows],
                    read.columns,
                    read.tip.position,
                    model.own(i),
                    read.scale,
                )
            )
    return parts


class _Findings(NamedTuple):
    """What speaks against a calibration, and the sentences that say it."""

    reasons: tuple[str, ...]
    mistaken: bool  # columns of joints are reversed or exchanged
    exchanged: bool  # so are sockets
    moved: str  # kind of what seems to have moved: socket, plane
    contradicting: tuple[int, ...]  # measurements that contradict the others
    doubtful: bool  # the readings or the description of the arm may be wrong
    remedy: str = CLEAR_UP  # of the doubt


def _findings(
    calibration: Fit,
    used: NDArray[np.intp],
    parts: list[Part],
    scatter: Reason | None,
    mistaken: str,
) -> _Findings:
    """What is wrong, by name.

    Args:
        calibration: of an arm.
        used: (N,) rows of the measurements that count.
        parts: of its sensors.
        scatter: what the noise does not explain.
        mistaken: what was said of reversed or exchanged columns, if they are.
    """
    model = calibration.model
    swapped: dict[int, int] = {}
    for part in parts:
        swapped |= _swapped(calibration, part, scatter is None)
    exchanged = [line for part in parts for line in _exchanged(calibration, part)]
    limit = _LOOSE if len(used) > _SPARSE else 0.0
    of_noise = scatter is not None and calibration.noise_known  # all rows are far off
    outliers = [] if of_noise else [*calibration.outliers]
    far = (calibration.distance[outliers] > limit**2).any()
    contradicting: tuple[int, ...] = ()
    reasons = _wrong_rows(calibration, used, parts, swapped, outliers)
    if scatter:
        reasons.insert(0, scatter.fact)
    if swapped or exchanged or far:
        reasons.insert(0, "some readings contradict the others")
        contradicting = tuple(sorted({*swapped, *outliers}))
    moved = {part.kind: _moved(calibration, part, swapped) for part in parts}
    moved_lines = [line for lines in moved.values() for line in lines]
    tip, doubtful = _other_tip(calibration, model)
    other_arm = [] if mistaken else _other_links(calibration, parts)
    apart, wrong = (
        ([], False) if other_arm else other_distances(calibration, parts, model.length)
    )
    still, unused = _still(model, calibration.commands[used])
    reasons += moved_lines + exchanged + _far(calibration)
    reasons += tip + other_arm + apart + still + _kept(calibration)
    reasons += _net_mass(calibration, parts)
    doubtful |= wrong or unused
    doubtful |= bool(contradicting or exchanged or other_arm or mistaken)
    return _Findings(
        # What the fit made of mistaken columns is no reason.
        (mistaken,) if mistaken else tuple(reasons),
        bool(mistaken),
        bool(exchanged),
        next((kind for kind, lines in moved.items() if lines), ""),
        contradicting,
        doubtful,
    )


def _usual_noise(calibration: Fit) -> str:
    """The sensor's noise as noise_std takes it: one number, or one of each output."""
    usual = np.broadcast_to(
        np.asarray(calibration.model.default_noise().std), (calibration.num_outputs,)
    )
    if np.ptp(usual) == 0.0:
        usual = usual[:1]
    return ",".join(f"{std:.2g}" for std in usual)


def _left_open(
    findings: _Findings,
    parts: list[Part],
    unit: str,
    anywhere: float,
    nominal: float,
) -> _Findings:
    """The findings, and that the readings leave the arm open, where they do.

    Of contacts the size: an arm a tenth smaller, its sockets nearer together, touches
    them as well.
    """
    sockets = [part for part in parts if part.sensor.socketed]
    sized = any(part.touched().any() for part in sockets)
    if findings.mistaken or sized or not anywhere > _VAGUE * nominal:
        return findings
    if not sockets:
        reason, remedy = "Too few readings:", _MORE
    else:
        remedy = "give the distance between two sockets (distances=, --distance)"
        reason = (
            "The distance between two sockets is missing, so the arm's size is open:"
        )
    reason += (
        f" away from the measured poses the tip is uncertain by {anywhere:.2g}{unit}; "
        f"uncalibrated it is off by {nominal:.2g}{unit}."
    )
    return findings._replace(
        reasons=(*findings.reasons, reason),
        doubtful=True,
        remedy=findings.remedy if findings.doubtful else remedy,
    )


def _wrong_rows(
    calibration: Fit,
    used: NDArray[np.intp],
    parts: list[Part],
    swapped: dict[int, int],
    outliers: list[int],
) -> list[str]:
    """Rows of another socket, outliers, and contacts that were written twice."""
    commands = calibration.commands
    kinds = {row: part.kind for part in parts for row in part.rows.tolist()}
    touching = {row: p.sensor.zeros for p in parts for row in p.rows.tolist()}
    said = [
        f"measurement {row} fits {kinds[row]} {other} instead"
        for row, other in sorted(swapped.items())
    ]
    loose = [row for row in outliers if row not in swapped]
    if reason := outlying(calibration, loose):
        said.append(reason.fact)
    for doubled in np.flatnonzero(calibration.loss_weights == 0.0):
        same = (commands[used] == commands[doubled]).all(axis=1)
        if same.any() and touching[used[same][0]]:
            said.append(f"measurement {doubled} is {used[same][0]} again, counted once")
    return said


def _next_step(
    findings: _Findings, scatter: Reason | None, noise_known: bool, more: bool
) -> str:
    """What to do about a calibration that is not good.

    ``more`` measurements may make it so.
    """
    kind, residuals = findings.moved, scatter.remedy if scatter else _LOOK
    steps = (
        (findings.mistaken, "correct the columns, then identify again"),
        (findings.exchanged, "look at the sockets' columns"),
        (scatter and noise_known, residuals),
        (
            findings.contradicting,
            f"look at {in_rows(findings.contradicting)} (counted from 0): correct, "
            "measure again or leave out",
        ),
        (
            findings.moved and scatter,
            f"measure again with the {kind} fixed, or number it as two: one {kind} "
            "before it moved and another after",
        ),
        (findings.doubtful, findings.remedy),
        (more, _MORE),
        (True, residuals),
    )
    return next(step for holds, step in steps if holds)


class _Helps(NamedTuple):
    """Held-out errors beside the nominal arm's, readings of two units in noise."""

    ratio: float  # of the means
    most: float  # upper end of its 95 % interval

    @property
    def helps(self) -> bool | None:
        """Whether held-out errors are below the nominal arm's; None where not sure."""
        if self.ratio < 1.0:
            return True
        return None if 2.0 * self.ratio - self.most < 1.0 else False


def _helps(held_out: Array, off: Array) -> _Helps:
    """Held-out errors (K, q) and the nominal arm's, in noise, compared."""
    mean, half_width = _mean(np.linalg.norm(held_out, axis=1))
    nominal = float(np.linalg.norm(off, axis=1).mean()) or 1e-300
    return _Helps(mean / nominal, (mean + half_width) / nominal)


def _mean(errors: Array) -> tuple[float, float]:
    """Mean of errors (K,), and the half-width of its 95 % interval."""
    half_width = 1.96 * errors.std() / np.sqrt(max(len(errors) - 1, 1))
    return float(errors.mean()), float(half_width)


def _errors(
    calibration: Fit, used: NDArray[np.intp], measured: Array, parts: list[Part]
) -> tuple[Array, Array]:
    """(N, q) errors held out, and those of the nominal arm of the rows ``used``."""
    commands, model = calibration.commands[used], calibration.model
    off = np.zeros_like(calibration.residuals)
    predicted = model.located(commands, measured).predict(commands)
    off[used] = model.wrapped(measured - predicted, commands)
    for part in parts:  # a socket's place is no merit of either
        for rows in part.groups():
            off[rows] -= off[rows].mean(axis=0) if len(rows) else 0.0
    return left_out(calibration), off


def _title(part: Part, parts: list[Part]) -> str:
    """Name of a part, where there are others."""
    return part.kind if len(parts) > 1 else ""


def _in_units(
    calibration: Fit, part: Part, parts: list[Part], held_out: Array, off: Array
) -> list[HeldOut]:
    """A part's mean errors, those of each unit by themselves."""
    means = []
    for quantity in calibration.model.quantities_of(
        part.sensor, calibration.measured_unit
    ):
        of_part, of_nominal = (
            quantity.size(errors[part.rows, : len(part.scale)] * part.scale)
            for errors in (held_out, off)
        )
        mean, half = _mean(of_part)
        interval = (max(mean - half, 0.0), mean + half)
        nominal = float(of_nominal.mean())
        means.append(
            HeldOut(_title(part, parts), quantity.unit, mean, interval, nominal)
        )
    return means


def _in(calibration: Fit) -> str:
    """The unit of lengths after a number, where it is known."""
    unit = calibration.model.length_unit(calibration.measured_unit)
    return f" {unit}" if unit else ""


def _scattered(calibration: Fit, usual: Array, parts: list[Part]) -> Reason | None:
    """Readings that scatter by more than the noise explains."""
    if calibration.noise_known:
        return wrong_noise(calibration)
    noise, times = np.asarray(calibration.noise_std), scatter(calibration)
    if times < SCATTER:
        return None
    largest = float(noise[(noise / usual).argmax()])
    unit = _in(calibration) if np.ptp(usual) == 0.0 else ""
    touches = any(part.sensor.socketed for part in parts)
    several = ", or of several sockets as one" * (touches and times > _LOUD)
    return Reason(
        f"the readings scatter by {largest:.3g}{unit}, {times:.3g} times what this "
        "sensor usually does: their noise, or what no parameter explains" + several,
        _LOOK,
    )


def _far(calibration: Fit) -> list[str]:
    """Parameters that were found far from what was known of them."""
    names = calibration.names
    p = len(names)
    off = np.abs(calibration.parameters - calibration.prior_mean[:p])
    off = off * np.sqrt(calibration.prior_precision[:p]) * calibration.free[:p]
    return [
        f"{names[i]} is {off[i]:.2g} standard deviations of the prior from what was "
        "known: a wrong tip, file or unit?"
        for i in np.flatnonzero(off > _FAR)
    ]


def _net_mass(calibration: Fit, parts: list[Part]) -> list[str]:
    """What is weighed may be less than what hangs there, as a sentence."""
    weighed = [part for part in parts if isinstance(part.sensor, Wrench)]
    masses = [calibration.parameters[part.own][0] for part in weighed]
    return [
        f"mass {mass:.3g} kg is what the readings show: where the controller subtracts "
        "a payload, the load less that one, which fits alike. Set its payload to zero, "
        "or add what it subtracts."
        for mass in masses
    ]


def _kept(calibration: Fit) -> list[str]:
    """Shifts of the tool that contacts do not show, as a sentence."""
    sensor, names = calibration.model.sensor.members[0], calibration.names
    if not sensor.zeros or sensor.views:
        return []
    shown = dict(zip(names, np.asarray(calibration.from_data), strict=True))
    kept = [name for name in names if name[:-1] == "tool " and shown[name] < _SHOWN]
    return (
        [
            f"{', '.join(kept)}: not shown by these contacts, kept as described; "
            "contacts with the tool turned other ways would show it."
        ]
        if kept
        else []
    )


def _other_tip(calibration: Fit, model: Chain) -> tuple[list[str], bool]:
    """A tip far from where the arm's description has it, and whether that is in doubt.

    In doubt is one that is farther off than the prior allowed. Else the description is
    wrong, or of another tool, and what the readings leave unknown is in the intervals.
    """
    if not model.sensor.members[0].zeros:  # the others' places on the tool are loose
        return [], False
    names = calibration.names
    if "tool rx" in names:  # where a camera or board is on the tip is asked for
        return [], False
    at = [names.index(f"tool {axis}") for axis in "xyz" if f"tool {axis}" in names]
    moved = calibration.parameters[at] - model.nominal[at]
    variance = moved @ np.asarray(calibration.covariance)[np.ix_(at, at)] @ moved
    far = float(np.linalg.norm(moved))
    if far**2 - 2.0 * np.sqrt(variance) <= _TIP * model.length * far:
        return [], False
    std = float(np.sqrt(variance)) / far
    allowed = 2.0 / np.sqrt(calibration.prior_precision[at].max() + 1e-300)
    by = ", ".join(f"{shift:.3g}" for shift in moved)
    return [
        f"the tip is {far:.3g}{_in(calibration)} from where the arm's description has "
        f"it (tool {by}), known to {std:.2g}: is it another tip?"
    ], bool(far > allowed)


def other_distances(
    calibration: Fit, parts: list[Part], length: float
) -> tuple[list[str], bool]:
    """Distances that were given and that the contacts contradict; by much or not.

    One that seems so, to first order, is freed: the readings are fitted without it.
    """
    said, most, unit = [], 0.0, _in(calibration)
    for part in parts:
        distances = getattr(part.sensor, "distances", ())
        if not len(distances):
            continue
        off, rows = _facts(calibration, part)
        _, facts = calibration.model.facts(calibration.parameters)
        spread = rows @ _at_these_sizes(calibration, facts)
        share = np.minimum((spread * rows).sum(axis=1), 1.0 - 1e-9)
        change = np.array(distances)[:, 3] * np.abs(off) / (1.0 - share)
        doubtful = np.abs(off) > _APART * np.sqrt(1.0 - share)
        doubtful &= (share < 1.0 - _ALONE) & (change > _SHORT * length)
        doubtful &= part.touched()
        if part.judged is not None:
            doubtful &= ~part.judged
        for k in np.flatnonzero(doubtful).tolist():
            first, second, distance, std = distances[k]
            free, free_std = _freed(calibration, part, k)
            change[k] = abs(free - distance)
            sure = change[k] > _APART * np.hypot(free_std, std)
            if not sure or change[k] < _SHORT * length:
                continue
            most = max(most, change[k])
            said.append(
                f"{part.kind}s {first:.0f} and {second:.0f} are given as "
                f"{distance:g}{unit} apart, but the contacts and the arm's lengths say "
                f"{free:.4g} +- {free_std:.2g}: measure that distance again"
            )
    return said, most > _WRONG * length


def _facts(calibration: Fit, part: Part) -> tuple[Array, Array]:
    """What is known of a sensor's things: (F,) off, (F, p) derivative."""
    off, own = part.sensor.facts(calibration.parameters[part.own])
    rows = np.zeros((len(off), len(calibration.names)))
    rows[:, part.own] = own
    return off, rows


def _freed(calibration: Fit, part: Part, row: int) -> tuple[float, float]:
    """A given distance as the readings have it without it, and its deviation."""
    model, touched = calibration.model, part.touched()
    touched[row] = False
    sensor: Any = part.sensor
    distances = sensor.distances
    rest = [one for one, kept in zip(distances, touched, strict=True) if kept]
    free = model.with_member(part.member, dataclasses.replace(sensor, distances=rest))
    fit = calibration.again(free, calibration.stated_prior)
    _, _, distance, std = distances[row]
    if fit.covariance is None:  # too few readings to tell the noise without it
        return distance, np.inf
    off, rows = _facts(fit, part)
    variance = rows[row] @ fit.covariance @ rows[row]
    return distance - std * off[row], std * float(np.sqrt(variance))


def _at_these_sizes(calibration: Fit, facts: Array) -> Array:
    """(p, p) covariance of the parameters, the sizes of the arm's errors held.

    That of the calibration counts what is not known of the sizes, and is no longer what
    the readings and ``facts`` (F, p) add up to.
    """
    used = np.flatnonzero(calibration.loss_weights > 0.0)
    theta = calibration.parameters
    slopes = np.asarray(calibration.model.jacobian(calibration.commands[used], theta))
    weight = np.sqrt(np.minimum(calibration.loss_weights[used], 1.0))[:, None, None]
    rows = weight * slopes / np.asarray(calibration.noise_std)[:, None]
    rows = np.vstack([rows.reshape(-1, len(theta)), facts])
    free = np.flatnonzero(calibration.free[: len(theta)])
    precision = calibration.prior_precision[free]
    information = rows[:, free].T @ rows[:, free] + np.diag(precision)
    scale = 1.0 / np.sqrt(information.diagonal() + 1e-300)
    inverse = np.linalg.pinv(
        scale[:, None] * information * scale, 1e-13, hermitian=True
    )
    covariance = np.zeros((len(theta), len(theta)))
    covariance[np.ix_(free, free)] = scale[:, None] * inverse * scale
    return covariance


def _still(model: Chain, commands: Array) -> tuple[list[str], bool]:
    """Joints' columns that never change, and whether one may not be recorded."""
    joints = commands[:, : model.num_joints]
    if len(joints) < _STILL:
        return [], False
    still = np.flatnonzero((joints == joints[0]).all(axis=0))
    said = [
        f"{model.joint_names[i]} is {joints[0, i] + 0.0:g} in all {len(joints)} "
        "measurements: was it recorded? What is said of it is the prior's"
        for i in still
    ]
    return said, bool((joints[0, still] == 0.0).any())


def _other_links(calibration: Fit, parts: list[Part]) -> list[str]:
    """Lengths and zeros far from the arm's description, if a prior allowed that."""
    model = calibration.model
    names, units = np.array(model.names), np.array(model.units)
    off = np.abs(calibration.parameters - model.nominal)
    std = np.asarray(calibration.standard_errors)
    sure = np.where(np.isfinite(std), off - 2.0 * std, 0.0)[: model.table.size]
    lengths = units[: model.table.size] == "length"
    most = np.full(model.table.size, _LINK * model.length)
    reasons = []
    if not any(p.sensor.positions and not p.sensor.relative for p in parts):
        far = np.flatnonzero(lengths & (sure > most))
        if far.size:
            reasons.append(
                f"{', '.join(names[far])}: to {off[far].max():.3g}"
                f"{_in(calibration)} from the arm's "
                "description: readings of another arm, in another unit, of a board of "
                "another size, or of several sockets as one?"
            )
    turned = [name.startswith("theta") for name in names[: model.table.size]]
    for i in np.flatnonzero(turned & (sure > _ZERO)):
        reasons.append(
            f"{names[i]} is {off[i]:.3g} degrees from the arm's description: is the "
            "joint's zero another, or its sign?"
        )
    return reasons


def _anywhere(calibration: Fit, model: Chain, parts: list[Part]) -> tuple[int, float]:
    """Standard deviation of the tip's position at postures of any kind.

    Beside a shift and a turn of the whole arm, which contacts do not show. NaN of
    sensors that read no position, and where nothing determines it. Before it the
    number of the part whose readings are positions.
    """
    for at, part in enumerate(parts):
        if part.sensor.positions or part.sensor.socketed:
            return at, _anywhere_of(calibration, model, part)
    return 0, np.nan


def _anywhere_of(calibration: Fit, model: Chain, part: Part) -> float:
    """``_anywhere`` of a sensor that reads positions, in its own unit."""
    commands = calibration.commands[calibration.loss_weights > 0.0]
    joints = commands[:, : model.num_joints]
    columns = calibration.commands[part.rows[:1], model.num_joints :]
    turning = np.array(model.command_units) == "deg"
    low, high = np.clip(model.limits, -180.0, 180.0).T
    low = np.where(turning, low, joints.min(axis=0))
    high = np.where(turning, high, joints.max(axis=0))
    drawn = np.random.default_rng(0).uniform(low, high, (_DRAWN, model.num_joints))
    slopes, covariance = calibration.linear(
        np.hstack([drawn, np.repeat(columns, _DRAWN, axis=0)])
    )
    slopes = slopes[:, :3] * part.scale[:3, None]
    slopes[..., part.own] = 0.0
    if (
        calibration.unidentified is not None
        and depends(slopes, calibration.unidentified).any()
    ):
        return np.nan
    points = model.nominal_tips(drawn)
    whole = np.repeat(np.eye(3, 6)[None], _DRAWN, axis=0)
    whole[..., 3:] = hats(points - points.mean(axis=0))
    moves, whole = slopes.reshape(3 * _DRAWN, -1), whole.reshape(-1, 6)
    basis, size, _ = np.linalg.svd(whole, full_matrices=False)
    basis = basis[:, significant(size)]
    moves = moves - basis @ (basis.T @ moves)
    return float(np.sqrt(((moves @ covariance) * moves).sum() / _DRAWN))


def _exchanged(calibration: Fit, part: Part) -> list[str]:
    """Sockets that were found where others were said to be."""
    sensor = part.sensor
    if not isinstance(sensor, Socket) or sensor.places is None:
        return []
    places = calibration.parameters[part.own]
    apart = np.linalg.norm(places.reshape(-1, 1, 3) - sensor.places, axis=-1)
    nearest = apart.argmin(axis=1)
    if len(np.unique(nearest)) < len(nearest):  # one was moved, or the arm is far off
        return []
    return [
        f"{part.kind} {i} was found where socket {j} was said to be: are their rows "
        "exchanged?"
        for i, j in enumerate(nearest)
        if i != j and apart[i, j] < 0.5 * apart[i, i]
    ]


def _moved(calibration: Fit, part: Part, swapped: dict[int, int]) -> list[str]:
    """Sockets and planes whose first and last contacts lie apart."""
    reasons, unit, rng = [], _in(calibration), np.random.default_rng(0)
    width = len(part.scale)
    for i, of_one in enumerate(part.groups()):
        rows = of_one[~np.isin(of_one, list(swapped))]
        residuals = calibration.residuals[rows, :width] * part.scale
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


def _swapped(calibration: Fit, part: Part, explains: bool) -> dict[int, int]:
    """Outliers that fit another socket or plane, as if their column were wrong."""
    model, sensor = calibration.model, part.sensor
    if not (sensor.zeros and sensor.num_places > 1):
        return {}
    noise = np.asarray(calibration.noise_std)
    at = part.rows[np.isin(part.rows, list(calibration.outliers))]
    swaps: dict[int, int] = {}
    if at.size:
        trial = np.repeat(calibration.commands[None, at], sensor.num_places, axis=0)
        column = model.num_joints + model.sensor.inputs.index(sensor.inputs[0])
        stated = trial[..., column].copy()
        trial[..., column] = np.arange(sensor.num_places)[:, None]
        off = np.abs(calibration.predict(trial) / noise).max(axis=-1)
        for other, row in np.argwhere((off < 4.0) & (stated != trial[..., column])):
            swaps[int(at[row])] = int(other)
    if sensor.socketed and not explains:
        # So many that none is an outlier: by the arm as described, where that can tell.
        points = part.points
        labels, which = np.unique(sensor.of_rows(part.columns), return_inverse=True)
        middles = [np.median(points[which == i], axis=0) for i in range(len(labels))]
        apart = np.linalg.norm(points[:, None] - middles, axis=-1)
        as_stated, nearest = apart[np.arange(len(which)), which], apart.min(axis=1)
        if np.median(as_stated) < 0.5 * np.median(apart.max(axis=1)):
            wrong = np.flatnonzero(nearest < 0.8 * as_stated)
            fits = labels[apart[wrong].argmin(axis=1)]
            swaps |= dict(zip(part.rows[wrong].tolist(), fits.tolist(), strict=True))
    return swaps
