"""``jaxcal score``: judge a choice made elsewhere."""

from __future__ import annotations

import argparse

from jaxcal.commands.select import add_candidates, add_output, show, whole_numbers
from jaxcal.commands.tables import read_table
from jaxcal.selection import score

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Flags of the command."""
    add_candidates(parser)
    chosen = parser.add_mutually_exclusive_group(required=True)
    chosen.add_argument(
        "--indices", type=whole_numbers, metavar="I,J", help="rows, counted from 0"
    )
    chosen.add_argument(
        "--subset",
        metavar="FILE",
        help="table with a column index, as select --csv writes it",
    )
    parser.add_argument(
        "--reference",
        choices=("bound", "exact"),
        default="bound",
        help="judge against an upper bound or the proven optimum",
    )
    parser.add_argument("--time-limit", type=float, metavar="SECONDS", help="of exact")
    add_output(parser)


def run(arguments: argparse.Namespace) -> int:
    """Judge and print."""
    table = read_table(arguments.file)
    names = table.inputs(arguments.columns)
    indices = arguments.indices
    if indices is None:
        column = read_table(arguments.subset).columns(["index"])[:, 0]
        if not (column == column.round()).all():
            raise ValueError(f"{arguments.subset}: index must hold whole numbers")
        indices = column.astype(int)
    selection = score(
        table.frame(names),
        indices,
        available=table.available(),
        num_outputs=arguments.num_outputs,
        max_replicates=None
        if arguments.max_replicates == 1
        else arguments.max_replicates,
        reference=arguments.reference,
        time_limit=arguments.time_limit,
    )
    show(selection, table, arguments)
    return 0
