"""Whether a calibration may be used, why not, and what to do next: one answer for all.

A rule returns a ``Reason`` that speaks against a calibration, or None.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from jaxcal.calibration.fit import linearised, no_noise, noise_of, studentised
from jaxcal.calibration.reasons import (
    Reason,
    computed,
    each,
    in_order,
    in_rows,
    never_measured,
    resolution,
    saturated,
    short,
)
from jaxcal.checks import Array
from jaxcal.late import late

if TYPE_CHECKING:
    from jaxcal.calibration.fit import Fit

UNLIKELY = 1e-4  # p-value of residuals under the noise that was given
_CHANCE = 0.01  # that readings of nothing pass for a fit
_RARE = float(np.log(20.0))  # an outlier
_TOO_LARGE = 3.0  # times: no caution makes a stated noise that much larger
_SIZES = 10.0  # of a parameter: known no better, it is not known
_FAR = 10.0  # times as far off as was stated
_STEP = 0.1  # standard errors, by which another step would move the parameters
_BENT, _BENT_MORE = 2.0, 3.0  # times the noise without squares and products of the
# commands; of a model that is a curve itself
_SAMPLE, _TERMS = 2000, 600  # readings; twice these terms
_SMOOTH = 16  # rows, of which fewer may be a curve by chance
_CHECK = "a change of the machine (check, jaxcal check)"
USE = (
    "use it (command_for, jaxcal command); check it with a few new readings after "
    f"{_CHECK}"
)
_PREDICT = (
    f"use it (predict, jaxcal predict); check it with a few new readings after {_CHECK}"
)


@dataclasses.dataclass(frozen=True)
class Verdict:
    """Whether a calibration may be used; ``print`` shows reasons and the next step."""

    good: bool
    reasons: tuple[str, ...]  # against it, or worth knowing
    next_step: str
    unit: str = ""  # of the readings, and of the lengths or angles in the reasons

    def lines(self) -> tuple[str, ...]:
        """What it says, without the last line, which is the verdict itself."""
        return self.reasons

    def __str__(self) -> str:
        word = "good" if self.good else "not good"
        return "\n".join([*self.lines(), f"{word}; next: {self.next_step}"])

    _repr_html_ = late("jaxcal.reports.shown:as_html")


def left_out(fit: Fit) -> Array:
    """(N, m) residual of each measurement from the fit without it, to first order."""
    noise = noise_of(fit, "held-out errors")
    slopes, covariance = linearised(fit, fit.commands, misfit=False)
    spread = slopes @ covariance @ np.matrix_transpose(slopes)
    root = np.diag(1.0 / np.where(noise > 0.0, noise, 1.0))
    share = np.minimum(fit.loss_weights, 1.0)[:, None, None]
    values, vectors = np.linalg.eigh(np.eye(len(noise)) - share * root @ spread @ root)
    turned = np.matrix_transpose(vectors) / np.maximum(values, 0.02)[..., None]
    white = vectors @ turned @ root @ fit.residuals[..., None]
    return np.asarray(np.linalg.solve(root, white)[..., 0])


# -- what the fit says -----------------------------------------------------------------


def _no_noise(fit: Fit) -> Reason | None:
    if fit.noise_std is not None:
        return None
    return Reason(
        no_noise(fit, "intervals"), "measure more rows, or state noise_std, --noise"
    )


def _undetermined(fit: Fit) -> Reason | None:
    if not fit.undetermined.any():
        return None
    names = ", ".join(np.array(fit.names)[fit.undetermined])
    searched = not (fit.model.linear or fit.prior_precision.any())
    return Reason(
        f"Not determined, kept near the prior's mean: {names}; see identifiability()."
        + " The search may have stopped on a plateau." * searched,
        "measure rows that determine them: "
        "select(candidates, model=..., measured=commands)",
    )


def _explains_nothing(fit: Fit) -> Reason | None:
    """F test of the fit against constant outputs. Of each output where it has
    parameters of its own and enough residuals, else of all."""
    from scipy import special

    m, dof = fit.num_outputs, float(fit.dof)
    varies = (fit.commands != fit.commands[0]).any()
    if dof < 1.0 or fit.free.sum() <= m or not varies:
        return None
    weight = fit.loss_weights
    off = fit.measured - weight @ fit.measured / weight.sum()
    total, unexplained = weight @ off**2, weight @ fit.residuals**2
    moved = total > 0.0
    share, names = unexplained[moved] / total[moved], np.array(fit.output_names)[moved]
    more = max(m * fit.num_measurements - dof - m, 1.0)  # parameters but the constants
    apart = fit.affine is not None or m == 1  # each output has parameters of its own
    if not apart and fit.model.linear:
        seen = np.asarray(fit.model.jacobian(fit.commands, fit.parameters)).any(axis=0)
        apart = bool((seen.sum(axis=0) <= 1).all())
    if dof >= 2.0 * m and apart:
        dof, more = dof / m, more / m
    elif moved.any():
        share, names = share.mean(keepdims=True), np.array([", ".join(names)])
    ratio = np.maximum(1.0 - share, 0.0) / more / np.maximum(share / dof, 1e-300)
    nothing = special.fdtrc(more, dof, ratio) > _CHANCE
    if not nothing.any():
        return None
    explained = np.maximum(1.0 - share[nothing], 0.0)
    of, outputs = f"of {fit.num_measurements} rows", ", ".join(names[nothing])
    if (explained > 0.5).all():
        return Reason(
            f"The fit of {outputs} may be chance: R2 = {each(explained)} {of} and "
            f"{int(fit.free.sum())} parameters.",
            "measure more rows, or over a wider range",
        )
    text = (
        f"The fit explains nothing of {outputs}: a constant fits as well (R2 = "
        f"{each(explained)} {of})."
    )
    turned = np.array(fit.output_names)[in_order(fit.measured, 0.7)]
    ordered = [name for name in names[nothing] if name in turned]
    if ordered and not in_order(fit.commands, 0.1).any():
        text += (
            f" {', '.join(ordered)} never turns from the first row to the last, which "
            "the commands do: it was sorted without them, or drifts."
        )
    return Reason(
        text,
        "check that readings and commands belong together (rows, columns, sensor), or "
        "measure over a wider range",
    )


def _unknown(fit: Fit) -> Reason | None:
    """Parameters that are known no better than before, or than many of their sizes."""
    of_prior = fit.prior_precision.any()
    if fit.noise_std is None or (fit.model.linear and not of_prior):
        return None
    errors = np.asarray(fit.standard_errors)
    free = fit.free[: len(errors)] > 0.0
    sizes = np.fmax(np.abs(fit.parameters), fit.model.parameter_sizes())
    bad = np.isnan(errors)
    if not fit.model.linear:
        bad |= np.isfinite(errors) & (errors > _SIZES * sizes)
    prior = fit.prior_precision[: len(errors)] > 0.0
    untouched = prior & (np.asarray(fit.from_data) < 0.1)
    if free.any() and untouched[free].all():
        bad |= free
    if not (bad & free).any():
        return None
    names = np.array(fit.names)[bad & free]
    return Reason(
        f"{', '.join(names)}: known only to +-{each(errors[bad & free])} (1 sigma).",
        "measure where they matter: select(candidates, model=..., measured=commands); "
        "or start nearer, Prior(mean=...)",
    )


def _far_off(fit: Fit) -> Reason | None:
    """Parameters whose estimates are far from where their prior, or a model's stated
    scale, has them."""
    p, off_by = len(fit.names), fit.model.fitting.off_by
    if off_by is None and not fit.prior_precision.any():
        return None
    with np.errstate(divide="ignore"):
        expected = 1.0 / np.sqrt(fit.prior_precision[:p])
    if off_by is not None:
        expected = np.minimum(expected, off_by)
    away = np.abs(fit.estimate - fit.prior_mean)[:p] / expected
    far = int(away.argmax())
    if away[far] <= _FAR:
        return None
    return Reason(
        f"{fit.names[far]} = {short(fit.estimate[far])} is {short(away[far])} times as "
        f"far from {short(fit.prior_mean[far])} as was stated.",
        "check the units of commands and readings, and what was stated",
    )


def _on_its_way(fit: Fit) -> Reason | None:
    """A fit whose next step would move the parameters: it has not converged."""
    if fit.model.linear or fit.noise_std is None or fit.estimated_commands is not None:
        return None
    white = fit.residuals / fit.noise_std
    if not _in_noise(fit, white):
        return None
    slopes, covariance = linearised(fit, fit.commands, misfit=False)
    rows = slopes / fit.noise_std[:, None]
    pull = np.einsum("nqp,nq->p", rows, fit.loss_weights[:, None] * white)
    pull += fit.prior_precision * (fit.prior_mean - fit.estimate)
    step = float(np.sqrt(max(pull @ covariance @ pull, 0.0)))
    least, rounding = _STEP, fit.model.fitting.rounding
    if rounding is not None:  # its own noise moves the end of a search
        share = np.asarray(rounding) / fit.noise_std
        least = max(least, 3.0 * float(np.sqrt(len(pull))) * float(share.max()))
    if step < least:
        return None
    return Reason(
        f"The fit has not converged: a step is {step:.2g} standard errors long.",
        "start nearer: Prior(mean=...)",
    )


def _unsigned(fit: Fit) -> Reason | None:
    """Negative counts that were read as unsigned: minus 2^16 or 2^32 they fit."""
    readings = fit.measured
    if not (fit.model.linear and readings.max() >= 2.0**15):
        return None
    for whole in (2.0**16, 2.0**32):
        half = 0.5 * whole
        within = (readings >= 0.0).all(axis=0) & (readings < whole).all(axis=0)
        for j in np.flatnonzero(within & (readings >= half).any(axis=0)):
            slopes = fit.model.jacobian(fit.commands, fit.parameters)[:, j]
            rows = readings[:, j] >= half
            signed = fit.residuals[:, j] - whole * rows
            signed -= slopes @ np.linalg.lstsq(slopes, signed, rcond=None)[0]
            if _BENT * np.linalg.norm(signed) < np.linalg.norm(fit.residuals[:, j]):
                return Reason(
                    f"{fit.output_names[j]}: {rows.sum()} readings are negative counts "
                    f"that were read as unsigned; minus {whole:.0f} they fit.",
                    f"subtract {whole:.0f} from readings of {half:.0f} and more",
                )
    return None


def wrong_noise(fit: Fit) -> Reason | None:
    """A noise that was given and that the residuals contradict, by which factor. Too
    small where residuals are too large for it (``UNLIKELY``) and no few outliers make
    them so; too large where it is over three times theirs."""
    from scipy import special

    if not fit.noise_known or fit.dof < 0.5:
        return None
    noise, where = np.asarray(fit.noise_std), ""
    white, names = fit.residuals / noise, np.array(fit.output_names)
    squares = (white**2).sum(axis=0)
    if fit.model.fitting.error_groups() is not None or not _in_noise(fit, white):
        squares, names = np.array([fit.square]), np.array([""])
    dof, chance = fit.dof / len(squares), UNLIKELY / len(squares)
    times = np.sqrt(np.maximum(squares, 1e-300) / dof)
    small = special.chdtrc(dof, squares) < chance
    if small.any() and 0 < 4 * len(rows := [*fit.outliers]) <= fit.num_measurements:
        small &= _likelier_than_outliers(fit, fit.distance[rows])
    large = (special.chdtr(dof, squares) < chance) & (times < 1.0 / _TOO_LARGE)
    if not (small | large).any():
        return None
    worst = int(np.where(small | large, np.abs(np.log(times)), -1.0).argmax())
    factor = times[worst]
    if times.max() > _TOO_LARGE * times.min():
        noise, where = noise[[worst]], f" for {names[worst]}"
    word, ratio = ("small", factor) if small[worst] else ("large", 1.0 / factor)
    unit = f" {fit.measured_unit}" if fit.measured_unit else ""
    pattern = "; if residuals have a pattern (--report), the model lacks terms"
    return Reason(
        f"The noise you gave{where} ({each(noise)}{unit}) is about {short(ratio)} "
        f"times too {word}: residuals are {each(factor * noise)}{unit}.",
        "correct noise_std, --noise, or leave it out" + pattern * bool(small[worst]),
    )


def _likelier_than_outliers(fit: Fit, distance: Array) -> bool:
    """Whether another noise explains the residuals better than outliers do. By the
    logarithms of both likelihoods: of one scale of all, or of one scale of each
    outlier, at squared ``distance`` (k,) in the noise that was given, where one row in
    twenty is an outlier."""
    dof, q = fit.dof, fit.num_readings
    scale = -0.5 * dof * (np.log(fit.square / dof) + 1.0)
    of_rows = 0.5 * q * (np.log(distance / q) + 1.0) + _RARE
    # Without an outlier the sum of squares is less by its distance.
    rest = max(fit.square - distance.sum(), 0.0)
    return bool(scale > -0.5 * rest - of_rows.sum())


def bends(fit: Fit) -> Reason | None:
    """Residuals that follow a curve along the commands: where squares and products, or
    cubes too, would leave a noise of at most half, by an F test to first order; or
    where neighbours along a command differ by so little."""
    (count, n), m = fit.commands.shape, fit.measured.shape[1]
    every = max(count * m // _SAMPLE, 1)
    if count < _SMOOTH and count <= n * (n + 3):  # twice the squares
        return None
    noise = np.asarray(fit.noise_std)  # 0-d of none
    if noise.ndim == 0 or not noise.all() or fit.prior_precision.any():
        return None
    sample = slice(None, None, every)
    commands = fit.commands[sample]
    i, j = np.triu_indices(n)
    unit = commands - commands.mean(axis=0)
    unit /= np.fmax(np.abs(unit).max(axis=0), 1e-300)
    squares = np.hstack([unit, unit[:, i] * unit[:, j]])
    of_unit = f" {fit.measured_unit}".rstrip()
    for terms, what in (
        (squares, "squares and products of the commands"),
        (np.hstack([squares, unit**3]), "squares, products and cubes of the commands"),
    ):
        few = len(unit) > 2 * terms.shape[1] and 2 * terms.shape[1] * m <= _TERMS
        if few and (share := _left_by(fit, sample, terms)):
            return Reason(
                f"Residuals follow a curve: of a noise of {each(noise)}{of_unit}, "
                f"{what} would leave {each(noise * share)}{of_unit}.",
                "identify with a model that has these terms (Polynomial or another), "
                "or measure over a smaller range",
            )
    if fit.model.linear and count >= _SMOOTH and (along := _smooth(fit)):
        output, command = along
        return Reason(
            f"Residuals of {fit.output_names[output]} follow a curve along "
            f"{fit.input_names[command]}: from one row to the next they change by less "
            f"than half of their noise of {short(noise[output])}{of_unit}.",
            "identify with a model that has it, or measure over a smaller range",
        )
    return None


def _left_by(fit: Fit, sample: slice, terms: Array) -> float:
    """Share of the noise that terms (N, t) beside the model's would leave; 0 where that
    is too much, or may be chance."""
    from scipy import special

    m, noise = fit.num_outputs, np.asarray(fit.noise_std)
    root = np.outer(fit.loss_weights[sample] ** 0.5, 1.0 / noise).ravel()
    white = root * fit.residuals[sample].ravel()
    slopes = linearised(fit, fit.commands[sample], misfit=False)[0]
    slopes = slopes.reshape(len(white), -1)
    both = np.hstack([slopes, np.kron(terms, np.eye(m))])

    def unexplained(columns: Array) -> tuple[float, int]:
        step, _, rank, _ = np.linalg.lstsq(root[:, None] * columns, white, rcond=1e-9)
        off = white - root * (columns @ step)
        return max(float(off @ off), 1e-300), len(white) - int(rank)

    (before, more), (after, rest) = unexplained(slopes), unexplained(both)
    least = _BENT if fit.model.linear else _BENT_MORE
    if rest < 1 or more == rest or least**2 * after / rest > before / more:
        return 0.0
    ratio = (before - after) / (more - rest) / (after / rest)
    # As of one output: the outputs of a row may err alike.
    chance = special.fdtrc((more - rest) / m, rest / m, ratio)
    return float((after / rest) ** 0.5) if chance <= UNLIKELY else 0.0


def _smooth(fit: Fit) -> tuple[int, int] | None:
    """The output and the command along which residuals are a curve: neighbours differ
    by half of their noise or less (von Neumann, 1941)."""
    from scipy import special

    used = fit.loss_weights > 0.0
    count, residuals = int(used.sum()), fit.residuals[used]
    # What a display rounded, or a computer, follows a pattern of its own.
    residuals = residuals * (np.asarray(fit.noise_std) > resolution(fit.measured))
    least, along = 0.5, None
    for k in range(fit.num_inputs):
        order = np.argsort(fit.commands[used, k], kind="stable")
        steps = np.diff(residuals[order], axis=0)
        square = 2.0 * (residuals**2).sum(axis=0)
        ratio = np.full(len(square), np.inf)
        np.divide((steps**2).sum(axis=0), square, ratio, where=square > 0.0)
        j = int(ratio.argmin())
        chance = special.ndtr((ratio[j] - 1.0) * np.sqrt(count))
        if ratio[j] <= least**2 and chance * ratio.size * fit.num_inputs <= UNLIKELY:
            least, along = float(ratio[j] ** 0.5), (j, k)
    return along


def outlying(fit: Fit, rows: Sequence[int]) -> Reason | None:
    """Rows that are far from the fit of the others."""
    if not rows:
        return None
    sigma = np.fmax(np.sqrt(fit.distance), studentised(fit)[0])[list(rows)]
    size = " to ".join(dict.fromkeys(short(end) for end in (min(sigma), max(sigma))))
    verb = "are outliers" if len(rows) > 1 else "is an outlier"
    named = in_rows(rows)
    return Reason(
        f"{named.capitalize()} {verb} ({size} sigma).",
        f"repeat {named} (counted from 0), or leave out",
    )


def _in_noise(fit: Fit, white: Array) -> bool:
    """Whether the fit took residuals in noise as these (N, m), no row unlike others."""
    return bool(np.isclose((white**2).sum(), fit.square, rtol=1e-6))


Rule = Callable[["Fit"], Reason | None]
RULES: tuple[Rule, ...] = (
    _no_noise,
    _undetermined,
    _unsigned,
    _explains_nothing,
    _unknown,
    _far_off,
    saturated,
    _on_its_way,
    wrong_noise,
    lambda fit: None if wrong_noise(fit) else outlying(fit, [*fit.outliers]),
)


def verdict(fit: Fit) -> Verdict:
    """Good if no rule speaks against the fit and its inverse is not refused. Where
    readings were not measured, that is the only reason given: the others would follow
    from it."""
    from jaxcal.calibration.inverse import no_inverse

    first = never_measured(fit) or computed(fit)
    reasons = [first] if first else [reason for rule in RULES if (reason := rule(fit))]
    if not reasons and (refusal := no_inverse(fit)):
        remedy = "measure over a wider range, or with less noise"
        reasons = [Reason(f"command_for refuses: {refusal}.", remedy)]
    use = USE if fit.num_outputs <= fit.num_inputs else _PREDICT
    return Verdict(
        good=not reasons,
        reasons=tuple(reason.fact for reason in reasons),
        next_step=reasons[0].remedy if reasons else use,
        unit=fit.measured_unit,
    )
