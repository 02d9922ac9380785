"""Harmonics of the joints as what an arm's parameters do not explain."""

from __future__ import annotations

import re

import contacts
import numpy as np
import pytest

import jaxcal
from jaxcal.calibration.fit import linearised
from jaxcal.models import Pose, SerialChain, Socket

from ..models.arms import CONTACTS, contacts_of_a_panda, ur5

ARM = ur5()
WHOLE = ARM.fitting.misfit_model()
RNG = np.random.default_rng(0)
JOINTS, ELSEWHERE = RNG.uniform(-120.0, 120.0, (2, 40, 6))
STD = np.asarray(WHOLE.default_prior().std)
WAVES = [" sin" in name or " cos" in name for name in WHOLE.names]
TRUTH = WHOLE.nominal + STD * RNG.normal(size=63) * np.where(WAVES, 3.0, 0.5)
MEASURED = WHOLE.predict(JOINTS, TRUTH) + 0.1 * RNG.normal(size=(40, 3))


@pytest.fixture(scope="module")
def found():
    return jaxcal.identify(JOINTS, MEASURED, model=ARM)


def test_what_no_parameter_explains_is_found(found, tmp_path):
    exact = WHOLE.predict(ELSEWHERE, TRUTH)
    given = jaxcal.identify(JOINTS, MEASURED, model=ARM, prior=ARM.default_prior())
    off = [np.linalg.norm(fit.predict(ELSEWHERE) - exact, axis=1).mean()
           for fit in (found, given)]  # fmt: skip
    assert off[0] < 0.5 * off[1]
    assert len(given.estimate) == 39
    assert found.names == ARM.names and len(found.estimate) == 63
    np.testing.assert_allclose(found.arm.predict(JOINTS), found.predict(JOINTS))
    found.save(tmp_path / "arm.json")
    again = jaxcal.Calibration.load(tmp_path / "arm.json")
    np.testing.assert_array_equal(again.predict(JOINTS), found.predict(JOINTS))
    low, high = found.predict_interval(ELSEWHERE)
    assert 0.85 < ((low <= exact) & (exact <= high)).mean() <= 1.0


def test_a_table_on_file_is_that_of_a_fit_without_them(found, tmp_path):
    given = jaxcal.identify(JOINTS, MEASURED, model=ARM, prior=ARM.default_prior())
    apart = np.linalg.norm(found.predict(JOINTS) - given.predict(JOINTS), axis=1)
    with pytest.warns(UserWarning, match="was fitted without harmonics") as told:
        found.to_dh(tmp_path / "found")
    assert f"calibration's by {apart.mean():.3g}" in str(told[0].message)
    given.to_dh(tmp_path / "given")
    tables = []
    for name in ("found", "given"):
        lines = (tmp_path / name).read_text().splitlines()[1:]
        tables.append([[float(x) for x in line.split(",")[1:]] for line in lines])
    np.testing.assert_allclose(tables[0], tables[1], atol=1e-4)


def test_it_is_the_fit_of_the_arm_that_has_them_as_parameters(found):
    """The same prior and sizes; harmonics are the last parameters of an arm."""
    assert WHOLE.names[: len(ARM.names)] == ARM.names
    fit = jaxcal.identify(JOINTS, MEASURED, model=WHOLE, prior=WHOLE.default_prior())
    own = [WHOLE.names.index(name) for name in ARM.names]
    np.testing.assert_allclose(found.parameters, fit.parameters[own], atol=1e-4)
    np.testing.assert_allclose(
        found.standard_errors, fit.standard_errors[own], rtol=1e-3
    )


def test_the_choice_has_them_too_unless_a_prior_is_given():
    candidates = RNG.uniform(-120.0, 120.0, (60, 6))
    options = {"k": 8, "method": "exchange", "seed": 0}
    chosen = jaxcal.select(candidates, model=ARM, **options)
    same = jaxcal.select(candidates, model=WHOLE, **options)
    assert list(chosen.indices) == list(same.indices)
    assert chosen.value == pytest.approx(same.value)
    of_table = jaxcal.select(candidates, model=ARM, criterion="D", **options)
    given = {"prior": ARM.default_prior(), "criterion": "D"}
    again = jaxcal.select(candidates, model=ARM, **given, **options)
    assert of_table.value == pytest.approx(again.value)
    plain = jaxcal.select(candidates, model=ARM, prior=ARM.default_prior(), **options)
    noise = np.asarray(ARM.default_noise().std)[0]
    assert plain.value == pytest.approx(_variance(ARM, candidates, plain, noise), 1e-6)
    # Readings scatter by what harmonics leave, too; of predictions that is no error.
    misfit = np.hypot(noise, 3e-4 * ARM.length)
    expected = _variance(WHOLE, candidates, chosen, misfit) * (misfit / noise) ** 2
    assert chosen.value == pytest.approx(expected, rel=1e-6)


