"""Can a calibration be trusted: does its model explain the readings, does it help?

Held-out errors are those of leaving out one measurement at a time, to first order:
with predicted covariance S and noise R the residual r becomes ``R (R - S)^-1 r``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from jaxcal.arms.chain import SerialChain as Chain
from jaxcal.arms.chains import Chains, ChainTable
from jaxcal.arms.effects import SCATTER, in_words, play_in_words, scatter
from jaxcal.arms.findings import (
    CLEAR_UP,
    LOOK,
    findings_of,
    left_open,
    other_distances,
    parts_of,
    unit_after,
)
from jaxcal.arms.plausible import mistaken_columns
from jaxcal.arms.sensors import Pose, Socket
from jaxcal.arms.sensors.sensor import Readings, hats
from jaxcal.calibration import verdict as models
from jaxcal.calibration.fit import linearised, no_noise, session_std
from jaxcal.calibration.reasons import Reason, computed, never_measured
from jaxcal.calibration.verdict import left_out, wrong_noise
from jaxcal.checks import Array, one_of
from jaxcal.information.singular import depends, significant
from jaxcal.models.model import Rows

if TYPE_CHECKING:
    from jaxcal.arms.effects import Fit

_LITTLE = 1.0 / 3.0  # of the nominal error: so little left is worth having anyway
_LOUD, _WILD = 10.0, 100.0  # times the usual noise
_PLACED = 0.01  # of the arm's length: a camera known to that is found
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
    """What the readings say of an arm's calibration; docs/sensors.md, "What is
    noticed", has when it is good."""

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
                "Position of the camera or board on the tip: uncertainty "
                f"{self.place.says(length)} (1 sigma)."
            )
        lines += [self.sessions] if self.sessions else []
        for one in _missed(self.errors, self.accuracy):
            asked = one.says((self.accuracy or {})[one.unit])
            lines.append(f"The accuracy you asked for is not reached: {asked}.")
        if not self.explains:
            lines.append("The noise of this model does not explain these readings.")
        if self.place is not None and not self.helps:
            lines.append("The uncalibrated arm was as accurate.")
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


