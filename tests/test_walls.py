"""Walls hold at run time: what a command or a call loads, seen in a new process."""

import numpy as np
import pytest
from loaded import modules_of, required_apart

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


@pytest.mark.parametrize(
    ("words", "most"),
    [
        (["select", "candidates.csv", "-k", "4"], 52),
        (["identify", "measured.csv", "--out", "calibration.json"], 57),
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
        ("jaxcal.plots.curves", "jaxcal.reports.plots"),
        ("jaxcal.commands.train_arguments", "jaxcal.commands.train_configuration"),
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


def test_a_table_and_an_arm_need_nothing_that_only_posix_has(tmp_path):
    body = """
import sys
for name in ("fcntl", "grp", "pwd", "resource", "termios"):
    sys.modules[name] = None  # as on Windows: ImportError
from jaxcal.commands import main
assert main(["example", "table", "--folder", "t"]) == 0
assert main("select t/candidates.csv -k 6 --json".split()) == 0
assert main("identify t/measured.csv --out c.json".split()) == 0
assert main("command c.json t/targets.csv --limits=-20,20".split()) == 0
assert main(["example", "arm", "--folder", "a"]) == 0
given = "a/measured.csv --model a/arm.urdf --noise 0.0001 --out a.json"
assert main(["identify", *given.split()]) == 0
"""
    names = modules_of(body, tmp_path)
    assert "jaxcal.jsonlines" not in names and required_apart(names, ("rig",)) == []
    for saved in ("c.json", "a.json"):
        assert (tmp_path / saved).stat().st_size > 100
