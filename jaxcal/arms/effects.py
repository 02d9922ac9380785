"""How far an arm is from its description, and what else it does than that says.

Where the noise does not explain the scatter, wider tolerances, compliance, gears and
harmonics are fitted too; what helps most by held-out readings is kept. Play is looked
for, and said.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.arms.chain import SerialChain as Chain
from jaxcal.arms.chain import turning
from jaxcal.calibration.fit_model import fitted_again
from jaxcal.calibration.verdict import left_out
from jaxcal.checks import Array, one_or_each, require_none
from jaxcal.models.model import ErrorGroups, Model
from jaxcal.models.uncertainty import Noise, Prior

if TYPE_CHECKING:
    from jaxcal.calibration import Calibration

    class Fit(Calibration):
        """A calibration of an arm, or of several."""

        model: Chain


# Standard deviations of the default prior. On a UR5 (links of 1.19 m in all): 1.8 mm,
# 0.3 degrees of the axes and 0.5 of a joint's zero, which is set by hand; 0.12 m and
# 1.7 degrees of the base and the tool.
_LENGTH, _TWIST, _ZERO = 1.5e-3, 0.3, 0.5  # share of the links' length; degrees
_GEAR, _SAG = 5e-3, 0.5  # ratio; degrees under the largest torque
_WAVE = 0.045  # degrees, of gears
_MOUNTING, _MOUNTING_ANGLE = 0.1, 1.7
# How large the errors of a group are beside the prior's, beforehand: lengths, turns of
# the axes, zeros of the joints, compliance, harmonics. Most arms have little misfit and
# some have much.
_SIZES, _SIZES_SPREAD = (1.0, 1.0, 1.0, 1.0, 0.1), (6.0, 6.0, 6.0, 6.0, 10.0)
SCATTER = 3.0  # times the sensor's usual noise: the model does not explain that
# Times the tolerances of the default prior: lengths, turns of the axes, zeros of the
# joints, which are set by hand, and what else joints do.
_LENGTHS, _TURNS, _ZEROS, _EFFECTS = 2.0, 3.0, 6.0, 4.0
_AS_IT_IS = "as described"
_BETTER = 0.95  # of the held-out error: less is no reason for more parameters
_ENOUGH = 12  # measurements
_PLAY = 0.9  # of the error: what is left of it without a joint's play
_NARROW, _SHORT = 20.0, 0.1  # degrees, of the arm's length: a range is no less
_BEYOND = 3.0  # times the scatter, a whole range beyond what was measured
_REPEATS = 3  # readings of postures that were repeated tell their noise
_SURE = 3.0  # standard errors of a play


def default_prior(arm: Chain) -> Prior:
    """Loose knowledge of any arm, by the length of its links; what the sensor cannot
    see is held, and the groups' scales are taken from the readings."""
    length = arm.length or np.inf  # axes of unknown stroke alone
    joint = [_LENGTH * length, _TWIST, _LENGTH * length, _ZERO, _TWIST]
    mounting = [_MOUNTING * length] * 3 + [_MOUNTING_ANGLE] * 3
    tool = [arm.sensor.members[0].mounting * length] * 3 + [_MOUNTING_ANGLE] * 3
    torque = length * sum(abs(weight) for _, weight, _ in arm.loads)
    std = [
        *joint * len(arm.joints),
        *[_GEAR] * len(arm.gears),
        *[_SAG / torque if torque else np.inf] * len(arm.compliance),
        *mounting,
        *(tool[i] for i in arm._tool),
        *arm.sensor.prior_std(length),
        *[_WAVE] * arm.waves.size,
    ]
    return Prior(std, fixed=arm.sensor.unseen(arm), by_data=True)


def parameter_sizes(arm: Chain) -> Array:
    """(p,) of the default prior; where it says nothing the arm's length, a radian:
    where things stand is no size."""
    sizes = Model.parameter_sizes(arm)
    unknown = arm.default_prior().resolve(arm).precisions == 0.0
    units = np.array(arm.units)
    sizes[unknown & (units == "length")] = arm.length or np.nan
    sizes[unknown & (units == "deg")] = np.degrees(1.0)
    return sizes


def error_groups(arm: Chain) -> ErrorGroups:
    """Lengths, turns of the axes, zeros of the joints, compliance, harmonics."""
    members = np.full(len(arm.names), -1)
    members[arm._at["table"]] = np.tile([0, 1, 0, 2, 1], len(arm.joints))
    members[arm._at["compliance"]], members[arm._at["harmonics"]] = 3, 4
    return ErrorGroups(members, np.array(_SIZES), np.array(_SIZES_SPREAD))


