"""Pictures: axes in, the same axes out, and what is drawn is what was given."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure

from jaxcal.models import SerialChain, Socket
from jaxcal.reports import plots


def test_an_ellipsoid_lies_at_the_mean_mahalanobis_distance_of_the_chosen(rng):
    places = rng.random((6, 3))
    off, every = places - places.mean(axis=0), np.arange(6)
    for d in (2, 3):
        axes = Figure().add_subplot(projection="3d" if d == 3 else None)
        plots.selection(axes, places, every)
        inverse = np.linalg.inv(np.cov(off[:, :d].T, bias=True))
        if d == 2:
            points = axes.lines[-1].get_xydata()
        else:
            points = np.vstack(axes.collections[0]._segments3d)
        points = points - places[:, :d].mean(axis=0)
        square = np.einsum("ni,ij,nj->n", points, inverse, points)
        np.testing.assert_allclose(square, d)


def test_a_selection_is_drawn_over_its_candidates_and_inside_its_ellipse(rng):
    candidates = rng.random((20, 2))
    axes = plots.selection(Figure().add_subplot(), candidates, [3, 5, 7], ("a", "b"))
    every, chosen, ring = (line.get_xydata() for line in axes.lines)
    np.testing.assert_array_equal(every, candidates)
    np.testing.assert_array_equal(chosen, candidates[[3, 5, 7]])
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("a", "b")
    # the ellipse of three points' scatter goes through them
    for point in chosen:
        assert np.linalg.norm(ring - point, axis=1).min() < 0.05


def test_a_selection_in_a_line_has_no_ellipse():
    axes = plots.selection(Figure().add_subplot(), np.eye(2).repeat(3, 0), [0, 3])
    assert len(axes.lines) == 2


def test_candidates_are_drawn_where_none_is_chosen_yet(rng):
    none = np.zeros(0, dtype=np.int64)
    axes = plots.selection(Figure().add_subplot(), rng.random((5, 2)), none)
    assert [len(line.get_xydata()) for line in axes.lines] == [5, 0]


def test_axes_of_three_dimensions_need_three_columns(rng):
    axes = Figure().add_subplot(projection="3d")
    with pytest.raises(ValueError, match=r"at least 3 columns .* \(5, 2\)"):
        plots.selection(axes, rng.random((5, 2)), [0, 1])


def test_errors_before_and_after_say_their_rms():
    before, after = np.array([[3.0, -4.0]]), np.array([[0.0, 1.0]])
    axes = plots.before_after(
        Figure().add_subplot(), {"raw": before, "fitted": after}, ("x", "y"), "mm"
    )
    texts = [text.get_text() for text in axes.get_legend().get_texts()]
    assert texts == ["raw: 3.54 mm rms", "fitted: 0.707 mm rms"]
    assert [t.get_text() for t in axes.get_xticklabels()] == ["x", "y"]


def test_residuals_hold_every_value(rng):
    values = rng.normal(size=(6, 2))
    axes = plots.residuals(Figure().add_subplot(), values, ("x", "y"))
    np.testing.assert_array_equal(axes.lines[2].get_ydata(), values[:, 1])


def test_the_postures_of_an_arm_end_where_its_tip_is():
    arm = SerialChain.from_dh([(0, 90, 100, 0), (300, 0, 0, 0)], sensor=Socket(2))
    rows = np.array([[0.0, 0.0, 1.0], [90.0, 0.0, 0.0]])
    figure = plots.postures(Figure(), arm, rows)
    assert [axes.get_title() for axes in figure.axes] == ["1, socket 1", "2, socket 0"]
    tips = [axes.lines[1].get_data_3d() for axes in figure.axes]
    np.testing.assert_allclose(np.array(tips)[..., 0], [[300, 0, 100], [0, 300, 100]],
                               atol=1e-9)  # fmt: skip
    whole = arm.skeleton(rows)
    assert whole.shape == (2, 4, 3)
    np.testing.assert_allclose(whole[:, 2], [[0, 0, 100]] * 2, atol=1e-9)
    assert list(arm.in_turn(rows[[0, 1, 0]])) == [0, 2, 1]
