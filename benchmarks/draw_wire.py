"""A real draw wire: an IRB 120, 1,042 lengths, whose wire's zero jumps twice.

  python benchmarks/draw_wire.py RobotCali-new.csv

The file is the first sheet of RobotCali-new.xlsx (Lizhibing1490183152/RobotCali), as
CSV: x, y, z, q1 to q6 in degrees, L in mm. Nothing of it is in this repository.
Printed are errors of lengths that were not used, with the table as it stands and after
the offsets that the verdict names are taken off, one after another.
"""

from __future__ import annotations

import argparse
import re
import warnings

import numpy as np

import jaxcal
from jaxcal.models import Distance, SerialChain

DH = [  # a, alpha, d, theta of the makers' sheet, mm and degrees
    (0, -90, 290, 0),
    (270, 0, 0, -90),
    (70, -90, 0, 0),
    (0, 90, 302, 0),
    (0, -90, 0, 0),
    (0, 0, 72, 180),
]


def held_out(arm: SerialChain, joints, lengths, rows) -> str:
    """Errors of the other rows, of a fit of these."""
    fit = jaxcal.identify(joints[rows], lengths[rows], model=arm)
    others = np.setdiff1d(np.arange(len(joints)), rows)
    off = fit.predict(joints[others]) - lengths[others]
    rms, median = np.sqrt((off**2).mean()), np.median(np.abs(off))
    word = "good" if fit.verdict.good else "not good"
    return f"rms {rms:.3f} mm, median {median:.3f}, {word}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file")
    table = np.genfromtxt(parser.parse_args().file, delimiter=",", skip_header=1)
    joints, lengths = table[:, 3:9], table[:, 9:10]
    arm = SerialChain.from_dh(DH, sensor=Distance(1))
    warnings.simplefilter("ignore", jaxcal.CalibrationWarning)
    mixed = np.random.default_rng(0).permutation(len(joints))
    for turn in range(4):
        print(f"half, {turn} offsets taken off:", end=" ")
        print(held_out(arm, joints, lengths, np.sort(mixed[: len(mixed) // 2])))
        found = jaxcal.identify(joints, lengths, model=arm).mispairing
        jump = found and re.search(r"from row (\d+) on .* by \((.*?)\)", found.reason)
        if not jump:
            break
        first, size = int(jump[1]), float(jump[2])
        print(f"  from row {first} on another offset, by {size:.3f}")
        lengths = lengths - size * (np.arange(len(lengths)) >= first)[:, None]
    for seed in range(4):
        rows = np.random.default_rng(seed).permutation(len(joints))[:60]
        print(f"60, draw {seed}:", held_out(arm, joints, lengths, np.sort(rows)))


if __name__ == "__main__":
    main()
