"""Against drives that libmodbus serves, and a phone written by hand from the formats.

Nothing of ``rig_workbench.simulator`` is used: the C program stores the registers, and
the phone below turns the drives' positions into attitudes with scipy and Android's own
formulas.
"""

import json
import os
import pathlib
import shutil
import socket
import subprocess
import threading
import time
import tty

import numpy as np
import pytest
from harness import commissioned, fast_text, free_port, read_words
from scipy.spatial.transform import Rotation

from rig.__main__ import main
from rig.config import parse_config
from rig.config.settings import BusSettings
from rig.core.motion import took
from rig.core.stop import stop_all
from rig.drives.bus import Bus
from rig.drives.line import BusError
from rig.drives.modbus import ModbusDrive

SOURCE = pathlib.Path(__file__).with_name("libmodbus_slave.c")
MATRIX = np.array([[0.95, 0.03, -0.02], [0.01, 1.04, 0.02], [-0.015, 0.01, 0.9]])


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    if shutil.which("gcc") is None:
        pytest.skip("gcc, which compiles the libmodbus slave, is not installed")
    target = tmp_path_factory.mktemp("slave") / "slave"
    built = subprocess.run(
        ["gcc", "-O1", "-o", str(target), str(SOURCE), "-lmodbus"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if "modbus.h" in built.stderr or "-lmodbus" in built.stderr:
        pytest.skip("libmodbus is no pip package: apt-get install libmodbus-dev")
    assert built.returncode == 0, built.stderr
    return target


class Slave:
    """The C program, and what it said."""

    def __init__(self, program, *arguments):
        self.moves: list[tuple[int, int]] = []
        self.stops: list[int] = []
        self.enabled: list[int] = []
        self.position = {1: 0, 2: 0, 3: 0}
        self.process = subprocess.Popen(
            [str(program), *arguments], stdout=subprocess.PIPE, text=True
        )
        assert self.process.stdout.readline() == "ready\n"
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self):
        for line in self.process.stdout:
            word, unit, *rest = line.split()
            if word == "move":
                self.moves.append((int(unit), int(rest[0])))
                self.position[int(unit)] = int(rest[0])
            elif word == "enable":
                self.enabled.append(int(unit))
            else:
                self.stops.append(int(unit))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.wait()


def eventually(true):
    """What the program says is read by a thread of its own."""
    end = time.monotonic() + 5
    while not true():
        assert time.monotonic() < end
        time.sleep(0.01)


def phone(slave, config, port, closing):
    """HyperIMU as its documentation has it: stamp, azimuth, pitch, roll, CR LF."""
    world = Rotation.from_euler("Z", 200.0, degrees=True)
    while not closing.is_set():
        try:
            connection = socket.create_connection(("127.0.0.1", port), timeout=1)
        except OSError:
            time.sleep(0.02)
            continue
        with connection:
            while not closing.is_set():
                pulses = [slave.position[axis.unit] for axis in config.axes]
                u = np.array([p * 360 / 100000 for p in pulses]) * [1, -1, 1]
                pitch, yaw, roll = MATRIX @ u
                joints = Rotation.from_euler("ZXY", [yaw, pitch, roll], degrees=True)
                r = (world * joints).as_matrix()
                angles = np.degrees(
                    [
                        np.arctan2(-r[1, 0], r[0, 0]) % (2 * np.pi),
                        np.arctan2(-r[2, 1], r[2, 2]),
                        np.arcsin(r[2, 0]),
                    ]
                )
                text = ",".join(
                    [str(int(time.time() * 1000)), *map(repr, map(float, angles))]
                )
                try:
                    connection.sendall(text.encode() + b"\r\n")
                except OSError:
                    break
                time.sleep(0.004)


@pytest.mark.slow
def test_a_whole_calibration_over_tcp(program, tmp_path):
    bus, imu = free_port(), free_port()
    text = fast_text(
        {"port = 5020": f"port = {bus}", "port = 2055": f"port = {imu}"},
        session='\n[session]\nmethod = "exact"\nzero = "drive"\n',
    )
    config = parse_config(text)
    path = tmp_path / "rig.toml"
    path.write_text(text)
    commissioned(config, tmp_path)
    closing = threading.Event()
    with Slave(program, "tcp", str(bus)) as slave:
        sender = threading.Thread(target=phone, args=(slave, config, imu, closing))
        sender.start()
        try:
            code = main(["calibrate", "--config", str(path), "--arm", "--out",
                         str(tmp_path / "runs")])  # fmt: skip
        finally:
            closing.set()
            sender.join()
        assert code == 0
        assert set(slave.stops) == {1, 2, 3}
    (folder,) = (tmp_path / "runs").iterdir()
    summary = json.loads((folder / "summary.json").read_text())
    np.testing.assert_allclose(summary["A"], MATRIX, atol=1e-5)
    np.testing.assert_allclose(summary["b"], np.zeros(3), atol=1e-4)
    records = [json.loads(line) for line in (folder / "journal.jsonl").open()]
    asked = [r["pulses"] for r in records if r["event"] == "command"]
    assert [pulses for _, pulses in slave.moves] == asked


@pytest.mark.slow
@pytest.mark.parametrize(
    ("register_map", "family"),
    [
        ("leadshine_pr", "leadshine"),
        ("oriental_az", "oriental"),
        ("applied_motion", "applied"),
    ],
)
def test_every_family_enables_moves_and_stops(program, register_map, family):
    """Registers, bits and opcodes of the C program are typed in from the manuals."""
    text = fast_text({'map = "leadshine_pr"': f'map = "{register_map}"'})
    axis, port = parse_config(text).axes[1], free_port()
    settings = BusSettings(transport="tcp", host="127.0.0.1", port=port, timeout_s=0.5)
    with Slave(program, "tcp", str(port), family) as slave, Bus(settings) as bus:
        drive = ModbusDrive(bus, axis)
        if axis.map.enable:
            assert not drive.status().enabled
            assert drive.bring(drive.arm, lambda s: s.enabled).enabled
            eventually(lambda: slave.enabled == [2])
        start = drive.status()
        assert start.enabled and start.done and not start.moving and not start.fault
        assert took(drive, -4321, start, 14) is False
        drive.go(-4321)
        assert took(drive, -4321, start, 14) is True
        end = time.monotonic() + 5
        while not (status := drive.status()).done:
            assert status.moving and time.monotonic() < end
        assert status.position == -4321
        (result,) = stop_all([drive])
        assert result.acknowledged and result.standing
        eventually(lambda: slave.moves == [(2, -4321)] and set(slave.stops) == {2})


@pytest.mark.slow
def test_one_drive_over_rtu_on_a_pseudo_terminal(program):
    pytest.importorskip("serial", reason="serial ports need pyserial")
    ours, theirs = os.openpty(), os.openpty()
    for fd in (*ours, *theirs):
        tty.setraw(fd)
    closing = threading.Event()

    def bridge(source, sink):
        import select

        while not closing.is_set():
            if select.select([source], [], [], 0.05)[0]:
                os.write(sink, os.read(source, 512))

    threads = [
        threading.Thread(target=bridge, args=pair, daemon=True)
        for pair in ((ours[0], theirs[0]), (theirs[0], ours[0]))
    ]
    for thread in threads:
        thread.start()
    axis = parse_config(fast_text()).axes[0]
    settings = BusSettings(transport="rtu", device=os.ttyname(ours[1]), timeout_s=0.5)
    try:
        with (
            Slave(program, "rtu", os.ttyname(theirs[1])) as slave,
            Bus(settings) as bus,
        ):
            drive = ModbusDrive(bus, axis)
            assert drive.ids()["pulses_per_rev"] == 10000
            drive.go(-4321)
            end = time.monotonic() + 5
            while not drive.status().done:
                assert time.monotonic() < end
            assert drive.status().position == -4321
            (result,) = stop_all([drive])
            assert result.acknowledged and result.standing
            with pytest.raises(BusError):
                read_words(bus, 2, 0, 1)  # no such unit: silence
            eventually(lambda: slave.moves == [(1, -4321)] and slave.stops == [1])
    finally:
        closing.set()
        for thread in threads:
            thread.join()
        for fd in (*ours, *theirs):
            os.close(fd)
