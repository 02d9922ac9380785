"""What a device, a file or a calibration is refused for, and what is said of others."""

import itertools

import pytest
from harness import (
    changed,
    commissioned,
    fast_config,
    fast_text,
    make_run,
    run_safely,
    session,
    simulator,
)

from rig import stopping
from rig.__main__ import main
from rig.config import ConfigError, parse_config
from rig.config.maps import load_map
from rig.core.record_check import check_drives
from rig.drives.bus import Bus
from rig.drives.modbus import ModbusDrive
from rig.identification.conclusion import conclude
from rig.journal import lock
from rig.journal.device import HOMED, STOP_PROVED
from rig.journal.lock import BusLock
from rig.journal.run_folder import Journal
from rig.outputs.messages import summary_lines
from rig.procedures.calibrate import collect

BAD = '\n[session]\nmethod = "exact"\nverify_postures = 1\nverify_limit_deg = 0.001\n'


def test_a_calibration_that_is_not_to_be_used_wants_a_word(tmp_path, capsys):
    """F: its session said "Do not use this calibration", and `goto` moved by it."""
    run = tmp_path / "run"
    config = parse_config(fast_text(session=BAD))
    with simulator(config, noise_deg=0.02) as sim:
        assert session(sim.start(), run, sim) == 1
    given = ["goto", str(run), "--simulate", "--to", "1", "-3", "2", "--noise", "0.005",
             "--out", str(tmp_path / "out"), "--speedup", "20"]  # fmt: skip
    assert config.session.verify_limit_deg == 0.001
    assert main(given) == 2
    said = capsys.readouterr()
    assert "advised against using it: the error after compensation, 0." in said.out
    assert " deg, exceeds session.verify_limit_deg (0.001 deg)" in said.out
    assert "--use" in said.out
    assert "moving" not in said.out
    assert main([*given, "--use"]) == 0


def test_a_wall_clock_that_is_set_back_exchanges_no_visits(tmp_path, monkeypatch):
    """H: the slip of 1.5 degrees at the end was read as the first visit."""
    wall = [1e9]
    monkeypatch.setattr("rig.journal.run_folder.time.time", lambda: wall[0])
    journal = Journal(tmp_path / "journal.jsonl")
    journal.write("a")
    wall[0] -= 3600.0
    journal.write("b")
    journal.close()
    again = Journal(tmp_path / "journal.jsonl")
    again.write("c")
    times = [record["time"] for record in again.records]
    assert times == sorted(times) and times[-1] - times[0] < 60.0


def test_visits_are_taken_in_the_order_of_the_journal(tmp_path):
    with simulator(config := fast_config()) as sim:
        assert session(sim.start(), tmp_path, sim) == 0
    records = Journal(tmp_path / "journal.jsonl").records
    back = [
        {**r, "time": r["time"] - 7200.0 * (r.get("name") == "reference:end")}
        for r in records
    ]
    _, told = conclude(config, back, {})
    assert told["drift"]["minutes"][-1] < 0  # as recorded, and still the last


def test_readings_that_are_a_posture_late_are_told_by_verdict_and_notes(tmp_path):
    config = parse_config(fast_text({}, BAD.replace("= 1\n", "= 8\n")))
    with simulator(config) as sim:
        assert session(sim.start(), tmp_path, sim) == 1
    records = Journal(tmp_path / "journal.jsonl").records
    rows = [r for r in records if r.get("role") in ("select", "before", "after")]
    late = {
        b["seq"]: {name: a[name] for name in ("attitude", "measured_deg")}
        for a, b in itertools.pairwise(rows[4:])
    }
    records = [{**record, **late.get(record["seq"], {})} for record in records]
    config = changed(config, session=changed(config.session, verify_limit_deg=99.0))
    calibration, told = conclude(config, records, {})
    (reason,) = calibration.provenance["notes"]["verdict"]["reasons"]
    assert "late" in reason
    said = summary_lines(told, 99.0)[-1]
    assert said.startswith(f"RECALIBRATE: {reason}. Do not use")


