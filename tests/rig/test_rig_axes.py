"""Devices of other axes than pitch, yaw and roll: their files, sessions and exports."""

import json

import numpy as np
import pytest
from commission import device
from harness import (
    RATE_HZ,
    SPEEDUP,
    Simulator,
    axes_text,
    measured_text,
    session,
)

import jaxcal
from rig.__main__ import main
from rig.config import ConfigError, parse_config
from rig.journal.device import SIGN_CHECKED, STOP_PROVED, DeviceRecord
from rig.journal.run_folder import read_journal
from rig_workbench.outputs.export import load_inverse
from rig_workbench.simulator import Truth

TABLE = {"table": "Z"}
GIMBAL = {"pan": "Z", "tilt": "X"}
STAGE = {"x": "translation", "y": "translation", "tilt": "rotation", "turn": "rotation"}


def simulated(config, **more):
    count, outputs = len(config.axes), len(config.output_names)
    truth = Truth.of_axes(count, outputs, noise_deg=0.005, **more)
    return Simulator(config, truth, rate_hz=RATE_HZ, speedup=SPEEDUP)


def calibrated(config, folder):
    """Calibration, summary and export of a session that ends well, and what it said."""
    said = []
    with simulated(config) as sim:
        assert session(sim.start(), folder, sim, said) == 0, said
        truth = sim.truth
    calibration = jaxcal.Calibration.load(folder / "calibration.json")
    np.testing.assert_allclose(calibration.matrix, truth.matrix, atol=0.01)
    return calibration, json.loads((folder / "summary.json").read_text()), said


def test_a_turntable_is_calibrated_with_two_postures(tmp_path):
    config = parse_config(axes_text(TABLE))
    calibration, summary, said = calibrated(config, tmp_path)
    assert summary["axes"] == summary["outputs"] == ["table"]
    assert len(summary["postures"]) == config.k == 2
    assert any(line.startswith("  table [") for line in said)
    head = (tmp_path / "pairs.csv").read_text().splitlines()[0]
    assert head == (
        "name,role,pulses_table,u_deg_table,y_deg_table,std_deg_table,samples"
    )
    exported = load_inverse(tmp_path, read_journal(tmp_path / "journal.jsonl"))
    assert exported["axes"] == ["table"] and len(exported["follow"]) == 2
    at = np.array(exported["matrix"]) @ [3.0] + exported["offset_deg"]
    np.testing.assert_allclose(at, calibration.command_for([3.0]), atol=1e-9)


@pytest.mark.slow
def test_a_gimbal_is_calibrated_with_three(tmp_path):
    _, summary, said = calibrated(parse_config(axes_text(GIMBAL)), tmp_path)
    assert len(summary["postures"]) == 3 and "all six together" in " ".join(said)


@pytest.mark.slow
@pytest.mark.parametrize("transport", ["tcp", "listen", "udp"])
def test_four_axes_are_calibrated_by_lines_of_numbers(tmp_path, transport):
    config = parse_config(measured_text(STAGE, transport))
    calibration, summary, said = calibrated(config, tmp_path)
    assert summary["unit"] == "mm" and len(summary["postures"]) == 5
    assert summary["after"]["max"] < 0.02 < summary["before"]["max"]
    assert "the phone" not in "\n".join(said)
    (tmp_path / "rig.toml").write_text(config.text)
    assert main(["refit", str(tmp_path), "--order", "ZXY"]) == 2
    assert main(["refit", str(tmp_path)]) in (0, 1)
    again = max(tmp_path.parent.glob("refit-*")) / "calibration.json"
    other = jaxcal.Calibration.load(again)
    np.testing.assert_allclose(other.matrix, calibration.matrix, rtol=1e-6)
    np.testing.assert_allclose(other.bias, calibration.bias, atol=1e-6)
    exported = load_inverse(tmp_path, read_journal(tmp_path / "journal.jsonl"))
    assert exported["outputs"] == exported["axes"] == list(STAGE)
    assert exported["axis_unit"] == "mm, deg" and len(exported["follow"]) == 16
    command = np.array(exported["matrix"]) @ np.ones(4) + exported["offset_deg"]
    np.testing.assert_allclose(command, calibration.command_for(np.ones(4)), atol=1e-9)


@pytest.mark.slow
def test_four_axes_are_commissioned_by_numbers(at, capsys):
    """One of them moves the other way, and its file is corrected."""
    truth = Truth.of_axes(4, noise_deg=0.002, reversed=(False, True, False, False))
    with device(truth, config=parse_config(measured_text(STAGE, "listen"))) as (
        _,
        bus,
        port,
    ):
        text = measured_text(STAGE, "listen").replace(
            "port = 5020", f"port = {bus.rpartition(':')[2]}"
        )
        text = text.replace("scale = 1.0", f"scale = 1.0\nport = {port}")
        (at / "rig.toml").write_text(text)
        for command in (["scan", "--units", "4"], ["home", "--here", "--yes"]):
            assert main(command) == 0
        assert main(["axes", "--yes"]) == 0
        assert main(["jog", "x", "-2", "--yes"]) == 0
        assert main(["calibrate", "--arm", "--zero"]) == 0
    now = parse_config((at / "rig.toml").read_text())
    assert [axis.direction for axis in now.axes] == [1, -1, 1, 1]
    record = DeviceRecord.load(at / "device.json")
    assert np.shape(record.state(SIGN_CHECKED)["turns"]["deg"]) == (4, 4)


@pytest.mark.slow
def test_a_gimbal_is_commissioned_and_corrected(at, capsys):
    """One axis turns the other way, and the other joint carries it."""
    text = axes_text(GIMBAL, "XZY")
    config = parse_config(text)
    truth = Truth.of_axes(2, noise_deg=0.005, reversed=(True, False))
    with device(truth, config=parse_config(axes_text(GIMBAL, "ZXY"))) as (_, bus, port):
        number = bus.rpartition(":")[2]
        text = text.replace("port = 5020", f"port = {number}")
        (at / "rig.toml").write_text(text.replace("port = 2055", f"port = {port}"))
        for command in (["scan", "--units", "2"], ["home", "--here", "--yes"]):
            assert main(command) == 0
        assert main(["axes", "--yes"]) == 0
    now = parse_config((at / "rig.toml").read_text())
    assert now.axes[0].direction == -config.axes[0].direction
    assert now.mechanism.order == "ZXY"
    record = DeviceRecord.load(at / "device.json")
    assert np.shape(record.state(SIGN_CHECKED)["turns"]["deg"]) == (3, 2)
    assert record.state(STOP_PROVED)


@pytest.mark.parametrize(
    "old, new, told",
    [
        ('name = "tilt"', 'name = "pan"', "axes: name must differ between them"),
        ('name = "tilt"', 'name = "Tilt"', "axes.Tilt.name: must be a name of small"),
        ('rotates = "X"\n', "", "axes.tilt.rotates: missing; a phone measures"),
        ('name = "tilt"', 'name = "tilt"\nkind = "translation"', "min_deg: a transl"),
        ("[settle]", "[session]\nk = 2\n[settle]", "session.k: must be at least 3"),
    ],
)
def test_wrong_axes_are_refused(old, new, told):
    with pytest.raises(ConfigError, match=told):
        parse_config(axes_text(GIMBAL, session="").replace(old, new, 1))
