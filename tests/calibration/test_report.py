"""The report of a calibration: numbers by brute force, files, exit codes."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys

import numpy as np
import pytest

import jaxcal
from jaxcal.calibration.verdict import left_out
from jaxcal.commands import main
from jaxcal.reports.budget import Source
from jaxcal.reports.calibration import SCHEMA, leverage, moved


def table(path, rng, gain=0.71, rows=9):
    u = rng.uniform(-20.0, 20.0, (rows, 3))
    y = u @ np.diag([0.43, gain, 0.87]) + [3.1, -5.8, 2.41]
    y += rng.normal(0.0, 0.05, y.shape)
    names = "u_a,u_b,u_c,y_a,y_b,y_c"
    both = np.hstack([u, y])
    np.savetxt(path, both, delimiter=",", header=names, comments="")
    return u, y


@pytest.mark.filterwarnings("ignore:.*far outside the measurements")
def test_held_out_errors_and_leverage_are_those_of_fits_without_the_row(tmp_path, rng):
    u, y = table(tmp_path / "t.csv", rng)
    calibration = jaxcal.identify(u, y, noise_std=0.05)
    off = left_out(calibration)
    for i in range(len(u)):
        kept = np.arange(len(u)) != i
        without = jaxcal.identify(u[kept], y[kept], noise_std=0.05)
        assert off[i] == pytest.approx(y[i] - without.predict(u[i]), rel=1e-6)
    z = np.column_stack([u, np.ones(len(u))])
    hat = np.diag(z @ np.linalg.solve(z.T @ z, z.T))
    found = leverage(calibration)
    assert found == pytest.approx(np.tile(hat[:, None], 3))
    assert found.sum(axis=0) == pytest.approx([4.0, 4.0, 4.0]) and found.max() <= 1.0


def test_a_pipeline_reads_the_verdict_and_the_exit_code(tmp_path, rng, capsys):
    pytest.importorskip("jinja2")
    data, folder = tmp_path / "t.csv", tmp_path / "report"
    u, y = table(data, rng)
    saved = str(tmp_path / "c.json")
    asked = ["identify", str(data), "--out", saved, "--report", str(folder)]
    assert main(asked) == 0
    found = json.loads((folder / "verdict.json").read_text())
    assert found["good"] and found["exit_code"] == 0 and found["of"] == "identify"
    assert found["files"][str(data)] == hashlib.sha256(data.read_bytes()).hexdigest()
    inside = hashlib.sha256((folder / "calibration.json").read_bytes()).hexdigest()
    assert found["files"]["calibration.json"] == inside
    again = jaxcal.Calibration.load(folder / "calibration.json")
    wanted = jaxcal.Calibration.load(saved)
    assert again.parameters.tolist() == wanted.parameters.tolist()
    again.report(folder, sources=[Source("certificate", 0.01)])
    found = json.loads((folder / "verdict.json").read_text())
    assert [s["name"] for s in found["budget"]["sources"]] == ["noise", "certificate"]
    z = np.column_stack([u, np.ones(len(u))])
    off = y - z @ np.linalg.lstsq(z, y)[0]
    std = np.sqrt((off**2).sum(axis=0) / (len(u) - 4))
    rows = found["budget_of_predictions"]["results"]
    for result in rows:
        output, _, row = result["name"].partition(" at ")
        point = z[int(row)]
        one = std["abc".index(output[-1])]
        one *= np.sqrt(point @ np.linalg.solve(z.T @ z, point))
        assert result["combined"] == pytest.approx(np.hypot(one, 0.01), rel=1e-9)
    assert len(rows) == 6
    assert found["next_step"].startswith("use it")
    page = (folder / "index.html").read_text()
    for title in ("Verdict", "Parameters", "Predictions", "Residuals"):
        assert title in page
    assert "<script" not in page and "http" not in page.replace("http://www.w3", "")

    # The machine has changed: told by the comparison, and by a check.
    table(data, rng, gain=0.75)
    assert (
        main(["identify", str(data), "--report", str(folder), "--against", saved]) == 0
    )
    found = json.loads((folder / "verdict.json").read_text())
    times = {row["name"]: row["deviations"] for row in found["moved"]}
    assert abs(times["a22"]) > 5.0 and abs(times["a11"]) < 5.0
    assert main(["check", saved, str(data), "--report", str(folder)]) == 1
    found = json.loads((folder / "verdict.json").read_text())
    assert found["of"] == "check" and not found["good"] and found["exit_code"] == 1
    assert "does not hold" in (folder / "index.html").read_text()
    assert "does not hold" in capsys.readouterr().out

    # Too few rows are no good calibration; a table that is not there is bad input.
    data.write_text("".join(data.read_text().splitlines(keepends=True)[:5]))
    assert main(["identify", str(data), "--report", str(folder)]) == 1
    reasons = json.loads((folder / "verdict.json").read_text())["reasons"]
    assert reasons[0].startswith("no intervals, because the noise is unknown: 4 mea")
    assert main(["check", saved, str(tmp_path / "none.csv")]) == 2
    assert main(["identify", str(data), "--against", saved]) == 2


def test_a_verdict_is_of_its_schema(tmp_path, rng):
    pytest.importorskip("jinja2")
    jsonschema = pytest.importorskip("jsonschema")
    u, y = table(tmp_path / "t.csv", rng)
    for count in (9, 4):
        calibration = jaxcal.identify(u[:count], y[:count])
        calibration.report(tmp_path, before=jaxcal.identify(u, y))
        found = json.loads((tmp_path / "verdict.json").read_text())
        jsonschema.validate(found, SCHEMA)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(found | {"exit_code": 7}, SCHEMA)


def test_what_moved_is_counted_in_its_own_deviations(rng):
    # Two calibrations of one machine: the differences are standard normal.
    u = rng.uniform(-20.0, 20.0, (9, 2))
    truth = u @ np.array([[0.4, 0.1], [0.0, 0.7]]) + 1.0
    times = []
    for _ in range(200):
        one, two = (
            jaxcal.identify(u, truth + rng.normal(0.0, 0.05, u.shape), noise_std=0.05)
            for _ in range(2)
        )
        times.append([row["deviations"] for row in moved(two, one)])
    assert np.std(times) == pytest.approx(1.0, abs=0.06)
    other = jaxcal.identify(u[:, :1], truth[:, :1])
    with pytest.raises(ValueError, match="before must be a calibration of the same"):
        moved(one, other)


def test_a_report_loads_no_jax(tmp_path):
    code = (
        "import sys, numpy as np, jaxcal; u = np.random.default_rng(0).random((9, 2));"
        f"jaxcal.identify(u, 2 * u + 1, noise_std=1.0).report({str(tmp_path)!r});"
        "print([m for m in ('jax', 'matplotlib.pyplot') if m in sys.modules])"
    )
    shown = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert shown.stdout.strip() == "[]"
