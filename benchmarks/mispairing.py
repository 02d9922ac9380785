"""How often a table that was mispaired is told how, and a right one is left alone.

    python -m benchmarks.mispairing              # 20 seeds of each kind and model
    python -m benchmarks.mispairing --seeds 5

A table is spoilt in one way; it counts where the least-squares residual of the table
as spoilt is at least five times the noise. Found means that the sentence names the kind
and the row, to one; said, that something else is named.
"""

from __future__ import annotations

import argparse
import collections
import dataclasses
import pathlib
import re
import sys
import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

import jaxcal
from jaxcal.calibration.pairing import mispairing, of_new_readings
from jaxcal.models import FromFunction, Linear

sys.path.append(str(pathlib.Path(__file__).parents[1] / "examples"))

Array = NDArray[np.float64]
RATIO = 5.0


@dataclasses.dataclass
class Case:
    """A right table, and what identifies it."""

    commands: Array
    measured: Array
    options: dict  # of identify
    noise: float
    spare: tuple[Array, Array]  # more rows of the same machine


# -- models ---------------------------------------------------------------------------


def affine(rng: np.random.Generator, count: int) -> Case:
    n, m = rng.integers(1, 5), rng.integers(1, 5)
    n, m = (3, 3) if rng.random() < 0.4 else (n, m)
    matrix = rng.normal(size=(m, n)) + np.eye(m, n)
    spread = 10.0 ** rng.uniform(-1, 2)
    u = _commands(rng, count + 20, n) * spread + rng.normal() * spread
    noise = spread * 10.0 ** rng.uniform(-3, -1.2)
    y = u @ matrix.T + rng.normal(size=m) * spread
    y = y + noise * rng.normal(size=y.shape)
    return Case(u[:count], y[:count], {}, noise, (u[count:], y[count:]))


def _commands(rng: np.random.Generator, count: int, n: int) -> Array:
    way = rng.integers(4)
    if way == 0:
        return rng.uniform(-1, 1, (count, n))
    if way == 1:
        return rng.normal(size=(count, n))
    if way == 2:
        levels = rng.choice([-1.0, 0.0, 1.0], (count, n))
        return levels + 0.2 * rng.normal(size=n)
    return rng.permutation(np.linspace(-1, 1, count))[:, None] * np.ones(n) + 0.5 * (
        rng.normal(size=(count, n))
    )


def curved(rng: np.random.Generator, count: int) -> Case:
    model = Linear("1 + x + y + x:y + I(x**2)", 2)
    u = rng.uniform(-1, 1, (count + 20, 2))
    theta = rng.normal(size=model.num_parameters)
    noise = 10.0 ** rng.uniform(-3, -1.5)
    y = model.predict(u, theta) + noise * rng.normal(size=(count + 20, 2))
    return Case(u[:count], y[:count], {"model": model}, noise, (u[count:], y[count:]))


def _saturating(u: Array, theta: Array) -> Array:
    gain, rate, offset, slope = theta
    damped = slope * u[1] * np.exp(-rate * 0.5 * u[0] ** 2) + gain * 0.1
    return np.array([gain * np.tanh(rate * u[0]) + offset, damped])


def nonlinear(rng: np.random.Generator, count: int) -> Case:
    nominal = np.array([1.0, 1.5, 0.2, 0.8])
    model = FromFunction(_saturating, nominal)
    u = rng.uniform(-1.5, 1.5, (count + 20, 2))
    theta = nominal * (1.0 + 0.2 * rng.normal(size=4))
    noise = 10.0 ** rng.uniform(-3, -1.7)
    y = model.predict(u, theta) + noise * rng.normal(size=(count + 20, 2))
    return Case(u[:count], y[:count], {"model": model}, noise, (u[count:], y[count:]))


def ur5(rng: np.random.Generator, count: int) -> Case:
    import ur5 as real

    joints, measured = real.load("ur5_grid_1000.csv")
    at = rng.choice(len(joints), count + 20, replace=False)
    u, y = joints[at], measured[at]
    return Case(
        u[:count], y[:count], {"model": real.arm()}, 0.1, (u[count:], y[count:])
    )


def _of_poses(arm: Any, table: Array, rng: np.random.Generator, count: int) -> Case:
    """A case of an arm whose readings are zero where the pose is as it should be."""
    drawn = table[rng.choice(len(table), count + 20, replace=False)]
    zeros = np.zeros((len(drawn), 6))
    rest = drawn[count:], zeros[count:]
    return Case(drawn[:count], zeros[:count], {"model": arm}, 1e-3, rest)


