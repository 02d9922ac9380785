"""Static models as tasks: the gains are those of the static solvers."""

import jax
import numpy as np
import pytest

import jaxcal
from jaxcal.adaptive.episodes import compare, play
from jaxcal.adaptive.gaussian import GaussianTask
from jaxcal.adaptive.loop import next_measurement, run
from jaxcal.adaptive.rules import Gain, Random
from jaxcal.adaptive.static import Static
from jaxcal.models import Affine, FromJax, Linear, Noise, Prior

COMMANDS = np.random.default_rng(5).uniform(-1, 1, (14, 2))


@pytest.fixture(scope="module", params=["affine", "linear", "jax"])
def case(request):
    """Model, prior and noise, all units unlike."""
    if request.param == "affine":
        model, noise = Affine(2, 3), Noise(std=[0.1, 0.3, 0.02])
        return model, Prior([0.5] * 6 + [20.0] * 3), noise
    if request.param == "linear":
        model = Linear("1 + x + x:y + sin(2*x)", num_outputs=2)
        return model, Prior(3.0, fixed=["y2:x:y"]), Noise(std=0.05, command_std=0.1)
    model = FromJax(lambda u, t: t[0] * u[0] * jax.numpy.exp(t[1] * u[1]), [2.0, 0.3])
    return model, Prior([1.0, 0.1]), Noise(std=0.2)


def test_one_at_a_time_gains_what_score_says(case):
    model, prior, noise = case
    task = GaussianTask.make(model, COMMANDS, most=5, prior=prior, noise=noise)

    def log_det(indices):
        design = jaxcal.Design(COMMANDS, model, prior, noise)
        return design.score(indices, "D").log_det

    history, chosen, total = [], [], 0.0
    for number in range(5):
        proposal = next_measurement(task, history, Gain())
        if number:
            step = log_det([*chosen, proposal.design]) - log_det(chosen)
            assert proposal.gain == pytest.approx(0.5 * step, rel=2e-4, abs=1e-4)
        chosen.append(proposal.design)
        total += proposal.gain
        # Whatever it answers, the next choice and its gain are the same.
        outcome = np.random.default_rng(number).normal(0.0, 3.0, model.num_outputs)
        history.append((proposal.design, outcome))
    assert len(set(chosen)) == 5
    slopes = model.command_jacobian(COMMANDS, prior.resolve(model).mean)
    white = noise.whitening(len(COMMANDS), model.num_outputs, slopes)
    free = prior.resolve(model).free
    jacobian = model.jacobian(COMMANDS, prior.resolve(model).mean)[..., free]
    each = np.einsum("nij,njk->nik", white, jacobian)
    each = np.einsum("nqi,nqj->nij", each, each)
    first = np.diag(np.diag(prior.resolve(model).precision)[free])
    worth = np.linalg.slogdet(first + each[chosen[:4]].sum(axis=0) + each)[1]
    worth[chosen[:4]] = -np.inf
    assert worth[chosen[4]] == pytest.approx(worth.max(), abs=1e-4)
    known = prior.resolve(model)
    before = np.log(np.diag(known.precision)[known.free]).sum()
    assert total == pytest.approx(0.5 * (log_det(chosen) - before), rel=1e-4)


def test_all_at_once_is_a_decider_of_the_same_task():
    """What ``select`` plans gains what it says, and no less than one at a time."""
    given = {"model": Affine(2, 2), "prior": Prior(2.0), "noise": Noise(std=0.1)}
    plan = jaxcal.select(COMMANDS, 4, "exact", criterion="D", **given)
    task = GaussianTask.make(
        given["model"], COMMANDS, most=4, prior=given["prior"], noise=given["noise"]
    )
    planned, myopic = (
        float(play(task, decider, jax.random.split(jax.random.key(0), 1)).gain[0])
        for decider in (Static(plan.indices), Gain())
    )
    assert planned == pytest.approx(0.5 * (plan.log_det - 6 * np.log(0.25)), rel=1e-3)
    assert myopic < planned + 1e-3


def test_the_belief_is_that_of_regularised_least_squares(case):
    model, prior, noise = case
    task = GaussianTask.make(model, COMMANDS, most=6, prior=prior, noise=noise)
    rng = np.random.default_rng(2)
    known = prior.resolve(model)
    truth = known.mean.copy()
    free = known.free
    truth[free] += (
        0.3 * rng.normal(size=free.sum()) / np.diag(known.precision)[free] ** 0.5
    )
    read = model.predict(COMMANDS, truth)
    chosen = [4, 0, 9, 2, 11, 4]
    proposal = next_measurement(task, [(i, read[i]) for i in chosen])
    slopes = model.command_jacobian(COMMANDS, known.mean)
    white = noise.whitening(len(COMMANDS), model.num_outputs, slopes)[chosen]
    rows = white @ model.jacobian(COMMANDS, known.mean)[chosen][..., free]
    off = np.einsum(
        "nij,nj->ni", white, (read - model.predict(COMMANDS, known.mean))[chosen]
    )
    information = np.diag(np.diag(known.precision)[free]) + np.einsum(
        "nqi,nqj->ij", rows, rows
    )
    covariance = np.linalg.inv(information)
    mean = known.mean[free] + covariance @ np.einsum("nqi,nq->i", rows, off)
    got, std = task.parameters(proposal.belief)
    spread = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(std, spread, rtol=1e-3)
    np.testing.assert_allclose((np.asarray(got) - mean) / spread, 0.0, atol=0.02)


def test_three_estimators_agree(case):
    model, prior, noise = case
    task = GaussianTask.make(model, COMMANDS, most=4, prior=prior, noise=noise)
    found = compare(task, {"gain": Gain(), "random": Random()}, 512, batch=512)
    np.testing.assert_allclose(found.gain, found.told, rtol=2e-3)
    difference = found.log_ratio - found.told
    error = difference.std(axis=1, ddof=1) / np.sqrt(512)
    assert (np.abs(difference.mean(axis=1)) < 4.0 * error).all()
    assert (found.gain[0] > found.gain[1] - 1e-3).mean() > 0.9


def test_a_candidate_is_measured_as_often_as_it_may_be():
    task = GaussianTask.make(
        Affine(2, 2), COMMANDS[:3], most=9, prior=Prior(1.0), replicates=2
    )
    played = play(task, Random(), jax.random.split(jax.random.key(0), 4))
    assert (np.asarray(played.alive).sum(axis=1) == 6).all()
    for designs in np.asarray(played.designs)[:, :6]:
        assert sorted(designs) == [0, 0, 1, 1, 2, 2]
    measured = run(task, None, lambda proposal: [0.0, 0.0]).history
    assert sorted(int(design) for design, _ in measured) == [0, 0, 1, 1, 2, 2]


@pytest.mark.parametrize("outcome", [1.0, [1.0], [1.0, np.nan], "a"])
def test_an_outcome_that_is_none_is_named(outcome):
    task = GaussianTask.make(Affine(2, 2), COMMANDS, most=3, prior=Prior(1.0))
    with pytest.raises(ValueError, match=r"history\[0\]: outcome must"):
        next_measurement(task, [(0, outcome)])


def test_a_prior_without_a_std_is_refused():
    with pytest.raises(ValueError, match=r"finite std .* a11"):
        GaussianTask.make(Affine(2, 2), COMMANDS, most=3)
