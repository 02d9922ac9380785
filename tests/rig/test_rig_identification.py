"""Intervals that keep their word, also under correlated noise; a zero that drifts."""

from typing import get_args

import numpy as np
import pytest
from harness import fast_config
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import special
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

import jaxcal
from rig.config import AXIS_NAMES
from rig.config.settings import Order
from rig.identification.conclusion import estimate_drift, uncertainty, without_drift
from rig.outputs.messages import drift_text, recalibrate
from rig.readings.geometry import (
    AttitudeFrame,
    Attitudes,
    Reading,
    euler_to_matrix,
)
from rig_workbench.refit import attitudes
from rig_workbench.simulator import Truth

CONFIG = fast_config()
TRUTH = np.column_stack([Truth().matrix, Truth().bias])
LETTERS = ("X", "Z", "Y")


def seen(frame, joints_deg):
    """(..., 3, 3) attitudes of the phone at (..., 3) pitch, yaw and roll."""
    places = [frame.letters.index(letter) for letter in frame.order]
    turned = euler_to_matrix(np.asarray(joints_deg)[..., places], frame.order)
    return frame.zero @ frame.mounting.T @ turned @ frame.mounting


def reading(frame):
    """Attitudes that are read in a frame, whatever the configuration says."""
    geometry = Attitudes(fast_config())
    geometry.frame = lambda zero: frame
    return geometry


def autoregression(rng, phi, n, size=3):
    """(n, size) of unit variance, stationary from the first reading on."""
    steps = rng.normal(size=(n, size)) * np.sqrt(1 - phi**2)
    steps[0] /= np.sqrt(1 - phi**2)
    return lfilter([1.0], [1.0, -phi], steps, axis=0)


# Intervals


def record(rng, u, zero, phi, sigma, samples, repeat):
    """What the journal keeps of a posture whose readings are correlated."""
    truth = TRUTH[:, :3] @ u + TRUTH[:, 3] - zero + rng.normal(0, repeat, 3)
    y = truth + sigma * autoregression(rng, phi, samples)
    return {
        "commanded_deg": u.tolist(),
        "measured_deg": y.mean(axis=0).tolist(),
        "std_deg": y.std(axis=0, ddof=1).tolist(),
        "samples": samples,
    }


@pytest.mark.parametrize("phi", [0.0, 0.8])
def test_intervals_hold_at_least_as_often_as_they_say(rng, phi):
    """Also where readings are correlated, and where a posture is not repeated exactly.

    Taken for independent, 25 readings would be 9 times as sure as they are.
    """
    sigma, repeat, held = np.array([0.02, 0.05, 0.1]), 0.02 * (phi > 0), 8
    inside, together = [], []
    for _ in range(300):
        u = rng.uniform(-18, 18, (50, 3))
        chosen = jaxcal.select(u, 4, method="greedy").indices
        u = np.vstack([u[chosen], u[:held]])
        off = sigma * autoregression(rng, phi, 100)
        records = [record(rng, x, off.mean(0), phi, sigma, 25, repeat) for x in u]
        fitted = jaxcal.identify(u[:4], [r["measured_deg"] for r in records[:4]])
        stated = uncertainty(CONFIG, records[:4], records[4:], 25 / 100)
        error = np.abs(np.column_stack([fitted.matrix, fitted.bias]) - TRUTH)
        one = special.stdtrit(held, 0.975) / special.stdtrit(held, 1 - 0.025 / 12)
        inside.append(error <= one * np.array(stated["ci95"]))
        together.append((error <= stated["ci95"]).all())
    assert 0.945 < np.mean(inside) < 0.98
    assert np.mean(together) > 0.94
    assert np.all(np.mean(inside, axis=(0, 2)) > 0.93)  # axis by axis


def test_without_held_out_postures_the_basis_says_so(rng):
    records = [
        record(rng, x, 0, 0.0, 0.05, 25, 0.0) for x in rng.uniform(-18, 18, (4, 3))
    ]
    stated = uncertainty(CONFIG, records, [], 0.25)
    assert stated["basis"] == "scatter of single readings only"
    np.testing.assert_allclose(stated["noise_std_deg"], 0.05 / 5, rtol=0.5)


