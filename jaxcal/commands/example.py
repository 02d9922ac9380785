"""``jaxcal example``: files to try the commands with."""

from __future__ import annotations

import importlib.resources
from pathlib import Path
from typing import Annotated, Literal

from jaxcal.files import require_writable_folder, write_text

# table: three axes in degrees, noise 0.05; the best six of fifty rows were measured.
# arm: four joints and a tracker, degrees and metres; links are 1 mm off (1 sigma).
_COMMANDS = {
    "table": """\
jaxcal select candidates.csv -k 6
jaxcal identify measured.csv --out calibration.json
jaxcal command calibration.json targets.csv --limits=-20,20""",
    "arm": """\
jaxcal select poses.csv -k 12 --model arm.urdf --noise 0.0001
jaxcal identify measured.csv --model arm.urdf --noise 0.0001 --out arm.json
jaxcal predict arm.json poses.csv""",
    "device": "jaxcal-rig simulate calibrate --config rig.toml",
}


def example(
    kind: Annotated[Literal["table", "arm", "device"], "what is calibrated"],
    *,
    folder: Annotated[Path, "where the files go"] = Path(),
) -> None:
    """Write small files to try the commands with, and print those commands.

    The readings come from a simulated machine with known errors. Existing files are not
    replaced.
    """
    if kind == "device":
        device = importlib.resources.files("rig").joinpath("examples", "simulate.toml")
        files = {"rig.toml": device.read_text()}
    else:
        shipped = importlib.resources.files("jaxcal.commands").joinpath("examples")
        kinds = shipped.joinpath(kind).iterdir()
        files = {file.name: file.read_text() for file in kinds}
    for name in files:
        if (folder / name).exists():
            raise ValueError(f"{folder / name} exists; choose another --folder")
    require_writable_folder(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        write_text(folder / name, text)
    print(f"wrote {', '.join(sorted(files))}; now type")
    print(_COMMANDS[kind])
