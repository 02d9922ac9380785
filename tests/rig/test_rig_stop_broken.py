"""`stop` stops, whatever is wrong with the file, the folder, the lock, the install."""

import contextlib
import json
import os
import pathlib
import random
import re
import shutil
import signal
import subprocess
import sys

import pytest
from harness import HASTY, fast_config, fast_text, simulator

from rig import stop_config, stopping
from rig.__main__ import main
from rig.config import load_config
from rig.config.config import EXAMPLES
from rig.config.maps import MAP_FOLDER, available_maps, load_map
from rig.core import stop as core_stop
from rig.drives.bus import Bus
from rig.drives.modbus import ModbusDrive
from rig.journal import lock
from rig.journal.lock import BusLock
from rig.registers import FLAGS


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Locks of these tests alone, also in their child processes."""
    monkeypatch.setattr(lock, "FOLDER", tmp_path / "locks")
    monkeypatch.setenv("JAXCAL_RIG_LOCKS", str(tmp_path / "locks"))
    monkeypatch.setattr(core_stop, "VERIFY_S", 0.6)
    return tmp_path / "locks"


@pytest.fixture
def rig(tmp_path):
    """Three drives that move, and the text of a file that reaches them."""
    with simulator(fast_config(), speedup=0.02) as sim:
        served = sim.start()
        sim.port = served.bus.port
        sim.path = tmp_path / "rig.toml"
        sim.text = fast_text({**HASTY, "port = 5020": f"port = {sim.port}"})
        sim.path.write_text(sim.text)
        with Bus(served.bus) as bus:
            for axis in served.axes:
                ModbusDrive(bus, axis).go(axis.to_pulses(18.0))
        assert all(drive.moving for drive in sim.drives)
        yield sim


def stopped(sim):
    """Names of the axes whose drives were told to stop, and stand."""
    with sim.server.lock:
        for drive in sim.drives:
            drive.advance()
    pairs = zip(sim.config.axis_names, sim.drives, strict=True)
    return {name for name, drive in pairs if drive.stops and not drive.moving}


ALL = {"pitch", "yaw", "roll"}


def replaced(old, new, count=1):
    def change(text):
        assert old in text, old
        return text.replace(old, new, count)

    return change


HOST = 'host = "127.0.0.1"'
PITCH = 'name = "pitch"'
MAP = 'map = "leadshine_pr"'
# What is changed of a file, and whether all three can still be stopped.
WHOLE = {
    "nothing": lambda text: text,
    "too few candidates": replaced("[session]", "[session]\ncandidates = 3"),
    "an unknown key": replaced("[session]", "[session]\nsampels = 3"),
    "an unknown table": lambda text: text + "\n[extra]\na = 1\n",
    "a wrong type": replaced("max_deg = 20", 'max_deg = "twenty"'),
    "limits exchanged": replaced("min_deg = -20", "min_deg = 200"),
    "no pulses": replaced("pulses_per_rev = 10000\n", ""),
    "no name": replaced(PITCH + "\n", ""),
    "a name twice": replaced(PITCH, 'name = "yaw"'),
    "no phone": lambda text: text[: text.index("[imu]")] + "[imu]\nformat = 3\n",
    "a line that is none below": replaced("[motion]", "[motion]\nmax step deg 3"),
    "a text without its end": replaced("[imu]", '[imu]\nname = "phone'),
    "a list without its end": replaced("[imu]", "[imu]\ncolumns = [1, 2"),
    "a key twice": replaced(PITCH, f"{PITCH}\n{PITCH}"),
    "a table twice": lambda text: text + "\n[motion]\npoll_s = 1\n",
    "bare words": replaced(HOST, "host = 127.0.0.1"),
    "a number as text": replaced("unit = 1\n", 'unit = "1"\n'),
    "a port as text": lambda text: (
        replaced("port = ", 'port = "')(text)
        .replace("\n", '"\n', text[: text.index("port = ")].count("\n") + 1)
        .replace('"\n', "\n", text[: text.index("port = ")].count("\n"))
    ),
    "another word for it": replaced('transport = "tcp"', 'transport = "TCP/IP"'),
    "no transport": replaced('transport = "tcp"\n', ""),
    "a bad time": replaced("timeout_s = 0.08", 'timeout_s = "soon"'),
    "a header without its end": replaced("[bus]", "[bus"),
    "single brackets": lambda text: text.replace("[[axes]]", "[axes]"),
    "a near name of a map": replaced(MAP, 'map = "leadshine-pr"'),
    "a near key": replaced("unit = 1\n", "units = 1\n"),
    "no map": replaced(MAP + "\n", ""),
    "a number for a map": replaced(MAP, "map = 3"),
    "no header of an axis": replaced("[[axes]]\n", ""),
    "another header of an axis": replaced("[[axes]]", "[[axis]]"),
    "no header of the bus": replaced("[bus]\n", ""),
    "a value that is too long": replaced("min_deg = -20", "min_deg = " + "9" * 5000),
    "capitals": replaced("[bus]", "[BUS]"),
    "a map in capitals": lambda text: text.replace("leadshine_pr", "LEADSHINE_PR"),
    "a host that is called ip": replaced("host =", "ip ="),
    "units that are called slave_id": lambda text: text.replace("unit =", "slave_id ="),
    "a space of no width": replaced("host =", "host\u200b ="),
    "backticks": replaced(HOST, "host = `127.0.0.1`"),
    "a wide equals sign": replaced("host =", "host \uff1d"),
    "a space in a number": lambda text: re.sub(r"(port = \d+)(\d{3})", r"\1 \2", text),
    "windows": lambda text: text.replace("\n", "\r\n"),
    "a control character": replaced("[imu]", "[imu]\n# \0 \x07"),
    "git's marks": replaced("[imu]", "<<<<<<< HEAD\n[imu]\n=======\n>>>>>>> other"),
    "half of it": lambda text: text[: text.index("[motion]") + 12],
}
OTHERS = {  # and which cannot
    "a unit that is none": (replaced("unit = 1\n", "unit = 900\n"), "pitch"),
    "no unit": (replaced("unit = 1\n", ""), "pitch"),
    "a missing map": (replaced(MAP, 'map = "own.toml"'), "pitch"),
    "a map of another planet": (replaced(MAP, 'map = "zorg"'), "pitch"),
    "a class that is none": (replaced(MAP, 'map = "bad.toml"'), "pitch"),
}


@pytest.mark.parametrize("name", WHOLE)
def test_all_are_stopped_by_a_file_that_no_session_takes(name, rig, capsys):
    rig.path.write_bytes(WHOLE[name](rig.text).encode())
    assert main(["stop", "--config", str(rig.path)]) == 0, capsys.readouterr()
    assert stopped(rig) == ALL
    assert capsys.readouterr().out.count("acknowledged, standing") == 3


@pytest.mark.parametrize("name", OTHERS)
def test_a_wrong_axis_is_said_and_the_others_are_stopped(name, rig, capsys):
    change, lost = OTHERS[name]
    text = (MAP_FOLDER / "leadshine_pr.toml").read_text()
    (rig.path.parent / "bad.toml").write_text(
        text.replace('name = "leadshine_pr"', 'name = "x"\ndrive = "no_such:Thing"')
    )
    rig.path.write_text(change(rig.text))
    assert main(["stop", "--config", str(rig.path)]) == 3
    said = capsys.readouterr().out
    assert stopped(rig) == ALL - {lost}
    assert f"{lost} (unit" in said and "use the emergency stop" in said
    assert said.count("acknowledged, standing") == 2


@pytest.mark.parametrize("name", OTHERS)
def test_what_was_armed_makes_up_for_it(name, rig, capsys):
    BusLock(load_config(rig.path).bus).leave(load_config(rig.path))
    BusLock(load_config(rig.path).bus).stood()  # the file is asked first
    rig.path.write_text(OTHERS[name][0](rig.text))
    assert main(["stop", "--config", str(rig.path)]) == 0, capsys.readouterr()
    assert stopped(rig) == ALL


@pytest.mark.parametrize("encoding", ["utf-16", "utf-8-sig", "cp1252"])
def test_a_file_of_another_editor_is_read(encoding, rig):
    rig.path.write_bytes(("# Gelenke für Jürgen\n" + rig.text).encode(encoding))
    assert main(["stop", "--config", str(rig.path)]) == 0
    assert stopped(rig) == ALL


def test_a_map_of_ones_own_with_faults_stops_its_drive(rig):
    text = (MAP_FOLDER / "leadshine_pr.toml").read_text()
    for number, change in enumerate((
        replaced("schema = 1", "schema = 9\nnonsense = true"),
        replaced("[units]", "[units\nspeed rev"),
        replaced('title = "', 'titel = "'),
    )):  # fmt: skip
        (rig.path.parent / f"own{number}.toml").write_text(change(text))
        rig.path.write_text(rig.text.replace(MAP, f'map = "own{number}.toml"'))
        for drive in rig.drives:
            drive.stops.clear()
        assert main(["stop", "--config", str(rig.path)]) == 0
        assert stopped(rig) == ALL


def _armed(rig):
    BusLock(load_config(rig.path).bus).leave(load_config(rig.path))


def _lock_of(rig):
    return BusLock(load_config(rig.path).bus)


@pytest.mark.parametrize("units", [[1, 2], [4, 5], [1, 2, 3]])
def test_what_is_armed_and_what_the_file_names_are_stopped(units, rig, capsys):
    """A record of another day that was not ended does not win over the file."""
    _armed(rig)
    path = _lock_of(rig).armed_path
    told = json.loads(path.read_text())
    told["drives"] = [
        {**drive, "unit": unit}
        for unit, drive in zip(units, told["drives"], strict=False)
    ]
    path.write_text(json.dumps(told))
    code = main(["stop", "--config", str(rig.path)])
    said = capsys.readouterr().out
    assert stopped(rig) == ALL
    assert code == (3 if 4 in units else 0), said
    assert all(f"(unit {unit}): " in said for unit in {*units, 1, 2, 3})


def test_a_record_that_is_nested_too_deep_is_none(rig, folder):
    folder.mkdir(mode=0o700)
    _lock_of(rig).armed_path.write_text("[" * 100_000)
    assert main(["stop", "--config", str(rig.path)]) == 0
    assert stopped(rig) == ALL


@pytest.mark.parametrize(
    "words",
    [
        "stop", "stop rig.toml", "stop --output runs", "stop --axis pitch", "stop all",
        "stop pitch", "stop \u2013config rig.toml", "stop --config RIG.TOML", "STOP",
        "Stop", "-v stop", "--config rig.toml stop", "stop pitch rig.toml", "--stop",
        "stop --config=gone/rig.toml", "stop notes.txt",
    ],
)  # fmt: skip
def test_words_that_name_no_file_do_not_keep_it(words, rig, monkeypatch, capsys):
    monkeypatch.chdir(rig.path.parent)
    rig.path.with_name("notes.txt").write_text("to do")
    assert main(words.split()) == 0
    assert stopped(rig) == ALL
    said = capsys.readouterr().out
    for word in ("runs", "gone", "notes.txt"):
        assert (word in words) <= (word in said)


@pytest.mark.parametrize("words", ["goto stop", "stpo", "halt", "stop --help"])
def test_another_command_stops_nothing(words, rig, monkeypatch):
    monkeypatch.chdir(rig.path.parent)
    with contextlib.suppress(SystemExit):
        main(words.split())
    assert not stopped(rig)


def test_the_folder_of_the_file_is_taken_for_it(rig):
    assert main(["stop", "--config", str(rig.path.parent)]) == 0
    assert stopped(rig) == ALL


@pytest.mark.parametrize("spoil", ["file", "garbage", "directory", "link", "mode"])
def test_a_lock_that_cannot_be_read_does_not_keep_it(spoil, rig, folder):
    path = _lock_of(rig).path
    if spoil == "file":
        folder.write_text("no folder")
    else:
        folder.mkdir(mode=0o700)
    if spoil == "garbage":
        path.write_bytes(b"\xff\0{]")
        path.with_suffix(".armed").write_bytes(b"\0" * 999)
    elif spoil == "directory":
        path.mkdir()
        path.with_suffix(".armed").mkdir()
    elif spoil == "link":
        path.symlink_to("/dev/full")
    elif spoil == "mode":
        path.touch(mode=0)
        folder.chmod(0o500)
    assert main(["stop", "--config", str(rig.path)]) == 0
    assert stopped(rig) == ALL


HOLDS = """
import sys, time
from rig.config import load_config
from rig.journal.lock import BusLock
lock = BusLock(load_config(sys.argv[1]).bus).acquire("calibrate")
print("holds", flush=True)
time.sleep(60)
"""


@pytest.mark.parametrize("spoil", ["folder gone", "file gone", "garbage"])
def test_a_session_is_asked_whatever_became_of_its_lock(spoil, rig, folder, capsys):
    child = subprocess.Popen(
        [sys.executable, "-c", HOLDS, str(rig.path)], stdout=subprocess.PIPE, text=True
    )
    try:
        assert child.stdout.readline() == "holds\n"
        if spoil == "folder gone":
            shutil.rmtree(folder)
        elif spoil == "file gone":
            _lock_of(rig).path.unlink()
        else:
            _lock_of(rig).path.write_bytes(b"\xff{")
        assert main(["stop", "--config", str(rig.path)]) == 0
        assert f"(process {child.pid}," in capsys.readouterr().out
        assert child.wait(5) == -signal.SIGTERM
    finally:
        child.kill()
        child.wait()
        child.stdout.close()
    assert stopped(rig) == ALL


@pytest.mark.parametrize("suffix", [".lock", ".armed"])
def test_a_pipe_in_its_folder_is_not_waited_for(suffix, rig, folder):
    folder.mkdir(mode=0o700)
    os.mkfifo(_lock_of(rig).path.with_suffix(suffix))
    assert main(["stop", "--config", str(rig.path)]) == 0
    assert stopped(rig) == ALL


def test_a_pipe_in_place_of_the_file_is_not_waited_for(rig, tmp_path, capsys):
    os.mkfifo(tmp_path / "pipe.toml")
    assert main(["stop", "--config", str(tmp_path / "pipe.toml")]) == 3
    said = capsys.readouterr()
    assert "pipe.toml cannot be read: it is no file" in said.out + said.err


SAYS = """
import fcntl, signal, sys, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
file = open(sys.argv[1], "a")
fcntl.flock(file, fcntl.LOCK_EX)
file.write(sys.argv[2])
file.flush()
print("holds", flush=True)
time.sleep(60)
"""


@pytest.mark.parametrize(
    "told", ['{"pid": %d}', '{"pid": 1099511627776, "command": 5, "since": null}', ""]
)
def test_a_holder_that_says_too_little_is_ended_and_nothing_is_said_of_its_drives(
    told, rig, folder, capsys, monkeypatch
):
    monkeypatch.setattr(stopping, "END_S", 0.1)
    folder.mkdir(mode=0o700)
    code = SAYS.replace("sys.argv[2]", "sys.argv[2].replace('%d', str(os.getpid()))")
    command = [sys.executable, "-c", "import os" + code, str(_lock_of(rig).path), told]
    child = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert child.stdout.readline() == "holds\n"
        assert main(["stop", "--config", str(rig.path)]) == 0
        said = capsys.readouterr().out
        assert f"`a session` (process {child.pid}, since unknown)" in said
        assert "killing it" in said and "reported" not in said
    finally:
        child.kill()
        child.wait()
        child.stdout.close()
    assert stopped(rig) == ALL


def test_whatever_fails_with_the_lock_the_drives_are_stopped(rig, monkeypatch, capsys):
    def fails(*_):
        raise ZeroDivisionError("of the lock")

    for name in ("signal_holder", "acquire"):
        monkeypatch.setattr(BusLock, name, fails)
    monkeypatch.setattr(stopping, "armed_files", fails)
    assert main(["stop", "--config", str(rig.path)]) == 0
    assert stopped(rig) == ALL and "ZeroDivisionError" in capsys.readouterr().out


@pytest.mark.parametrize(
    "words",
    ["", "rig.toml", "--conf rig.toml", "--config=rig.toml --now", "-c rig.toml"],
)
def test_words_that_it_does_not_know_do_not_keep_it(words, rig, monkeypatch):
    monkeypatch.chdir(rig.path.parent)
    assert main(["stop", *words.split()]) == 0
    assert stopped(rig) == ALL


BARE = """
import sys
class Gone:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {gone!r}:
            raise ImportError(name + " is broken")
