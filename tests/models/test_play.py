"""Servos with play: as noise of the joints, and kept on one side."""

import warnings

import numpy as np
import pytest

import jaxcal
from jaxcal.models import Noise, Pose, Position, SerialChain, Socket

from .arms import differences

ARM = [(0.03, 90, 0.12, 0), (0.11, 0, 0, 90), (0.13, 0, 0, -90), (0, 90, 0, 0)]
ARM += [(0, 0, 0.1, 0)]
PLACES = np.array([[0.25, 0.05, 0.05], [0.2, -0.05, 0.2]])
PLAY = 0.6  # degrees, from stop to stop


def servo_arm(sensor):
    limits = [(-110, 110)] * 4 + [(-160, 160)]
    return SerialChain.from_dh(
        ARM, tool=(0.02, 0, 0.1), sensor=sensor, limits=limits, compliance=()
    )


def made(rng, model):
    """Parameters of a hobby arm: zeros off by 2 degrees, lengths by 0.45 %."""
    truth = model.nominal.copy()
    for i, (name, unit) in enumerate(
        zip(model.names[:25], model.units[:25], strict=True)
    ):
        size = 2.0 if name.startswith("theta") else 0.0
        truth[i] += rng.normal(0, 4.5e-3 * model.length if unit == "length" else size)
    return truth


def test_play_is_added_to_the_noise_of_each_reading():
    model = servo_arm(Position())
    rng = np.random.default_rng(0)
    joints = rng.uniform(-80, 80, (20, 5))
    measured = model.predict(joints) + rng.normal(0, 1e-3, (20, 3))
    noise = model.noise_with_play(PLAY)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        found = jaxcal.identify(joints, measured, model=model, noise=noise)
    std = np.asarray(model.default_noise().std)
    variance = [
        std**2 + (slopes**2).sum(axis=1) * PLAY**2 / 12.0
        for slopes in (
            differences(lambda u: model.predict(u[None])[0], row) for row in joints
        )
    ]
    wanted = np.sqrt(np.mean(variance, axis=0))
    np.testing.assert_allclose(found.noise_std, wanted, rtol=1e-4)
    with pytest.raises(ValueError, match="play must not be negative"):
        model.noise_with_play(-0.1)
    with pytest.raises(ValueError, match="command_std of an arm must be finite"):
        unknown = Noise(1e-4, command_std=[np.inf, 0.0, 0.0, 0.0, 0.0])
        jaxcal.identify(joints, measured, model=model, noise=unknown)


@pytest.mark.filterwarnings("ignore:.*far outside the measurements")
@pytest.mark.slow
def test_what_is_stated_of_an_arm_with_play_is_its_error():
    ratios, explained = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        model = servo_arm(Socket(2, PLACES))
        truth = made(rng, model)
        plan = model.postures(60, seed=seed)[:30]
        resting = rng.uniform(-PLAY / 2, PLAY / 2, (30, 5))
        off = model.predict(plan + np.pad(resting, ((0, 0), (0, 1))), truth)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            noise = model.noise_with_play(PLAY)
            found = jaxcal.identify(plan, off, model=model, noise=noise)
        rest = model.postures(60, seed=100 + seed)
        error = found.predict(rest) - model.predict(rest, truth)
        std = found.predict_std(rest)
        ratios.append(np.sqrt((error**2).mean() / (std**2).mean()))
        explained.append(found.verdict.explains)
    assert 0.6 < np.sqrt(np.mean(np.square(ratios))) < 1.4
    assert np.mean(explained) >= 0.8


@pytest.mark.slow
def test_play_on_one_side_is_an_error_of_the_zeros():
    rng = np.random.default_rng(1)
    model = servo_arm(Position())
    truth = made(rng, model)
    plan = rng.uniform(-100, 100, (40, 5))
    last = rng.uniform(-100, 100, (40, 5))

    def error(come_from):
        rests = plan - PLAY / 2 * np.sign(plan - come_from)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            measured = model.predict(rests, truth) + rng.normal(0, 1e-5, (40, 3))
            found = jaxcal.identify(plan, measured, model=model)
        return np.abs(found.residuals).mean()

    assert error(plan - 3.0) < 0.1 * error(last)


@pytest.mark.slow
def test_poses_of_an_arm_with_play_are_as_uncertain_as_stated():
    """Orientations are compared with those of the joints as told, not as they rest."""
    inside, ratios = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        model = servo_arm(Pose())
        truth, plan = made(rng, model), rng.uniform(-80, 80, (30, 5))
        resting = plan + rng.uniform(-PLAY / 2, PLAY / 2, plan.shape)
        at = model.predict(resting, truth)
        turned = model.rotation_vectors(plan, model.rotations(resting, at[:, 3:]))
        measured = np.hstack([at[:, :3], turned])
        measured += np.asarray(model.default_noise().std) * rng.normal(size=(30, 6))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            found = jaxcal.identify(
                plan, measured, model=model, noise=model.noise_with_play(PLAY)
            )
        low, high = found.confidence_intervals().T
        free = found.free[: len(truth)] > 0.0
        inside.append(((low <= truth) & (truth <= high))[free].mean())
        there = rng.uniform(-80, 80, (100, 5))
        off = found.predict(there) - model.predict(there, truth)
        std = found.predict_std(there)
        ratios.append(np.sqrt((std**2).mean(axis=0) / (off**2).mean(axis=0)).mean())
        assert found.verdict.good
    assert 0.92 < np.mean(inside) < 0.99
    assert 0.8 < np.median(ratios) < 2.0
