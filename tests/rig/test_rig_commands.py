"""The command line of a session."""

import importlib.util
import os
import pathlib
import re
import shlex
import signal
import subprocess
import sys

import numpy as np
import pytest
from harness import (
    HASTY,
    QUIET,
    SESSION,
    commissioned,
    fast_config,
    fast_text,
    no_figures,
    simulator,
)

import jaxcal
from rig.__main__ import main
from rig.commands import make_parser, resolved
from rig_workbench.simulator import Truth, parse_fault

TRUTH = np.column_stack([Truth().matrix, Truth().bias])


@pytest.mark.parametrize(
    ("method", "session_table"),
    [("exact", SESSION), pytest.param("policy", "", marks=pytest.mark.slow)],
    ids=["short windows", "as users do first"],
)
def test_calibrate_simulate_takes_a_device_from_the_bus_to_its_calibration(
    method, session_table, tmp_path, capsys
):
    """Quickly with short windows; slowly without a configuration, as users do first."""
    given = ["--speedup", "5", "--rate", "250", "--out", str(tmp_path / "runs")]
    if session_table:
        given += QUIET
        (tmp_path / "rig.toml").write_text(fast_text(session=session_table))
        given += ["--config", str(tmp_path / "rig.toml")]
    with no_figures():
        assert main(["calibrate", "--simulate", *given]) == 0
    said = capsys.readouterr().out
    assert "95 % confidence" in said and "after compensation" in said
    plan, _, moved = said.partition("armed:")
    assert moved and f"by {method}: log det" in plan
    assert "proven optimum" in plan and "gap 0." in plan and "note:" not in plan
    (folder,) = (tmp_path / "runs").iterdir()
    loaded = jaxcal.Calibration.load(folder / "calibration.json")
    assert loaded.num_measurements == 4
    np.testing.assert_allclose(loaded.matrix, TRUTH[:, :3], atol=0.005)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["leadshine_pr", "oriental_az", "applied_motion", "generic"]
)
def test_every_example_calibrates_on_the_simulator(name, tmp_path):
    """Each map, and HyperIMU, Sensor Logger and a line stream in client mode."""
    from rig.config.config import EXAMPLES

    code = main(["calibrate", "--simulate", "--speedup", "20", "--out", str(tmp_path),
                 "--config", str(EXAMPLES / f"{name}.toml")])  # fmt: skip
    assert code == 0
    (folder,) = tmp_path.iterdir()
    found = jaxcal.Calibration.load(folder / "calibration.json")
    np.testing.assert_allclose(found.matrix, TRUTH[:, :3], atol=0.005)
    np.testing.assert_allclose(found.bias, TRUTH[:, 3], atol=0.05)


def test_nothing_moves_without_confirmation(tmp_path, capsys):
    config = fast_config()
    with simulator(config) as sim:
        served = sim.start()
        text = fast_text({"port = 5020": f"port = {served.bus.port}"})
        (tmp_path / "rig.toml").write_text(text)
        commissioned(config, tmp_path)
        code = main(["calibrate", "--config", str(tmp_path / "rig.toml"),
                     "--out", str(tmp_path / "runs")])  # fmt: skip
        assert code == 2
        assert "pass --arm to confirm" in capsys.readouterr().out
        assert sim.server.requests == 0