sys.meta_path.insert(0, Gone())
sys.argv = ["jaxcal-rig", "stop", "--config", {path!r}]
from rig.__main__ import main
code = main()
rooms = ("rig", "jaxcal")
found = sorted(n for n in sys.modules if n.partition(".")[0] in rooms)
others = sorted(set(sys.modules) & {gone!r})
print("LOADED", *found, "|", *others, file=sys.stderr)
sys.exit(code)
"""
HEAVY = {"numpy", "scipy", "jax", "pydantic", "pydantic_core", "pymodbus", "jinja2",
         "tomlkit", "nicegui", "matplotlib", "serial"}  # fmt: skip
MAY = {  # all of rig and jaxcal that a stop over a network may load
    "jaxcal", "jaxcal.compiled", "jaxcal.jsonlines", "jaxcal.moved", "rig",
    "rig.__main__", "rig.core", "rig.core.stop", "rig.drives", "rig.drives.drive",
    "rig.drives.line", "rig.drives.bus", "rig.drives.modbus", "rig.drives.wire",
    "rig.faults", "rig.journal",
    "rig.journal.lock", "rig.registers", "rig.stop_config",
    "rig.stopping",
}  # fmt: skip


def test_it_loads_its_own_drives_and_nothing_heavy(rig, folder):
    """The wall at run time, with an environment and an installation that are bare."""
    env = {"JAXCAL_RIG_LOCKS": str(folder)}  # no HOME, no TMPDIR, no PATH
    done = subprocess.run(
        [sys.executable, "-c", BARE.format(gone=HEAVY, path=str(rig.path))],
        capture_output=True, text=True, env=env, cwd="/",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert stopped(rig) == ALL
    loaded, _, others = done.stderr.partition("LOADED")[2].partition("|")
    assert set(loaded.split()) <= MAY, set(loaded.split()) - MAY
    assert not others.split()


@pytest.mark.parametrize("init", ["def (", "import no_such_module", "1 / 0", None])
def test_a_jaxcal_that_cannot_be_imported_does_not_keep_it(init, rig, tmp_path):
    root, installed = pathlib.Path(stop_config.__file__).parents[1], tmp_path / "site"
    (installed / "jaxcal").mkdir(parents=True)
    (installed / "rig").symlink_to(root / "rig")
    if init is not None:
        (installed / "jaxcal" / "__init__.py").write_text(init)
    shutil.copy(root / "jaxcal" / "jsonlines.py", installed / "jaxcal")
    program = [sys.executable, "-m", "rig", "stop", "--config", str(rig.path)]
    done = subprocess.run(program, cwd=installed, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert stopped(rig) == ALL


def test_what_it_loads_can_be_read_in_a_morning():
    root = os.path.dirname(os.path.dirname(stop_config.__file__))
    lines = 0
    for name in MAY:
        path = os.path.join(root, *name.split("."))
        path = f"{path}.py" if os.path.isfile(f"{path}.py") else f"{path}/__init__.py"
        with open(path, encoding="utf-8") as file:
            lines += len(file.readlines())
    assert lines < 3500, lines


def test_a_folder_that_is_gone_does_not_keep_it(rig, tmp_path):
    """Neither the working directory, nor that of the file but for itself.

    From a file, as the installed program: of ``python -c`` in such a folder CPython
    3.13.0 fails at the first attribute that is missing.
    """
    gone, program = tmp_path / "gone", tmp_path / "program.py"
    gone.mkdir()
    program.write_text(
        f"import os, sys; os.chdir({str(gone)!r}); os.rmdir({str(gone)!r})\n"
        f"sys.argv = ['x', 'stop', '--config', {str(rig.path)!r}]\n"
        "from rig.__main__ import main; sys.exit(main())\n"
    )
    subprocess.run([sys.executable, str(program)], check=True, capture_output=True)
    assert stopped(rig) == ALL


def test_one_bus_that_is_away_does_not_keep_the_other(rig, tmp_path, capsys):
    """Two devices were armed, and the file is of no use."""
    _armed(rig)
    config = load_config(rig.path)
    away = config.model_copy(
        update={"bus": config.bus.model_copy(update={"host": "127.0.0.9", "port": 9})}
    )
    BusLock(away.bus).leave(away)
    rig.path.unlink()
    with contextlib.ExitStack() as stack:
        stack.enter_context(pytest.MonkeyPatch.context()).setattr(
            stopping, "REOPEN_S", 0.2
        )
        assert main(["stop", "--config", str(rig.path)]) == 3
    assert stopped(rig) == ALL
    assert "NOTHING WAS STOPPED" in capsys.readouterr().out


# Its own reading says what the schema's does


@pytest.mark.parametrize("name", available_maps())
def test_a_map_is_read_as_its_schema_reads_it(name):
    theirs, faults = load_map(name), []
    text = (MAP_FOLDER / f"{name}.toml").read_text()
    mine = stop_config.map_of(text, MAP_FOLDER, faults)
    assert not faults
    for key in ("name", "drive", "settings", "restart_s", "inter_frame_s"):
        assert getattr(mine, key) == getattr(theirs, key), key
    if theirs.drive != "modbus":
        return
    for key in ("word_order", "broadcast_stop", "home_place"):
        assert getattr(mine, key) == getattr(theirs, key), key
    for key in ("stop", "hold"):
        frames = [
            [(f.address, f.function, f.words) for f in table.write] if table else None
            for table in (getattr(mine, key), getattr(theirs, key))
        ]
        assert frames[0] == frames[1], key
    for word in range(1 << 16):
        if word % 251 == 0 or word < 256:
            assert mine.status.flags(word) == theirs.status.flags(word)
    places = [(r.address, r.type, r.count) for m in (mine, theirs)
              for r in (m.status, m.position)]  # fmt: skip
    assert places[:2] == places[2:] and FLAGS


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.toml")), ids=lambda p: p.stem)
def test_a_file_is_read_as_its_schema_reads_it(path, tmp_path):
    theirs, mine = load_config(path), stop_config.read_file(path)
    assert not mine.faults and not mine.lost
    known = theirs.bus.model_dump()
    assert vars(mine.bus) == known and mine.bus.where == theirs.bus.where
    assert mine.silence_s == theirs.silence_s
    rows = [[(a.name, a.unit, a.map.name) for a in c.axes] for c in (mine, theirs)]
    assert sorted(rows[0]) == sorted(rows[1])


PIECES = [
    b'"', b"[", b"]", b"{", b"}", b"\n", b"[bus]\n", b"[[axes]]\n", b"axes = 3\n", b"'",
    b'"""', b"=", b"[axes.x]\n", b"bus = 4\n", b"stop = 1\n", b"[stop.write]\n",
]  # fmt: skip


