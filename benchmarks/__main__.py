"""Every benchmark with its peers: ``python -m benchmarks``; ``make benchmark``.

Writes OUT/results.json, OUT/table.md and OUT/benchmark.png (and scaling.png). Rows that
were not run keep the figures that OUT/results.json already holds.
"""

from __future__ import annotations

import argparse
import datetime
import importlib
import json
import os
import pathlib
import sys
import time
from typing import Any

ROWS = (
    "steps",
    "training",
    "throughput",
    "optimum",
    "exchange",
    "blocks",
    "scenarios",
    "decision",
    "startup",
    "memory",
    "scaling",
    "records",
    "accelerator",
)


def main() -> int:
    parser = argparse.ArgumentParser(prog="benchmarks", description=__doc__)
    parser.add_argument(
        "--only", nargs="+", choices=ROWS, metavar="ROW", help=", ".join(ROWS)
    )
    parser.add_argument(
        "--quick", action="store_true", help="small sizes: shows that it runs"
    )
    parser.add_argument(
        "--train-seconds",
        type=float,
        default=600.0,
        help="what each peer of the row training may take; 600",
    )
    parser.add_argument(
        "--data",
        type=pathlib.Path,
        metavar="FOLDER",
        help="the suites' own files (.mat, .cbf) for the row records",
    )
    parser.add_argument(
        "--out", type=pathlib.Path, default=pathlib.Path("runs/benchmark")
    )
    arguments = parser.parse_args()
    # brax loads mujoco, whose optional parts announce themselves on every import.
    os.environ.setdefault("MUJOCO_GL", "disable")

    from benchmarks import report
    from benchmarks.harness import Budget, machine
    from jaxcal.files import require_writable_folder

    require_writable_folder(arguments.out)
    arguments.out.mkdir(parents=True, exist_ok=True)
    kept = arguments.out / "results.json"
    results: dict[str, Any] = json.loads(kept.read_text()) if kept.exists() else {}
    budget = Budget(arguments.quick, arguments.train_seconds, arguments.data)
    failed = 0
    for name in arguments.only or ROWS:
        module = importlib.import_module(f"benchmarks.rows.{name}")
        print(f"{name}: {module.TITLE} ...", flush=True)
        begun = time.perf_counter()
        before = machine()
        try:
            row = module.run(budget)
        except Exception as error:
            failed += 1
            print(f"{name}: failed: {type(error).__name__}: {error}", file=sys.stderr)
            continue
        results[name] = report.as_json(row) | {
            "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            "seconds": round(time.perf_counter() - begun, 1),
            "quick": budget.quick,
            "machine": before,
        }
        print(report.text(results[name]), flush=True)
        report.write(arguments.out, {n: results[n] for n in ROWS if n in results})
    print(f"saved: {arguments.out}/results.json, table.md and figures")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