def scatter(fit: Fit) -> float:
    """Noise that was found, by the sensor's usual one."""
    usual = np.asarray(fit.model.default_noise().std)
    return float(np.sqrt(np.mean((np.asarray(fit.noise_std) / usual) ** 2)))


def improved(model: Chain, fit: Fit) -> Fit:
    """The calibration, or one with the effects that held-out readings ask for.

    Left as it is: of a noise or prior that was stated, a scatter that the noise
    explains, contacts at few places, a mispaired table, and fewer than 12 measurements.
    """
    stated = fit.noise_std is None or fit.noise_known or "prior" in fit.provenance
    few = fit.num_measurements < max(_ENOUGH, len(model.joint_names) + 6)
    if stated or few or not model.fitting.fits_misfit or scatter(fit) < SCATTER:
        return fit
    if fit.mispairing is not None:  # no effect of the arm
        return fit
    before, trials = _held_out(fit), {}
    for words, other, prior in _alternatives(model):
        with contextlib.suppress(ValueError):  # it does not converge
            trial = fitted_again(fit, other, prior)
            if trial.noise_std is not None:
                trials[words] = trial, _held_out(trial)
    if not trials:
        return fit
    best = min((off for _, off in trials.values()), key=np.mean)
    # The least that is added: more must be better beyond chance.
    name = next(n for n, (_, off) in trials.items() if not _surely(off, best))
    fitted, off = trials[name]
    if not (_surely(before, off) and off.mean() < _BETTER * before.mean()):
        name, fitted = _AS_IT_IS, fit
    errors = {n: float(off.mean()) for n, (_, off) in trials.items()}
    effects = {"chosen": name, "held_out": {_AS_IT_IS: float(before.mean())} | errors}
    origin = {**fit.provenance, "effects": effects}
    if fitted is not fit:
        origin["prior"] = "stated"
    return dataclasses.replace(fitted, provenance=origin)


def _surely(errors: Array, less: Array) -> bool:
    """Whether errors are larger than others by more than a standard error."""
    gain = errors - less
    return bool(gain.mean() > gain.std() / np.sqrt(len(gain)))


def _held_out(fit: Fit) -> Array:
    """(K,) held-out errors of the measurements, in the first unit."""
    used = fit.loss_weights > 0.0
    usual = np.asarray(fit.model.default_noise().std)
    off = left_out(fit)[used] * usual[0] / usual
    first, *others = fit.model.quantities(fit.measured_unit)
    return np.asarray(np.linalg.norm(off, axis=1) if others else first.size(off))


def _alternatives(model: Chain) -> Iterator[tuple[str, Chain, Prior]]:
    """Effects in words, the arm with them, and its prior."""
    more = {
        "compliance": model.compliance or turning(model.joints),
        "gears": model.gears or range(1, len(model.joints) + 1),
        "harmonics": turning(model.joints),
    }
    for names in (
        (),
        ("compliance",),
        ("harmonics",),
        ("compliance", "harmonics"),
        ("compliance", "gears", "harmonics"),
    ):
        other = model._with_effects(**{name: more[name] for name in names})
        prior = other.default_prior()
        std = np.array(prior.std, dtype=np.float64)
        of_row = [_LENGTHS, _TURNS, _LENGTHS, _ZEROS, _TURNS]
        std[other._at["table"]] *= of_row * len(other.joints)
        for kind in more:
            std[other._at[kind]] *= _EFFECTS
        words = ", ".join(names) or "wider tolerances"
        yield words, other, Prior(std, fixed=prior.fixed)


def in_words(fit: Fit, unit: str) -> list[str]:
    """What was tried, and what it brought."""
    tried = fit.provenance.get("effects")
    if not tried:
        return []
    errors, name = dict(tried["held_out"]), tried["chosen"]
    before = errors.pop(_AS_IT_IS)
    after = errors.pop(name, None)
    others = ", ".join(f"{other} {error:.3g}" for other, error in errors.items())
    if after is None:
        return [
            f"None of these effects reduces the cross-validated error: {others}{unit}; "
            f"without them {before:.3g}{unit}."
        ]
    return [
        f"Added effect: {name}. It reduces the cross-validated error from "
        f"{before:.3g} to {after:.3g}{unit} (with {others})."
    ]


