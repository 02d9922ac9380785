"""``jaxcal example``: files to try the commands with."""

from __future__ import annotations

import importlib.resources
import tempfile
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray

from jaxcal.files import require_writable_folder, write_text

Array = NDArray[np.float64]

_TABLE = """\
jaxcal select candidates.csv -k 6
jaxcal identify measured.csv --out calibration.json
jaxcal command calibration.json targets.csv --limits=-20,20"""
_ARM = """\
jaxcal select poses.csv -k 12 --model arm.urdf --noise 0.0001
jaxcal identify measured.csv --model arm.urdf --noise 0.0001 --out arm.json
jaxcal predict arm.json poses.csv"""
_DEVICE = "jaxcal-rig simulate calibrate --config rig.toml"
_LINKS = np.array([[0.09, 0.0], [0.42, 0.0], [0.39, 0.0], [0.11, 0.0]])  # x, z in m
_AXES = ["0 0 1", "0 1 0", "0 1 0", "1 0 0"]


def example(
    kind: Annotated[Literal["table", "arm", "device"], "what is calibrated"],
    *,
    folder: Annotated[Path, "where the files go"] = Path(),
) -> None:
    """Write small files to try the commands with, and print those commands.

    The readings come from a simulated machine with known errors. Existing files are not
    replaced.
    """
    files = {"table": _table, "arm": _arm, "device": _device}[kind]()
    for name in files:
        if (folder / name).exists():
            raise ValueError(f"{folder / name} exists; choose another --folder")
    require_writable_folder(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        write_text(folder / name, text)
    print(f"wrote {', '.join(files)}; now type")
    print({"table": _TABLE, "arm": _ARM, "device": _DEVICE}[kind])


def _csv(header: str, rows: Array) -> str:
    lines = (",".join(f"{value:.6g}" for value in row) for row in rows)
    return "\n".join([header, *lines, ""])


def _table() -> dict[str, str]:
    """Three axes in degrees; the best six of fifty rows were measured."""
    rng = np.random.default_rng(0)
    candidates = rng.uniform(-20.0, 20.0, (50, 3)).round(2)
    u = candidates[[1, 4, 19, 30, 31, 37]]
    y = u @ np.diag([0.43, 0.71, 0.87]) + [3.1, -5.8, 2.41]
    y += rng.normal(0.0, 0.05, y.shape)
    names = "u_pitch,u_yaw,u_roll,y_pitch,y_yaw,y_roll"
    return {
        "candidates.csv": _csv("pitch,yaw,roll", candidates),
        "measured.csv": _csv(names, np.hstack([u, y])),
        "targets.csv": _csv("pitch,yaw,roll", np.array([[2.0, -4.0, 3.0]])),
    }


def _urdf(links: Array) -> str:
    joints = []
    for i, ((x, z), axis) in enumerate(zip(links, _AXES, strict=True)):
        joints.append(
            f'  <joint name="j{i + 1}" type="revolute">\n'
            f'    <parent link="l{i}"/><child link="l{i + 1}"/>\n'
            f'    <origin xyz="{x:.6g} 0 {z:.6g}"/><axis xyz="{axis}"/>\n'
            '    <limit lower="-1.57" upper="1.57" effort="1" velocity="1"/>\n'
            "  </joint>\n"
        )
    joints.append(
        '  <joint name="flange" type="fixed">\n'
        '    <parent link="l4"/><child link="tool"/><origin xyz="0.1 0.05 0"/>\n'
        "  </joint>\n"
    )
    names = [*(f"l{i}" for i in range(len(links) + 1)), "tool"]
    bodies = "".join(f'  <link name="{name}"/>\n' for name in names)
    return f'<robot name="example">\n{bodies}{"".join(joints)}</robot>\n'


def _arm() -> dict[str, str]:
    """Four joints and a tracker, degrees and metres; links are 1 mm off (1 sigma)."""
    from jaxcal.arms.chain import SerialChain

    rng = np.random.default_rng(0)
    poses = rng.uniform(-85.0, 85.0, (100, 4)).round(2)  # the controller's, degrees
    nominal = _urdf(_LINKS)
    with tempfile.TemporaryDirectory() as hidden:
        path = Path(hidden, "true.urdf")
        path.write_text(_urdf(_LINKS + rng.normal(0.0, 0.001, _LINKS.shape)))
        true = SerialChain.from_urdf(path)
    measured = poses[:20]
    y = true.predict(measured) + rng.normal(0.0, 1e-4, (20, 3))
    return {
        "arm.urdf": nominal,
        "poses.csv": _csv("j1,j2,j3,j4", poses),
        "measured.csv": _csv(
            "u_j1,u_j2,u_j3,u_j4,y_x,y_y,y_z", np.hstack([measured, y])
        ),
    }


def _device() -> dict[str, str]:
    found = importlib.resources.files("rig").joinpath("examples", "simulate.toml")
    return {"rig.toml": found.read_text()}
