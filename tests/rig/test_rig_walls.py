"""What a session and a stop load."""

from commission import device, quick_text
from harness import prove_stops
from loaded import modules_of, required_apart

from rig.config import load_config
from rig.journal.device import HOMED, IDENTIFIED, SIGN_CHECKED, DeviceRecord

_RIG = """
from rig.__main__ import main
assert main({words!r}) == 0
"""


def test_a_session_and_a_stop_load_nothing_of_the_workbench(tmp_path):
    """Nor does calibrating load what draws a report: another process writes it."""
    path = tmp_path / "rig.toml"
    with device() as (_, bus, port):
        path.write_text(quick_text(bus, port))
        config = load_config(path)
        record = DeviceRecord.load(config.device_path)
        for state in (IDENTIFIED, HOMED, SIGN_CHECKED):
            record.reach(state, config)
        prove_stops(record, config)
        words = ["calibrate", "--config", str(path), "--arm", "--zero"]
        session = modules_of(_RIG.format(words=words), tmp_path)
        stop = modules_of(_RIG.format(words=["stop", "--config", str(path)]), tmp_path)
    assert list(tmp_path.glob("**/report.html"))
    far = ("rig_workbench", "jaxcal.arms", "jaxcal.adaptive", "jaxcal.reports")
    heavy = ("jax", "flax", "matplotlib", "jinja2", "pymodbus", "nicegui", "pandas")
    assert required_apart(session, (*far, *heavy)) == []
    assert "rig.procedures.calibrate" in session
    assert required_apart(stop, (*far, *heavy, "jaxcal.models", "scipy")) == []