def verdict(model: Chain, fit: Fit) -> ArmVerdict:
    """Does its model explain the readings, does it help, what is wrong by name."""
    unit = fit.measured_unit
    usual, reason = np.asarray(model.default_noise().std), None
    if fit.noise_std is None:
        stds = usual if np.ptp(usual) else usual.ravel()[:1]
        reason = Reason(
            no_noise(fit, "intervals and no verdict"),
            "measure more postures, or state noise_std, --noise (usual for this "
            f"sensor: {','.join(f'{std:.2g}' for std in stds)})",
        )
    elif not model.sensor.zeros:
        reason = never_measured(fit) or computed(fit)
    if reason is not None:
        return ArmVerdict(
            good=False, reasons=(reason.fact,), next_step=reason.remedy, unit=unit
        )
    used = np.flatnonzero(fit.loss_weights > 0.0)
    commands, measured = fit.commands[used], fit.measured[used]
    parts = parts_of(fit, used)
    held_out, off = left_out(fit), _nominal(fit, used, parts)
    errors = [one for part in parts for one in _in_units(fit, part, held_out, off)]
    mean, half = _mean(np.linalg.norm(held_out[used] / usual, axis=1))
    as_described = float(np.linalg.norm(off[used] / usual, axis=1).mean()) or 1e-300
    ratio, half = mean / as_described, half / as_described
    # Below the nominal arm's; None where not sure.
    helps = ratio < 1.0 or (None if ratio - half < 1.0 else False)
    scattered = _scattered(fit, usual, parts)
    explains = scattered is None
    mistaken = ""
    if not explains and errors[0].nominal > _PLAIN * model.length:
        mistaken = mistaken_columns(model, commands, measured)
    first, anywhere = _anywhere(fit, model, parts)
    nominal = next(one.nominal for one in errors if one.of == first.title)
    accuracy = fit.provenance.get("accuracy")
    if isinstance(accuracy, float):  # of a file of 0.2
        accuracy = {errors[0].unit: accuracy}
    more = accuracy is not None or helps is None
    vague = left_open(parts, unit_after(fit), anywhere, nominal)
    reasons, clean, step = findings_of(
        fit, used, parts, scattered, mistaken, vague, more
    )
    camera = all(part.sensor.views for part in parts)
    place = place_of(fit, [f"tool {axis}" for axis in Pose.tool]) if camera else None
    reach = model.length or float(np.ptp(parts[0].tip.position, axis=0).max())
    if place is not None and place.hidden:
        reasons += (
            f"{', '.join(place.hidden)}: not shown by these views, kept at the nominal "
            "value. To find it, turn the tip about another axis, or measure it and "
            "give tool=",
        )
    if not explains and not fit.noise_known:
        unit_of_first = "" if errors[0].unit == "length" else f" {errors[0].unit}"
        reasons += (*in_words(fit, unit_of_first), *play_in_words(fit))
    if accuracy is not None:
        good = clean and not _missed(errors, accuracy)
    elif place is not None and place.std[0] < _PLACED * reach and explains:
        good = clean and ratio < _NO_WORSE
    else:
        # No machine scatters that much: other units, columns.
        wild = not fit.noise_known and scatter(fit) > _WILD
        little = ratio + half < _LITTLE and not wild
        good = bool(clean and helps and (explains or little))
    return ArmVerdict(
        good=good,
        reasons=reasons,
        next_step=models.USE if good else step,
        unit=unit,
        explains=explains,
        helps=helps,
        clean=clean,
        errors=tuple(errors),
        anywhere=anywhere,
        accuracy=accuracy,
        place=place,
        sessions=_sessions(fit, errors[0]),
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
        lost = (len(self.hidden) - len(turns), len(turns))
        shown = [size for size, count in zip(sizes, lost, strict=True) if count < 3]
        return " and ".join(shown) or "nothing"


def place_of(fit: Fit, names: Sequence[str]) -> Place:
    """How well six shifts and turns are known.

    Hidden are those in directions of which the readings leave half of what is usual of
    a tool: along a SCARA's axes, and all shifts of a gantry.
    """
    model = fit.model
    at = np.array([model.names.index(name) for name in names])
    size = np.repeat([0.1 * (model.length or 1.0), 1.7], 3)
    scaled = np.asarray(fit.covariance)[np.ix_(at, at)] / np.outer(size, size)
    lost = np.flatnonzero(fit.undetermined[at])
    scaled[lost, lost] += 1.0
    square, axes = np.linalg.eigh(scaled)
    vague = square > _UNSHOWN
    shown = size[:, None] * axes[:, ~vague] * np.sqrt(square[~vague].clip(0.0))
    hidden = (axes[:, vague] ** 2).sum(axis=1) > _UNSHOWN
    std = np.sqrt((shown**2).sum(axis=1).reshape(2, 3).sum(axis=1))
    named = tuple(np.array(names)[hidden].tolist())
    return Place((float(std[0]), float(std[1])), named)


def _sessions(fit: Fit, first: HeldOut) -> str:
    """How sessions differ, in a sentence."""
    of_sessions = fit.provenance.get("sessions")
    if of_sessions is None:
        return (
            "On another day or after remounting the error may be larger; one session "
            "cannot show it (sessions=, --session)."
        )
    quantity = fit.model.quantities(fit.measured_unit)[0]
    size = first.says(float(quantity.size(session_std(fit))))
    return f"Sessions differ by {size} (1 sigma); predictions include this."


def _mean(errors: Array) -> tuple[float, float]:
    """Mean of errors (K,), and half of its 95 % interval."""
    half_width = 1.96 * errors.std() / np.sqrt(max(len(errors) - 1, 1))
    return float(errors.mean()), float(half_width)


def _nominal(fit: Fit, used: Rows, parts: list[Readings]) -> Array:
    """(N, q) errors of the nominal arm, of the rows ``used``."""
    commands, measured = fit.commands[used], fit.measured[used]
    model, off = fit.model, np.zeros_like(fit.residuals)
    predicted = model.located(commands, measured).predict(commands)
    off[used] = model.fitting.wrapped(measured - predicted, commands)
    for part in parts:  # a socket's place is no merit of either
        for rows in filter(len, part.groups()):
            off[rows] -= off[rows].mean(axis=0)
    return off


def _in_units(
    fit: Fit, part: Readings, held_out: Array, off: Array
) -> Iterator[HeldOut]:
    """A part's mean errors, those of each unit by themselves."""
    unit = fit.measured_unit
    for quantity in fit.model._quantities_of(part.sensor, unit):
        of_part, of_nominal = (
            quantity.size(errors[part.rows, : len(part.scale)] * part.scale)
            for errors in (held_out, off)
        )
        mean, half = _mean(of_part)
        interval = (max(mean - half, 0.0), mean + half)
        nominal = float(of_nominal.mean())
        yield HeldOut(part.title, quantity.unit, mean, interval, nominal)


def _scattered(fit: Fit, usual: Array, parts: list[Readings]) -> Reason | None:
    """Readings that scatter by more than the noise explains."""
    if fit.noise_known:
        return wrong_noise(fit)
    noise, times = np.asarray(fit.noise_std), scatter(fit)
    if times < SCATTER:
        return None
    largest = float(noise[(noise / usual).argmax()])
    unit = unit_after(fit) if np.ptp(usual) == 0.0 else ""
    touches = any(isinstance(part.sensor, Socket) for part in parts)
    several = ", or of several sockets numbered as one" * (touches and times > _LOUD)
    return Reason(
        f"the readings scatter by {largest:.3g}{unit}, {times:.3g} times the usual "
        "scatter of this sensor: noise, or an effect that no parameter describes"
        + several,
        LOOK,
    )


def _anywhere(fit: Fit, model: Chain, parts: list[Readings]) -> tuple[Readings, float]:
    """The first part whose readings are positions, and the standard deviation of the
    tip's position at postures of any kind, beside a shift and a turn of the whole arm.

    NaN where none reads positions, and where nothing determines it.
    """
    seen = [p for p in parts if p.sensor.positions or isinstance(p.sensor, Socket)]
    if not seen:
        return parts[0], np.nan
    part = seen[0]
    commands = fit.commands[fit.loss_weights > 0.0]
    joints = commands[:, : model.num_joints]
    columns = fit.commands[part.rows[:1], model.num_joints :]
    turning = np.array(model.command_units) == "deg"
    low, high = np.clip(model.limits, -180.0, 180.0).T
    low = np.where(turning, low, joints.min(axis=0))
    high = np.where(turning, high, joints.max(axis=0))
    drawn = np.random.default_rng(0).uniform(low, high, (_DRAWN, model.num_joints))
    postures = np.hstack([drawn, np.repeat(columns, _DRAWN, axis=0)])
    slopes, covariance = linearised(fit, postures)
    slopes = slopes[:, :3] * part.scale[:3, None]
    slopes[..., part.own] = 0.0
    null = fit.unidentified
    if null is not None and depends(slopes, null).any():
        return part, np.nan
    points = model.nominal_tip(drawn).position
    whole = np.repeat(np.eye(3, 6)[None], _DRAWN, axis=0)
    whole[..., 3:] = hats(points - points.mean(axis=0))
    moves, whole = slopes.reshape(3 * _DRAWN, -1), whole.reshape(-1, 6)
    basis, size, _ = np.linalg.svd(whole, full_matrices=False)
    basis = basis[:, significant(size)]
    moves = moves - basis @ (basis.T @ moves)
    return part, float(np.sqrt(((moves @ covariance) * moves).sum() / _DRAWN))


def of_chain(model: Chains, fit: Any, tip: str) -> dict[str, Any]:
    """The fields of a calibration that are of one chain, in its own units."""
    k = model.tips.index(one_of("tip", tip, model.tips))
    arm, at, scale = model.chains[k], fit.whole.members[k], model._scale(k)
    q, rows = arm.num_outputs, fit.commands[:, len(model.joint_names)] == k
    residuals = fit.residuals[rows, :q] * scale
    noise, square = fit.noise_std, fit.square
    if noise is not None:
        noise, weights = noise[:q] * scale, fit.loss_weights[rows]
        square = float((weights[:, None] * (residuals / noise) ** 2).sum())
    share = int(rows.sum()) * q / max(len(fit.commands) * model.num_outputs, 1)
    null, joint = fit.unidentified, fit.joint_covariance
    if null is not None:
        null = null[:, at]
        null = null[null.any(axis=1)]
    by_parameter = ("estimate", "prior_mean", "prior_precision", "free")
    by_row = ("loss_weights", "distance")
    return {
        **{name: getattr(fit, name)[at] for name in by_parameter},
        **{name: getattr(fit, name)[rows] for name in by_row},
        "model": arm,
        "input_names": (*arm.joint_names, *arm.sensor.inputs),
        "output_names": tuple(arm.sensor.outputs),
        "joint_covariance": None if joint is None else joint[np.ix_(at, at)],
        "unidentified": null if null is not None and len(null) else None,
        "commands": fit.commands[rows][:, model._columns[k]],
        "estimated_commands": None,
        "residuals": residuals,
        "dof": max(fit.dof * share, 0.0),
        "square": square,
        "num_readings": float(q),
        "noise_std": noise,
    }


@dataclasses.dataclass(frozen=True)
class ChainsVerdict(models.Verdict):
    """What the readings say of each chain."""

    of_chains: Mapping[str, ArmVerdict] = dataclasses.field(default_factory=dict)

    @property
    def held_out(self) -> float:
        """Mean held-out error of the chains, each in its unit."""
        return float(np.mean([of_arm.held_out for of_arm in self.of_chains.values()]))


def verdict_of_chains(model: Chains, fit: Any) -> ChainsVerdict:
    """Good where every chain that was read is, and distances that they share."""
    used = np.flatnonzero(fit.loss_weights > 0.0)
    tables = [
        (k, commands, None) for k, _, _, commands in model._parts(fit.commands[used])
    ]
    tips = [model.tips[k] for k, *_ in tables]
    of_chains = {tip: fit.of(tip).verdict for tip in tips}
    bad = [tip for tip in tips if not of_chains[tip].good]
    step = f"{bad[0]}: {of_chains[bad[0]].next_step}" if bad else models.USE
    reasons = [f"{tip}: {line}" for tip in tips for line in of_chains[tip].lines()]
    reasons += [f"{tip}: no reading" for tip in model.tips if tip not in tips]
    wrong = False
    if fit.noise_std is None:
        step = "measure more postures, or state noise_std=1 (in units of noise)"
    else:
        length = min(arm.length for arm in model.chains)
        parts = _shared_parts(model, used, tables)
        apart, wrong = other_distances(fit, parts, length)
        reasons += apart
        step = CLEAR_UP if wrong else step
    good = not (bad or wrong)
    return ChainsVerdict(good, tuple(reasons), step, "", of_chains)


def _shared_parts(
    model: Chains, used: Rows, tables: Sequence[ChainTable]
) -> list[Readings]:
    """What chains read of the sensors that they share, of the rows ``used``; distances
    that one chain's contacts judge are left to its own verdict."""
    parts = []
    for number, readings in model._by_member(model.chains, tables).items():
        if len(readings) < 2:
            continue
        k, i = model._members[number][0]
        part = readings[0]._replace(
            member=number,
            kind=readings[0].sensor.kind,
            own=model.members[k][model.chains[k]._own(i)],
            rows=used,
            columns=np.vstack([of_chain.columns for of_chain in readings]),
        )
        alone = [part._replace(columns=r.columns).touched() for r in readings]
        parts.append(part._replace(judged=np.any(alone, axis=0)))
    return parts
