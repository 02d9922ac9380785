"""``jaxcal plan``: how many measurements a wanted accuracy takes."""

from __future__ import annotations

import argparse
import dataclasses

from jaxcal.commands.select import add_design, design_of, numbers, one_or_all
from jaxcal.commands.tables import add_output, read_table, written

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Flags of the command."""
    add_design(parser, noise_needed=True)
    add = parser.add_argument
    accuracy = "standard error that a prediction may have; one number or one per output"
    add("--accuracy", type=numbers, required=True, metavar="E", help=accuracy)
    criterion = "G: the largest standard error over the candidates; I: the average"
    add("--criterion", choices=("G", "I"), default="G", help=criterion)
    add("--max-k", type=int, metavar="K", help="most measurements")
    more = "rows beyond the answer; 0"
    add("--more", type=int, default=0, metavar="N", help=more)
    add_output(parser)


def run(arguments: argparse.Namespace) -> None:
    """Plan and print."""
    result = design_of(arguments, read_table(arguments.file)).plan(
        one_or_all(arguments.accuracy),
        criterion=arguments.criterion,
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
