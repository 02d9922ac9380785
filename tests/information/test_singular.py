"""What is not determined is one answer, whoever is asked."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

import jaxcal
from jaxcal import identify
from jaxcal.information.singular import rank_rule, significant
from jaxcal.models import Affine, Model, Polynomial, Prior, identifiability

Array = NDArray[np.float64]

PLANE = np.array([1.0, 1.0, -1.0]) / np.sqrt(3.0)  # normal of the candidates
ASKED = ("select", "score", "plan", "identify")


def coplanar(rng: np.random.Generator) -> Array:
    u = rng.random((12, 3))
    return u - np.outer(u @ PLANE, PLANE)


def refusal(question: str, candidates: Array, model: Model | None) -> str:
    """What one question says of candidates that leave a direction unknown."""
    m = candidates.shape[1] if model is None else model.num_outputs
    more = np.random.default_rng(1).random((10, candidates.shape[1]))
    with pytest.raises(ValueError) as caught:
        if question == "select":
            jaxcal.Design(candidates, model).select()
        elif question == "plan":
            jaxcal.Design(candidates, model).plan(accuracy=0.1, noise_std=0.1)
        elif question == "score":
            whole = np.concatenate([candidates, more])
            jaxcal.Design(whole, model).score(np.arange(len(candidates)))
        else:
            identify(candidates, np.ones((len(candidates), m)), model=model)
    return str(caught.value)


@pytest.mark.parametrize("question", ASKED)
def test_coplanar_candidates_are_refused_by_the_same_direction(
    question: str, rng: np.random.Generator
) -> None:
    words = "(+0.5774 u_x +0.5774 u_y -0.5774 u_z)"
    assert words in refusal(question, coplanar(rng), None)


@pytest.mark.filterwarnings("ignore::UserWarning")  # exact readings, and far away
def test_the_parameters_of_that_direction_are_named_and_not_used(
    rng: np.random.Generator,
) -> None:
    u, model = coplanar(rng), Affine(3, 3)
    matrix = rng.normal(size=(3, 3))
    found = identifiability(model, u)
    assert [each.words for each in found.directions] == [
        f"a{i}1 with a{i}2 and a{i}3" for i in (1, 2, 3)
    ]
    for i, each in enumerate(found.directions):
        slopes = each.vectors[0, 3 * i : 3 * i + 3]
        np.testing.assert_allclose(np.abs(slopes @ PLANE), 1.0, rtol=1e-9)
    prior = Prior(np.inf, mean=np.concatenate([np.eye(3).ravel(), np.zeros(3)]))
    fit = identify(u, u @ matrix.T, model=model, prior=prior, noise_std=1e-4)
    directions = np.concatenate([each.vectors for each in found.directions])
    assert fit.unidentified is not None
    both = np.concatenate([fit.unidentified, directions])
    assert significant(np.linalg.svd(directions, compute_uv=False)).sum() == 3
    both /= np.linalg.norm(both, axis=1, keepdims=True)
    assert significant(np.linalg.svd(both, compute_uv=False)).sum() == 3
    # Within the plane a command is found; across it the question is refused.
    np.testing.assert_allclose(fit.command_for(u @ matrix.T), u, atol=1e-9)
    across = u[:1] + PLANE
    assert np.isinf(fit.predict_std(across)).all()
    with pytest.raises(
        ValueError, match=r"unmeasured parameters: a11 with a12 and a13\."
    ):
        fit.command_for(fit.predict(across))


@pytest.mark.parametrize("question", ASKED[:3])
@pytest.mark.parametrize("error", [0.0, 1e-13])
def test_parameters_that_act_alike_are_refused_by_name(
    question: str, error: float, rng: np.random.Generator
) -> None:
    v = rng.random((12, 2))
    v[:, 0] = 0.5 + error * v[:, 1]
    words = "1 with x and x^2; y with x y"
    assert words in refusal(question, v, Polynomial(2, 2))
    found = identifiability(Polynomial(2, 2), v).directions
    assert "; ".join(each.words for each in found) == words


@pytest.mark.parametrize("question", ASKED)
def test_a_measurement_too_few_is_refused_by_what_stays_unknown(
    question: str, rng: np.random.Generator
) -> None:
    words = "1 with x, y, x^2, x y and y^2"
    if question == "score":  # where others could be chosen, the number is what is wrong
        words = "k must be at least 6 for 6 parameters"
    assert words in refusal(question, rng.random((5, 2)), Polynomial(2, 2))


@pytest.mark.parametrize("computed", [False, True])
@pytest.mark.parametrize("share", [1e-8, 1e-12])
def test_derivatives_are_less_exact_than_the_numbers_given(
    share: float, computed: bool, rng: np.random.Generator
) -> None:
    columns = rng.normal(size=(1, 30, 4))
    columns[..., 3] = columns[..., 2] + share * columns[..., 3]
    largest = np.abs(columns).max(axis=1)
    rank = rank_rule(columns, largest, computed=computed)[0][0]
    assert rank == (3 if computed and share < 1e-10 else 4)


def test_a_column_of_zeros_beside_large_numbers_brings_no_warning(recwarn):
    columns = np.array([[[1.0, 0.0], [2.0, 0.0]]])
    assert rank_rule(columns, np.array([[2.0, 10.0]]))[0] == [1]
    assert not recwarn.list
