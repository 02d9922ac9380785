"""The robot's twin: closed form against MuJoCo, and the error that each flaw causes.

    python benchmarks/robot_twin.py

Prints the tables of docs/robot.md: how far the closed form and MuJoCo are apart, the
residual of the best A and b under a wrong Euler order, a misaligned phone, play and
compliance, how often the intervals of dataset0 hold Table 1, and the seconds it takes.
"""

from __future__ import annotations

import time

import numpy as np

import jaxcal
from benchmarks.paper.datasets import BIAS_DEG, SCALE, make_dataset
from benchmarks.paper.twin import ORDERS, RobotConfig, read_out, simulate

GROUPS, LENGTH = 20, 50


def commands_deg(seed: int, groups: int = GROUPS) -> np.ndarray:
    """(groups, 50, 3) uniform in -20 to 20 degrees."""
    return np.random.default_rng(seed).uniform(-20.0, 20.0, (groups, LENGTH, 3))


def left_over(commands: np.ndarray, read: np.ndarray) -> tuple[float, float, float]:
    """Residual rms and max of the best A and b, largest off-diagonal of A."""
    rows, values = commands.reshape(-1, 3), read.reshape(-1, 3)
    found = jaxcal.identify(rows, values)
    rest = values - found.predict(rows)
    off = np.abs(found.matrix[~np.eye(3, dtype=bool)]).max()
    return float(np.sqrt((rest**2).mean())), float(np.abs(rest).max()), float(off)


def agreement() -> None:
    """MuJoCo, settled, against the closed form of a stiff robot."""
    crooked = RobotConfig(
        mechanism_order="YXZ", read_out_order="ZXY", mounting_deg=(3.0, -2.0, 4.0)
    )
    robots = {"ideal, Table 1": RobotConfig(), "wrong order, askew": crooked}
    commands = commands_deg(0)
    print(f"closed form against MuJoCo, {GROUPS} groups of {LENGTH} postures, degrees")
    for name, config in robots.items():
        apart = np.abs(simulate(config, commands) - read_out(config, commands))
        print(f"  {name:<20} max {apart.max():.1e}  median {np.median(apart):.1e}")


def flaws() -> None:
    """What no A and b can take away."""
    commands = commands_deg(1)
    print("\nresidual of the best A and b: rms, max (deg); largest off-diagonal of A")
    for scale, bias, name in (
        ((1.0, 1.0, 1.0), (0.0, 0.0, 0.0), "unit scale, no bias"),
        (tuple(SCALE), tuple(BIAS_DEG), "Table 1"),
    ):
        print(f"  axes YXZ (yaw outermost), {name}")
        for order in ORDERS:
            config = RobotConfig(scale, bias, "YXZ", order)
            rms, top, off = left_over(commands, read_out(config, commands))
            print(f"    read as {order}: {rms:.4f}, {top:.3f}; {off:.4f}")
    turned = RobotConfig(mounting_deg=(3.0 / np.sqrt(3.0),) * 3)
    noise = np.random.default_rng(2).normal(0.0, 0.1, commands.shape)
    rows = {
        "phone misaligned by 3 deg about (1, 1, 1)": read_out(turned, commands),
        "noise of 0.1 deg": read_out(RobotConfig(), commands) + noise,
    }
    for name, config in (
        ("play of 0.5 deg, random order", RobotConfig(backlash_deg=0.5)),
        ("compliance 0.14 deg/Nm, 1 kg", RobotConfig(compliance_deg_per_nm=0.14)),
        ("compliance 0.95 deg/Nm, 1 kg", RobotConfig(compliance_deg_per_nm=0.95)),
    ):
        rows[f"{name}, in MuJoCo"] = simulate(config, commands)
    print("  Table 1, axes and read-out XYZ")
    for name, read in rows.items():
        rms, top, off = left_over(commands, read)
        print(f"    {name}: {rms:.4f}, {top:.3f}; {off:.4f}")


def intervals() -> None:
    """How often the 95 % intervals of dataset0 hold Table 1."""
    truth = np.concatenate([np.diag(SCALE).ravel(), BIAS_DEG])
    started = time.perf_counter()
    data = make_dataset("dataset0")
    seconds = time.perf_counter() - started
    assert data.measured is not None and data.ranges is not None
    commands, read = data.ranges.denormalise(data.candidates), data.measured

    def held(rows: np.ndarray, values: np.ndarray) -> np.ndarray:
        low, high = jaxcal.identify(rows, values).confidence_intervals().T
        return (low < truth) & (truth < high)

    whole = held(commands.reshape(-1, 3), read.reshape(-1, 3))
    each = np.array([held(*group) for group in zip(commands, read, strict=True)])
    print(f"\ndataset0, seed 0: made in {seconds:.1f} s")
    print(f"  all 10,000 postures: {whole.sum()} of 12 intervals hold Table 1")
    print(
        f"  each of 200 groups: {each.mean():.3f} of the intervals, all twelve in "
        f"{each.all(axis=1).mean():.2f} of the groups (0.95^12 = {0.95**12:.2f})"
    )


if __name__ == "__main__":
    agreement()
    flaws()
    intervals()
