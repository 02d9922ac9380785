"""What no candidate shows: the UR5's known list, and laws for any arm."""

from __future__ import annotations

import hypothesis
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcal
from jaxcal.models import (
    Affine,
    FromJax,
    Linear,
    Noise,
    Polynomial,
    Pose,
    Prior,
    SerialChain,
    identifiability,
)

from .arms import ur5, ur5_data
from .test_serial_chain import arms

UR5_DIRECTIONS = [
    "d1 with base z",
    "theta1 with beta1 and base rz",
    "d2 = d3 = d4",
    "theta4 with beta4",
    "a5 with theta5 and beta5",
    "alpha5 with d5",
    "a6 with beta6 and tool x",
    "alpha6 with tool y",
    "d6 with tool z",
    "theta6",
]


def test_the_ur5_shows_25_of_its_39_parameters():
    report = identifiability(ur5(), ur5_data()[0])
    assert report.rank == 25 and len(report.names) == 39
    assert [each.words for each in report.directions] == UR5_DIRECTIONS
    assert sum(len(each.vectors) for each in report.directions) == 14
    assert "a2" in report.identifiable and "d3" not in report.identifiable
    assert 50.0 < report.condition < 500.0
    text = str(report)
    assert text.startswith("25 of 39 parameters can be identified from 1000 candidates")
    assert "\n  d2 = d3 = d4\n" in text and "No effect on the readings: theta6" in text


@hypothesis.settings(max_examples=30)
@hypothesis.given(arms())
def test_directions_span_what_the_measurements_do_not_show(arm):
    model, commands, _ = arm
    rng = np.random.default_rng(len(commands))
    commands = np.vstack([commands, rng.uniform(-90.0, 90.0, (40, model.num_inputs))])
    commands[:, [kind == "P" for kind in model.joints]] /= 50.0
    report = identifiability(model, commands)
    rows = model.jacobian(commands).reshape(-1, model.num_parameters)
    vectors = np.vstack(
        [np.zeros((0, rows.shape[1]))] + [each.vectors for each in report.directions]
    )
    size = np.linalg.svd(
        rows / np.maximum(np.linalg.norm(rows, axis=0), 1e-10), compute_uv=False
    )
    assert report.rank == (size > 1e-9 * size[0]).sum()
    assert len(vectors) == model.num_parameters - report.rank
    if len(vectors):
        assert np.linalg.matrix_rank(vectors, tol=1e-6) == len(vectors)
        assert np.abs(rows @ vectors.T).max() < 1e-7 * np.abs(rows).max()
    for each in report.directions:
        moved = np.abs(each.vectors).max(axis=0) > 0.0
        assert set(each.names) == set(np.array(model.names)[moved])


def test_a_prior_is_information_and_fixed_parameters_are_left_out():
    commands = ur5_data()[0][:50]
    prior = Prior({"base z": 1.0, "d2": 1.0}, fixed=["d3", "d4", "theta6"])
    report = identifiability(ur5(), commands, prior=prior)
    told = [each.words for each in report.directions]
    assert told == [
        words
        for words in UR5_DIRECTIONS
        if words not in ("d1 with base z", "d2 = d3 = d4", "theta6")
    ]
    assert len(report.names) == 36


def test_some_parameters_taking_the_others_as_known():
    names = ["d2", "d3", "a2", "theta6"]
    report = identifiability(ur5(), ur5_data()[0][:50], parameters=names)
    assert report.names == ("a2", "d2", "d3", "theta6")
    assert [each.words for each in report.directions] == ["d2 = d3", "theta6"]
    assert report.identifiable == ("a2",)
    with pytest.raises(ValueError, match=r"parameters must be one of .* got 'd9'"):
        identifiability(ur5(), ur5_data()[0][:50], parameters=["d9"])


def test_two_levels_of_an_axis_do_not_show_its_curvature():
    corners = [[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]]
    report = identifiability(Polynomial(2, 2), corners)
    assert report.rank == 4
    assert [each.words for each in report.directions] == ["1 with x^2 and y^2"]
    assert report.identifiable == ("x", "y", "x y")


def test_a_direction_of_three_parameters_has_the_sizes_of_its_parts():
    """y = a u1 + b u2 + c u3 where u3 = u1 + 2 u2: moving (1, 2, -1) shows nothing."""
    two = np.random.default_rng(0).normal(size=(9, 2))
    model = Linear("0 + u1 + u2 + u3")
    report = identifiability(model, np.column_stack([two, two @ [1.0, 2.0]]))
    (direction,) = report.directions
    assert direction.words == "u1 with u2 and u3"
    ratio = direction.vectors[0] / direction.vectors[0, 0]
    np.testing.assert_allclose(ratio, [1.0, 2.0, -1.0])


def test_what_an_unknown_command_hides_is_named():
    """A gain cannot be identified where the command is unknown."""
    model = Affine(1, 2)
    commands = np.random.default_rng(0).normal(size=(20, 1))
    assert identifiability(model, commands).rank == 4
    noise = Noise(std=0.1, command_std=np.inf)
    report = identifiability(Affine(1, 1), commands, noise=noise)
    assert report.rank == 0 and report.identifiable == ()
    assert str(report).endswith("No effect on the readings: a11, b1")


def test_encoder_pulses_far_from_zero_show_what_angles_do():
    angles = np.random.default_rng(0).uniform(0.0, 90.0, (8, 3))
    assert identifiability(Affine(3, 3), angles * 1e4 + 1e7).rank == 12


def test_candidates_are_checked():
    with pytest.raises(ValueError, match="candidates must hold at least one row"):
        identifiability(ur5(), np.zeros((0, 6)))
    with pytest.raises(ValueError, match=r"commands must have shape \(N, 6\)"):
        identifiability(ur5(), np.zeros((3, 2)))


def test_a_pose_shows_more_than_a_position():
    rng = np.random.default_rng(0)
    commands = rng.uniform(-150.0, 150.0, (40, 6))
    position = identifiability(ur5(), commands)
    pose = identifiability(ur5(sensor=Pose()), commands)
    assert pose.rank > position.rank
    gantry = SerialChain.from_dh([(0, 0, 0, 0)] * 3, joints="PPP")
    unseen = identifiability(gantry, commands[:, :3]).directions
    assert "theta1" in [each.words for each in unseen]


def test_a_prior_says_where_the_model_is_looked_at():
    """The rate of a sine of no height shows only where a height is expected."""

    def wave(u, theta):
        return theta[0] * jnp.sin(theta[1] * u[0])

    model = FromJax(wave, [0.0, 1.0], ["height", "rate"], num_inputs=1)
    commands = np.linspace(-1.0, 1.0, 9)[:, None]
    assert identifiability(model, commands).rank == 1
    prior = Prior(np.inf, mean={"height": 2.0})
    assert identifiability(model, commands, prior=prior).rank == 2
    found = jaxcal.select(commands, 2, model=model, prior=prior, criterion="D")
    heights = np.sin(commands[found.indices, 0])
    rates = 2.0 * commands[found.indices, 0] * np.cos(commands[found.indices, 0])
    expected = np.linalg.slogdet(np.c_[heights, rates])[1] * 2
    assert found.log_det == pytest.approx(expected)
