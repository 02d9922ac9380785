"""What a fit of several chains says of each of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.arms.chains import Chains
from jaxcal.arms.findings import CLEAR_UP, Part, other_distances
from jaxcal.arms.verdict import ArmVerdict
from jaxcal.calibration import verdict as models
from jaxcal.checks import Array, one_of


def of_chain(model: Chains, fit: Any, tip: str) -> dict[str, Any]:
    """The fields of a calibration that are of one chain, in its own units."""
    k = model.tips.index(one_of("tip", tip, model.tips))
    arm, at, scale = model.chains[k], fit.whole.members[k], model._scale(k)
    q, rows = arm.num_outputs, fit.commands[:, len(model.joint_names)] == k
    residuals = fit.residuals[rows, :q] * scale
    noise = None if fit.noise_std is None else fit.noise_std[:q] * scale
    square = fit.square
    if noise is not None:
        weights = fit.loss_weights[rows]
        square = float((weights[:, None] * (residuals / noise) ** 2).sum())
    share = int(rows.sum()) * q / max(len(fit.commands) * model.num_outputs, 1)
    null = fit.unidentified
    if null is not None:
        null = null[:, at]
        null = null[np.abs(null).max(axis=1, initial=0.0) > 0.0]
    joint = fit.joint_covariance
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
    model: Chains, used: NDArray[np.intp], tables: list[tuple[int, Array, None]]
) -> list[Part]:
    """What chains read of the sensors that they share, of the rows ``used``; distances
    that one chain's contacts judge are left to its own verdict."""
    parts = []
    for number, readings in model._by_member(model.chains, tables).items():
        if len(readings) < 2:
            continue
        k, i = model._members[number][0]
        sensor, own = readings[0].sensor, model.members[k][model.chains[k].own(i)]
        columns = np.vstack([of_chain.columns for of_chain in readings])
        points = np.vstack([of_chain.tip.position for of_chain in readings])
        where = (used, columns, points, own, readings[0].scale)
        part = Part(number, sensor, sensor.kind, "", *where)
        alone = [part._replace(columns=r.columns).touched() for r in readings]
        parts.append(part._replace(judged=np.any(alone, axis=0)))
    return parts