def _variance(arm, candidates, chosen, noise):
    """Mean variance of a prediction, in that of the noise, by definition."""
    slopes = arm.jacobian(candidates) / noise
    used = slopes[chosen.indices].reshape(-1, len(arm.names))
    prior = np.diag(np.asarray(arm.default_prior().std) ** -2.0)
    inverse = np.linalg.inv(used.T @ used + prior)
    rows = slopes.reshape(-1, len(arm.names))
    return np.einsum("ri,ij,rj->", rows, inverse, rows) / len(rows)


def test_a_urdf_file_is_fitted_without_harmonics_and_says_what_that_costs(tmp_path):
    """The file is the arm that positions at the measured postures fit best."""
    arm = SerialChain.from_urdf(CONTACTS / "panda.urdf", tip="ball_link")
    bent = arm.fitting.misfit_model()
    joints = RNG.uniform(*np.clip(arm.limits, -60.0, 60.0).T, (60, 7))
    std = np.asarray(arm.default_prior().std)
    truth = arm.nominal + 0.3 * std * RNG.normal(size=len(std))
    waves = 0.02 * RNG.normal(size=28)
    measured = bent.predict(joints, np.append(truth, waves))
    measured += 1e-4 * RNG.normal(size=(60, 3))
    fit = jaxcal.identify(joints, measured, model=arm)
    with pytest.warns(UserWarning, match="was fitted without harmonics") as told:
        tip = fit.to_urdf(tmp_path / "arm.urdf")
    again = SerialChain.from_urdf(tmp_path / "arm.urdf", tip=tip)
    off, left_out, naive = (
        np.linalg.norm(points - measured, axis=1).mean()
        for points in (
            again.predict(joints),
            fit.predict(joints),
            arm.predict(joints, fit.parameters),
        )
    )
    assert left_out < off < naive
    said = re.search(
        r"cross-validated error (\S+), of the calibration", str(told[0].message)
    )
    assert off < float(said[1]) < 2.0 * off


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "place"), [("panda_1", "right"), ("kuka_14", "front")]
)
def test_a_file_of_a_real_arm_without_compliance_errs_as_one_that_drops_it(
    name, place, tmp_path
):
    """At the other places; and its tip is nearer to the calibration's."""
    places = contacts.load(name)
    every = np.arange(len(places[place][0]))
    fit = contacts.identify(name, places.pop(place), every)
    assert any("compliance" in name for name in fit.names)
    with pytest.warns(UserWarning, match="moved as a whole"):
        tip = fit.to_urdf(tmp_path / "arm.urdf")
    file = SerialChain.from_urdf(tmp_path / "arm.urdf", tip=tip)
    plain = fit.parameters.copy()
    plain[~np.isin(fit.names, fit.model.writable().names)] = 0.0
    dropped = fit.model.calibrated(plain)
    error, far = np.zeros((2, 2))
    for joints, sockets in places.values():
        for k, arm in enumerate((file, dropped)):
            error[k] += contacts.consistency(arm, (joints, sockets))
            off = arm.predict(joints) - fit.arm.predict(joints)
            far[k] += np.linalg.norm(off, axis=1).mean()
    assert error[0] < 1.001 * error[1]
    assert far[0] < 0.9 * far[1]


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "count"), [(34, 8), (50, 8), (1, 60)])
def test_positions_have_one_level_of_noise_and_turns_another(seed, count):
    """Of few poses the noise of a single reading ran to zero and back, without end."""
    rng = np.random.default_rng(seed)
    bent = ur5(sensor=Pose(), harmonics=range(1, 7))
    waves = [" sin" in name or " cos" in name for name in bent.names]
    truth = bent.nominal + 0.1 * np.array(waves) * rng.normal(size=len(waves))
    truth = bent.nominal if count > 8 else truth
    joints = rng.uniform(-120.0, 120.0, (count, 6))
    noise = np.array([0.1, 0.1, 0.1, 0.02, 0.02, 0.02])
    measured = bent.predict(joints, truth) + noise * rng.normal(size=(count, 6))
    found = jaxcal.identify(joints, measured, model=ur5(sensor=Pose()))
    place, turn = found.noise_std[:3], found.noise_std[3:]
    np.testing.assert_allclose(place, place[0])
    np.testing.assert_allclose(turn, turn[0])
    if count > 8:
        np.testing.assert_allclose([place[0], turn[0]], [0.1, 0.02], rtol=0.2)
        assert found.noise_dof > 100.0