def test_the_noise_of_each_axis_is_its_own(rng):
    sigma, found = np.array([0.01, 0.05, 0.2]), []
    for _ in range(60):
        u = rng.uniform(-18, 18, (12, 3))
        y = u @ TRUTH[:, :3].T + TRUTH[:, 3] + sigma * rng.normal(size=(12, 3))
        records = [
            {"commanded_deg": a, "measured_deg": b, "std_deg": [0.1] * 3, "samples": 25}
            for a, b in zip(u.tolist(), y.tolist(), strict=True)
        ]
        stated = uncertainty(CONFIG, records[:4], records[4:], 0.25)
        found.append(np.square(stated["noise_std_deg"]))
    np.testing.assert_allclose(np.sqrt(np.mean(found, axis=0)), sigma, rtol=0.15)


# Drift


def visit(minute, joints, frame, turn=(0.0, 0.0, 0.0), std=0.001):
    """A posture at a minute, seen by a phone whose world has turned by (3,) degrees."""
    world = Rotation.from_rotvec(turn, degrees=True).as_matrix()
    attitude = world @ seen(frame, joints)
    return {
        "time": 1e9 + 60.0 * minute,
        "attitude": attitude.tolist(),
        "measured_deg": frame.angles(attitude).tolist(),
        "std_deg": [std] * 3,
        "samples": 25,
    }


def a_frame(order="ZXY", heading=170.0):
    zero = euler_to_matrix([heading, 4.0, -7.0], "ZYX")
    return AttitudeFrame(
        zero, euler_to_matrix([10.0, 20.0, 30.0], "ZYX"), order, LETTERS
    )


@given(
    st.sampled_from(get_args(Order)),
    st.tuples(*[st.floats(-2, 2)] * 3).filter(lambda w: np.linalg.norm(w) > 0.1),
    st.tuples(*[st.floats(-20, 20)] * 3),
)
@settings(max_examples=40, deadline=None)
def test_a_linear_drift_of_the_phones_world_is_taken_out(order, rate, joints):
    """Of attitudes, so also where the joint angles do not shift by equal amounts."""
    frame, rate = a_frame(order), np.array(rate)
    visits = [visit(t, np.zeros(3), frame, rate * t) for t in (0.0, 0.6, 1.0)]
    drift = estimate_drift(visits, reading(frame), 0.2)
    assert drift["corrected"] and not drift["over"]
    moved = visit(0.8, joints, frame, 0.8 * rate)
    assert np.abs(np.subtract(moved["measured_deg"], joints)).max() > 0.02
    mended = without_drift(moved, drift["turn_deg_per_min"], visits[0], reading(frame))
    np.testing.assert_allclose(mended["measured_deg"], joints, atol=2e-3)


def test_a_drift_that_is_not_linear_stays_and_is_judged():
    frame = a_frame()
    turns = [(0, 0, 0), (0, 0, 0.5), (0, 0, 0.5)]  # the phone slipped once
    visits = [
        visit(t, np.zeros(3), frame, turn)
        for t, turn in zip((0, 0.5, 1), turns, strict=True)
    ]
    drift = estimate_drift(visits, reading(frame), 0.2)
    assert not drift["corrected"] and drift["over"]
    told = {"drift": drift}
    assert "session.drift_limit_deg (0.2 deg)" in " ".join(recalibrate(told, 0.5))
    assert "not linear" in drift_text(drift, AXIS_NAMES)
    assert not estimate_drift(visits, reading(frame), 0.6)["over"]


def test_a_drift_within_the_noise_or_under_a_tenth_of_the_limit_is_left_alone():
    frame = a_frame()
    for end, std in ((0.015, 0.001), (0.1, 0.3)):
        visits = [
            visit(t, np.zeros(3), frame, (0, 0, end * t), std) for t in (0, 0.5, 1)
        ]
        drift = estimate_drift(visits, reading(frame), 0.2)
        assert not drift["corrected"] and not drift["over"]


def test_two_visits_say_how_far_and_not_whether_in_a_line():
    frame = a_frame()
    visits = [visit(t, np.zeros(3), frame, (0, 0, 0.5 * t)) for t in (0, 1)]
    drift = estimate_drift(visits, reading(frame), 0.2)
    assert drift["size_deg"] == pytest.approx(0.5, rel=0.3)
    assert not drift["corrected"] and drift["over"]
    assert estimate_drift(visits[:1], reading(frame), 0.2) is None


# Raw data


def test_the_readings_of_a_record_come_back(rng):
    frame = a_frame()
    matrices = seen(frame, rng.normal([3, -5, 8], 0.1, (25, 3)))
    readings = [Reading(100.0 + 0.01 * i, m) for i, m in enumerate(matrices)]
    kept = reading(frame).raw(readings)
    np.testing.assert_allclose(attitudes(kept), matrices, atol=1e-7)
    np.testing.assert_allclose(np.diff(kept["stamps"]), 0.01, atol=2e-4)