def play_in_words(fit: Fit) -> list[str]:
    """Joints whose residuals follow the side that they came from, rows being in the
    order of measuring."""
    model, commands = fit.model, fit.commands
    joints = [i - 1 for i in turning(model.joints)]
    at = [5 * joint + 3 for joint in joints]  # their theta
    if len(commands) < _ENOUGH + len(at) or not at:
        return []
    moves = model._moves(commands)[:, joints]
    side = np.sign(np.diff(moves, axis=0, prepend=moves[:1]))
    slopes = model.jacobian(commands, fit.parameters)[..., at] * side[:, None]
    noise = np.asarray(fit.noise_std)
    rows = (slopes / noise[:, None]).reshape(-1, len(at))
    size = np.linalg.norm(rows, axis=0)
    seen = size > 1e-6 * size.max(initial=1e-300)
    rows, right = rows[:, seen], (fit.residuals / noise).ravel()
    inverse = np.linalg.pinv(rows.T @ rows)
    play = inverse @ rows.T @ right
    share = np.einsum("ri,ij,rj->r", rows, inverse, rows)
    errors = ((right - rows @ play) / (1.0 - share)).reshape(-1, len(noise))
    before = np.linalg.norm(fit.residuals / noise, axis=1).mean()
    left = np.linalg.norm(errors, axis=1).mean() / before
    sure = np.abs(play) > _SURE * np.sqrt(inverse.diagonal())
    if left > _PLAY or not sure.any():
        return []
    both = zip(np.array(model.names)[at][seen][sure], play[sure], strict=True)
    sizes = ", ".join(f"{name} {2.0 * abs(half):.2g} deg" for name, half in both)
    return [
        f"Residuals depend on the side from which joints came (backlash: {sizes}). "
        "Approaching always from one side would reduce the scatter by "
        f"{1.0 - left:.0%}."
    ]


def noise_with_play(arm: Chain, play: ArrayLike) -> Noise:
    """The sensor's noise plus the backlash of the joints, for ``identify`` and
    ``select``.

    Args:
        play: total width of the backlash in degrees (or units of length): one
            number or (J,); about 0.3 for hobby servos. A joint is off by it over
            the square root of 12.
    """
    width = one_or_each("play", play, arm.num_joints)
    require_none(~(width >= 0.0), width, "play must not be negative")
    by_inputs = np.zeros(len(arm.sensor.inputs))
    spread = np.concatenate([width / np.sqrt(12.0), by_inputs])
    return dataclasses.replace(arm.default_noise(), command_std=spread)


def unexplained(model: Chain, fit: Fit, rows: Array) -> Array:
    """(N, q) standard deviations of an arm's predictions at commands ``rows`` (N, n).

    An estimated noise above three times the sensor's usual one is taken for errors of
    the arm, but for what repeated postures scatter by. It grows with how far a joint is
    beyond the range that was measured.
    """
    if fit.noise_std is None or fit.noise_known or scatter(fit) < SCATTER:
        return np.zeros((len(rows), fit.num_outputs))
    variance = np.asarray(fit.noise_std) ** 2 - _of_readings(fit)
    columns, used = fit.model.num_joints, fit.loss_weights > 0.0
    measured = fit.commands[used, :columns]
    low, high = measured.min(axis=0), measured.max(axis=0)
    turning = np.array(model.command_units) == "deg"
    width = np.maximum(high - low, np.where(turning, _NARROW, _SHORT * model.length))
    joints = rows[:, :columns]
    beyond = np.maximum(low - joints, joints - high).clip(0.0) / width
    times = 1.0 + (_BEYOND * np.linalg.norm(beyond, axis=1)) ** 2
    return np.sqrt(times[:, None] * variance.clip(0.0))


def _of_readings(fit: Fit) -> Array:
    """(q,) variance of a reading: of repeated postures, else the sensor's usual one."""
    usual = np.broadcast_to(np.asarray(fit.model.default_noise().std), fit.num_outputs)
    used = fit.loss_weights > 0.0
    near = np.round(fit.commands[used], 2)
    _, which, counts = np.unique(near, axis=0, return_inverse=True, return_counts=True)
    freedom = len(near) - len(counts)
    if freedom < _REPEATS:
        return np.asarray(usual**2)
    off = fit.residuals[used]
    sums = np.zeros((len(counts), off.shape[1]))
    np.add.at(sums, which.ravel(), off)
    off = off - (sums / counts[:, None])[which.ravel()]
    return np.asarray((off**2).sum(axis=0) / freedom)
