"""Metres and millimetres give the same picks; wrong units and names are refused."""

from __future__ import annotations

import numpy as np
import pytest

import jaxcal
from jaxcal.models import Linear, Sensor, SerialChain

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
    with pytest.raises(ValueError, match="model's unit of length"):
        jaxcal.identify(JOINTS, measured / 1000, model=model)
    with pytest.raises(ValueError, match="commands in degrees"):
        jaxcal.identify(np.radians(JOINTS), measured, model=model)


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


def test_a_calibration_takes_data_frames_by_name() -> None:
    pandas = pytest.importorskip("pandas")
    rng = np.random.default_rng(1)
    u = pandas.DataFrame(rng.uniform(-9, 9, (9, 3)), columns=["pitch", "yaw", "roll"])
    slopes, bias = {"pitch": 0.4, "yaw": 0.7, "roll": 0.9}, {"pitch": 3.0, "yaw": -5.0}
    y = pandas.DataFrame({f"y_{a}": slopes[a] * u[a] + bias[a] for a in bias})
    found = jaxcal.identify(u, y)
    assert found.input_names == ("pitch", "yaw", "roll")
    assert found.output_names == ("y_pitch", "y_yaw")
    turned = u[["roll", "pitch", "yaw"]].add_prefix("u_").assign(note=1.0)
    with pytest.warns(UserWarning, match="'note' is ignored"):
        np.testing.assert_allclose(found.predict(turned), y.to_numpy(), atol=1e-12)
    found = jaxcal.identify(u[["pitch", "yaw"]], y, noise_std=0.1)
    back = found.command_for(y[["y_yaw", "y_pitch"]])
    np.testing.assert_allclose(back, u[["pitch", "yaw"]], atol=1e-12)
    assert found.check(u[["yaw", "pitch"]], y[["y_yaw", "y_pitch"]]).p_value > 0.99
    off = y.rename(columns={"y_yaw": "y_jaw"})
    with pytest.raises(ValueError, match=r"desired needs .* 'y_yaw' is missing"):
        found.command_for(off)


def test_what_was_measured_is_taken_by_the_candidates_names() -> None:
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame(
        np.random.default_rng(2).uniform(-9, 9, (20, 2)) * [1.0, 50.0],
        columns=["pitch", "yaw"],
    )
    measured = frame.iloc[:2] * 3.0
    picks = [
        jaxcal.select(frame, 2, "greedy", measured=given).indices.tolist()
        for given in (measured, measured[["yaw", "pitch"]], measured.to_numpy())
    ]
    assert picks[0] == picks[1] == picks[2]
    with pytest.raises(ValueError, match=r"measured needs .* 'yaw' is missing"):
        jaxcal.select(frame, 2, measured=measured.rename(columns={"yaw": "roll"}))
