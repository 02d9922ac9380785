"""Lines of each room of the code: `python docs/tools/rooms.py` prints the table."""

from __future__ import annotations

import pathlib

ROOT = pathlib.Path(__file__).parents[2]
# The first that a file lies in counts.
ROOMS = {
    "arms": (
        "jaxcal/arms",
        "jaxcal/arms/sensors",
        "jaxcal/commands/arms.py",
        "jaxcal/commands/postures.py",
    ),
    "closed loop": ("jaxcal/adaptive",),
    "rig": ("rig",),
    "mission": ("jaxcal", "train.py", "evaluate.py"),
}


def lines_of_rooms() -> dict[str, int]:
    """Lines of Python in each room."""
    lines = dict.fromkeys(ROOMS, 0)
    patterns = ("*.py", "jaxcal/**/*.py", "rig/**/*.py")
    for path in (path for pattern in patterns for path in ROOT.glob(pattern)):
        name = path.relative_to(ROOT).as_posix()
        for room, places in ROOMS.items():
            if any(name == place or name.startswith(f"{place}/") for place in places):
                lines[room] += len(path.read_text().splitlines())
                break
    return lines


if __name__ == "__main__":
    for room, lines in lines_of_rooms().items():
        print(f"{room:12} {lines:6,}")
