"""``jaxcal plan``: how many measurements a wanted accuracy takes."""

from __future__ import annotations

import argparse
import dataclasses

from jaxcal.commands.model import add_model, read_model
from jaxcal.commands.select import add_candidates, numbers
from jaxcal.commands.tables import add_output, read_table, written
from jaxcal.selection.plan import plan

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Flags of the command."""
    add_candidates(parser)
    add_model(parser)
    add = parser.add_argument
    accuracy = "standard error that a prediction may have; one number or one per output"
    add("--accuracy", type=numbers, required=True, metavar="E", help=accuracy)
    noise = "standard deviation of one measurement, in the same unit"
    add("--noise", type=numbers, required=True, metavar="S", help=noise)
    criterion = "G: the largest standard error over the candidates; I: the average"
    add("--criterion", choices=("G", "I"), default="G", help=criterion)
    add("--max-k", type=int, metavar="K", help="most measurements")
    more = "rows beyond the answer; 0"
    add("--more", type=int, default=0, metavar="N", help=more)
    add_output(parser)


def run(arguments: argparse.Namespace) -> None:
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
        model=read_model(arguments.model),
        criterion=arguments.criterion,
        available=table.available(),
        max_replicates=arguments.max_replicates,
        num_outputs=arguments.num_outputs,
        max_k=arguments.max_k,
        more=arguments.more,
    )
    header = ("k", "distinct", "standard_error", "least_error")
    rows = [
        [row.k, row.num_distinct, row.standard_error.max(), row.least_error.max()]
        for row in result.rows
    ]
    if not written(arguments, header, rows, dataclasses.asdict(result)):
        print(result.table())
        print(f"measure rows {', '.join(str(i) for i in result.indices)}")
