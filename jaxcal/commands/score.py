"""``jaxcal score``: judge a choice made elsewhere."""

from __future__ import annotations

import argparse

from jaxcal.commands.select import (
    add_criterion,
    add_design,
    criterion_of,
    design_of,
    show,
    whole_numbers,
)
from jaxcal.commands.tables import add_output, read_table

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Flags of the command."""
    add_design(parser)
    add_criterion(parser)
    chosen = parser.add_mutually_exclusive_group(required=True)
    indices = "rows, counted from 0"
    chosen.add_argument("--indices", type=whole_numbers, metavar="I,J", help=indices)
    subset = "table with a column index, as select --csv writes it"
    chosen.add_argument("--subset", metavar="FILE", help=subset)
    parser.add_argument(
        "--reference",
        choices=("bound", "exact"),
        default="bound",
        help="judge against an upper bound or the proven optimum",
    )
    parser.add_argument("--time-limit", type=float, metavar="SECONDS", help="of exact")
    add_output(parser)


def run(arguments: argparse.Namespace) -> None:
    """Judge and print."""
    table = read_table(arguments.file)
    indices = arguments.indices
    if indices is None:
        if set(arguments.subset) <= set("0123456789, "):
            raise ValueError(
                f"--subset must be a file, got {arguments.subset!r}; rows by their "
                f"numbers are --indices {arguments.subset}"
            )
        column = read_table(arguments.subset).columns(["index"])[:, 0]
        if not (column == column.round()).all():
            raise ValueError(f"{arguments.subset}: index must hold whole numbers")
        indices = column.astype(int)
    selection = design_of(arguments, table).score(
        indices,
        criterion_of(arguments),
        reference=arguments.reference,
        time_limit=arguments.time_limit,
    )
    show(selection, table, arguments)
