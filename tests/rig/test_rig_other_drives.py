"""The drives of examples/drives: the same code proves the same of them."""

import contextlib
import json
import pathlib
import sys
import time
import types

import numpy as np
import pytest
from gcode_controller import Controller
from harness import changed, line_here, session
from other_drives import MATRIX, place_of, sensed, stage_text

import jaxcal
from rig.__main__ import main
from rig.command_run import Run
from rig.config import parse_config
from rig.core.motion import took
from rig.drives import make_drives
from rig.drives.line import BusError, Refusal
from rig.faults import LimitError, Refused
from rig.journal.device import SIGN_CHECKED, STOP_PROVED
from rig.prove import steps

KINDS = ("grbl", "marlin", "cia402")
DRIVES = pathlib.Path(__file__).parents[2] / "examples" / "drives"
CAN = 'transport = "can"\ndevice = "virtual:{}"'
SERIAL = 'transport = "serial"\ndevice = "{}"'


def device(kind, channel="rig"):
    """A simulated controller of a kind, how its bus is reached, counts a millimetre."""
    if kind == "cia402":
        pytest.importorskip("canopen", reason="canopen is not installed")
        from can_nodes import Nodes

        return Nodes(channel), lambda made: CAN.format(channel), 1000
    counts = 1000 if kind == "grbl" else 80
    return Controller(kind), lambda made: SERIAL.format(made.device), counts


def family(kind):
    """The map of a kind of drive."""
    return str(DRIVES / f"{kind}.toml")