def fr3(rng: np.random.Generator, count: int) -> Case:
    import fr3 as real

    return _of_poses(real.arm(), real.load(), rng, count)


def positioner(rng: np.random.Generator, count: int) -> Case:
    import positioner as real

    return _of_poses(real.arm(), real.load(), rng, count)


MODELS: dict[str, Callable[[np.random.Generator, int], Case]] = {
    "affine": affine,
    "curved": curved,
    "nonlinear": nonlinear,
    "ur5": ur5,
    "fr3": fr3,
    "positioner": positioner,
}

# -- spoiling -------------------------------------------------------------------------


def _split(case: Case) -> tuple[Array, Array, Callable[[Array], tuple[Array, Array]]]:
    """What was commanded, what was read, and a table of both again."""
    sensed = _sensed(case)
    if sensed is None:
        return case.commands, case.measured, lambda y: (case.commands, y)
    read = case.commands[:, sensed]

    def table(y: Array) -> tuple[Array, Array]:
        u = case.commands.copy()
        u[:, sensed] = y
        return u, case.measured

    return case.commands, read, table


def _sensed(case: Case) -> slice | None:
    model = case.options.get("model")
    sensed = slice(0, 0) if model is None else model.fitting.sensed
    return sensed if sensed.stop > sensed.start else None


def _spare(case: Case) -> Array:
    sensed = _sensed(case)
    return case.spare[1] if sensed is None else case.spare[0][:, sensed]


Spoilt = tuple[Array, Array, str]  # table, and a pattern of what is said


def _at(rng: np.random.Generator, count: int) -> int:
    return int(rng.integers(4, count - 4))


def _near(row: int) -> str:
    return "|".join(str(r) for r in (row - 1, row, row + 1))


def lost(case: Case, rng: np.random.Generator) -> Spoilt:
    _, y, table = _split(case)
    k = _at(rng, len(y))
    end = _spare(case)[:1]
    y = np.vstack([np.delete(y, k, axis=0), end])
    return (*table(y), rf"row ({_near(k)})\b.*one row early")


def lost_short(case: Case, rng: np.random.Generator) -> Spoilt:
    _, y, table = _split(case)
    k = _at(rng, len(y))
    commands, measured = table(np.vstack([np.delete(y, k, axis=0), y[-1:]]))
    return commands[:-1], measured[:-1], rf"row ({_near(k)})\b.*one row early"


def doubled(case: Case, rng: np.random.Generator) -> Spoilt:
    _, y, table = _split(case)
    k = _at(rng, len(y))
    y = np.insert(y, k, y[k], axis=0)[:-1]
    return (*table(y), rf"row ({_near(k)}|{k + 2})\b.*one row late")


def shift(case: Case, rng: np.random.Generator) -> Spoilt:
    _, y, table = _split(case)
    by = int(rng.choice([-3, -2, -1, 1, 2, 3]))
    rows = "one row" if abs(by) == 1 else f"{abs(by)} rows"
    # np.roll(y, by): the reading of row i stands in row i + by, late by by
    return (
        *table(np.roll(y, by, axis=0)),
        rf"all readings are {rows} " + ("late" if by > 0 else "early"),
    )


def halves(case: Case, rng: np.random.Generator) -> Spoilt:
    _, y, table = _split(case)
    h = len(y) // 2
    return (*table(np.vstack([y[h:], y[:h]])), "halves")


def order(case: Case, rng: np.random.Generator) -> Spoilt:
    _, y, table = _split(case)
    return (*table(y[::-1]), "reverse order")


def commands_sorted(case: Case, rng: np.random.Generator) -> Spoilt:
    u, y, table = _split(case)
    moved = np.argsort(u[:, 0], kind="stable")
    commands, measured = table(y)
    sensed, kept = _sensed(case), commands
    commands = commands[moved]
    if sensed is not None:
        commands[:, sensed] = kept[:, sensed]
    return commands, measured, "commands are sorted"


def readings_sorted(case: Case, rng: np.random.Generator) -> Spoilt:
    _, y, table = _split(case)
    return (*table(y[np.argsort(y[:, 0], kind="stable")]), "readings are sorted")


