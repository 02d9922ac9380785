"""The play that a calibration keeps is put back by `goto`, by the way it arrives."""

import numpy as np
import pytest
from harness import (
    RATE_HZ,
    SPEEDUP,
    Simulator,
    commissioned,
    fast_config,
    make_run,
    notes_of,
)

import jaxcal
from rig.core.faults import Refused
from rig.simulator import Truth
from rig.workbench.procedures.checking import keep, load_calibration
from rig.workbench.procedures.goto import CHARACTERISED, Play, goto
from rig.workbench.run import run_safely

WIDTH = 0.4


def found(width=WIDTH):
    """As `characterise` keeps an axis."""
    interval = {"value": width, "low": width - 0.01, "high": width + 0.01}
    none = {"value": 0.0, "low": 0.0, "high": 0.02}
    return {
        "backlash_deg": interval, "dead_zone_deg": none, "dead_zone_at_deg": 0.0,
        "breakaway_deg": [none, none],
    }  # fmt: skip


def saved(folder, bias, **notes):
    """A calibration of the simulated device, with another bias."""
    matrix, config = np.array(Truth().matrix), fast_config()
    u = np.vstack([np.zeros(3), 10.0 * np.eye(3), -10.0 * np.eye(3)])
    notes |= notes_of(config)
    calibration = jaxcal.identify(u, u @ matrix.T + bias, noise_std=0.01, notes=notes)
    path = folder / "calibration.json"
    calibration.save(path)
    return path


def joint_behind(path, width):
    """Where a joint with play stands after its drive went along a path."""
    joint = path[0]
    for at in path[1:]:
        joint = min(max(joint, at - width / 2), at + width / 2)
    return joint


@pytest.mark.parametrize("below", [False, True])
@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_the_shift_brings_a_joint_to_where_the_calibration_means(below, direction):
    """For a calibration from below, 0 of the joint is a drive at half the play."""
    kept = {CHARACTERISED: {"yaw": found()}, "approach_overshoot_deg": float(below)}
    play = Play.of(kept)
    meant = joint_behind([-9.0, 2.0], WIDTH) if below else 2.0
    command = 2.0 + play.shift(np.array([1.0, direction, 1.0]))
    assert joint_behind([-9.0 * direction, command[1]], WIDTH) == pytest.approx(meant)
    assert command[0] == command[2] == 2.0
    assert abs(command[1] - 2.0) <= play.most[1] + 1e-9


@pytest.mark.parametrize(
    ("desired", "below"),
    [([5.0, -3.0, 4.0], False), ([-2.0, 3.0, -4.0], False), ([0.1, 0.1, -0.1], False),
     ([-2.0, 3.0, 4.0], True),
     (np.array(Truth().matrix) @ [-19.6, 0, 0] + Truth().bias, False)],
    ids=["up", "down", "near", "calibrated from below", "no room below"],
)  # fmt: skip
def test_goto_reaches_through_play(desired, below, tmp_path):
    matrix, bias = np.array(Truth().matrix), np.array(Truth().bias)
    overshoot = 1.0 if below else 0.0
    bias = bias - matrix @ np.full(3, WIDTH / 2) if below else bias
    path = saved(tmp_path, bias, approach_overshoot_deg=overshoot)
    for name in ("pitch", "yaw", "roll"):
        keep(path, name, found())
    config, said = fast_config(), []
    kept = load_calibration(path, config)
    np.testing.assert_allclose(kept.play.widths, WIDTH)
    truth = Truth(noise_deg=0.0, backlash_deg=WIDTH)
    with Simulator(config, truth, rate_hz=RATE_HZ, speedup=SPEEDUP) as sim:
        folder = tmp_path / "run"
        folder.mkdir()
        run = make_run(sim.start(), folder, "goto", said.append,
                  record=commissioned(config, folder))  # fmt: skip
        run.listeners.append(sim.answer)
        wanted = np.array(desired)
        code = run_safely(run, lambda r: goto(r, kept.calibration, wanted, kept.play))
        assert code == 0, said
        np.testing.assert_allclose(sim.plant.joints(), wanted, atol=0.01)
    assert sum("deg of play" in line for line in said) == 3


def test_a_target_within_the_play_of_a_limit_is_refused(tmp_path):
    path = saved(tmp_path, np.array(Truth().bias))
    keep(path, "pitch", found())
    config, said = fast_config(), []
    kept = load_calibration(path, config)
    edge = kept.calibration.predict([[19.9, 0.0, 0.0]])[0]
    run = make_run(config, tmp_path, "goto", said.append,
              record=commissioned(config, tmp_path))  # fmt: skip
    with pytest.raises(Refused, match=r"less its play, 0\.200 deg"):
        goto(run, kept.calibration, edge, kept.play)
    run.journal.close()


def test_keeping_an_axis_leaves_the_rest_of_the_file(tmp_path):
    path = saved(tmp_path, np.zeros(3), run="then")
    before = jaxcal.Calibration.load(path)
    keep(path, "roll", found())
    keep(path, "pitch", found(0.1))
    keep(path, "roll", found(0.2))
    after = jaxcal.Calibration.load(path)
    np.testing.assert_array_equal(after.parameters, before.parameters)
    notes = after.provenance["notes"]
    assert notes["run"] == "then"
    assert notes[CHARACTERISED] == {"roll": found(0.2), "pitch": found(0.1)}
