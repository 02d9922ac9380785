"""Metres and millimetres give the same picks; wrong units and names are refused."""

from __future__ import annotations

import numpy as np
import pytest

import jaxcal
from jaxcal import Noise
from jaxcal.models import Linear, Pose, Sensor, SerialChain

TABLE = np.array([[0, 90, 400, 0], [500, 0, 0, 0], [0, 90, 0, 0], [0, 0, 450, 0.0]])
JOINTS = np.random.default_rng(0).uniform(-120, 120, (60, 4))


def arm(unit: float, sensor: Sensor | None = None) -> SerialChain:
    table = TABLE * [unit, 1, unit, 1]
    return SerialChain.from_dh(table, tool=(30 * unit, 0, 80 * unit), sensor=sensor)


def test_without_noise_given_metres_select_what_millimetres_do() -> None:
    picks = [
        jaxcal.select(JOINTS, 6, "greedy", model=arm(unit)) for unit in (1.0, 1e-3)
    ]
    assert picks[0].value == pytest.approx(picks[1].value, rel=1e-9)
    np.testing.assert_array_equal(picks[0].indices, picks[1].indices)


def test_measurements_in_another_unit_are_refused() -> None:
    model = arm(1.0)
    measured = model.predict(JOINTS)
    with pytest.raises(ValueError, match="unit of the model's lengths"):
        jaxcal.identify(JOINTS, measured / 1000, model=model)
    with pytest.raises(ValueError, match="commands in degrees"):
        jaxcal.identify(np.radians(JOINTS), measured, model=model)


def test_a_pose_with_uncertain_commands_is_refused() -> None:
    model = arm(1.0, Pose())
    noise = Noise(std=0.1, command_std=0.01)
    with pytest.raises(ValueError, match="command_std must not be given"):
        jaxcal.identify(JOINTS, model.predict(JOINTS), model=model, noise=noise)


@pytest.mark.parametrize("model", ["affine", SerialChain, np.sin])
def test_what_is_no_model_is_refused(model: object) -> None:
    with pytest.raises(ValueError, match="model must be"):
        jaxcal.select(JOINTS, 6, model=model)  # type: ignore[arg-type]  # the point


def test_columns_of_a_data_frame_are_taken_by_name() -> None:
    pandas = pytest.importorskip("pandas")
    grid = np.random.default_rng(0).uniform(-1, 1, (30, 2))
    model = Linear("1 + x + y + I(x**3)", inputs=["x", "y"])
    frame = pandas.DataFrame(grid, columns=["x", "y"])[["y", "x"]]
    picked = jaxcal.select(frame, 5, "greedy", model=model)
    expected = jaxcal.select(grid, 5, "greedy", model=model)
    np.testing.assert_array_equal(picked.indices, expected.indices)
    found = jaxcal.identify(frame, model.predict(grid, [1, 2, 3, 4]), model=model)
    np.testing.assert_allclose(found.parameters, [1, 2, 3, 4])
    with pytest.raises(ValueError, match="'x' is missing"):
        jaxcal.select(frame.rename(columns={"x": "a"}), 5, "greedy", model=model)