@pytest.mark.parametrize(
    "count", [pytest.param(400, id="quick"),
              pytest.param(20_000, id="full", marks=pytest.mark.slow)]
)  # fmt: skip
def test_whatever_becomes_of_a_file_it_is_read_as_far_as_it_goes(count, tmp_path):
    """No change of its bytes raises anything, and most leave all three axes."""
    rng, whole = random.Random(count), 0
    files = [(EXAMPLES / "leadshine_pr.toml").read_bytes(),
             (MAP_FOLDER / "leadshine_pr.toml").read_bytes()]  # fmt: skip
    for number in range(count):
        data = bytearray(files[number % 2])
        for _ in range(rng.randint(1, 4)):
            place = rng.randrange(len(data))
            match rng.randrange(4):
                case 0:
                    data[place] = rng.randrange(256)
                case 1:
                    data[place:place] = rng.choice(PIECES)
                case 2:
                    del data[place : place + rng.randint(1, 40)]
                case 3:
                    data[place:place] = data[: rng.randint(1, 80)]
        path = tmp_path / "rig.toml"
        path.write_bytes(data)
        if number % 2:
            stop_config.map_of(data.decode(errors="replace"), tmp_path, [])
            continue
        found = stop_config.read_file(path)
        whole += found.bus is not None and len(found.axes) == 3
    assert whole > 0.5 * count / 2, whole


def test_what_a_session_armed_is_read_as_its_file(rig, folder):
    _armed(rig)
    armed = json.loads(_lock_of(rig).armed_path.read_text())
    mine, file = stop_config.read_armed(armed), stop_config.read_file(rig.path)
    assert vars(mine.bus) == vars(file.bus) and not mine.faults
    assert [a.unit for a in mine.axes] == [a.unit for a in file.axes]


def test_the_disk_is_full(rig, tmp_path):
    """Nothing can be written, neither words nor lock."""
    shutil.copy(rig.path, tmp_path / "r.toml")
    code = ("import resource, signal, sys; "
            "signal.signal(signal.SIGXFSZ, signal.SIG_IGN); "
            "resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0)); "
            f"sys.argv = ['x', 'stop', '--config', {str(tmp_path / 'r.toml')!r}]; "
            "from rig.__main__ import main; sys.exit(main())")  # fmt: skip
    with open("/dev/full", "w") as full:
        done = subprocess.run([sys.executable, "-c", code], stdout=full, stderr=full)
    assert done.returncode == 0
    assert stopped(rig) == ALL