def test_stop_names_the_devices_that_it_did_not_stop(tmp_path, monkeypatch, capsys):
    """G: it said "standing" of one device while another went on."""
    monkeypatch.setattr(lock, "FOLDER", tmp_path / "locks")
    monkeypatch.setattr(stopping, "REOPEN_S", 0.5)  # no server on these ports
    buses = []
    for port in (6001, 6002, 6003):
        config = parse_config(
            fast_text({"port = 5020": f"port = {port}"}), tmp_path / str(port)
        )
        buses.append(BusLock(config.bus))
        with buses[-1].acquire("calibrate"):
            buses[-1].leave(config)
    buses[2].stood()
    stopping._tell_others([buses[0].armed_path])
    said = capsys.readouterr().out
    assert "NOT stopped, another device: 127.0.0.1:6002" in said
    assert str(tmp_path / "6002" / "device.json") in said
    assert "6001" not in said and "6003" not in said
    (tmp_path / "rig.toml").write_text('[bus]\ntransport = "tcp"\nport = 1\n')
    assert main(["stop", "--config", str(tmp_path / "rig.toml")]) == 3
    assert "another device: 127.0.0.1:6002" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [('format = "hyperimu"', 'format = "hyperimu"\ncolumns = [1, 1, 1]', "must differ"),
     ('format = "hyperimu"', 'format = "hyperimu"\ncolumns = [0, 3, 2]',
      "also one of the angles"),
     ("min_deg = -20", "min_deg = -120", "between -90 and 90")],
    ids=["columns", "stamp", "middle"],
)  # fmt: skip
def test_what_no_phone_can_tell_is_refused(old, new, told):
    with pytest.raises(ConfigError, match=told):
        parse_config(fast_text().replace(old, new, 1))


def test_one_mangled_position_voids_no_home(tmp_path):
    with simulator(fast_config()) as sim:
        config = sim.start()
        record = commissioned(config, tmp_path)
        record.left_at(
            {a.name: d.position for a, d in zip(config.axes, sim.drives, strict=True)}
        )
        drive, calls = sim.drives[1], []
        place = drive.map.position.address

        def read(address, count, real=drive.read):
            words = real(address, count)
            if address == place and not calls:
                calls.append(address)
                return [(words[0] - 1) % 65536, words[1]]  # 65536 counts less
            return words

        drive.read = read
        with Bus(config.bus) as bus:
            check_drives(
                config, [ModbusDrive(bus, axis) for axis in config.axes], record
            )
        assert calls and record.state(HOMED) is not None


def test_collect_and_held_out_visits_have_the_same_limit_of_lost_postures(tmp_path):
    said: list[str] = []
    with simulator(fast_config()) as sim:
        sim.confine(-12.0, 12.0)
        config = sim.start()
        run = make_run(config, tmp_path, "collect", said.append,
                       record=commissioned(config, tmp_path))  # fmt: skip
        run.listeners.append(sim.answer)
        assert run_safely(run, lambda r: collect(r, 30)) == 3
    assert "4 postures are out of reach, more than session.max_unreachable" in said[-2]


@pytest.mark.parametrize(
    ("old", "new"),
    [("words = [0x0040]", "words = [0x0041]"),
     ("moving = { set = [2] }", "moving = { set = [3] }")],
    ids=["stop", "status"],
)  # fmt: skip
def test_an_edit_of_how_a_drive_is_stopped_voids_the_proof(old, new, tmp_path):
    config = fast_config()
    record = commissioned(config, tmp_path)
    assert record.missing(config) is None
    text = load_map("leadshine_pr").text
    assert old in text
    (tmp_path / "own.toml").write_text(text.replace(old, new))
    family = load_map("own.toml", tmp_path)
    axes = tuple(changed(axis, map=family) for axis in config.axes)
    told = record.missing(changed(config, axes=axes))
    assert f"not {STOP_PROVED}: edited since: axes.pitch.map, how it is stopped" in told


def test_a_finished_run_is_not_resumed(tmp_path, capsys):
    with simulator(fast_config()) as sim:
        assert session(sim.start(), tmp_path / "run", sim) == 0
    (tmp_path / "run/rig.toml").write_text(fast_text())
    before = (tmp_path / "run/journal.jsonl").read_bytes()
    assert main(["resume", str(tmp_path / "run"), "--arm"]) == 2
    assert "is finished" in capsys.readouterr().err
    assert (tmp_path / "run/journal.jsonl").read_bytes() == before


def test_the_order_that_is_printed_is_that_of_the_visits(tmp_path):
    said: list[str] = []
    with simulator(fast_config()) as sim:
        assert session(sim.start(), tmp_path, sim, said) == 0
    table = [line.split() for line in said if line.startswith("  ") and "[" in line]
    printed = [f"select:{row[1]}" for row in table if row[0].isdecimal()]
    visits = [
        r["name"]
        for r in Journal(tmp_path / "journal.jsonl").records
        if r["event"] == "visit" and r["name"].startswith("select")
    ]
    assert len(printed) == 4 and visits == printed