@pytest.mark.slow
def test_contacts_of_eccentric_gears_err_elsewhere_as_predicted():
    """One socket does not show them; the fit bends its parameters instead."""
    arm = SerialChain.from_urdf(
        CONTACTS / "panda.urdf", tip="ball_link", sensor=Socket(1, [[0.45, 0.0, 0.3]])
    )
    bent = arm.fitting.misfit_model()
    waves = np.asarray(bent.default_prior().std)[-28:]
    there = arm.postures(40, seed=1)
    wide = arm.measured_with(Socket(1, [[0.2, 0.4, 0.6]])).postures(40, seed=2)
    covered, told = [], []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        for size in (1.0, 0.1):  # that contacts show, and do not
            truth = np.append(arm.nominal, size * waves * rng.normal(size=28))
            measured = bent.predict(there, truth) + 2e-4 * rng.normal(size=(40, 3))
            found = jaxcal.identify(there, measured, model=arm)
            assert len(found.estimate) == len(found.names) + 28
            told.append((size, found.estimate[-28:].any()))
            off = found.arm.predict(wide[:, :7])
            off -= bent.calibrated(truth).predict(wide[:, :7])
            slopes, covariance = linearised(found, wide)
            moves = slopes - slopes.mean(axis=0)  # a place is known by its middle
            variance = np.einsum("nqi,ij,nqj->nq", moves, covariance, moves)
            inside = np.abs(off - off.mean(axis=0)) < 1.96 * np.sqrt(variance)
            covered.append(inside.mean())
    assert np.mean(covered) > 0.9
    assert not any(fitted for size, fitted in told if size < 1.0)


def test_the_covariance_of_what_may_be_there_is_that_of_a_dense_formula():
    """An estimate that ignores harmonics w errs by -K G w, its prediction by G w."""
    path, joints, sockets = contacts_of_a_panda("front")
    arm = SerialChain.from_urdf(path, tip="ball_link", sensor=Socket(2))
    commands = np.column_stack([np.degrees(joints), sockets])
    options = {"loss": "gaussian", "noise_std": 2e-4}
    found = jaxcal.identify(
        commands, np.zeros((len(commands), 3)), model=arm, **options
    )
    p, free = len(found.names), found.free > 0.0
    slopes = found.whole.jacobian(commands, found.estimate)
    log = found.whole.fitting.log_size(commands, found.estimate)  # misses are by size
    by_size = found.whole.fitting.log_size_jacobian(commands, found.estimate)
    off = found.predict(commands)
    slopes = slopes - off[..., None] * by_size[:, None]
    start = np.append(found.prior_mean[:p], np.zeros(28))
    size = np.exp(log - found.whole.fitting.log_size(commands, start))
    slopes = (slopes / size[:, None, None]).reshape(-1, p + 28) / 2e-4
    fitted, waves = slopes[:, :p][:, free[:p]], slopes[:, p:]
    precision = np.diag(found.prior_precision[:p][free[:p]])
    gain = np.linalg.solve(fitted.T @ fitted + precision, fitted.T)
    std = found.prior_precision[-1] ** -0.5  # as large as the contacts allow
    assert 0.001 < std < 0.045
    np.testing.assert_allclose(found.prior_precision[p:], std**-2.0)
    across = found.joint_covariance[:p, p:][free[:p]]
    np.testing.assert_allclose(across, -gain @ waves * std**2, rtol=1e-4, atol=1e-12)
