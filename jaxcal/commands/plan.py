"""``jaxcal plan``: how many measurements a wanted accuracy takes."""

from __future__ import annotations

import argparse
import dataclasses

from jaxcal.commands.select import add_candidates, add_output
from jaxcal.commands.tables import read_table, write_json, write_rows
from jaxcal.selection.plan import plan

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Flags of the command."""
    add_candidates(parser)
    parser.add_argument(
        "--accuracy",
        type=numbers,
        required=True,
        metavar="E",
        help="standard error that a prediction may have; one number or one per output",
    )
    parser.add_argument(
        "--noise",
        type=numbers,
        required=True,
        metavar="S",
        help="standard deviation of one measurement, in the same unit",
    )
    parser.add_argument(
        "--criterion",
        choices=("G", "I"),
        default="G",
        help="G: the largest standard error over the candidates; I: the average",
    )
    parser.add_argument("--max-k", type=int, metavar="K", help="most measurements")
    parser.add_argument(
        "--more", type=int, default=0, metavar="N", help="rows beyond the answer; 0"
    )
    add_output(parser)


def numbers(text: str) -> list[float]:
    """Numbers separated by commas."""
    try:
        return [float(part) for part in text.split(",") if part.strip()]
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"must be numbers separated by commas, got {text!r}"
        ) from None


def run(arguments: argparse.Namespace) -> int:
    """Plan and print."""
    table = read_table(arguments.file)
    accuracy, noise = (
        values[0] if len(values) == 1 else values
        for values in (arguments.accuracy, arguments.noise)
    )
    result = plan(
        table.columns(table.inputs(arguments.columns)),
        target_accuracy=accuracy,
        noise_std=noise,
        criterion=arguments.criterion,
        available=table.available(),
        max_replicates=arguments.max_replicates,
        num_outputs=arguments.num_outputs,
        max_k=arguments.max_k,
        more=arguments.more,
    )
    out = arguments.out
    if arguments.json or (out and out.endswith(".json")):
        document = dataclasses.asdict(result)
        write_json(out, document)
    elif arguments.csv or out:
        rows = [
            [row.k, row.num_distinct, row.standard_error.max(), row.least_error.max()]
            for row in result.rows
        ]
        write_rows(out, ("k", "distinct", "standard_error", "least_error"), rows)
    else:
        print(result.table())
        print(f"measure rows {', '.join(str(i) for i in result.indices)}")
    return 0
