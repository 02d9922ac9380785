"""Walls hold at run time: what a command or a call loads, seen in a new process."""

import subprocess
import sys

import numpy as np
import pytest

LOADED = r"""
import sys
{body}
print("\n\x1e" + "\n".join(sorted(sys.modules)))
"""
_COMMAND = """
from jaxcal.commands import main
assert main({words!r}) == 0
"""
# What none of these may load: rooms of jaxcal, and packages of others.
FAR = (
    "jaxcal.arms",
    "jaxcal.adaptive",
    "jaxcal.designs",
    "jaxcal.reports",
    "jaxcal.learning",
    "rig",
    "rig_workbench",
)
FOREIGN = ("jax", "flax", "matplotlib", "jinja2", "pydantic", "pandas", "joblib")


def modules_of(body: str, folder) -> set[str]:
    """Names of the modules that a program has loaded at its end."""
    done = subprocess.run(
        [sys.executable, "-c", LOADED.format(body=body)],
        cwd=folder,
        capture_output=True,
        text=True,
        check=True,
    )
    return set(done.stdout.rpartition("\n\x1e")[2].split())


@pytest.fixture
def tables(tmp_path):
    rng = np.random.default_rng(0)
    commands = rng.uniform(-20.0, 20.0, (50, 3))
    readings = commands * [0.4, 0.7, 0.9] + [3.0, -5.0, 2.0]
    readings += rng.normal(0.0, 0.05, commands.shape)
    header = "u_pitch,u_yaw,u_roll"
    save = {"delimiter": ",", "comments": ""}
    np.savetxt(tmp_path / "candidates.csv", commands, header=header, **save)
    both = f"{header},{header.replace('u_', 'y_')}"
    np.savetxt(
        tmp_path / "measured.csv", np.c_[commands, readings], header=both, **save
    )
    targets = readings[:3]
    np.savetxt(
        tmp_path / "targets.csv", targets, header=header.replace("u_", "y_"), **save
    )
    return tmp_path


def required_apart(names: set[str], forbidden) -> list[str]:
    return sorted(
        name
        for name in names
        for room in forbidden
        if name == room or name.startswith(f"{room}.")
    )


@pytest.mark.parametrize(
    ("words", "most"),
    [
        (["select", "candidates.csv", "-k", "4"], 63),
        (["identify", "measured.csv", "--out", "calibration.json"], 58),
        (["command", "calibration.json", "targets.csv"], 58),
        (["check", "calibration.json", "measured.csv"], 58),
    ],
)
def test_a_command_of_a_table_loads_no_other_room(tables, words, most):
    if words[0] in ("command", "check"):
        modules_of(
            _COMMAND.format(words=["identify", "measured.csv", "--out", words[1]]),
            tables,
        )
    names = modules_of(_COMMAND.format(words=words), tables)
    assert required_apart(names, (*FAR, *FOREIGN)) == []
    assert sum(name.split(".")[0] == "jaxcal" for name in names) <= most


def test_select_identify_save_and_load_in_python_load_no_other_room(tables):
    body = """
import numpy as np, jaxcal
u = np.loadtxt("candidates.csv", delimiter=",", skiprows=1)
chosen = jaxcal.select(u, 6).indices
calibration = jaxcal.identify(u[chosen], u[chosen] @ np.diag([0.4, 0.7, 0.9]) + 1.0)
calibration.save("saved.json")
jaxcal.Calibration.load("saved.json").command_for([2.0, -4.0, 3.0])
"""
    assert required_apart(modules_of(body, tables), (*FAR, *FOREIGN)) == []


def test_import_costs_numpy_alone(tmp_path):
    names = modules_of("import jaxcal", tmp_path)
    assert required_apart(names, (*FAR, *FOREIGN, "scipy")) == []


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("jaxcal.models.serial", "jaxcal.arms"),
        ("jaxcal.models.serial.urdf", "jaxcal.arms.files.urdf"),
        ("jaxcal.models.sensors", "jaxcal.arms.sensors"),
        ("jaxcal.pages", "jaxcal.reports.page"),
        ("jaxcal.calibration.budget", "jaxcal.reports.budget"),
        ("rig.simulator", "rig_workbench.simulator"),
        ("rig.simulator.truth", "rig_workbench.simulator.truth"),
        ("rig.workbench.commission.steps", "rig.prove.steps"),
        ("rig.workbench.outputs.view", "rig_workbench.outputs.view"),
    ],
)
def test_an_old_path_is_the_new_module_and_warns(tmp_path, old, new):
    body = f"""
import warnings
with warnings.catch_warnings(record=True) as given:
    warnings.simplefilter("always")
    import {old} as old
import {new} as new
assert old is new and sys.modules["{old}"] is new
assert new.__name__ == "{new}", new.__name__
assert any("{old} is {new}" in str(warning.message) for warning in given), given
from {old} import *
"""
    modules_of(body, tmp_path)


def test_models_have_the_names_of_arms(tmp_path):
    before = modules_of("import jaxcal.models", tmp_path)
    after = modules_of("from jaxcal.models import SerialChain", tmp_path)
    assert "jaxcal.arms.chain" in after - before
    import jaxcal.arms
    import jaxcal.models

    for name in jaxcal.arms.__all__:
        assert getattr(jaxcal.models, name) is getattr(jaxcal.arms, name)
    with pytest.raises(AttributeError, match="no attribute 'NoModel'"):
        _ = jaxcal.models.NoModel


_RIG = """
from rig.__main__ import main
assert main({words!r}) == 0
"""


def test_a_session_and_a_stop_load_nothing_of_the_workbench(tmp_path):
    """Nor does calibrating load what draws a report: another process writes it."""
    from commission import device, quick_text
    from harness import prove_stops

    from rig.config import load_config
    from rig.journal import HOMED, IDENTIFIED, SIGN_CHECKED, DeviceRecord

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