def block(case: Case, rng: np.random.Generator) -> Spoilt:
    _, y, table = _split(case)
    width = int(rng.integers(4, max(5, len(y) // 4) + 1))
    k = int(rng.integers(2, len(y) - width - 2))
    y = y.copy()
    y[k : k + width] = _spare(case)[:width]
    return (*table(y), rf"row ({_near(k)})\b.* to .*do not belong")


def sessions(case: Case, rng: np.random.Generator) -> Spoilt:
    _, y, table = _split(case)
    k = int(rng.integers(5, len(y) - 5))
    y = y.copy()
    step = np.zeros(y.shape[1])
    wide = y.std(axis=0)[:3]
    step[: len(wide)] = 0.5 * wide * rng.choice([-1, 1], len(wide))
    y[k:] += step
    return (*table(y), rf"two sessions.*row ({_near(k)})\b")


def lag(case: Case, rng: np.random.Generator) -> Spoilt:
    """Readings late by a constant, as of a recording."""
    _, y, table = _split(case)
    by = int(rng.integers(4, 8))
    return (
        *table(np.roll(y, by, axis=0)),
        rf"all readings are {by} rows late|rotation|first commands",
    )


ROWS = {
    "lost": lost,
    "lost, short": lost_short,
    "doubled": doubled,
    "shift": shift,
    "halves": halves,
    "reversed": order,
    "commands sorted": commands_sorted,
    "readings sorted": readings_sorted,
    "block": block,
    "sessions": sessions,
    "lag": lag,
}


def columns_exchanged(case: Case, rng: np.random.Generator) -> Spoilt:
    u = case.commands.copy()
    i, j = sorted(rng.choice(_moved(case), 2, replace=False).tolist())
    u[:, [i, j]] = u[:, [j, i]]
    return u, case.measured, rf"{_name(case, i)} and {_name(case, j)} .*exchanged"


def column_sign(case: Case, rng: np.random.Generator) -> Spoilt:
    u = case.commands.copy()
    i = int(rng.integers(_moved(case)))
    u[:, i] *= -1
    return u, case.measured, rf"{_name(case, i)} (has|seems).*(other sign|reversed)"


def column_unit(case: Case, rng: np.random.Generator) -> Spoilt:
    u = case.commands.copy()
    i = int(rng.integers(_moved(case)))
    u[:, i] *= np.pi / 180
    return u, case.measured, rf"{_name(case, i)} is in radians"


COLUMNS = {
    "exchanged": columns_exchanged, "sign": column_sign, "unit": column_unit,
}  # fmt: skip


def _moved(case: Case) -> int:
    model = case.options.get("model")
    width = case.commands.shape[1]
    return (
        width if model is None else width - len(np.arange(width)[model.fitting.sensed])
    )


def _name(case: Case, i: int) -> str:
    model = case.options.get("model")
    inputs = getattr(model, "inputs", ())
    name = "u_" + "xyz"[i] if case.commands.shape[1] == 3 else f"u_{i + 1}"
    return f"({inputs[i]}|{name})" if inputs else name  # as refused, or as fitted


# -- right tables ---------------------------------------------------------------------


def right(rng: np.random.Generator, count: int) -> tuple[str, Case]:
    """A right table of some kind."""
    n, m = rng.integers(1, 4), rng.integers(1, 4)
    kind = str(rng.choice([
        "plain", "heteroscedastic", "outliers", "drift", "curve", "tiny", "replicated",
        "swept", "swept curve", "random walk", "heavy tails", "quantised", "kink",
        "noise alone", "grid", "backlash",
    ]))  # fmt: skip
    if kind == "tiny":
        count = int(rng.integers(n + 1, n + 6))
    u = _commands(rng, count, n)
    if kind in ("swept", "swept curve", "backlash"):
        u = np.linspace(-1, 1, count)[:, None] * rng.normal(size=n) + 0.0
        if kind != "swept" or rng.random() < 0.5:
            phase = rng.uniform(0, 6, n)
            u = np.sin(np.linspace(0, rng.uniform(3, 20), count)[:, None] + phase)
        if n > 1:
            u = u + 0.1 * rng.normal(size=u.shape)
    if kind == "grid":
        u = np.stack(np.meshgrid(*[np.linspace(-1, 1, 4)] * n), -1).reshape(-1, n)
        count = len(u)
    if kind == "replicated":
        u = np.repeat(u[: max(count // 3, n + 2)], 3, axis=0)
        count = len(u)
    matrix = rng.normal(size=(m, n)) + np.eye(m, n)
    noise = 10.0 ** rng.uniform(-3, -0.5)
    e = rng.normal(size=(count, m))
    if kind == "heavy tails":
        e = rng.standard_t(2, (count, m))
    if kind == "heteroscedastic":
        e *= (0.1 + 2 * np.abs(u[:, :1])) ** 2
    y = u @ matrix.T + noise * e
    t = np.linspace(0, 1, count)[:, None]
    size = rng.uniform(0.05, 1.0)
    if kind == "outliers":
        at = rng.random(count) < 0.1
        y[at] += 3 * rng.normal(size=(at.sum(), m))
    if kind == "drift":
        y += size * t ** rng.choice([1, 2]) * rng.normal(size=m)
    if kind == "random walk":
        y += size * np.cumsum(rng.normal(size=(count, m)), axis=0) / np.sqrt(count)
    if kind in ("curve", "swept curve"):
        y += size * u[:, :1] ** 2 * rng.normal(size=m) + 0.5 * size * np.sin(
            3 * u[:, :1]
        )
    if kind == "kink":
        y += size * np.abs(u[:, :1] - 0.2) * rng.normal(size=m)
    if kind == "quantised":
        y = np.round(y / 0.2) * 0.2
    if kind == "noise alone":
        y = e
    if kind == "backlash":
        way = np.sign(np.gradient(u[:, 0])) if count > 1 else np.ones(count)
        y += 0.2 * size * way[:, None]
    return kind, Case(u, y, {}, noise, (u, y))


def _told(case: Case, u: Array, y: Array, checked: bool) -> tuple[str, float]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if checked:
            fit = jaxcal.identify(case.commands, case.measured, **case.options)
            begin = time.perf_counter()
            found = of_new_readings(fit, u, y)
        else:
            fit = jaxcal.identify(u, y, **case.options)
            begin = time.perf_counter()
            found = mispairing(fit)
    return (found.reason if found else ""), time.perf_counter() - begin


def _excess(case: Case, u: Array, y: Array) -> float:
    """Residual of the spoilt table over that of the right one."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        size = []
        for table in ((u, y), (case.commands, case.measured)):
            fit = jaxcal.identify(*table, **case.options, loss="gaussian")
            off = np.asarray(fit.residuals)
            size.append(np.sqrt((off**2).mean(axis=0)))
    return float((size[0] / np.maximum(size[1], 1e-12)).max())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--models", default=",".join(MODELS))
    parser.add_argument("--kinds", default="", help="split by /")
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--right", type=int, default=300)
    parser.add_argument("--verbose", action="store_true")
    args = parser.parse_args()
    kinds = args.kinds.split("/") if args.kinds else [*ROWS, *COLUMNS]
    for name in filter(None, args.models.split(",")):
        for kind in kinds:
            spoil = ROWS.get(kind) or COLUMNS[kind]
            tally, times = collections.Counter(), []
            for seed in range(args.seeds):
                rng = np.random.default_rng([seed, len(name), len(kind)])
                case = MODELS[name](rng, args.count)
                if kind in COLUMNS and (name == "curved" or _moved(case) < 2):
                    continue
                try:
                    u, y, pattern = spoil(case, rng)
                    checked = kind in COLUMNS and name == "affine"
                    if not checked and _excess(case, u, y) < RATIO:
                        tally["small"] += 1
                        continue
                    said, seconds = _told(case, u, y, checked)
                except ValueError as error:  # which names the mispairing too
                    said, seconds = f"refused: {error}", 0.0
                times.append(seconds)
                result = (
                    "found"
                    if re.search(pattern, said)
                    else ("said" if said else "missed")
                )
                tally[result] += 1
                if args.verbose and result != "found":
                    print(
                        "  ",
                        seed,
                        (case.commands.shape, y.shape[1]),
                        pattern,
                        "->",
                        said,
                    )
            spent = f"{1e3 * np.median(times):.1f} ms" if times else ""
            print(f"{name:11s} {kind:16s} {dict(tally)} {spent}", flush=True)
    tally, wrong = collections.Counter(), collections.Counter()
    times = []
    for seed in range(args.right):
        rng = np.random.default_rng([seed, 77])
        kind, case = right(rng, int(rng.integers(8, 60)))
        try:
            said, seconds = _told(case, case.commands, case.measured, False)
        except ValueError:
            continue
        times.append(seconds)
        tally[kind] += 1
        if said:
            wrong[kind] += 1
            if args.verbose:
                print("  right", seed, kind, case.commands.shape, said)
    if times:
        print(
            f"right {sum(tally.values())}, false {sum(wrong.values())} {dict(wrong)}, "
            f"{1e3 * np.median(times):.1f} ms, at most {1e3 * max(times):.0f}"
        )


if __name__ == "__main__":
    main()
