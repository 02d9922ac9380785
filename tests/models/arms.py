"""Arms and derivatives that the tests of models share."""

from __future__ import annotations

import pathlib

import numpy as np

from jaxcal.models import SerialChain

UR5 = pathlib.Path(__file__).parents[2] / "examples" / "ur5"

# The controller's lengths: with these the targets of the files come out to 0.003 mm.
UR5_TABLE = np.loadtxt(UR5 / "dh.csv", delimiter=",", skiprows=1).tolist()


def ur5(**options):
    return SerialChain.from_dh(UR5_TABLE, tool=(0, 0, 31), **options)


def ur5_data(name="ur5_grid_1000.csv"):
    """Commands (N, 6) in degrees, targets (N, 3) and measured points (N, 3) in mm."""
    rows = np.genfromtxt(UR5 / name, delimiter=",", names=True)
    targets = np.stack([rows[f"{axis}_t"] for axis in "xyz"], axis=1)
    errors = np.stack([rows[f"{axis}_dif"] for axis in "xyz"], axis=1)
    commands = np.stack([rows[f"joint_{i + 1}"] for i in range(6)], axis=1)
    return commands, targets, targets + errors


def differences(function, at, step=1e-4):
    """Central differences of ``function`` by each entry of ``at`` (d,): (..., d)."""
    columns = []
    for entry in np.eye(len(at)) * step:
        columns.append((function(at + entry) - function(at - entry)) / (2.0 * step))
    return np.stack(columns, axis=-1)


CONTACTS = UR5.parent / "contacts"


def contacts_of_a_panda(place):
    """URDF file, joints (N, 7) in radians and sockets (N,) of a real arm at a place."""
    rows = np.genfromtxt(
        CONTACTS / "panda_1.csv",
        delimiter=",",
        names=True,
        dtype=None,
        encoding="utf-8",
    )
    rows = rows[rows["place"] == place]
    joints = np.stack([rows[f"panda_joint{i + 1}"] for i in range(7)], axis=1)
    return CONTACTS / "panda.urdf", joints, rows["socket"]