@pytest.mark.parametrize(
    "arguments",
    [
        ["calibrate"],
        ["calibrate", "--config", "/does/not/exist.toml"],
        ["resume", "/does/not/exist"],
        ["check", "/does/not/exist.toml"],
        ["example", "unknown"],
        ["verify", "/does/not/exist", "--simulate"],
        ["calibrate", "--simulate", "--fault", "earthquake"],
        ["collect", "--simulate", "--count", "0"],
    ],
)
def test_bad_input_is_one_clear_line_and_exit_code_2(
    arguments, capsys, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("jaxcal-rig: ") and "Traceback" not in error


def test_stop_works_alone_and_says_when_it_cannot(tmp_path, capsys):
    config = fast_config()
    with simulator(config) as sim:
        served = sim.start()
        path = tmp_path / "rig.toml"
        path.write_text(
            fast_text({**HASTY, "port = 5020": f"port = {served.bus.port}"})
        )
        assert main(["stop", "--config", str(path)]) == 0
        assert capsys.readouterr().out.count("acknowledged, standing") == 3
        assert all(drive.stops for drive in sim.drives)
        sim.faults.add(parse_fault("dead_drive,axis=yaw"))
        assert main(["stop", "--config", str(path)]) == 3
        assert "NOT acknowledged" in capsys.readouterr().out
    assert main(["stop", "--config", str(path)]) == 3
    error = capsys.readouterr().err
    assert "NOTHING WAS STOPPED" in error and "cannot open" in error


def test_identify_prints_every_drive(capsys):
    assert main(["identify", "--simulate"]) == 0
    said = capsys.readouterr().out
    assert said.count("pulses_per_rev = 10000") == 3


def test_help_stop_check_and_ports_load_no_heavy_module(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(fast_text({"port = 5020": "port = 1"}))
    program = (
        "import contextlib, sys\n"
        "from rig.__main__ import main\n"
        "for arguments in {}:\n"
        "    with contextlib.suppress(SystemExit):\n"
        "        main(arguments)\n"
        "heavy = set('jax matplotlib scipy flax'.split()) & set(sys.modules)\n"
        "sys.exit(' '.join(heavy) or 0)\n"
    )
    reads = [["--help"], ["check", str(path)], ["ports"]]
    for commands in (reads, [["stop", "--config", str(path)]]):
        subprocess.run(
            [sys.executable, "-c", program.format(commands)], check=True,
            capture_output=True, cwd=tmp_path,
        )  # fmt: skip


@pytest.mark.slow
def test_simulate_serves_a_session_in_another_process(tmp_path):
    """Two programs, as with real hardware: the simulator and the session."""
    from harness import free_port

    bus, phone = free_port(), free_port()
    path = tmp_path / "rig.toml"
    path.write_text(fast_text({"port = 5020": f"port = {bus}",
                               "port = 2055": f"port = {phone}"}))  # fmt: skip
    commissioned(fast_config(), tmp_path)
    served = subprocess.Popen(
        [sys.executable, "-m", "rig", "simulate", "--config", str(path),
         "--rate", "250"], stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        for line in served.stdout:
            if "Ctrl-C" in line:
                break
        with no_figures():
            code = main(["calibrate", "--config", str(path), "--arm", "--zero",
                         "--out", str(tmp_path / "runs")])  # fmt: skip
        assert code == 0
    finally:
        os.kill(served.pid, signal.SIGINT)
        assert served.wait(60) == 0
        served.stdout.close()


def readme_commands():
    """The rig's commands of README, without their comments."""
    text = (pathlib.Path(__file__).parents[2] / "README.md").read_text()
    lines = [line.partition("#")[0].strip() for line in text.splitlines()]
    return [shlex.split(line)[1:] for line in lines if line.startswith("jaxcal-rig ")]


def test_the_commands_of_the_readme_parse():
    commands = readme_commands()
    named = {words[0] for words in commands}
    assert {"setup", "calibrate", "verify", "export", "stop"} <= named
    for words in commands:
        make_parser().parse_args(words)


@pytest.mark.parametrize(
    ("typed", "known", "note"),
    [
        ("setup home --here", "home --here", ""),
        ("home --here", "home --here", "home is now `jaxcal-rig setup home`"),
        ("check scan --units 3", "scan --units 3", ""),
        ("check rig.toml", "check rig.toml", ""),
        ("simulate", "simulate", ""),
        ("simulate --noise 1", "simulate --noise 1", ""),
        ("simulate calibrate --noise 1", "calibrate --simulate --noise 1", ""),
        ("simulate setup axes", "axes --simulate", ""),
        ("calibrate --simulate --noise=1", "calibrate --simulate --noise=1", ""),
        ("goto run --to 1,-2.5,3 --arm", "goto run --arm --to 1 -2.5 3", ""),
        ("goto --to=1,2,3 run", "goto run --to 1 2 3", ""),
        ("goto --to 1 2 3 run", "goto run --to 1 2 3", ""),
    ],
)  # fmt: skip
def test_words_are_taken_as_commands_and_old_ones_are_told(typed, known, note):
    words, notes = resolved(typed.split())
    assert words == known.split()
    assert bool(notes) == bool(note) and note in "".join(notes)


def test_the_first_screen_has_about_a_dozen_commands(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    listed = re.findall(r"^    ([a-z]+)\b", capsys.readouterr().out, re.M)
    assert 10 <= len(listed) <= 15
    assert not {"home", "axes", "zero", "jog", "ports", "scan", "imu"} & {*listed}
    for words in (["setup", "home"], ["check", "imu"]):
        with pytest.raises(SystemExit):
            main([*words, "--help"])
        assert f"usage: jaxcal-rig {' '.join(words)}" in capsys.readouterr().out


def test_options_of_the_simulator_are_listed_under_simulate_alone(capsys):
    for words, listed in (
        ("simulate --help", True),
        ("simulate calibrate --help", True),
        ("calibrate --help", False),
        ("calibrate --help all", False),
    ):
        with pytest.raises(SystemExit):
            main(words.split())
        assert ("--backlash" in capsys.readouterr().out) == listed


def test_what_a_simulated_session_lacks_is_named_at_once(monkeypatch, capsys):
    """It asked for the extra rig, and once that was there for workbench."""
    find = importlib.util.find_spec
    gone = {"pydantic", "serial", "tomlkit", "jinja2"}
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name in gone else find(name)
    )
    assert main(["calibrate", "--simulate"]) == 2
    told = capsys.readouterr().err
    assert "calibrate --simulate needs pydantic, serial, tomlkit, jinja2" in told
    assert "workbench" in told and told.count("\n") == 1


def test_check_takes_its_file_with_and_without_config(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["example", "leadshine_pr"]) == 0
    (tmp_path / "rig.toml").write_text(capsys.readouterr().out)
    for given in (["--config", "rig.toml"], ["rig.toml"], []):
        assert main(["check", *given]) == 0
        assert "valid" in capsys.readouterr().out
    assert main(["verify", "calibration.json"]) == 2  # the file is found, not this
    assert "calibration.json: not a calibration" in capsys.readouterr().err
    (tmp_path / "rig.toml").unlink()
    assert main(["check"]) == main(["calibrate"]) == 2
    assert "give --config FILE or --simulate" in capsys.readouterr().err


def test_a_missing_package_is_one_line_with_the_command_that_installs_it(
    monkeypatch, capsys, tmp_path
):
    path = tmp_path / "rig.toml"
    path.write_text(fast_text({"port = 5020": "port = 1"}))
    calibrate = ["calibrate", "--simulate", "--out", str(tmp_path)]
    for missing, words, extra in (
        ("serial", calibrate, "workbench"),
        ("pydantic", ["calibrate", "--out", str(tmp_path)], "rig"),
        ("jinja2", ["report", str(tmp_path)], "workbench"),
    ):
        real = importlib.util.find_spec
        with monkeypatch.context() as patch:
            patch.setattr(
                importlib.util,
                "find_spec",
                lambda name, *more, gone=missing, real=real: (
                    None if name == gone else real(name, *more)
                ),
            )
            assert main(words) == 2
            error = capsys.readouterr().err
            assert missing in error and error.count("\n") == 1
            assert "-m pip install" in error and error.endswith(f"[{extra}]'\n")
            assert main(["stop", "--config", str(path)]) == 3  # no drive answers
            capsys.readouterr()


WITHOUT = """
import sys
class Gone:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "rig_workbench":
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Gone())
from rig.__main__ import main
sys.exit(main(sys.argv[1:]))
"""


def test_without_the_workbench_its_commands_say_what_to_install(tmp_path):
    def typed(*words):
        return subprocess.run(
            [sys.executable, "-c", WITHOUT, *words],
            capture_output=True, text=True, cwd=tmp_path,
        )  # fmt: skip

    whole = " ".join(typed("--help").stdout.split())
    for name in ("calibrate", "setup", "watch", "report", "simulate"):
        assert f" {name} " in whole
    assert "setup needs rig_workbench, which is not installed: " in whole
    for words in (["report", "RUN"], ["calibrate", "--simulate"]):
        done = typed(*words)
        assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr
        assert "needs rig_workbench" in done.stderr
        assert done.stderr.endswith("[workbench]'\n")
