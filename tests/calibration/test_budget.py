"""The uncertainty budget against GTC, simulation, and the calibration's own numbers."""

from __future__ import annotations

import numpy as np
import pytest

import jaxcal
from jaxcal.calibration import Source
from jaxcal.models import SerialChain

TRUE = np.array([[0.43, 0.02], [-0.01, 0.71]])
BIAS = np.array([3.1, -5.8])


def readings(rng, rows=7, noise=0.05):
    commands = rng.uniform(-20.0, 20.0, (rows, 2))
    return commands, commands @ TRUE.T + BIAS + rng.normal(0.0, noise, (rows, 2))


def test_without_sources_it_is_the_uncertainty_of_the_calibration(rng):
    commands, measured = readings(rng)
    calibration = jaxcal.identify(commands, measured)
    parameters, outputs = calibration.budget(), calibration.budget(commands)
    assert parameters.combined == pytest.approx(calibration.standard_errors)
    std = calibration.predict_std(commands).ravel()
    assert outputs.combined == pytest.approx(std)
    low, high = calibration.predict_interval(commands)
    assert 2.0 * outputs.expanded == pytest.approx((high - low).ravel())
    assert parameters.sources == ("noise",) and outputs.dof == pytest.approx(4.0)


def test_of_an_arm_what_was_known_before_and_misfit_are_counted_apart(rng):
    table = [(0, 90, 90, 0), (-425, 0, 0, 0), (-390, 0, 0, 0)]
    arm = SerialChain.from_dh(table)
    joints = rng.uniform(-90.0, 90.0, (15, 3))
    off = rng.normal(0.0, 0.2, len(arm.names))
    measured = arm.predict(joints, arm.nominal + off) + rng.normal(0, 0.1, (15, 3))
    fit = jaxcal.identify(joints, measured, model=arm, noise=jaxcal.Noise(0.1))
    found = fit.budget(joints)
    assert {"noise", "known before"} <= set(found.sources)
    assert found.combined == pytest.approx(fit.predict_std(joints).ravel(), rel=1e-6)
    # A tracker's offset moves what is predicted, but less than by itself: the prior
    # of the base holds some of it.
    more = fit.budget(joints, sources=[Source("tracker", offset=0.02)])
    moved = more.contributions[:, -1]
    assert (moved > 0.0).all() and (moved < 0.021).all()
    # The gain, by fitting readings that are moved.
    step = 1e-3
    again = jaxcal.identify(
        joints, measured + np.array([step, 0, 0]), model=arm, noise=jaxcal.Noise(0.1)
    )
    finite = (again.predict(joints) - fit.predict(joints)) / step
    one = Source("tracker", offset=[1.0, 0.0, 0.0])
    gains = fit.budget(joints, sources=[one]).contributions[:, -1].reshape(-1, 3)
    assert gains[:, 0] == pytest.approx(np.abs(finite[:, 0]), abs=0.05)


@pytest.mark.parametrize("scale", [0.0, 2e-3])
def test_a_line_has_the_budget_that_gtc_finds(rng, scale):
    import GTC as gtc

    x = np.linspace(-3.0, 5.0, 6)
    y = 1.7 * x + 0.4 + rng.normal(0.0, 0.03, 6)
    calibration = jaxcal.identify(x[:, None], y[:, None])
    sources = [Source("certificate", offset=0.02, dof=9.0)]
    if scale:
        sources.append(Source("gain", scale=scale, dof=5.0))
    line = gtc.type_a.line_fit(x.tolist(), y.tolist())
    a, b = line.a_b
    offset = gtc.ureal(0.0, 0.02, 9.0)
    times = gtc.ureal(1.0, scale, 5.0) if scale else 1.0
    at = [-2.0, 0.3, 4.0]
    found = calibration.budget(np.array(at)[:, None], sources=sources)
    for i, point in enumerate(at):
        wanted = (a + b * point - offset) / times
        assert found.values[i] == pytest.approx(gtc.value(wanted))
        assert found.combined[i] == pytest.approx(gtc.uncertainty(wanted), rel=1e-4)
        assert found.dof[i] == pytest.approx(gtc.dof(wanted), rel=1e-3)
        factor = gtc.reporting.k_factor(gtc.dof(wanted), p=95)
        assert found.coverage_factor[i] == pytest.approx(factor, rel=2e-3)
    found = calibration.budget(sources=sources)
    for i, wanted in enumerate((b / times, (a - offset) / times)):
        assert found.combined[i] == pytest.approx(gtc.uncertainty(wanted), rel=1e-4)
        assert found.dof[i] == pytest.approx(gtc.dof(wanted), rel=1e-3)


@pytest.mark.slow
def test_the_expanded_uncertainty_covers_as_often_as_it_says(rng):
    sources = [Source("zero", offset=0.04), Source("tracker", scale=1e-3)]
    at = np.array([[5.0, -3.0], [18.0, 12.0]])
    theta = np.concatenate([TRUE.ravel(), BIAS])
    hits = []
    for _ in range(1000):
        commands, measured = readings(rng)
        measured = measured * (1.0 + rng.normal(0.0, 1e-3, 2))
        measured = measured + rng.normal(0.0, 0.04, 2)
        calibration = jaxcal.identify(commands, measured)
        parameters = calibration.budget(sources=sources)
        outputs = calibration.budget(at, sources=sources)
        truth = (at @ TRUE.T + BIAS).ravel()
        off = np.concatenate([parameters.values - theta, outputs.values - truth])
        hits.append(np.abs(off) < np.r_[parameters.expanded, outputs.expanded])
    share = np.mean(hits, axis=0)
    # Four standard errors of 1,000 draws; Welch and Satterthwaite's rule is one-sided.
    assert (share > 0.95 - 0.028).all() and (share < 0.985).all(), share
    assert np.mean(share) == pytest.approx(0.95, abs=0.012)


def test_what_nothing_determines_has_no_bound(rng):
    model = jaxcal.models.Polynomial(1, 2, 1)
    commands = np.column_stack([rng.uniform(size=8), np.ones(8)])
    measured = commands[:, :1] + rng.normal(0.0, 0.1, (8, 1))
    fit = jaxcal.identify(commands, measured, model=model, noise=jaxcal.Noise(0.1))
    assert np.isinf(fit.standard_errors).any()
    assert fit.budget().combined == pytest.approx(fit.standard_errors)
    assert None in [one["combined"] for one in fit.budget().to_dict()["results"]]


def test_what_is_wrong_is_named(rng):
    commands, measured = readings(rng)
    calibration = jaxcal.identify(commands, measured)
    with pytest.raises(ValueError, match="zero needs an offset or a scale, both are 0"):
        Source("zero")
    with pytest.raises(ValueError, match="offset and scale of zero must be 0 or more"):
        Source("zero", offset=-1.0)
    with pytest.raises(ValueError, match=r"sources must hold .*Source, got 0.1"):
        calibration.budget(sources=[0.1])
    with pytest.raises(ValueError, match="offset of zero"):
        calibration.budget(sources=[Source("zero", offset=[1.0, 1.0, 1.0])])
    with pytest.raises(ValueError, match="different names: 'zero'"):
        calibration.budget(sources=[Source("zero", 1.0), Source("zero", 2.0)])
    exact = jaxcal.identify(commands[:3], measured[:3])
    with pytest.raises(ValueError, match=r"no uncertainty budget, .* 3 measurements"):
        exact.budget()
    text = str(calibration.budget(sources=[Source("tracker", 0.02)]))
    assert "tracker" in text and "U (0.95)" in text
