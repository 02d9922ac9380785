"""``python -m jaxcal.paper.datasets.record``: record Datasets 4 and 5 in simulation.

Runs ``python -m rig collect --simulate`` twice, in processes of their own: the rig's
whole path from the plan to the settled reading, over Modbus and TCP on loopback, with
the simulator's mechanism, play, noise and a heading that drifts. Its axes are ten times
as fast as a device's, so the drift is as well. Threads and sockets take their own time:
the postures come out the same again, the last digits of the readings do not.
"""

from __future__ import annotations

import datetime
import hashlib
import json
import pathlib
import platform
import subprocess
import sys
import tempfile
import time

from jaxcal.arguments import Parser
from jaxcal.files import atomic_write, require_writable_folder, write_text
from jaxcal.paper import command
from jaxcal.paper.constants import RANGES
from jaxcal.paper.datasets.data_card import ranges_of

__all__ = ["main", "record"]

SESSIONS = {"dataset4": (500, 4), "dataset5": (50, 5)}  # postures, seed
CONDITIONS = {
    "noise_deg": 0.05,  # of a single reading; 25 are averaged
    "backlash_deg": 0.2,  # of each joint, on the drive's side
    "drift_deg_per_min": 0.2,  # of the phone's heading
    "speedup": 10.0,  # of the axes
    "rate_hz": 250.0,  # of the phone
}
_FLAGS = ("--noise", "--backlash", "--drift", "--speedup", "--rate")


def record(name: str, folder: pathlib.Path, count: int | None = None) -> pathlib.Path:
    """Record one dataset through the rig: ``name``.csv and its data card; the CSV.

    Raises:
        OSError: the folder cannot be written.
        RuntimeError: the rig's session failed.
    """
    postures, seed = SESSIONS[name]
    postures = count or postures
    with tempfile.TemporaryDirectory() as place:
        work = pathlib.Path(place)
        example = _rig("example", "simulate", capture=True)
        config = work / "rig.toml"
        config.write_text(f"{example}\n[session]\nseed = {seed}\n", encoding="utf-8")
        arguments = ["collect", "--simulate", "--count", str(postures)]
        for flag, value in zip(_FLAGS, CONDITIONS.values(), strict=True):
            arguments += [flag, f"{value:g}"]
        started = time.monotonic()
        _rig(*arguments, "--config", str(config), "--out", str(work / "runs"))
        seconds = time.monotonic() - started
        data = next((work / "runs").glob("*/pairs.csv")).read_bytes()
    path = folder / f"{name}.csv"
    with atomic_write(path) as file:
        file.write(data)
    card = {
        "schema": 1,
        "name": name,
        "what": "recorded through the rig's own code against its simulator: SIMULATED "
        "drives, mechanism and phone, no device",
        "command": f"python -m jaxcal.paper.datasets.record --out DIR {name}",
        "rig": "python -m rig " + " ".join(arguments),
        "rig_seed": seed,
        "conditions": CONDITIONS,
        "truth": "rig.simulator.Truth: Table 1 with cross-coupling of up to 0.015",
        "postures": data.count(b"\n") - 1,
        "columns": "u_deg_*: command of the whole pulses sent; y_deg_*: mean of "
        "`samples` settled readings against the zero posture; "
        "std_deg_*: of one reading",
        "ranges_deg": ranges_of(RANGES),
        "recorded": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "seconds": round(seconds, 1),
        "python": platform.python_version(),
        "sha256": hashlib.sha256(data).hexdigest(),
    }
    write_text(path.with_suffix(".json"), json.dumps(card, indent=2) + "\n")
    return path


def _rig(*arguments: str, capture: bool = False) -> str:
    """Run a command of the rig; what it printed, if that is wanted."""
    done = subprocess.run(
        [sys.executable, "-m", "rig", *arguments],
        stdout=subprocess.PIPE if capture else None,
        encoding="utf-8",
        check=False,
    )
    if done.returncode:
        raise RuntimeError(
            f"python -m rig {arguments[0]} ended with exit code {done.returncode}"
        )
    return done.stdout or ""


def main(arguments: list[str] | None = None) -> int:
    """Record; the exit code."""
    parser = Parser(
        prog="python -m jaxcal.paper.datasets.record",
        description="Record Datasets 4 and 5 through the rig against its simulator "
        "(550 postures, about three and a half minutes).",
    )
    name = command.one_of(SESSIONS)
    about = "dataset4, dataset5"
    parser.add_argument("names", nargs="*", type=name, metavar="NAME", help=about)
    parser.add_argument("--out", type=pathlib.Path, required=True, metavar="DIR")
    options = parser.parse_args(arguments)

    def write() -> None:
        require_writable_folder(options.out)
        options.out.mkdir(parents=True, exist_ok=True)
        for name in options.names or SESSIONS:
            print(f"saved: {record(name, options.out)}")

    return command.run(write, "record", "files already named are complete")


if __name__ == "__main__":
    sys.exit(main())
