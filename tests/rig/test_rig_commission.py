"""Commissioning over the real protocol, against a simulated device that is miswired."""

import contextlib
import json
import os
import pathlib
import pty
import re
import select
import shutil
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest
from harness import fast_config, no_figures

from rig.__main__ import main
from rig.commission import bench, home, steps
from rig.commission.jog import FIRST_S, REPEAT_S, Held, Released
from rig.commission.operator import Operator
from rig.commission.scan import parse_bus
from rig.commission.toml import edit, set_values
from rig.config import AXIS_NAMES, ConfigError, load_config
from rig.config.files import EXAMPLES
from rig.config.registers import encode
from rig.device.record import (
    HOMED,
    IDENTIFIED,
    SIGN_CHECKED,
    ZEROED,
    DeviceRecord,
)
from rig.faults import Refused
from rig.simulator import Simulator, Truth

RIG = pathlib.Path(__file__).parents[2]
QUICK = (  # of the new rig.toml: short windows, quick axes
    "settle.window_s=0.04", "settle.min_samples=5", "settle.samples=5",
    "settle.slope_deg_s=0.5", "motion.poll_s=0.005", "imu.stale_s=1.0",
    "session.method=exact", "session.verify_postures=1",
    *(f"axes.{name}.{key}" for name in AXIS_NAMES
      for key in ("speed_deg_s=400", "accel_deg_s2=8000", "reduction=10")),
)  # fmt: skip


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


@pytest.fixture
def at(tmp_path, monkeypatch):
    """An empty folder to work in, and axes that need not be watched by a person."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(steps, "WATCH_S", 0.3)
    monkeypatch.setattr(bench, "SLOW_DEG_S", 400.0)
    return tmp_path


@contextlib.contextmanager
def device(truth=None, transport="tcp", config=None, **options):
    """A simulated device, the bus as the command line names it, and a phone's port."""
    config = config or fast_config()
    with Simulator(
        config, truth or Truth(noise_deg=0.005), transport=transport, rate_hz=250.0,
        **options,
    ) as sim:  # fmt: skip
        bus = sim.start().bus
        port = free_port()
        sim.start_phone(port)
        where = f"{transport}:{bus.host}:{bus.port}"
        if transport == "rtu":
            where = f"rtu:{bus.device},115200,N,8,1"
        yield sim, where, port


def set_up(bus: str, port: int, *more: str, values=QUICK) -> int:
    given = [word for value in values for word in ("--set", value)]
    common = ["--yes", "--bus", bus, "--imu", f"hyperimu:{port}", "--units", "4"]
    return main(["setup", *common, *given, *more])


# From cables to a calibration


@pytest.mark.parametrize("transport", ["tcp", "rtu"])
def test_setup_finds_exchanged_reversed_and_wrongly_geared_axes(
    at, transport, capsys
):
    truth = Truth(
        noise_deg=0.005, swapped=(1, 0, 2), reversed=(True, False, True),
        drive_pulses_per_rev=(4000, 10000, 20000),
    )  # fmt: skip
    with device(truth, transport) as (_, bus, port):
        assert set_up(bus, port) == 0
        config = load_config("rig.toml")
        # Joint i is turned by drive swapped[i], whose unit is that index plus one.
        assert [axis.unit for axis in config.axes] == [2, 1, 3]
        assert [axis.pulses_per_rev for axis in config.axes] == [10000, 4000, 20000]
        assert [axis.reduction for axis in config.axes] == [10, 10, 10]
        # Yaw's drive has direction -1 in the simulator; those of 1 and 3 are reversed.
        assert [axis.direction for axis in config.axes] == [-1, -1, -1]
        record = DeviceRecord.load(config.device_path)
        for state in (IDENTIFIED, HOMED, SIGN_CHECKED, ZEROED):
            assert record.state(state) is not None, state
        assert record.sender == "127.0.0.1"
        assert record.missing(config) is None
        with no_figures():
            assert main(["calibrate", "--config", "rig.toml", "--arm", "--zero"]) == 0
    summary = json.loads(next(at.glob("runs/calibrate-*/summary.json")).read_text())
    np.testing.assert_allclose(summary["A"], truth.matrix, atol=0.005)
    said = capsys.readouterr().out
    assert "next: jaxcal-rig calibrate --config rig.toml" in said
    # the corrected file is the written one with other values: comments stay
    text = pathlib.Path("rig.toml").read_text()
    assert "# omega: pulses for one motor turn, as set in the drive" in text
    assert len(list(at.glob("rig.toml.*.bak"))) == 1


def test_gearing_that_no_register_tells_is_taken_from_the_phone(at):
    text = (EXAMPLES / "generic.toml").read_text()
    config = load_config_text(text)
    truth = Truth(noise_deg=0.005, drive_pulses_per_rev=(1000,) * 3)
    turned = []
    with device(truth, config=config, speedup=20.0) as (sim, bus, port):
        start = sim.plant.attitude()
        measure = sim.plant.attitude

        def watched():
            matrix = measure()
            angle = np.arccos(np.clip((np.trace(start.T @ matrix) - 1) / 2, -1, 1))
            turned.append(np.degrees(angle))
            return matrix

        sim.plant.attitude = watched
        values = [value for value in QUICK if "reduction" not in value]
        values += [f"axes.{a.name}.reduction={a.reduction}" for a in config.axes]
        assert set_up(bus, port, values=values) == 0
    written = load_config("rig.toml")
    for axis, was, gain in zip(written.axes, config.axes, (0.43, 0.71, 0.87)):
        # ten times as far as commanded: now about as commanded
        factor = was.pulses_per_rev / 1000 * gain
        assert axis.reduction == pytest.approx(was.reduction / factor, rel=0.03)
    assert max(turned) < 9.0  # and on the way to it nothing went far


def load_config_text(text):
    from rig.config import parse_config

    return parse_config(re.sub(r"(?m)^(speed_deg_s =) .*", r"\1 100", text))


def test_setup_goes_on_where_it_was_left(at, capsys):
    with device() as (sim, bus, port):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(
                steps, "take_zero", lambda place: (_ for _ in ()).throw(OSError("gone"))
            )
            assert set_up(bus, port) == 2
        capsys.readouterr()
        moved = len(sim.executions()[0])
        assert main(["setup", "--yes"]) == 0
        said = capsys.readouterr().out
        assert "9 zero" in said and "8 axes" not in said and "6 jog" not in said
        assert len(sim.executions()[0]) == moved


def test_setup_asks_with_a_default_and_moves_nothing_before_a_yes(at):
    asked, told = [], []

    def read(question):
        asked.append(question)
        return "no" if "go on?" in question and "home: " in told[-1] else ""

    with device() as (sim, bus, port):
        given = steps_given(bus, port)
        operator = Operator(say=told.append, read=read)
        config = steps_setup().write_config(at / "rig.toml", given, operator)
        place = steps.Place(
            config, DeviceRecord.load(config.device_path), operator, at / "rig.toml"
        )
        with pytest.raises(Refused):
            operator.say = told.append
            home.home(None, True, operator.confirm)  # type: ignore[arg-type]
        assert steps.go_home(prepared(place), True) == 2
        assert sim.executions() == [[], [], []]
    assert all("[" in question and "]: " in question for question in asked)


def steps_setup():
    from rig.commission import setup

    return setup


def steps_given(bus, port):
    return steps_setup().Given(bus=bus, imu=f"hyperimu:{port}", units=4)


def prepared(place):
    steps.identify(place)
    return place
