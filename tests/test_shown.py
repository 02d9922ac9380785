"""Results in a notebook and as pictures: what is drawn is what was chosen."""

from __future__ import annotations

import sys
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.figure import Figure

import jaxcal

RNG = np.random.default_rng(0)


def selected(inputs):
    return jaxcal.select(RNG.uniform(-20.0, 20.0, (30, inputs)), inputs + 2)


def fitted():
    u = RNG.uniform(-20.0, 20.0, (12, 3))
    return jaxcal.identify(u, 0.5 * u + RNG.normal(0.0, 0.05, u.shape))


def planned():
    design = jaxcal.Design(RNG.uniform(-20.0, 20.0, (30, 3)))
    return design.plan(accuracy=0.2, noise_std=0.1)


@pytest.mark.parametrize("inputs", [1, 2, 3, 4])
def test_the_chosen_are_drawn(inputs):
    chosen = selected(inputs)
    axes = chosen.plot()
    points = chosen.problem.candidates[chosen.indices]
    drawn = np.concatenate([np.ravel(line.get_data()[1]) for line in axes.lines])
    if inputs == 4:  # each input's range is the height
        low = chosen.problem.candidates.min(axis=0)
        points = (points - low) / np.ptp(chosen.problem.candidates, axis=0)
    column = points[:, 0] if inputs == 1 else points[:, 1]
    assert np.isin(column.round(9), drawn.round(9)).all()


def test_blocks_without_commands_are_bars():
    chosen = jaxcal.select(blocks=RNG.normal(size=(8, 1, 3)), k=4)
    heights = [bar.get_height() for bar in chosen.plot().patches]
    np.testing.assert_allclose(heights, chosen.left_without)


def test_residuals_and_plans_are_drawn_on_axes_that_are_given():
    first, second = Figure().subplots(1, 2)
    calibration = fitted()
    assert calibration.plot(first) is first
    drawn = np.concatenate([line.get_ydata() for line in first.lines])
    assert np.isin(calibration.residuals.ravel(), drawn).all()
    plan = planned()
    plan.plot(second)
    assert [row.k for row in plan.rows] == list(second.lines[0].get_xdata())


@pytest.mark.parametrize("make", [lambda: selected(3), fitted, planned])
def test_a_notebook_shows_text_and_picture(make):
    shown = make()._repr_html_()
    text, _, picture = shown.partition("</pre>")
    assert text.startswith("<pre>")
    assert ElementTree.fromstring(picture[picture.index("<svg") :]).tag.endswith("svg")


def test_without_matplotlib_a_notebook_shows_the_text(monkeypatch):
    for name in [*sys.modules]:
        if name.split(".")[0] == "matplotlib" or name.startswith("jaxcal.reports"):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    calibration = fitted()
    assert calibration._repr_html_().endswith("</pre>")
    assert calibration.verdict._repr_html_().startswith("<pre>")
    with pytest.raises(ImportError, match="plots"):
        calibration.plot()
