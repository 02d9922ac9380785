"""What is made of recorded runs: refit, report, export, trend."""

import csv
import hashlib
import json
import re
import shutil
import socket
import subprocess
import threading

import numpy as np
import pytest
from harness import (
    QUIET,
    Run,
    Simulator,
    calibrate,
    changed,
    commissioned,
    fast_config,
    fast_text,
    no_figures,
    run_safely,
    session,
    simulator,
)
from scipy.optimize import lsq_linear

import jaxcal
from rig.__main__ import main
from rig.config import AXIS_NAMES, parse_config
from rig.faults import Refused
from rig.journal.run_folder import read_journal
from rig.outputs.messages import numbers
from rig_workbench.outputs.export import LANGUAGES, follow, load_inverse
from rig_workbench.outputs.export import checksum as checksum_of
from rig_workbench.outputs.report import write_report
from rig_workbench.simulator import Truth

TRUTH = np.column_stack([Truth().matrix, Truth().bias])
SESSION = '\n[session]\nmethod = "exact"\nverify_postures = 2\n'
WRONG = 'order = "ZYX"'  # of the joints, where ZXY is right


def run_in(folder, text, truth=None, serve=None):
    """A calibration in a folder with its rig.toml; the exit code."""
    folder.mkdir(parents=True)
    (folder / "rig.toml").write_text(text)
    config = parse_config(text)
    with Simulator(serve or config, truth or Truth(noise_deg=0.01)) as sim:
        served = sim.start()
        mended = changed(config, bus=served.bus, imu=changed(
            config.imu, port=0, host="127.0.0.1"))  # fmt: skip
        return session(mended, folder, sim)