def until(holds, seconds=3.0):
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_each_line_of_gcode_has_an_answer_of_its_own():
    """As OctoPrint's virtual printer has it: one line for M114, and each ok is late."""
    made, bus, counts = device("marlin")
    made.faults |= {"one_line", "late"}
    with made:
        config = parse_config(stage_text(bus(made), family("marlin"), 1, counts))
        line, (x, _) = make_drives(config.bus, config.axes)
        with line:
            x.look(0)
            x.go(counts // 10)
            assert x.look(0).moving
            until(lambda: x.look(0).done)
            assert x.position() == counts // 10


@pytest.mark.parametrize("kind", KINDS)
def test_a_drive_moves_stops_and_says_what_it_is(kind):
    made, bus, counts = device(kind, "quick")
    with made:
        config = parse_config(stage_text(bus(made), family(kind), 1, counts))
        line, drives = make_drives(config.bus, config.axes)
        with line:
            x, y = drives
            assert x.ids() != y.ids() and not x.alarm()
            for drive in drives:
                if not drive.status().enabled:
                    drive.bring(drive.arm, lambda status: status.enabled)
                assert drive.sound().done
            x.go(2 * counts)
            assert x.status().moving
            until(lambda: x.status().done)
            assert abs(made.places()[0] - 2.0) < 1e-3
            assert x.status().position == 2 * counts
            x.go(-19 * counts)
            until(lambda: x.status().position < counts)
            x.stop()
            until(lambda: x.status().done)
            stood = x.steady().position
            x.hold(stood)
            time.sleep(0.1)
            assert -18 * counts < x.steady().position == stood
            y.go(-counts)  # from there: a stop is no lock, and leaves nothing queued
            until(lambda: y.status().position == -counts)
            assert x.steady().position == stood
            with pytest.raises(LimitError):
                x.go(21 * counts)


def test_a_refused_target_is_told_from_a_silent_controller():
    with Controller("grbl") as made:
        text = stage_text(SERIAL.format(made.device), family("grbl"), 1)
        config = parse_config(text.replace("max_mm = 20", "max_mm = 200"))
        line, (x, _) = make_drives(config.bus, config.axes)
        with line:
            with pytest.raises(Refusal) as told:
                x.go(150_000)
            assert told.value.refused and told.value.out_of_reach
            made.lost = 1
            with pytest.raises(BusError) as told:
                x.move(1000, 1000, 1000)
            assert not told.value.refused and took(x, 1000, x.status(), 2)


def grbl_of(made, **changes):
    text = stage_text(SERIAL.format(made.device), family("grbl"), 1, **changes)
    config = parse_config(text)
    return make_drives(config.bus, config.axes)


def test_a_board_that_its_ports_opening_resets_is_waited_for_and_reset_once():
    with Controller("grbl") as made:
        for _ in range(2):  # its control line is left up, so that it keeps its place
            line, (x, _) = grbl_of(made)
            with line:
                assert x.ids()["firmware"].startswith("[VER:1.1h")
                x.go(x.status().position + 500)
                until(lambda x=x: x.status().done)
        assert made.resets == 1 and made.places()[0] == pytest.approx(1.0)
        made.hang_up()  # as another program leaves it
        until(lambda: not made._high)
        line, (x, _) = grbl_of(made)
        with line:
            assert x.status().position == 0 and made.resets == 2


def test_a_board_that_is_not_reset_is_not_waited_for():
    with Controller("grbl") as made:
        made.faults.add("no_reset")
        line, (x, _) = grbl_of(made)
        begun = time.monotonic()
        with line:
            assert x.status().done
        assert time.monotonic() - begun < 2.0 and not made.resets


def test_a_stop_at_rest_leaves_nothing_that_holds_or_goes_on():
    with Controller("grbl") as made:
        line, (x, _) = grbl_of(made)
        with line:
            x.stop()
            assert made.state == "Idle" and x.status().done
            x.go(1000)
            until(lambda: x.status().done)
            assert made.places()[0] == pytest.approx(1.0)


def test_what_another_program_runs_is_held_and_then_ended_where_it_stands():
    with Controller("grbl") as made:
        line, (x, _) = grbl_of(made)
        with line:
            x.status()
            made.run("X", 50.0, 20.0)
            made.run("X", 0.0, 20.0)
            assert x.status().moving
            x.stop()
            until(lambda: not x.status().moving)
            assert made.state == "Hold:0" and not x.status().enabled
            stood = x.steady().position
            x.hold(stood)
            assert made.state == "Idle" and not made.queue and not made.alarm
            assert x.steady().position == stood and x.status().enabled


def test_the_slowest_feed_is_the_controllers():
    """GRBL raises a slower one, which its jogs must not ask for."""
    with Controller("grbl") as made:
        line, (x, _) = grbl_of(made)
        with line:
            x.move(100, 1.0, 1000.0)
            assert made.queue[0][2] == pytest.approx(1 / 60)
            x.stop()


def test_objects_that_a_canopen_drive_may_lack_are_left_out():
    pytest.importorskip("canopen", reason="canopen is not installed")
    from can_nodes import Nodes

    with Nodes("lean", without=(2, 4, 0x6083, 0x6061, 0x605D)) as made:
        text = stage_text(CAN.format("lean"), family("cia402"), 1)
        config = parse_config(text)
        line, (x, _) = make_drives(config.bus, config.axes)
        with line:
            assert x.ids() == {"vendor": 11}
            assert x.bring(x.arm, lambda status: status.enabled).enabled
            x.go(2000)
            until(lambda: x.status().done)
            assert made.places()[0] == pytest.approx(2.0, abs=1e-3)


def test_a_canopen_node_is_started_and_its_mode_is_set_before_it_is_halted():
    pytest.importorskip("canopen", reason="canopen is not installed")
    from can_nodes import Nodes

    with Nodes("fresh") as made:
        config = parse_config(stage_text(CAN.format("fresh"), family("cia402"), 1))
        line, (x, _) = make_drives(config.bus, config.axes)
        node, seen = made.nodes[0], []
        control = node._control
        node._control = lambda word: (seen.append((node.mode, word)), control(word))
        with line:
            assert not x.status().enabled
            assert x.bring(x.arm, lambda status: status.enabled).enabled
            assert node.node.nmt.state == "OPERATIONAL"
        assert seen and all(mode == 1 for mode, word in seen if word & 0x100)


OWN = """
from rig.drives import Drive, Line


class Wire(Line):
    transports = ("serial",)

    def connect(self):
        pass

    def close(self):
        pass


class Mine(Drive):
    line_type = Wire
    at = 0

    def ids(self):
        return {"serial": self.axis.map.settings["serial"]}

    def arm(self):
        pass

    def position(self):
        return self.at

    def move(self, count, speed, accel):
        with self.line.exchange(self.axis.unit):
            self.at = count

    def standing(self):
        return True

    def stop(self):
        pass

    def alarm(self):
        return ""
"""
MAP = """
schema = 1
drive = "mine.py:Mine"
name = "mine"
title = "of one's own"
sources = "none"
[settings]
serial = 7
"""


def test_a_class_of_ones_own_is_a_drive(tmp_path):
    (tmp_path / "mine.py").write_text(OWN)
    (tmp_path / "mine.toml").write_text(MAP)
    text = stage_text(SERIAL.format("x"), "mine.toml", 1)
    config = parse_config(text, tmp_path)
    line, (x, _) = make_drives(config.bus, config.axes)
    with line:
        x.go(1234)
        assert x.sound().position == 1234 and x.ids() == {"serial": 7}
    (tmp_path / "mine.toml").write_text(MAP.replace("mine.py:Mine", "mine.py:Yours"))
    config = parse_config(text, tmp_path)
    with pytest.raises(Refused, match=r"mine\.py:Yours.*cannot be loaded"):
        make_drives(config.bus, config.axes)


@pytest.mark.parametrize("method", ["def stop", "def close", "line_type"])
def test_what_a_class_lacks_is_named_before_anything_moves(tmp_path, capsys, method):
    (tmp_path / "mine.py").write_text(OWN.replace(method, method + "_"))
    (tmp_path / "mine.toml").write_text(MAP)
    (tmp_path / "rig.toml").write_text(stage_text(SERIAL.format("x"), "mine.toml", 1))
    assert main(["check", str(tmp_path / "rig.toml")]) == 0
    assert "NOT CHECKED: mine.py:Mine" in capsys.readouterr().out
    assert main(["check", str(tmp_path / "rig.toml"), "--run", "mine.py:Mine"]) == 2
    told = capsys.readouterr().err
    assert f" {method.split()[-1]}" in told.replace("Mine.", " ") and "mine.py" in told


def test_drives_of_two_lines_and_of_another_bus_are_refused():
    config = parse_config(stage_text(SERIAL.format("x"), family("grbl"), 1))
    other = parse_config(stage_text(CAN.format("x"), family("cia402"), 1))
    with pytest.raises(Refused, match="must be of one kind"):
        make_drives(config.bus, [config.axes[0], other.axes[1]])
    with pytest.raises(Refused, match=r"bus\.transport: must be serial"):
        make_drives(other.bus, config.axes)


def test_a_missing_extra_is_named(monkeypatch):
    for module in ("can", "canopen"):
        monkeypatch.setitem(sys.modules, module, None)
    config = parse_config(stage_text(CAN.format("x"), family("cia402"), 1))
    line, _ = make_drives(config.bus, config.axes)
    with pytest.raises(Refused, match=r"need can, which is not installed: .*canopen"):
        line.open()


# A device of each kind, commissioned once and then spoilt


@pytest.fixture(scope="module", params=KINDS)
def stage(request, tmp_path_factory):
    folder, said = tmp_path_factory.mktemp(request.param), []
    made, bus, counts = device(request.param, f"stage {request.param}")
    with pytest.MonkeyPatch.context() as patch, made, sensed(made.places) as sensor:
        port, gain = sensor
        if request.param == "cia402":  # no other process sees the virtual bus
            patch.setattr(Run, "lines", staticmethod(line_here))
        config = parse_config(
            stage_text(bus(made), family(request.param), port, counts)
        )
        place = place_of(config, folder, said)
        steps.show_identity(place)
        assert steps.go_home(place, here=True) == 0, said
        assert steps.axes(place) == 0, said
        yield types.SimpleNamespace(
            kind=request.param, made=made, gain=gain, config=config, folder=folder,
            place=place, said=said,
        )  # fmt: skip


def run(stage, name, listeners=(), speed=100):
    said = []
    folder = stage.folder / name
    axes = [changed(axis, speed_deg_s=speed) for axis in stage.config.axes]
    config = changed(stage.config, axes=tuple(axes))
    code = session(config, folder, None, said, listeners, record=stage.place.record)
    return code, "\n".join(said), folder


def back(stage):
    """Whoever mends it puts it where it was commissioned."""
    made = stage.made
    with getattr(made, "_lock", contextlib.nullcontext()):
        if isinstance(made, Controller):
            made.at, made.queue = dict.fromkeys("XY", 0.0), []
    for node in getattr(made, "nodes", ()):
        with node._lock:
            node.position = node.velocity = 0.0
            node.target, node.reached = 0, True
    stage.place.record.left_at({"x": 0, "y": 0})


@pytest.mark.slow
def test_it_is_commissioned_and_calibrated(stage):
    record = stage.place.record
    assert np.shape(record.state(SIGN_CHECKED)["turns"]["deg"]) == (2, 2)
    assert list(record.state(STOP_PROVED)["ways"]) == ["the stop of each unit"]
    code, said, folder = run(stage, "calibrate")
    assert code == 0, said
    calibration = jaxcal.Calibration.load(folder / "calibration.json")
    np.testing.assert_allclose(calibration.matrix, MATRIX, atol=2e-3)
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["after"]["max"] < 0.02


@pytest.mark.slow
def test_a_halt_from_outside_is_a_fault_and_nothing_moves_again(stage):
    halt = getattr(stage.made, "halt", None) or (
        lambda: [node.halt() for node in stage.made.nodes]
    )
    done = []

    def listen(run, phase):
        if phase == "moving" and len(run.postures()) == 2 and not done:
            import threading

            done.append(True)
            threading.Timer(0.1, halt).start()

    code, said, _ = run(stage, "halted", [listen])
    assert code == 3 and "short of its target" in said, said
    places = stage.made.places()
    time.sleep(0.5)
    assert stage.made.places() == pytest.approx(places, abs=1e-6)
    assert all(f"{name} (unit" in said for name in "xy") and "NOT" not in said


@pytest.mark.slow
def test_a_drive_that_is_far_too_fast_is_named(stage):
    made = stage.made
    for each in getattr(made, "nodes", [made]):
        each.speed = 20.0
    code, said, _ = run(stage, "fast", speed=20)
    back(stage)
    for each in getattr(made, "nodes", [made]):
        each.speed = 1.0
    assert code == 3 and "instead of the commanded" in said, said


@pytest.mark.slow
def test_a_stop_that_does_nothing_is_found(stage):
    back(stage)
    made, said = stage.made, stage.said
    for each in getattr(made, "nodes", [made]):
        each.faults.add("deaf")
    del said[:]
    record = stage.place.record
    assert steps.axes(stage.place) == 3
    for each in getattr(made, "nodes", [made]):
        each.faults.clear()
    assert "moved on to the target" in "\n".join(said)
    assert record.state(STOP_PROVED) is None


@pytest.mark.slow
def test_another_gearing_is_found_before_it_is_far(stage):
    back(stage)
    assert steps.axes(stage.place) == 0, stage.said
    stage.gain[0] = 3.0
    far = []

    def listen(run, phase):
        far.append(np.abs(np.array(stage.made.places()) * stage.gain))

    code, said, _ = run(stage, "regeared", [listen])
    stage.gain[0] = 1.0
    assert code == 3 and "x changed the readings by" in said, said
    assert np.max(far) < 21.0
