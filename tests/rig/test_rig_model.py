"""Devices with a ``[model]``: an arm by its URDF and a phone, and functions."""

import json
import shutil

import numpy as np
import pytest
from commission import device
from harness import (
    ARM,
    RATE_HZ,
    SPEEDUP,
    Simulator,
    arm_text,
    measured_text,
    session,
)

import jaxcal
from jaxcal.models import Gravity, SerialChain
from rig.__main__ import main
from rig.config import ConfigError, parse_config
from rig.journal.device import SIGN_CHECKED, STOP_PROVED, DeviceRecord
from rig.journal.run_folder import SCHEMA
from rig_workbench.model import model_of
from rig_workbench.simulator import Truth, parse_fault

STAGE = {"x": "translation", "y": "translation"}
BENT = """
import numpy as np
from jaxcal.models import FromFunction, Polynomial

def bent(u, theta):
    x, y = u
    a, b, c = theta
    return [a * x + b * x**2, c * y + b * x * y]

def function():
    start, scale = [1.0, 0.0, 1.0], [0.1, 0.01, 0.1]
    return FromFunction(bent, start, scale, ["a", "b", "c"], inputs=2, quiet=True)

cubic = Polynomial(3, 1, 1)
"""


def written(folder, bus, port, text):
    """rig.toml of a device that is reached there."""
    text = text.replace("port = 5020", f"port = {bus.rpartition(':')[2]}")
    text = text.replace("port = 2055", f"port = {port}")
    (folder / "rig.toml").write_text(text)


def newest(folder, mode):
    return max((folder / "runs").glob(f"{mode}-*"))


@pytest.mark.slow
def test_an_arm_is_commissioned_and_calibrated_by_a_phone_at_rest(at, capsys):
    """One axis turns the other way; the truth is another URDF than the file."""
    config = parse_config(arm_text())
    truth = Truth.of(
        config, noise_deg=0.005, reversed=(False, False, True, False, False)
    )
    with device(truth, config=config) as (sim, bus, port):
        written(at, bus, port, arm_text())
        assert main(["setup", "--yes"]) == 0
        now = parse_config((at / "rig.toml").read_text())
        assert [axis.direction for axis in now.axes] == [1, 1, -1, 1, 1]
        record = DeviceRecord.load(at / "device.json")
        assert np.shape(record.state(SIGN_CHECKED)["turns"]["deg"]) == (3, 5)
        assert record.state(STOP_PROVED)
        assert main(["calibrate", "--arm", "--zero"]) == 0
        run = newest(at, "calibrate")
        assert main(["verify", str(run), "--arm", "--zero"]) == 0
        assert main(["collect", "--arm", "--zero", "--count", "3"]) == 0
        assert main(["goto", str(run), "--to", "0", "0", "57", "--arm"]) == 2
        assert "Give it calibrated.urdf" in capsys.readouterr().err
        # A gearbox is exchanged: seen while the first axis that has it moves.
        sim.plant.regear(1, 3.0)
        before = sim.plant.joints()
        assert main(["collect", "--arm", "--zero"]) == 3
        assert "shoulder turned the phone by" in capsys.readouterr().out
        assert np.abs(sim.plant.joints() - before).max() < 10.0
    assert main(["export", str(run), "--to", "c"]) == 2
    assert main(["report", str(run)]) == 0 and main(["refit", str(run)]) == 0
    summary = json.loads((run / "summary.json").read_text())
    assert summary["prediction"]["max"] < 0.05 < summary["before"]["max"]
    # What the written file does at other commands, against what the arm does.
    real = SerialChain.from_urdf(ARM, sensor=Gravity(magnitude=180 / np.pi))
    commands = np.random.default_rng(1).uniform(-30, 30, (40, 5))
    wanted = real.predict(commands, truth.parameters)
    path, calibration = run / "calibrated.urdf", run / "calibration.json"
    mended = SerialChain.from_urdf(path, sensor=real.sensor, tip="l5_calibrated")
    for found in (mended, jaxcal.Calibration.load(calibration)):
        off = np.abs(found.predict(commands) - wanted).max()
        assert off < 0.05 < np.abs(real.predict(commands) - wanted).max()