@pytest.fixture(autouse=True)
def quick_pages():
    """Without figures, which take most of the time."""
    with no_figures():
        yield


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A calibration under a wrong mechanism order: done, but it says recalibrate."""
    runs = tmp_path_factory.mktemp("runs")
    right = fast_config()
    text = fast_text({'order = "ZXY"': WRONG}, SESSION)
    assert run_in(runs / "run", text, serve=right) == 1
    return runs / "run"


@pytest.fixture
def run(finished, tmp_path):
    """A copy in a folder of its own, so that a test may add runs beside it."""
    return shutil.copytree(finished, tmp_path / "run")


def beside(run, kind="refit"):
    return [path for path in run.parent.iterdir() if path.name.startswith(kind)]


def found(folder):
    summary = json.loads((folder / "summary.json").read_text())
    return np.column_stack([summary["A"], summary["b"]])


def files(folder):
    return {path: path.read_bytes() for path in folder.iterdir()}


def rewritten(run, change):
    """The journal with every record changed, None leaving it out, numbered anew."""
    kept = [change(r) for r in read_journal(run / "journal.jsonl")]
    kept = [record for record in kept if record is not None]
    lines = [json.dumps(r | {"seq": i}) + "\n" for i, r in enumerate(kept)]
    (run / "journal.jsonl").write_text("".join(lines))


@pytest.mark.slow
def test_refit_mends_a_wrong_order_without_new_recording(run, capsys):
    before = files(run)
    assert np.abs(found(run) - TRUTH).max() > 0.05
    assert main(["refit", str(run), "--order", "ZXY"]) == 0
    said = capsys.readouterr().out
    assert 'mechanism.order = "ZXY"  # was "ZYX"' in said
    (folder,) = beside(run)
    assert np.abs(found(folder) - TRUTH)[:, :3].max() < 0.01
    np.testing.assert_allclose(found(folder)[:, 3], TRUTH[:, 3], atol=0.05)
    assert files(run) == before  # nothing in the run was touched
    loaded = jaxcal.Calibration.load(folder / "calibration.json")
    assert loaded.provenance["notes"]["device"]["mechanism.order"] == "ZXY"
    page = (folder / "report.html").read_text()
    assert "Identified anew from run" in page and "as recorded" in page
    assert main(["refit", str(run)]) == 1  # as it was, again beside
    assert len(beside(run)) == 2
    capsys.readouterr()
    assert main(["refit", str(folder)]) == 2
    assert "pass that run instead" in capsys.readouterr().err


def test_refit_says_why_it_refuses(run, capsys, tmp_path):
    assert main(["refit", str(tmp_path / "none"), "--order", "ZXY"]) == 2
    dropped = []

    def cut(record):
        if record["event"] == "posture" and len(dropped) < 10:
            dropped.append(record)
            return None
        return record

    rewritten(run, cut)
    assert main(["refit", str(run), "--order", "ZXY"]) == 2
    assert "Finish it first with `jaxcal-rig resume`" in capsys.readouterr().err
    assert not beside(run)


# Drift in a session


@pytest.mark.slow
def test_a_heading_that_drifts_is_taken_out_of_a_session(tmp_path):
    truth = Truth(noise_deg=0.0, drift_deg_per_min=3.0)
    assert run_in(tmp_path / "run", fast_text(session=SESSION), truth) == 0
    summary = json.loads((tmp_path / "run/summary.json").read_text())
    assert summary["drift"]["corrected"] and len(summary["drift"]["minutes"]) == 3
    assert max(map(abs, summary["drift"]["turn_deg_per_min"])) == pytest.approx(3, 0.1)
    rows = [*csv.DictReader((tmp_path / "run/pairs.csv").open())]
    chosen = [row for row in rows if row["role"] == "select"]
    u, y = ([[float(row[f"{what}_deg_{axis}"]) for axis in AXIS_NAMES]
             for row in chosen] for what in "uy")  # fmt: skip
    plain = jaxcal.identify(u, y)
    left = np.abs(found(tmp_path / "run") - TRUTH).max(axis=0)
    before = np.abs(np.column_stack([plain.matrix, plain.bias]) - TRUTH).max(axis=0)
    assert (left < 0.3 * before).all()


def test_a_run_of_an_earlier_version_is_refused(run, capsys):
    rewritten(run, lambda record: record | {"schema": 1})
    for command in (["report"], ["refit"], ["export", "--to", "c"], ["resume"]):
        assert main([command[0], str(run), *command[1:]]) == 2
        assert "by an earlier version of jaxcal" in capsys.readouterr().err


def test_a_journal_keeps_every_reading_in_little_room(finished):
    records = read_journal(finished / "journal.jsonl")
    postures = [r for r in records if r["event"] in ("posture", "zero")]
    assert len(postures) == 11
    for record in postures:
        assert np.shape(record["quaternions"]) == (record["samples"], 4)
        assert len(record["stamps"]) == record["samples"]
        raw = {key: record[key] for key in ("quaternions", "stamps")}
        assert len(json.dumps(raw, separators=(",", ":"))) < 80 * record["samples"]


# Report of every kind of run


@pytest.mark.parametrize("kept", [1, 4, 12, 30, 10_000])
def test_a_report_says_what_there_is_of_an_unfinished_run(run, finished, kept):
    lines = (run / "journal.jsonl").read_text().splitlines(keepends=True)
    (run / "journal.jsonl").write_text("".join(lines[:kept]))
    if kept < len(lines):
        (run / "summary.json").unlink()
    assert main(["report", str(run)]) == 0
    page = (run / "report.html").read_text()
    if kept < len(lines):
        assert "killed, or a power failure" in page
        assert "y = A u + b" not in page
    else:
        assert "Done: recalibrate" in page and "session.verify_limit_deg" in page
        text = re.sub(r"<[^>]*>", "|", page)
        assert re.search(r"\|posture \d+\|", text) and "select:" not in text
        assert re.search(r"\|u pitch\|+\s*\|*u yaw\|", text)
        summary = json.loads((run / "summary.json").read_text())
        cell = f"{summary['A'][2][1]:.5f} ± {summary['ci95'][2][1]:.5f}"
        assert f"|{cell}|" in text
    own = (finished / "report.html").read_text()  # written before the last record
    assert "All measurements are made" in own and "killed" not in own
    measured = sum('"event":"posture"' in line for line in lines[:kept])
    assert (f"{measured} measured" in page) == (measured > 0)


@pytest.mark.slow
def test_reports_of_collect_verify_and_goto(run, tmp_path, capsys):
    (tmp_path / "rig.toml").write_text((run / "rig.toml").read_text())
    given = ["--config", str(tmp_path / "rig.toml"), "--simulate", *QUIET]
    given += ["--noise", "0"]
    out = ["--out", str(tmp_path / "more")]
    assert main(["collect", *given, *out, "--count", "3"]) == 0
    assert main(["verify", str(run), *given, *out, "--count", "1"]) in (0, 1)
    assert main(["goto", str(run), *given, *out, "--use", "--to", "1", "-4", "2"]) == 0
    capsys.readouterr()
    folders = sorted((tmp_path / "more").iterdir())
    assert [path.name.split("-")[0] for path in folders] == [
        "collect", "goto", "verify"
    ]  # fmt: skip
    for folder in folders:
        assert main(["report", str(folder)]) == 0
        page = (folder / "report.html").read_text()
        assert "measured [deg]" in page and "<p>Done" in page
        assert folder.name in page
        assert ("error before" in page) == folder.name.startswith("verify")


def test_a_refused_sender_is_in_the_journal_and_in_the_report(run):
    records = read_journal(run / "journal.jsonl")
    told = {"event": "sender_refused", "time": 0.0, "reason": "refused 10.0.0.9"}
    page = write_report(run, [*records, told]).read_text()
    assert "refused 10.0.0.9" in page


# Export


@pytest.fixture(scope="module")
def inverse(finished):
    return load_inverse(finished, read_journal(finished / "journal.jsonl"))


def targets(finished, rng, count=200):
    """Desired postures, half of them out of reach, and what command_for says."""
    calibration = jaxcal.Calibration.load(finished / "calibration.json")
    desired = rng.uniform(-15, 15, (count, 3))
    limits = [[-20, 20]] * 3
    free = calibration.command_for(desired)
    return desired, calibration.command_for(desired, limits, clip=True), free


def at_limit(commands):
    return np.isclose(np.abs(commands), 20, rtol=0, atol=1e-9)


PROGRAM = r"""
#include <stdio.h>
#include "calibration.h"
int main(void) {
    double d[3], u[3];
    float df[3], uf[3];
    int32_t p[3], pf[3];
    while (scanf("%lf %lf %lf", d, d + 1, d + 2) == 3) {
        for (int i = 0; i < 3; ++i) { u[i] = 99; p[i] = 77; df[i] = (float)d[i]; }
        int s = jaxcal_command(d, u, p), sf = jaxcal_commandf(df, uf, pf);
        printf("%d %.17g %.17g %.17g %d %d %d %d", s, u[0], u[1], u[2], p[0], p[1],
               p[2], sf);
        printf(" %.9g %.9g %.9g\n", uf[0], uf[1], uf[2]);
    }
    return jaxcal_command(d, 0, 0) == 16;
}
"""


@pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc is not installed")
def test_the_c_header_computes_what_command_for_does(finished, inverse, rng, tmp_path):
    (tmp_path / "calibration.h").write_text(LANGUAGES["c"](inverse))
    (tmp_path / "main.c").write_text(PROGRAM)
    flags = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic"]
    subprocess.run(
        ["gcc", *flags, "main.c", "-o", "main"], cwd=tmp_path, check=True,
        capture_output=True,
    )  # fmt: skip
    desired, clipped, free = targets(finished, rng)
    given = "".join(f"{a!r} {b!r} {c!r}\n" for a, b, c in desired.tolist())
    given += "nan 0 0\n0 inf 0\n"
    out = subprocess.run(
        [tmp_path / "main"], input=given, text=True, capture_output=True, check=True
    ).stdout
    rows = np.array([list(map(float, line.split())) for line in out.splitlines()])
    values, odd = rows[: len(desired)], rows[len(desired) :]
    np.testing.assert_allclose(values[:, 1:4], clipped, atol=1e-12)
    held = at_limit(clipped) @ [1, 2, 4]
    assert values[:, 0].tolist() == held.tolist() == values[:, 7].tolist()
    assert 0 < np.mean(held > 0) < 1
    assert ((held > 0) == (np.abs(free) > 20).any(axis=1)).all()
    config = fast_config()
    assert values[:, 4:7].tolist() == [list(config.to_pulses(u)) for u in clipped]
    np.testing.assert_allclose(values[:, 8:11], clipped, atol=2e-5)  # of float
    assert odd[:, 0].tolist() == [8, 8]  # the last command stays
    assert odd[:, 1:7].tolist() == [[99, 99, 99, 77, 77, 77]] * 2


@pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc is not installed")
@pytest.mark.parametrize("count", [1, 2, 4])
def test_the_c_header_finds_the_nearest_posture_of_any_axes(count, inverse, tmp_path):
    """Of axes that depend on each other clipping each by itself is far from it."""
    rng = np.random.default_rng(count)
    matrix = rng.normal(size=(count, count))
    if count == 2:
        matrix = np.array([[1.0, 0.9], [0.9, 1.0]])
    given = {
        "matrix": np.linalg.inv(matrix).tolist(), "offset_deg": [0.0] * count,
        "min_deg": [-1.0] * count, "max_deg": [1.0] * count,
        "pulses_per_deg": [100.0] * count, "min_pulses": [-100] * count,
        "max_pulses": [100] * count, "follow": follow(matrix).tolist(),
        "forward": np.column_stack([matrix, np.zeros(count)]).tolist(),
        "axes": [f"axis{i}" for i in range(count)],
        "outputs": [f"y{i}" for i in range(count)],
    }  # fmt: skip
    (tmp_path / "calibration.h").write_text(LANGUAGES["c"](inverse | given))
    read = "".join(f' && scanf("%lf", d + {i}) == 1' for i in range(count))
    (tmp_path / "main.c").write_text(
        '#include <stdio.h>\n#include "calibration.h"\n'
        f"int main(void) {{ double d[{count}], u[{count}]; while (1{read}) {{"
        'printf("%d", jaxcal_command(d, u, 0));'
        f'for (int i = 0; i < {count}; ++i) printf(" %.17g", u[i]);'
        'printf("\\n"); } return 0; }'
    )
    subprocess.run(
        ["gcc", "-std=c99", "main.c", "-o", "main"], cwd=tmp_path, check=True
    )
    desired = np.concatenate(
        [[[2.5, 1.5, 0.5, 0][:count]], rng.normal(0, 2, (60, count))]
    )
    out = subprocess.run(
        [tmp_path / "main"],
        input="\n".join(" ".join(map(repr, y)) for y in desired.tolist()),
        text=True, capture_output=True, check=True,
    ).stdout  # fmt: skip
    rows = np.array([list(map(float, line.split())) for line in out.splitlines()])
    for y, (status, *u) in zip(desired, rows, strict=True):
        nearest = lsq_linear(matrix, y, (-1, 1), tol=1e-14).x
        assert np.abs(u).max() <= 1.0
        best = np.linalg.norm(matrix @ nearest - y)
        assert np.linalg.norm(matrix @ u - y) <= best + 1e-9
        held = np.isclose(np.abs(u), 1.0, rtol=0, atol=1e-12)
        assert status == held @ (1 << np.arange(count))
    if count == 2:
        np.testing.assert_allclose(rows[0], [3, 1, 1], atol=1e-12)


@pytest.mark.slow
def test_structured_text_parses(inverse):
    blark = pytest.importorskip(
        "blark", reason="blark, the parser of TwinCAT sources, is not installed"
    )
    text = LANGUAGES["st"](inverse)
    parsed = blark.parse_source_code(text)
    assert parsed.exception is None
    assert "FB_JaxcalCommand" in str(parsed.transform())


OPERATORS = {"AND": "and", "OR": "or", "NOT": "not", "MOD": "%", "TRUE": "True",
             "FALSE": "False", " / 3": " // 3"}  # fmt: skip


def translated(text):
    """The function block as Python, for its few kinds of statements."""
    text = re.sub(r"\(\*.*?\*\)", "", text, flags=re.S)
    declared, _, body = text.rpartition("END_VAR")
    lines, depth = [], 0
    for name, size, values in re.findall(
        r"(\w+) : ARRAY \[0\.\.(\d+)\] OF \w+(?: := \[(.*?)\])?;", declared, re.S
    ):
        lines.append(
            f"{name} = [{values}]" if values else f"{name} = [0] * {size} + [0]"
        )
    body = body.replace("END_FUNCTION_BLOCK", "").replace("DINT#", "")
    for word in ("THEN", "DO", "ELSE"):
        body = re.sub(rf"\b{word}\b", f"{word};", body)
    for statement in (" ".join(part.split()) for part in body.split(";")):
        python = re.sub(r"(?<![<>:])=", "==", statement).replace(":=", "=")
        for word, operator in OPERATORS.items():
            python = re.sub(rf"(?<!\w){word}\b", operator, python)
        depth -= statement.startswith(("END_", "ELS"))
        if loop := re.fullmatch(r"FOR (\w+) = (\d+) TO (\d+) DO", python):
            python = f"for {loop[1]} in range({loop[2]}, {loop[3]} + 1):"
        elif branch := re.fullmatch(r"(IF|ELSIF) (.*) THEN", python):
            python = f"{'if' if branch[1] == 'IF' else 'elif'} {branch[2]}:"
        elif statement == "ELSE":
            python = "else:"
        if statement and not statement.startswith("END_"):
            lines.append("    " * depth + python)
        depth += python.endswith(":")
    return "\n".join(lines)


def test_structured_text_computes_what_command_for_does(finished, inverse, rng):
    code = compile(translated(LANGUAGES["st"](inverse)), "ST", "exec")
    known = {
        "LIMIT": lambda low, value, high: min(max(low, value), high),
        "LREAL_TO_DINT": round,
    }
    config = fast_config()
    for y, clipped, free in zip(*targets(finished, rng, 40), strict=True):
        state = known | {f"desired_{n}": v for n, v in zip(AXIS_NAMES, y, strict=True)}
        exec(code, state)
        u = [state[f"command_{name}"] for name in AXIS_NAMES]
        np.testing.assert_allclose(u, clipped, atol=1e-12)
        pulses = tuple(state[f"pulses_{name}"] for name in AXIS_NAMES)
        assert pulses == config.to_pulses(clipped)
        clamped = [state[f"clamped_{name}"] for name in AXIS_NAMES]
        assert clamped == at_limit(clipped).tolist() and not state["not_finite"]
        assert any(clamped) == (np.abs(free) > 20).any()
    state["desired_yaw"], last = float("nan"), u
    exec(code, state)
    assert state["not_finite"]
    assert [state[f"command_{name}"] for name in AXIS_NAMES] == last


FIELDS = ("matrix", "offset_deg", "min_deg", "max_deg", "pulses_per_deg", "min_pulses",
          "max_pulses")  # fmt: skip


def checksum(values):
    numbers = [float(x) for name in FIELDS for x in np.ravel(values[name]).tolist()]
    return hashlib.sha256("\n".join(map(repr, numbers)).encode()).hexdigest()


def test_json_holds_the_numbers_and_their_checksum(inverse):
    data = json.loads(LANGUAGES["json"](inverse))
    assert data["checksum"] == checksum(data)
    assert data["device"]["axes.yaw.direction"] == -1
    for name in ("c", "st"):
        assert data["checksum"] in LANGUAGES[name](inverse)


def test_a_changed_number_changes_the_checksum(inverse):
    other = inverse | {"max_pulses": [1, 2, 3]}
    assert checksum_of(other) != checksum_of(inverse)


def test_no_name_of_a_run_or_a_map_ends_a_comment(inverse):
    wild = "a */ int x; *) \n \\"
    nasty = inverse | {"run": wild, "device": {wild: wild}, "warnings": [wild]}
    for name in ("c", "st"):
        comment = LANGUAGES[name](nasty).partition("*/" if name == "c" else "\n*)")[0]
        assert "x;" in comment.splitlines()[-1] and wild not in comment


@pytest.mark.parametrize(
    ("language", "comment"), [("c", r"/\*.*?\*/"), ("st", r"\(\*.*?\*\)")]
)
def test_no_unit_ends_a_comment(inverse, language, comment):
    """A unit is a text of rig.toml, and it stands in comments."""
    wild = "mm */ int evil; /* *) evil := 1; (*"
    nasty = inverse | {"output_unit": wild, "axis_unit": wild}
    text = LANGUAGES[language](nasty)
    left = re.sub(comment, "", text, flags=re.DOTALL)
    plain = re.sub(comment, "", LANGUAGES[language](inverse), flags=re.DOTALL)
    assert "evil" in text and left == plain


def test_a_name_that_is_no_name_is_refused(finished):
    """The journal may come from another person, so its names are not trusted."""
    records = read_journal(finished / "journal.jsonl")
    config = json.loads(json.dumps(records[0]["config"]))
    config["axes"][0]["name"] = "pitch; int evil"
    with pytest.raises(Refused, match="'pitch; int evil' is not the name"):
        load_inverse(finished, [records[0] | {"config": config}, *records[1:]])


def test_export_writes_over_no_record_that_it_reads(run, capsys):
    record = run / "calibration.json"
    before = record.read_bytes()
    for folder in (run, record):
        arguments = ["export", str(folder), "--to", "json", "--out", str(record)]
        assert main(arguments) == 2
        assert f"{record} is what is read (run); write to" in capsys.readouterr().err
    assert record.read_bytes() == before
    again = ["export", str(run), "--to", "c", "--out", str(run / "inverse.h")]
    assert main(again) == main(again) == 0


def test_export_prints_or_writes_and_warns(run, capsys, tmp_path):
    assert main(["export", str(run), "--to", "json"]) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["run"] == "run"
    assert "verify_limit_deg" in printed.err  # this one is not to be used
    path = tmp_path / "c.h"
    assert main(["export", str(run), "--to", "c", "--out", str(path)]) == 0
    assert "WARNING: the error" in path.read_text()
    (run / "calibration.json").unlink()
    for folder in (run, tmp_path / "none"):
        assert main(["export", str(folder), "--to", "c"]) == 2
    assert capsys.readouterr().err.count("jaxcal-rig: ") == 2


# Trend


def test_trend_tells_what_moved_and_separates_devices(run, capsys):
    later = shutil.copytree(run, run.parent / "later")
    summary = json.loads((later / "summary.json").read_text())
    summary["measured_at"] += 7 * 86400
    summary["b"][1] += 10.0  # the wrong order leaves intervals of 4
    summary["after"]["max"] = 0.1
    (later / "summary.json").write_text(json.dumps(summary))
    other = shutil.copytree(run, run.parent / "other")
    rewritten(
        other,
        lambda r: (
            r | {"device": r["device"] | {"axes.roll.reduction": 20.0}}
            if r["event"] == "start"
            else r
        ),
    )
    unreal = shutil.copytree(run, run.parent / "unreal")
    rewritten(
        unreal,
        lambda r: r | {"simulated": {"noise": 0.02}} if r["event"] == "start" else r,
    )
    unfinished = shutil.copytree(run, run.parent / "unfinished")
    (unfinished / "summary.json").unlink()
    broken = shutil.copytree(run, run.parent / "broken")
    (broken / "summary.json").write_text("{")
    assert main(["trend", str(run.parent)]) == 1  # the other device: recalibrate
    said = capsys.readouterr()
    assert said.out.count("device pitch") == 2
    assert said.out.count("device simulated: pitch") == 1
    assert "b[yaw] +10.0000" in said.out and "b[pitch]" not in said.out
    assert "the last calibration still holds" in said.out
    assert "RECALIBRATE: other" in said.out and "unfinished" not in said.out
    assert "broken" in said.err
    shutil.rmtree(other)
    shutil.rmtree(unreal)
    assert main(["trend", str(run.parent)]) == 0
    for name in ("prediction", "after"):  # nothing was held out
        summary.pop(name, None)
    summary["mispairing"] = "the readings from row 2 on are one row late"
    (later / "summary.json").write_text(json.dumps(summary))
    assert main(["trend", str(run.parent)]) == 1
    assert "RECALIBRATE: later: the readings from row 2" in capsys.readouterr().out
    assert main(["trend", str(unfinished)]) == 2
    assert main(["trend", str(run.parent / "none")]) == 2


def test_a_folder_of_runs_is_no_run(tmp_path, capsys):
    (tmp_path / "calibrate-1").mkdir()
    for command in (["report"], ["refit"], ["export", "--to", "c"], ["watch"]):
        assert main([command[0], str(tmp_path), *command[1:]]) == 2
        lack = f"{tmp_path} is not a run's folder: it has no journal.jsonl"
        assert lack in capsys.readouterr().err


def test_what_rounds_to_zero_has_no_sign():
    assert numbers([-0.0004, -0.0, 0.0004, -0.0006], 6, 3).split() == [
        "0.000", "0.000", "0.000", "-0.001"
    ]  # fmt: skip


def test_a_phone_beside_the_right_one_changes_nothing_in_a_session(tmp_path):
    """Two real senders: the second connects as soon as the port is open."""
    allowed = {"column_count = 4": 'column_count = 4\nallow = ["127.0.0.1"]'}
    config, ended = fast_config(allowed), threading.Event()
    (tmp_path / "run").mkdir()
    with simulator(config) as sim:
        folder = tmp_path / "run"
        known = commissioned(config, folder, sim)
        run = Run(sim.start(), folder, "calibrate", [].append, record=known)
        rogue = []

        def intrude(port):
            def send():
                while not ended.is_set():
                    made = socket.socket()
                    made.bind(("127.0.0.5", 0))
                    with made:
                        try:
                            made.connect(("127.0.0.1", port))
                            while not ended.wait(0.01):
                                made.sendall(b"1700000000000,90,10,10\r\n")
                        except OSError:
                            rogue.append("refused")

            threading.Thread(target=send, daemon=True).start()
            sim.start_phone(port)

        run.listeners.append(lambda r: r["event"] == "listening" and intrude(r["port"]))
        with no_figures():
            code = run_safely(run, calibrate)
        ended.set()
    assert code == 0 and rogue
    records = read_journal(tmp_path / "run/journal.jsonl")
    told = [r for r in records if r["event"] == "sender_refused"]
    assert [record["address"] for record in told] == ["127.0.0.5"]
    np.testing.assert_allclose(found(tmp_path / "run"), TRUTH, atol=1e-3)
