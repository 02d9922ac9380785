"""Scales of the prior from the readings, against brute force and the truth."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import jaxcal
from jaxcal import Prior
from jaxcal.models import Affine, SerialChain

from ..models.arms import ur5

ARM = ur5()
STD = np.asarray(ARM.default_prior().std)
GROUPS = np.tile([0, 1, 0, 2, 1], 6)  # lengths, turns of the axes, zeros of the joints


def _data(sizes, count, seed):
    rng = np.random.default_rng(seed)
    factors = np.ones(39)
    factors[:30] = np.take(sizes, GROUPS)
    truth = ARM.nominal + factors * STD * rng.normal(size=39)
    joints = rng.uniform(-120.0, 120.0, (count, 6))
    measured = ARM.predict(joints, truth) + 0.1 * rng.normal(size=(count, 3))
    return joints, measured, truth, factors


@pytest.mark.parametrize("sizes", [(0.2, 0.2, 0.2), (0.2, 3.0, 1.0), (3.0, 0.3, 5.0)])
def test_the_factors_are_found(sizes):
    joints, measured, *_ = _data(sizes, 60, 0)
    prior = Prior(STD).sized()
    found = jaxcal.identify(joints, measured, model=ARM, prior=prior)
    sized = found.prior_precision[:30] ** -0.5 / STD[:30]
    for group, factor in enumerate(sizes):
        ratio = sized[GROUPS == group]
        assert np.ptp(ratio) < 1e-9
        assert 0.4 < ratio[0] / factor < 2.5, (group, ratio[0])
    np.testing.assert_allclose(found.prior_precision[30:] ** -0.5, STD[30:])


def test_the_factors_maximise_the_marginal_likelihood():
    """Brute force: the density of the readings, linear about the fit, on a grid."""
    joints, measured, *_ = _data((0.3, 2.0, 2.0), 12, 1)
    stated = Prior(STD)
    found = jaxcal.identify(
        joints,
        measured,
        model=ARM,
        prior=stated.sized(),
        loss="gaussian",
        noise_std=0.1,
    )
    slopes = ARM.jacobian(joints, found.parameters).reshape(-1, 39)
    off = (measured - ARM.predict(joints, found.parameters)).ravel()
    off = off + slopes @ (found.parameters - ARM.nominal)

    def density(logs):
        factors = np.ones(39)
        factors[:30] = np.exp(logs)[GROUPS]
        spread = (slopes * (factors * STD) ** 2) @ slopes.T + 0.01 * np.eye(len(off))
        value = np.linalg.slogdet(spread)[1] + off @ np.linalg.solve(spread, off)
        return value + (np.square(logs) / np.log(6.0) ** 2).sum()

    sized = np.log(found.prior_precision[:30] ** -0.5 / STD[:30])
    here = np.array([sized[GROUPS == group][0] for group in range(3)])
    steps = 0.3 * (np.indices((3, 3, 3)).reshape(3, -1).T - 1)
    values = [density(here + step) for step in steps]
    # Twice round the fit moves little; no neighbour is better by more than rounding.
    assert density(here) <= min(values) + 0.05


def test_wrong_tolerances_cost_little():
    """Errors a fifth of the tolerances, few poses: nearly as with the right prior."""
    errors = {"stated": [], "sized": [], "right": []}
    stated = Prior(STD)
    for seed in range(6):
        joints, measured, truth, factors = _data((0.2, 0.2, 0.2), 12, seed)
        rest = np.random.default_rng(99).uniform(-120.0, 120.0, (100, 6))
        where = ARM.predict(rest, truth)
        right = Prior(STD * factors)
        for name, prior in zip(errors, (stated, stated.sized(), right), strict=True):
            found = jaxcal.identify(joints, measured, model=ARM, prior=prior)
            off = found.predict(rest) - where
            errors[name].append(np.linalg.norm(off, axis=1).mean())
    means = {name: np.mean(values) for name, values in errors.items()}
    assert means["sized"] < means["right"] / 0.9
    assert means["sized"] < means["stated"]


def test_only_arms_have_sizes():
    prior = dataclasses.replace(Prior(1.0), by_data=True)
    with pytest.raises(ValueError, match=r"Prior\.sized\(\) is of arms"):
        jaxcal.identify(np.eye(4, 3), np.eye(4, 3), model=Affine(3, 3), prior=prior)


SIX = [(150, -90, 475, 0), (600, 0, 0, -90), (120, -90, 0, 0), (0, 90, 720, 0)]
SIX += [(0, -90, 0, 0), (0, 0, 85, 0)]
LIMITS = [(-165, 165), (-90, 110), (-200, 60), (-180, 180), (-115, 115), (-180, 180)]
PLACES = np.array([(700.0, 150, 300), (700, 200, 300), (820, 90, 390)])


def test_an_arm_in_sockets_does_not_shrink():
    """Contacts as they are made, errors of twice and four times the tolerances.

    An arm of no size touches any sockets in any posture.
    """
    sockets = jaxcal.models.Socket(3)
    arm = SerialChain.from_dh(SIX, tool=(15, -20, 140), sensor=sockets, limits=LIMITS)
    tip = arm.measured_with(jaxcal.models.Position())
    std, inside = np.asarray(tip.default_prior().std), []
    std = np.where(np.isfinite(std), std, 0.0)
    for size in (2.0, 4.0):
        rng = np.random.default_rng(int(size))
        truth = tip.nominal + size * std * rng.normal(size=len(std))
        tool = np.char.startswith(tip.names, "tool")
        truth[tool] = tip.nominal[tool] + 0.1 * std[tool] * rng.normal(size=tool.sum())
        joints = arm.postures(80, near=PLACES, seed=1)
        joints, socket = joints[:, :6], joints[:, 6].astype(int)
        goal = PLACES[socket] + 0.1 * rng.normal(size=(80, 3))
        for _ in range(30):  # Newton, by differences
            off = tip.predict(joints, truth) - goal
            slopes = [
                (tip.predict(joints + step, truth) - off - goal) / 1e-5
                for step in 1e-5 * np.eye(6)
            ]
            steps = np.linalg.pinv(np.stack(slopes, axis=2), rcond=1e-3)
            joints = joints - np.clip((steps @ off[..., None])[..., 0], -10.0, 10.0)
        made = np.abs(tip.predict(joints, truth) - goal).max(axis=1) < 1e-6
        made &= (
            (joints > np.array(LIMITS)[:, 0]) & (joints < np.array(LIMITS)[:, 1])
        ).all(1)
        assert made.sum() > 40
        commands = np.column_stack([joints, socket])[made]
        found = jaxcal.identify(commands, None, model=arm)
        assert found.verdict.good, str(found.verdict)
        low, high = found.confidence_intervals()[: len(SIX) * 5].T
        held = ((low <= truth[:30]) & (truth[:30] <= high))[std[:30] > 0.0]
        inside.append(held.mean())
    assert np.mean(inside) > 0.9