def simulated(config, folder, fault=None, **more):
    said = []
    truth = Truth.of(config, noise_deg=0.005, **more)
    faults = [parse_fault(fault, config.axis_names)] if fault else []
    with Simulator(config, truth, faults, rate_hz=RATE_HZ, speedup=SPEEDUP) as sim:
        code = session(sim.start(), folder, sim, said)
    return code, "\n".join(said), truth


def stage_text(folder, factory="bent.py:function", k=6):
    (folder / "bent.py").write_text(BENT)
    text = measured_text(STAGE, "listen").replace('method = "exact"', f"k = {k}")
    return text.replace("[readings]", f'[model]\nfactory = "{factory}"\n\n[readings]')


@pytest.mark.slow
def test_a_function_of_ones_own_is_the_model(tmp_path):
    config = parse_config(stage_text(tmp_path), tmp_path)
    code, said, _ = simulated(config, tmp_path, parameters=(0.9, 0.004, 1.1))
    assert code == 0, said
    summary = json.loads((tmp_path / "summary.json").read_text())
    found = [summary["parameters"][name]["value"] for name in "abc"]
    np.testing.assert_allclose(found, [0.9, 0.004, 1.1], atol=2e-3)
    assert "held-out" in said and "I-efficiency" in said


@pytest.mark.slow
def test_an_arm_whose_coupling_slips_is_stopped(tmp_path):
    fault = "slipping_axis,axis=bend"
    code, said, _ = simulated(parse_config(arm_text()), tmp_path, fault)
    assert code == 3 and "differ from the model's prediction" in said


@pytest.mark.parametrize(
    "old, new, told",
    [
        ("k = 12\n", "", "session.k: missing; with a"),
        (
            "[model]\n",
            '[model]\nfactory = "a:b"\n',
            "model.urdf: give either urdf or fact",
        ),
        ("arm5.urdf", "none.urdf", "model.urdf: there is no file"),
        (
            "[model]\n",
            '[model]\nsensor = "position"\n',
            "model.sensor: must be gravity",
        ),
        ('name = "turn"', 'name = "swing"', "outwards are turn, shoulder, elbow"),
    ],
)
def test_wrong_models_of_arms_are_refused(old, new, told):
    with pytest.raises(ConfigError, match=told):
        model_of(parse_config(arm_text().replace(old, new, 1)))


@pytest.mark.parametrize(
    "factory, told",
    [
        ("bent.py:none", "has no attribute 'none'"),
        (
            "bent.py:cubic",
            "the model has 1 commands and 1 readings; the device has 2",
        ),
        ("no.such.module:it", "No module named"),
        ("bent.py", r"factory: must be FILE.py:NAME or MODULE:NAME"),
    ],
)
def test_wrong_functions_are_refused(tmp_path, factory, told):
    with pytest.raises(ConfigError, match=told):
        model_of(parse_config(stage_text(tmp_path, factory), tmp_path))


def test_check_and_refit_run_no_program_that_was_not_asked_for(tmp_path, capsys):
    """The folder may come from another person, with any program in it."""
    text = stage_text(tmp_path)
    (tmp_path / "bent.py").write_text(
        "import pathlib\npathlib.Path(__file__).with_name('ran').touch()\n" + BENT
    )
    path = tmp_path / "rig.toml"
    path.write_text(text)
    assert main(["check", str(path)]) == 0
    assert "NOT CHECKED: bent.py:function" in capsys.readouterr().out
    run = tmp_path / "calibrate-1"
    run.mkdir()
    shutil.copy(path, run)
    start = {
        "seq": 0, "event": "start", "schema": SCHEMA, "mode": "calibrate",
        "maps_from": str(tmp_path), "inputs": {}, "simulated": None,
    }  # fmt: skip
    (run / "journal.jsonl").write_text(json.dumps(start) + "\n")
    for given in ([], ["--factory", "other.py:it"]):
        assert main(["refit", str(run), *given]) == 2
        told = capsys.readouterr().err
        assert "a program that refit would run: give --factory bent.py:function" in told
    assert not (tmp_path / "ran").exists()
    assert main(["check", str(path), "--run", "bent.py:function"]) == 0
    assert (tmp_path / "ran").exists()
